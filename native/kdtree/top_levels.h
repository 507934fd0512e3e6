// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <deque>
#include <mutex>
#include <vector>

#include "kdtree/build_kernels.h"

namespace espalier {

/// A run of a node's references in shared memory. A node of the top levels is a list of them, in order.
struct Segment {
    References references;
    uint32_t count;
    uint32_t capacity;
};

/// Memory for segments, handed out to any thread.
class SegmentMemory {
 public:
    explicit SegmentMemory(ReferenceBuffer first) { buffers_.push_back(std::move(first)); }
    References take(uint32_t count);
    ReferenceBuffer& first() { return buffers_.front(); }
    /// References of the first buffer that were handed out: all of them if there is another one.
    size_t used() const { return buffers_.size() == 1 ? used_ : buffers_.front().capacity(); }
    LargeBuffer<uint32_t> take_memory() { return buffers_.front().take_memory(); }

 private:
    std::mutex mutex_;
    std::deque<ReferenceBuffer> buffers_;
    size_t used_ = 0;  ///< of the last buffer
};

/// A node of the top of the tree: split further, or the root of a subtree.
struct TopNode {
    OpenNode node;
    Split split;
    uint32_t left = 0;  ///< index among the top nodes, if split
    uint32_t right = 0;
    std::vector<Segment> segments;

    bool is_split() const { return split.axis >= 0; }
};

/// Copies a node's references into one piece.
void gather(const TopNode& node, const References& to);

/// References in one piece of memory, and how many of its places are in use.
struct UsedReferences {
    const ReferenceBuffer& buffer;
    size_t used;
};

/// Phases 1 and 2: the references and the top of the tree, all threads on one level at a time.
class TopLevels {
 public:
    /// memory: if any, its front, of at least reference_bytes, holds the references and those of subtrees, and later
    /// the blocks; behind it lies what subtrees take for themselves, whose huge pages are taken too, if few.
    TopLevels(const TriangleSoup& soup, const BuildParameters& parameters, const std::atomic<bool>* cancel, int threads,
              BuildMemory* memory = nullptr);

    /// What references take at the front of a memory.
    static size_t reference_bytes(uint32_t triangles, int threads);

    /// Phase 1: boxes of all faces that can be hit. Those of a large scene are sorted as they are made by the leaves of
    /// a multiway split, so that they go through memory once.
    void make_references();
    /// Phase 2: splits every node of more than `cut` references, breadth first, but for a large scene's.
    void split_above(uint32_t cut);

    const std::vector<TopNode>& nodes() const { return nodes_; }
    const RejectedFaces& rejected() const { return rejected_; }
    /// Where most or all references are.
    UsedReferences memory() { return {memory_.first(), memory_.used()}; }
    /// Gives away the memory of the references, for when they are no longer needed.
    LargeBuffer<uint32_t> take_memory() { return memory_.take_memory(); }
    /// The root, if it is split several levels at once, or null.
    const SortedNode* sorted_root() const { return root_.split.leaves > 1 ? &root_ : nullptr; }

 private:
    struct Part {
        uint32_t node;
        uint32_t segment;
    };
    size_t pages_behind() const;
    size_t pages_of_references() const;
    /// Of the memory that is usually needed.
    size_t page_count() const { return pages_of_references() + pages_behind(); }
    void take_page(size_t page);
    bool sort_root();
    Box3f bound_vertices() const;
    MultiwaySplit choose_multiway_split(const Box3f& bounds, size_t pages);
    void sort_faces();
    uint32_t add_nodes(uint32_t child, const Box3f& cell, int depth);
    std::vector<Part> parts_of(const std::vector<uint32_t>& nodes) const;
    void choose_splits(const std::vector<uint32_t>& level, const std::vector<Part>& parts);
    /// Counts the references of each part, all threads together.
    template <class F>
    void count_parts(const std::vector<Part>& parts, const F& count);
    /// Calls choose(node, sum of its parts' counts) for each node of a level.
    template <class F>
    void for_each_node(const std::vector<uint32_t>& level, const F& choose);
    std::vector<uint32_t> open_level(const std::vector<uint32_t>& level, const std::vector<Part>& parts);
    Partition partition_segment(const TopNode& node, const Segment& segment, const References& scratch, Segment& left,
                                Segment& right);

    const TriangleSoup& soup_;
    const BuildParameters& parameters_;
    const std::atomic<bool>* cancel_;
    const int threads_;
    const BuildKernels& kernels_;
    const bool is_large_;  ///< whether the root is split several levels at once, if it can be
    const uint32_t segment_size_;
    BuildMemory* const build_memory_;
    SegmentMemory memory_;
    ReferenceBuffer& first_places_;  ///< of that; others may be added while this one is used
    const size_t words_in_use_;      ///< of those, usually
    SortedNode root_;                ///< of one leaf, if the scene is not sorted
    std::vector<TopNode> nodes_;
    std::vector<BinCounts> counts_;    ///< per part
    std::vector<References> scratch_;  ///< per thread
    RejectedFaces rejected_;
};

/// What the triangle blocks of all but strange trees stay below: the memory of the references becomes theirs.
inline size_t most_block_bytes(uint32_t triangles) { return size_t{160} * triangles; }
/// What they usually take.
inline size_t usual_block_bytes(uint32_t triangles) { return size_t{72} * triangles; }

/// Room for the splits of the whole tree to add references, however hostile the scene: 6 for each triangle.
inline uint64_t spare_references(uint32_t triangles) { return uint64_t{6} * triangles + 1024; }

}  // namespace espalier
