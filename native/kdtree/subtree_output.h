// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <hwy/base.h>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <span>
#include <stdexcept>
#include <vector>

#include "geometry/vec.h"
#include "kdtree/large_buffer.h"
#include "kdtree/node.h"
#include "kdtree/open_node.h"
#include "kdtree/tree_piece.h"

namespace espalier {

/// A right child that another thread builds: what it makes belongs between the nodes before `node` and those from there
/// on, and its triangles likewise.
struct Gap {
    size_t inner;  ///< index of the parent
    size_t node;
    size_t triangle;
    uint32_t subtree;  ///< which belongs there
};

/// The subtrees that one thread builds: nodes depth first, the tight box of each, and the triangles of the leaves in
/// whole blocks, with as many boxes for parts of leaves. Child and block indices count from the beginning of these
/// arrays. All lie in one piece of memory, so that small trees touch few pages. What is called for every node is
/// inlined by force (see build_kernels.h).
class SubtreeOutput {
 public:
    SubtreeOutput() = default;
    /// With room for what so many triangles usually become, in `memory` if there is one.
    explicit SubtreeOutput(size_t triangles, BuildMemory* memory = nullptr) {
        reserve(triangles / 5 + 64, 5 * triangles / 2 / kBlockSize * kBlockSize + 1024, memory);
    }

    size_t node_count() const { return node_count_; }
    size_t triangle_count() const { return triangle_count_; }
    std::span<const KdNode> nodes() const { return {nodes_, node_count_}; }
    std::span<const uint32_t> triangles() const { return {triangles_, triangle_count_}; }
    /// What lies between these counts of nodes and triangles, which have those places in the finished tree.
    TreePiece piece(size_t node, size_t node_end, size_t triangle, size_t triangle_end, size_t node_place,
                    size_t block_place) const {
        return {static_cast<uint32_t>(node_place),
                static_cast<uint32_t>(block_place),
                {boxes_ + node, node_end - node},
                {part_boxes_ + triangle / kBlockSize, (triangle_end - triangle) / kBlockSize},
                {triangles_ + triangle, triangle_end - triangle}};
    }
    /// All of it, where that is the whole tree.
    TreePiece whole() const { return piece(0, node_count_, 0, triangle_count_, 0, 0); }

    /// Takes the place of an inner node, before its left child is written; returns its index.
    HWY_INLINE size_t open_inner() {
        if (node_count_ == node_limit_) {
            make_node_room();
        }
        return node_count_++;
    }
    /// Fills it in when both children are there.
    HWY_INLINE void close_inner(size_t index, Split split, size_t right_child) {
        nodes_[index] = KdNode::inner(split.axis, split.position, static_cast<uint32_t>(right_child));
        Box3f box = boxes_[index + 1];
        box.extend(boxes_[right_child]);
        boxes_[index] = box;
    }
    /// The same where the right child, which would come next, is built elsewhere. The box lacks it.
    void close_inner_with_gap(size_t index, Split split, uint32_t subtree) {
        nodes_[index] = KdNode::inner(split.axis, split.position, static_cast<uint32_t>(node_count_));
        boxes_[index] = boxes_[index + 1];
        gaps_.push_back({index, node_count_, triangle_count_, subtree});
    }
    const std::vector<Gap>& gaps() const { return gaps_; }
    /// What a new leaf leaves to be filled in.
    struct Leaf {
        uint32_t* triangles;  ///< of which the last block is padded with kNoTriangle
        Box3f* part_boxes;
        Box3f* box;
    };
    HWY_INLINE Leaf add_leaf(uint32_t references) {
        const size_t index = open_inner();
        const size_t first = triangle_count_;
        const size_t room = size_t{block_count(references)} * kBlockSize;
        if (first + room > triangle_limit_) {
            make_triangle_room(first + room);
        }
        nodes_[index] = KdNode::leaf(static_cast<uint32_t>(first / kBlockSize), references);
        triangle_count_ += room;
        std::fill(triangles_ + first + references, triangles_ + triangle_count_, kNoTriangle);
        return {triangles_ + first, part_boxes_ + first / kBlockSize, boxes_ + index};
    }
    /// Appends a leaf of these triangles, whose parts are not told apart.
    HWY_INLINE void add_leaf(std::span<const uint32_t> triangles, const Box3f& box) {
        const auto count = static_cast<uint32_t>(triangles.size());
        const Leaf leaf = add_leaf(count);
        std::copy(triangles.begin(), triangles.end(), leaf.triangles);
        std::fill_n(leaf.part_boxes, block_count(count), box);
        *leaf.box = box;
    }
    /// Takes back what was appended since the counts were these.
    HWY_INLINE void rewind(size_t nodes, size_t triangles) {
        node_count_ = nodes;
        triangle_count_ = triangles;
    }

