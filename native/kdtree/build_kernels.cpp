// SPDX-License-Identifier: GPL-3.0-or-later
#include "kdtree/build_kernels.h"

#include <span>
#include <utility>

#include "kdtree/simd_config.h"
#include "kdtree/simd_target.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "kdtree/build_kernels.cpp"
#include <hwy/foreach_target.h>
// Highway's own header has to follow foreach_target.h.
#include <hwy/highway.h>

#include "kdtree/binning-inl.h"
#include "kdtree/blocks-inl.h"
#include "kdtree/bounds-inl.h"
#include "kdtree/careful_node-inl.h"
#include "kdtree/multiway-inl.h"
#include "kdtree/partition-inl.h"
#include "kdtree/small_node-inl.h"
#include "kdtree/split_search-inl.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {

/// Splits one node after the other, depth first. Left children stay where their parent's references lay, right ones
/// wait behind.
class SubtreeBuilder {
 public:
    SubtreeBuilder(const SubtreeInput& input, SubtreeOutput& output) : input_(input), output_(output) {}

    /// Builds below a node whose references are sorted, none of them in the room.
    void build_sorted(const SortedNode& sorted, size_t room, size_t room_end) {
        const Room rooms[] = {{room, room_end}};
        build_below(sorted, rooms, sorted.split.root, sorted.node.cell, sorted.node.depth);
    }

    /// Builds below a node whose references begin at `begin`; from `room` on there is space for right children.
    /// is_counted: the node is its parent without empty space, and no other node was searched since.
    void build(const OpenNode& node, size_t begin, size_t room, bool is_counted = false) {
        const References references = at(begin);
        const BuildParameters& parameters = *input_.parameters;
        if (parameters.is_careful() && node.count <= CarefulNode::kCapacity) {
            careful_node_.build(node, references);
            return;
        }
        if (node.count <= parameters.small_node) {
            finish_small_node(references, node, parameters, output_);
            return;
        }
        if (input_.cancel != nullptr && input_.cancel->load(std::memory_order_relaxed)) {
            throw BuildCancelled();
        }
        if (input_.sharing != nullptr && input_.sharing->is_wanted()) {
            share();
        }
        if (is_multiway(node, parameters) && build_multiway(node, begin, room)) {
            return;
        }
        const Split split = search_(node, references, is_counted);
        if (split.axis < 0) {
            output_.add_leaf({references.triangle, node.count}, node.tight);
            return;
        }
        Partition parts;
        size_t right_begin = begin;
        size_t right_room = room;
        const bool is_same = parameters.search != Search::kAllEvents && cuts_empty_space(node, split, parts);
        if (!is_same) {
            if (room + node.count > room_end_) {
                build_elsewhere(node, references, subtree_room(node.count));
                return;
            }
            parts = partition(*input_.soup, references, node.count, split, parameters.clip, references, at(room));
            right_begin = room;
            right_room = room + parts.right_count;
        }
        OpenNode left;
        Waiting right{{}, right_begin};
        open_children(node, split, parts, left, right.node);

        const size_t index = output_.open_inner();
        waiting_.push_back(&right);
        build(left, begin, right_room, is_same);
        waiting_.pop_back();
        if (right.given != SubtreeSharing::kNotGiven) {
            output_.close_inner_with_gap(index, split, right.given);
            return;
        }
        if (right_begin != begin && right_room + right.node.count > room_end_) {
            copy_references(at(right_begin), right.node.count, references);  // the parent's place is free
            right_begin = begin;
            right_room = room;
        }
        const size_t right_child = output_.node_count();
        build(right.node, right_begin, right_room, is_same && left.count == 0);
        output_.close_inner(index, split, right_child);
    }

 private:
    static constexpr uint32_t kLeastToGive =
        CarefulNode::kCapacity + 1;  ///< references, below which giving costs more than it gains

    /// Places where nothing is any more.
    struct Room {
        size_t begin;
        size_t end;
    };

    /// A right child whose sibling is being built.
    struct Waiting {
        OpenNode node;
        size_t begin;
        uint32_t given = SubtreeSharing::kNotGiven;  ///< number of the subtree that it became
    };

    References at(size_t place) const { return input_.references.at(place); }

    /// Gives away the waiting node nearest to the root for which there is room: the largest, as a rule.
    void share() {
        for (Waiting* waiting : waiting_) {
            if (waiting->given == SubtreeSharing::kNotGiven && waiting->node.count >= kLeastToGive) {
                waiting->given = input_.sharing->give(waiting->node, at(waiting->begin));
                if (waiting->given != SubtreeSharing::kNotGiven) {
                    return;
                }
            }
        }
    }

    /// For nodes that there is no room for: where every plane leaves nearly all references on one side, or on both.
    void build_elsewhere(const OpenNode& node, const References& references, size_t capacity) {
        const ReferenceBuffer buffer(capacity);
        copy_references(references, node.count, buffer.references());
        build_in(buffer, node);
    }

    /// Builds below a node whose references lie at the beginning of a buffer.
    void build_in(const ReferenceBuffer& buffer, const OpenNode& node) {
        const SubtreeInput input{input_.soup, input_.parameters, input_.cancel,
                                 nullptr,     nullptr,           buffer.references(),
                                 0,           node.count,        buffer.capacity()};
        SubtreeBuilder(input, output_).build(node, input.begin, input.room);
    }

