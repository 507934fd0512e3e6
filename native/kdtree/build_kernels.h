// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <hwy/base.h>

#include <atomic>
#include <utility>

#include "kdtree/multiway_split.h"
#include "kdtree/open_node.h"
#include "kdtree/references.h"
#include "kdtree/size_class.h"
#include "kdtree/subtree_output.h"
#include "kdtree/tree.h"

namespace espalier {

/// Which planes are tried.
enum class Search {
    kSlices,       ///< those between equal slices of a node's tight box, and its ends
    kFinerSlices,  ///< those between thinner slices around the cheapest of them, too
    kEvents,       ///< the begins and ends of references' boxes around the cheapest of those, too
    kAllEvents,    ///< all begins and ends
};

/// What the quality modes differ in.
struct BuildParameters {
    SahConstants sah;
    Search search;
    bool arrange;         ///< whether the references of a leaf are sorted such that those of its parts lie together
    bool clip;            ///< whether straddlers' boxes are cut to the part of the triangle on each side
    uint32_t small_node;  ///< a node of at most so many references is finished as bit masks (see small_node-inl.h)
    uint32_t one_thread;  ///< a node of at most so many references is left to one thread, which may try its events

    bool is_careful() const { return search == Search::kEvents || search == Search::kAllEvents; }
};

/// Along each axis the planes between so many slices of a node's tight box are tried, and both its ends: as many planes
/// as the widest vector has lanes.
constexpr int kSlices = 15;
constexpr int kPlanes = kSlices + 1;

/// Whether a node is split several levels at once (see multiway_split.h). Only where each of its references may be
/// split.
HWY_INLINE bool is_multiway(const OpenNode& node, const BuildParameters& parameters) {
    return node.count >= kMultiwayFrom && node.spare >= node.count && parameters.search == Search::kFinerSlices;
}

/// Whether the root is to be split so, too, before there are references at all.
inline bool is_large(const TriangleSoup& soup, const BuildParameters& parameters) {
    return soup.size() >= kMultiwayFrom && parameters.search == Search::kFinerSlices;
}

/// References that begin before plane j, and that end before it, per axis, for the planes between slices. Counts add up
/// over parts of a node. There is room for both ends of the node's tight box.
struct BinCounts {
    alignas(64) uint32_t left[3][kPlanes];
    alignas(64) uint32_t ends_before[3][kPlanes];
};

struct Interval {
    float lower, upper;
};

struct Partition {
    uint32_t left_count = 0;
    uint32_t right_count = 0;
    Box3f left_tight;
    Box3f right_tight;
};

/// Where a thread that builds a subtree may give part of it to threads that have nothing to do.
class SubtreeSharing {
 public:
    static constexpr uint32_t kNotGiven = 0xffffffffU;

    virtual ~SubtreeSharing() = default;
    bool is_wanted() const { return idle_.load(std::memory_order_relaxed) > 0; }
    /// Takes over a node and a copy of its references; returns the number of the new subtree, or kNotGiven where there
    /// is no room for it.
    virtual uint32_t give(const OpenNode& node, const References& references) = 0;