 private:
    // Pages are taken for so many nodes and triangles at a time.
    static constexpr size_t kNodeStretch = 4096;
    static constexpr size_t kTriangleStretch = 2048 * kBlockSize;

    HWY_NOINLINE void make_node_room() {
        if (node_count_ == node_capacity_) {
            reserve(2 * node_capacity_ + 64, triangle_capacity_);
        }
        node_limit_ = std::min(node_capacity_, node_count_ + kNodeStretch);
        take_pages(nodes_ + node_count_, nodes_ + node_limit_);
        take_pages(boxes_ + node_count_, boxes_ + node_limit_);
    }
    HWY_NOINLINE void make_triangle_room(size_t end) {
        if (end > triangle_capacity_) {
            if (triangle_count_ / kBlockSize > kMaxBlocks) {
                throw std::length_error("the tree needs more triangle blocks than its indices can count");
            }
            reserve(node_capacity_, 2 * end);
        }
        triangle_limit_ = std::min(triangle_capacity_, std::max(end, triangle_count_ + kTriangleStretch));
        take_pages(triangles_ + triangle_count_, triangles_ + triangle_limit_);
        take_pages(part_boxes_ + triangle_count_ / kBlockSize, part_boxes_ + triangle_limit_ / kBlockSize);
    }

    void reserve(size_t nodes, size_t triangles, BuildMemory* shared = nullptr) {
        const size_t blocks = triangles / kBlockSize;
        const size_t bytes =
            nodes * (sizeof(KdNode) + sizeof(Box3f)) + blocks * (kBlockSize * sizeof(uint32_t) + sizeof(Box3f));
        // What has grown is twice as large as it had to be.
        auto memory = shared != nullptr ? shared->take<std::byte>(bytes) : LargeBuffer<std::byte>(bytes, bytes / 2);
        auto* new_nodes = reinterpret_cast<KdNode*>(memory.data());
        auto* new_boxes = reinterpret_cast<Box3f*>(new_nodes + nodes);
        auto* new_part_boxes = new_boxes + nodes;
        auto* new_triangles = reinterpret_cast<uint32_t*>(new_part_boxes + blocks);
        std::copy_n(nodes_, node_count_, new_nodes);
        std::copy_n(boxes_, node_count_, new_boxes);
        std::copy_n(part_boxes_, triangle_count_ / kBlockSize, new_part_boxes);
        std::copy_n(triangles_, triangle_count_, new_triangles);
        nodes_ = new_nodes;
        boxes_ = new_boxes;
        part_boxes_ = new_part_boxes;
        triangles_ = new_triangles;
        node_capacity_ = nodes;
        node_limit_ = node_count_;
        triangle_capacity_ = triangles;
        triangle_limit_ = triangle_count_;
        memory_ = std::move(memory);
    }

    KdNode* nodes_ = nullptr;
    Box3f* boxes_ = nullptr;
    Box3f* part_boxes_ = nullptr;
    uint32_t* triangles_ = nullptr;
    size_t node_count_ = 0;
    size_t triangle_count_ = 0;
    size_t node_capacity_ = 0;
    size_t node_limit_ = 0;  ///< for so many, pages have been taken
    size_t triangle_capacity_ = 0;
    size_t triangle_limit_ = 0;  ///< likewise
    LargeBuffer<std::byte> memory_;
    std::vector<Gap> gaps_;
};

}  // namespace espalier
