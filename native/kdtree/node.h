// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <bit>
#include <cstddef>
#include <cstdint>

namespace espalier {

/// Triangles are tested this many at a time, whatever the instruction set.
constexpr uint32_t kBlockSize = 8;

/// Indices of faces lie below this.
constexpr uint32_t kMaxTriangles = 1U << 28;

/// Subtrees that may wait to be opened.
constexpr uint32_t kMaxUnopened = 1U << 20;

/// What the 26 bits of a wide leaf can count, but for the numbers that stand for those.
constexpr size_t kMaxBlocks = (size_t{1} << 26) - kMaxUnopened;

/// Blocks that hold `references` triangles.
constexpr uint32_t block_count(uint32_t references) { return (references + kBlockSize - 1) / kBlockSize; }

/// A leaf of three blocks and more consists of two parts that rays may visit one without the other, and so does each
/// part: so many blocks come first. An even number, since two blocks are tested at a time.
constexpr uint32_t first_blocks(uint32_t blocks) { return (blocks / 2 + 1) / 2 * 2; }

/// Parts that a leaf, or a part of one, with so many blocks is made of, the parts of its parts among them. There are
/// fewer of them than blocks.
constexpr uint32_t part_count(uint32_t blocks) { return blocks == 0 ? 0 : (blocks + 1) / 2 * 2 - 2; }

/// A kd-tree node in 8 bytes, as in pbrt. Nodes lie depth first: the left child right behind its parent.
class KdNode {
 public:
    static KdNode inner(int axis, float split, uint32_t right_child) {
        return {std::bit_cast<uint32_t>(split), (right_child << 2) | static_cast<uint32_t>(axis)};
    }
    static KdNode leaf(uint32_t first_block, uint32_t references) { return {first_block, (references << 2) | kLeaf}; }

    bool is_leaf() const { return (tag_ & 3U) == kLeaf; }
    int axis() const { return static_cast<int>(tag_ & 3U); }
    float split() const { return std::bit_cast<float>(value_); }
    uint32_t right_child() const { return tag_ >> 2; }
    uint32_t first_block() const { return value_; }
    uint32_t references() const { return tag_ >> 2; }
    uint64_t bits() const { return (static_cast<uint64_t>(tag_) << 32) | value_; }

 private:
    static constexpr uint32_t kLeaf = 3;
    KdNode(uint32_t value, uint32_t tag) : value_(value), tag_(tag) {}
    uint32_t value_;
    uint32_t tag_;
};
static_assert(sizeof(KdNode) == 8);

/// Eight triangles in SIMD order. Lanes past the leaf's last triangle hold NaN corners and kNoTriangle.
struct alignas(32) TriangleBlock {
    float vertex[3][3][kBlockSize];  ///< [corner][axis][lane]
    uint32_t triangle[kBlockSize];   ///< index of the face in the mesh as it was given; kMaxTriangles times the block's
                                     ///< size class on top of the first
};
static_assert(sizeof(TriangleBlock) == 320);

constexpr uint32_t kNoTriangle = 0xffffffffU;

/// What the rays walk through: up to eight children with the tight boxes of what they hold, collapsed from the kd-tree.
struct alignas(64) WideNode {
    static constexpr int kWidth = 8;
    static constexpr uint32_t kLeafFlag = 0x80000000U;
    static constexpr uint32_t kMaxLeafBlocks = 32;
    /// Levels of the deepest tree: 48 of the kd-tree if each node opens but its siblings, and below it the longest
    /// leaf, kMaxBlocks halved until parts of kMaxLeafBlocks are left.
    static constexpr size_t kMostLevels = 70;

    float lower[3][kWidth];  ///< unused lanes hold an inverted box, which no ray meets
    float upper[3][kWidth];
    uint32_t child[kWidth];  ///< index of a wide node, leaf(first_block, blocks), or unopened(number)
    /// Per ray octant (bit a: direction[a] < 0) eight ranks of 3 bits, the nearest child in the highest. In the highest
    /// byte of all together one more order, the same for every octant: of how soon a child is looked through, the
    /// soonest in the last. Nodes above what is built on demand have none such.
    uint32_t order[8];
    static constexpr uint32_t kSoonestShift = 24;

    static constexpr uint32_t leaf(uint32_t first_block, uint32_t blocks) {
        return kLeafFlag | (first_block << 5) | (blocks - 1);
    }
    /// A subtree that is built when the first ray enters it (see on_demand.h). All such codes exceed all others.
    static constexpr uint32_t unopened(uint32_t number) { return leaf(static_cast<uint32_t>(kMaxBlocks) + number, 1); }
    static constexpr bool is_unopened(uint32_t child) { return child >= unopened(0); }
    static constexpr uint32_t number(uint32_t child) { return first_block(child) - static_cast<uint32_t>(kMaxBlocks); }

    static constexpr uint32_t first_block(uint32_t child) { return (child & ~kLeafFlag) >> 5; }
    static constexpr uint32_t blocks(uint32_t child) { return (child & 31U) + 1; }
};
static_assert(sizeof(WideNode) == 256);

}  // namespace espalier
