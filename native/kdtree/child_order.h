// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>

#include "geometry/vec.h"
#include "kdtree/node.h"

namespace espalier {

/// Surface area of a box of this size, halved.
inline float half_area(Vec3f size) { return size.x * size.y + size.y * size.z + size.z * size.x; }
inline float half_area(const Box3f& box) { return half_area(box.size()); }

inline void set_box(WideNode& node, size_t slot, const Box3f& box) {
    for (int axis = 0; axis < 3; ++axis) {
        node.lower[axis][slot] = box.lower[axis];
        node.upper[axis][slot] = box.upper[axis];
    }
}

/// Where any hit will do, what is looked through soonest comes first (as Nah and Manocha 2014 take the largest surface
/// first): a leaf by its blocks, and behind all leaves a wide node by how many it and those below it are. Places that
/// are not used cost most.
class ChildCosts {
 public:
    ChildCosts() {
        for (size_t slot = 0; slot < WideNode::kWidth; ++slot) {
            keys_[slot] = INT32_MAX - static_cast<int32_t>(slot);
        }
    }

    void set_leaf(size_t slot, uint32_t blocks) { set(slot, blocks); }
    void set_nodes(size_t slot, uint32_t count) { set(slot, WideNode::kMaxLeafBlocks + count); }

    /// Adds the order to a node that has its orders by octant.
    void write(WideNode& node) const {
        std::array<int32_t, WideNode::kWidth> ranks{};
        for (size_t other = 0; other < WideNode::kWidth; ++other) {
            for (size_t slot = 0; slot < WideNode::kWidth; ++slot) {  // a vector operation, as the compiler does it
                ranks[slot] += keys_[other] > keys_[slot] ? 1 : 0;
            }
        }
        for (size_t slot = 0; slot < WideNode::kWidth; ++slot) {
            node.order[ranks[slot]] |= static_cast<uint32_t>(slot) << WideNode::kSoonestShift;
        }
    }

 private:
    /// No two are equal. There are fewer wide nodes than the 2^26 blocks that leaves can count: but for a root alone,
    /// each has two children or more.
    void set(size_t slot, uint32_t cost) { keys_[slot] = static_cast<int32_t>(cost << 3 | slot); }

    std::array<int32_t, WideNode::kWidth> keys_;
};

/// In which order rays of each octant meet the children of a wide node, while it opens from one to eight of them.
class ChildOrder {
 public:
    /// A child gives way to two: the one below a plane of `axis` takes its slot, the other slot `added`. The near one
    /// comes first in each octant, and everything nearer moves up by one.
    void split(int axis, size_t slot, size_t added) {
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

    /// Fills in the orders of a node that has so many children, and its other places: where there are none, no ray
    /// gets.
    void write(size_t children, WideNode& node) const {
        for (size_t slot = children; slot < WideNode::kWidth; ++slot) {
            set_box(node, slot, {});
            node.child[slot] = WideNode::leaf(0, 1);
        }
        // Unused slots come first, that is farthest: no ray meets them, but each slot has to appear once.
        const size_t unused = WideNode::kWidth - children;
        uint32_t farthest = 0;
        for (size_t i = 0; i < unused; ++i) {
            farthest |= static_cast<uint32_t>(children + i) << (3 * i);
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