    /// Splits several levels of a node at once; false if the sample has no plane for that, or too much straddles its
    /// planes.
    bool build_multiway(const OpenNode& node, size_t begin, size_t room) {
        if (room + node.count > room_end_) {
            build_elsewhere(node, at(begin), multiway_room(node.count));
            return true;
        }
        SortedNode sorted;
        sorted.node = node;
        sorted.split = choose_split_of_levels(node, begin, room);
        if (sorted.split.leaves == 1) {
            return false;
        }
        const size_t end = sort_by_leaves(sorted, begin, room);
        if (end == 0) {
            build_elsewhere(node, at(begin), multiway_room(node.count));
            return true;
        }
        if (!sorted.add_up()) {
            return false;
        }
        const Room rooms[] = {{begin, begin + node.count - ReferenceBuffer::kSlack}, {end, room_end_}};
        build_below(sorted, rooms, sorted.split.root, node.cell, node.depth);
        return true;
    }

    MultiwaySplit choose_split_of_levels(const OpenNode& node, size_t begin, size_t room) const {
        const uint32_t shift = sampling_shift(node.count);
        uint32_t sampled = 0;
        for (uint32_t first = 0; first < node.count; first += kChunk) {
            sampled += take_sample(at(begin + first), std::min(kChunk, node.count - first), first / kChunk, shift,
                                   at(room + sampled));
        }
        return choose_multiway_split(*input_.soup, node, at(room), sampled, *input_.parameters);
    }

    /// Where the sorted references end; 0 if there is no room for what straddles.
    size_t sort_by_leaves(SortedNode& sorted, size_t begin, size_t room) {
        if (scratch_.references().triangle == nullptr) {
            scratch_ = ReferenceBuffer(SortedChunk::kScratch, 0);
        }
        const uint32_t count = sorted.node.count;
        uint64_t total = 0;  // what a sample that misleads may take is bounded
        for (uint32_t first = 0; first < count && total <= count + sorted.node.spare; first += kChunk) {
            SortedChunk& chunk = sorted.chunks.emplace_back();
            chunk.places = at(room);
            const size_t used = HWY_NAMESPACE::sort_by_leaves(*input_.soup, sorted.split, at(begin + first),
                                                              std::min(kChunk, count - first), input_.parameters->clip,
                                                              scratch_.references(), room_end_ - room, chunk);
            if (used > room_end_ - room) {
                return 0;
            }
            room += used;
            total += chunk.total();
        }
        return room;
    }

    void build_below(const SortedNode& sorted, std::span<const Room> rooms, uint32_t child, const Box3f& cell,
                     int depth) {
        child = sorted.skip_planes_beside(cell, child);
        if (MultiwaySplit::is_leaf(child)) {
            build_leaf(sorted, rooms, child, sorted.leaf(child, cell, depth));
            return;
        }
        const MultiwaySplit::Branch& branch = sorted.split.branch(child);
        const auto [left, right] = halves(cell, branch.split);
        const size_t index = output_.open_inner();
        build_below(sorted, rooms, branch.child[0], left, depth + 1);
        const size_t right_child = output_.node_count();
        build_below(sorted, rooms, branch.child[1], right, depth + 1);
        output_.close_inner(index, branch.split, right_child);
    }

    /// Builds a leaf of a multiway split in the first room that is large enough.
    void build_leaf(const SortedNode& sorted, std::span<const Room> rooms, uint32_t leaf, const OpenNode& node) {
        const size_t wanted = subtree_room(node.count);
        for (const Room room : rooms) {
            if (room.begin + wanted <= room.end) {
                sorted.gather(leaf, at(room.begin));
                const size_t outer_end = std::exchange(room_end_, room.end);
                build(node, room.begin, room.begin + node.count);
                room_end_ = outer_end;
                return;
            }
        }
        const ReferenceBuffer buffer(wanted);
        sorted.gather(leaf, buffer.references());
        build_in(buffer, node);
    }

    const SubtreeInput& input_;
    SubtreeOutput& output_;
    size_t room_end_ = input_.room_end;
    ReferenceBuffer scratch_;  ///< made when several levels are first split at once
    SplitSearch search_{*input_.parameters};
    CarefulNode careful_node_{input_, search_, output_};
    std::vector<Waiting*> waiting_;  ///< from the root down
};

void build_subtree(const SubtreeInput& input, const OpenNode& node, SubtreeOutput& output) {
    SubtreeBuilder builder(input, output);
    if (input.sorted != nullptr) {
        builder.build_sorted(*input.sorted, input.room, input.room_end);
    } else {
        builder.build(node, input.begin, input.room);
    }
}

Split find_split(const OpenNode& node, const References& references, const BuildParameters& parameters) {
    return SplitSearch(parameters)(node, references);
}

constexpr BuildKernels kKernels{make_references,       count_rejected, count_bins,    count_bins_along, choose_split,
                                choose_finer_split,    find_split,     partition,     bound_vertices,   sample_faces,
                                choose_multiway_split, sort_by_leaves, build_subtree, write_blocks};

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace espalier {

const BuildKernels& build_kernels() { return *ESPALIER_OF_TARGET(kKernels); }

}  // namespace espalier
#endif
