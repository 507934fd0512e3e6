// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <utility>

#include "geometry/vec.h"
#include "kdtree/large_buffer.h"
#include "kdtree/node.h"

namespace espalier {

/// Wide nodes in the order in which they are made.
class WideNodes {
 public:
    WideNodes() = default;
    /// With room for so many for now.
    WideNodes(size_t capacity, TransientMemory& memory) : nodes_(memory.take<WideNode>(capacity)) {}

    uint32_t add() {
        if (count_ == limit_) {
            make_room();
        }
        return count_++;
    }
    uint32_t count() const { return count_; }
    WideNode& operator[](size_t i) { return nodes_[i]; }
    void clear() { count_ = 0; }

 private:
    void make_room() {
        constexpr size_t kStretch = 256;  // pages are taken for so many at a time
        if (count_ == nodes_.size()) {
            LargeBuffer<WideNode> larger(2 * nodes_.size() + kStretch);
            std::copy_n(nodes_.data(), count_, larger.data());
            nodes_ = std::move(larger);
        }
        limit_ = static_cast<uint32_t>(std::min(nodes_.size(), count_ + kStretch));
        nodes_.take_pages(count_, limit_);
    }

    LargeBuffer<WideNode> nodes_;
    uint32_t count_ = 0;
    uint32_t limit_ = 0;  ///< for so many, pages have been taken
};

/// Surface area of a box, halved.
inline float half_area(const Box3f& box) {
    const Vec3f size = box.size();
    return size.x * size.y + size.y * size.z + size.z * size.x;
}

/// In which order rays of each octant meet the children of a wide node, while it opens from one to eight of them.
class ChildOrder {
 public:
    /// A child gives way to two: the one below a plane of `axis` takes its slot, the other slot `added`. The near one
    /// comes first in each octant, and everything nearer moves up by one.
    void split(int axis, int slot, int added) {
        const auto first = static_cast<uint32_t>(slot);
        const uint32_t both = first ^ static_cast<uint32_t>(added);
        for (uint32_t octant = 0; octant < 8; ++octant) {  // a vector operation each, as the compiler does it
            const uint32_t order = order_[octant];
            const uint32_t near = first ^ (both & (0U - (octant >> axis & 1U)));
            const uint32_t far = near ^ both;
            // The highest bit of the lowest nibble that equals the slot, and units of that nibble and the next.
            const uint32_t differing = order ^ (first * 0x11111111U);
            const uint32_t equal = (differing - 0x11111111U) & ~differing & 0x88888888U;
            const uint32_t found = equal & (0U - equal);
            const uint32_t unit = found >> 3;
            const uint32_t next_unit = found << 1;
            const uint32_t nearer = (order & (0U - next_unit)) << 4;
            order_[octant] = nearer | near * next_unit | far * unit | (order & (unit - 1));
        }
    }

    /// Fills in all of a node but its children: where there are none, no ray gets.
    void write(std::span<const Box3f> boxes, WideNode& node) const {
        const auto count = static_cast<int>(boxes.size());
        std::fill_n(node.child, WideNode::kWidth, WideNode::leaf(0, 1));
        for (int i = 0; i < WideNode::kWidth; ++i) {
            const Box3f box = i < count ? boxes[static_cast<size_t>(i)] : Box3f{};
            for (int axis = 0; axis < 3; ++axis) {
                node.lower[axis][i] = box.lower[axis];
                node.upper[axis][i] = box.upper[axis];
            }
        }
        // Unused slots come first, that is farthest: no ray meets them, but each slot has to appear once.
        const int unused = WideNode::kWidth - count;
        uint32_t farthest = 0;
        for (int i = 0; i < unused; ++i) {
            farthest |= static_cast<uint32_t>(count + i) << (3 * i);
        }
        for (size_t octant = 0; octant < 8; ++octant) {
            // From 4 bits each to 3: in pairs, pairs of these, and both of those.
            uint32_t slots = order_[octant];
            slots = (slots & 0x07070707U) | (slots & 0x70707070U) >> 1;
            slots = (slots & 0x003f003fU) | (slots & 0x3f003f00U) >> 2;
            slots = (slots & 0x00000fffU) | (slots & 0x0fff0000U) >> 4;
            node.order[octant] = slots << (3 * unused) | farthest;
        }
    }

 private:
    std::array<uint32_t, 8> order_{};  ///< per octant the slots, 4 bits each, the farthest lowest
};

}  // namespace espalier