 protected:
    std::atomic<int> idle_{0};  ///< threads that wait for a subtree
};

/// What one thread needs while it builds a subtree.
struct SubtreeInput {
    const TriangleSoup* soup;
    const BuildParameters* parameters;
    const std::atomic<bool>* cancel;
    SubtreeSharing* sharing;   ///< null where one thread builds alone
    const SortedNode* sorted;  ///< the node, if it is split several levels at once already
    References references;
    size_t begin;     ///< place of the node's own among them
    size_t room;      ///< from where there is space for right children
    size_t room_end;  ///< and up to where
};

/// Room for a subtree's references, and for the right children that wait while left ones are built: rarely more than as
/// many again.
inline size_t subtree_room(uint32_t count) { return size_t{2} * count + count / 4 + 1024; }

/// Room that will do for a node that is split several levels at once, even if everything straddles every plane.
inline size_t multiway_room(uint32_t count) { return (MultiwaySplit::kMostLeaves + size_t{2}) * count; }

/// The inner loops of the builder, compiled once for each instruction set. All give the same tree bit for bit.
struct BuildKernels {
    /// Writes a reference for each valid face of [begin, end) to `out`; returns how many, extends `bounds`, counts the
    /// others.
    uint32_t (*make_references)(const TriangleSoup& soup, uint32_t begin, uint32_t end, const References& out,
                                Box3f& bounds, RejectedFaces& rejected);
    /// Of the faces of [begin, end), those that have no reference.
    RejectedFaces (*count_rejected)(const TriangleSoup& soup, uint32_t begin, uint32_t end);
    /// Adds part of a node's references to its counts.
    void (*count_bins)(const OpenNode& node, const References& references, uint32_t count, BinCounts& counts);
    /// The same for one axis and the planes that cut an interval of it.
    void (*count_bins_along)(int axis, Interval range, const References& references, uint32_t count, BinCounts& counts);
    /// The plane of least cost by the surface area heuristic, or a leaf. Fills in the counts at the ends of the tight
    /// box.
    Split (*choose_split)(const OpenNode& node, BinCounts& counts, const BuildParameters& parameters);
    /// The cheapest of a split and the planes that cut an interval around it.
    Split (*choose_finer_split)(const OpenNode& node, Split split, Interval range, const BinCounts& counts,
                                const BuildParameters& parameters);
    /// The plane that a node is split at, or a leaf: all of the above on one thread, as far as the parameters ask.
    Split (*find_split)(const OpenNode& node, const References& references, const BuildParameters& parameters);
    /// Sorts references by side, in order; those on both sides go to both. `left` may be `in` itself.
    Partition (*partition)(const TriangleSoup& soup, const References& in, uint32_t count, Split split, bool clip,
                           const References& left, const References& right);
    /// The box of those of the vertices [begin, end) that a face can have.
    Box3f (*bound_vertices)(const TriangleSoup& soup, size_t begin, size_t end);
    /// Makes references of a sample of the faces of a chunk; returns how many.
    uint32_t (*sample_faces)(const TriangleSoup& soup, uint32_t number, uint32_t shift, const References& to);
    /// The planes of several levels of a node, chosen by a sample of so many references in a room of sample_room(), of
    /// which nothing is left.
    MultiwaySplit (*choose_multiway_split)(const TriangleSoup& soup, const OpenNode& node, const References& sample,
                                           uint32_t count, const BuildParameters& parameters);
    /// Sorts a chunk of a node's references by leaves into its places; those on both sides of a plane go to both,
    /// behind the others. Returns how many places that takes, and writes to none if they are more than `capacity`.
    size_t (*sort_by_leaves)(const TriangleSoup& soup, const MultiwaySplit& split, const References& chunk,
                             uint32_t count, bool clip, const References& scratch, size_t capacity,
                             SortedChunk& sorted);
    /// Appends everything below a node to the output. Throws BuildCancelled.
    void (*build_subtree)(const SubtreeInput& input, const OpenNode& node, SubtreeOutput& output);
    /// Fills blocks from kBlockSize face indices each.
    void (*write_blocks)(const TriangleSoup& soup, SizeClasses classes, const uint32_t* triangles, size_t count,
                         TriangleBlock* blocks);
};

/// The kernels for the instruction set in use (see simd_target.h).
const BuildKernels& build_kernels();

// What the kernels call for every node is inlined by force. A call would lead from vector code to code for the base
// instruction set, and the processor takes 100 cycles and more to change over: a quarter of a whole build.

/// Shares out what a split leaves of the node's spare references, by count.
HWY_INLINE void share_spare(const OpenNode& parent, OpenNode& left, OpenNode& right) {
    const uint64_t both = uint64_t{left.count} + right.count;
    const uint64_t added = both > parent.count ? both - parent.count : 0;
    const uint64_t rest = parent.spare > added ? parent.spare - added : 0;
    left.spare = both == 0 ? 0 : rest * left.count / both;
    right.spare = rest - left.spare;
}

/// True for a plane at an end of the tight box, which has all references on one side: nothing needs to be partitioned.
HWY_INLINE bool cuts_empty_space(const OpenNode& node, Split split, Partition& parts) {
    if (split.position <= node.tight.lower[split.axis]) {
        parts = {0, node.count, {}, node.tight};
        return true;
    }
    if (split.position >= node.tight.upper[split.axis]) {
        parts = {node.count, 0, node.tight, {}};
        return true;
    }
    return false;
}

/// Whether a better plane may lie between the chosen one's neighbours, and where they are.
HWY_INLINE bool finer_range(const OpenNode& node, Split split, Interval& range) {
    if (split.axis < 0) {
        return false;
    }
    const float lower = node.tight.lower[split.axis];
    const float upper = node.tight.upper[split.axis];
    const float slice = (upper - lower) * (1.0F / kSlices);
    range = {std::max(split.position - slice, lower), std::min(split.position + slice, upper)};
    return lower < split.position && split.position < upper;
}

/// What a split leaves of a cell on both sides.
HWY_INLINE std::pair<Box3f, Box3f> halves(const Box3f& cell, Split split) {
    std::pair<Box3f, Box3f> made(cell, cell);
    made.first.upper[split.axis] = split.position;
    made.second.lower[split.axis] = split.position;
    return made;
}

/// The two nodes that a split makes of one.
HWY_INLINE void open_children(const OpenNode& parent, Split split, const Partition& parts, OpenNode& left,
                              OpenNode& right) {
    const auto [left_cell, right_cell] = halves(parent.cell, split);
    left = {left_cell, parts.left_tight, parts.left_count, 0, parent.depth + 1};
    right = {right_cell, parts.right_tight, parts.right_count, 0, parent.depth + 1};
    share_spare(parent, left, right);
}

}  // namespace espalier
