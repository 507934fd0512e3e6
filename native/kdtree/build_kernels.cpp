// SPDX-License-Identifier: GPL-3.0-or-later
#include "kdtree/build_kernels.h"

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
            if (room + node.count > input_.room_end) {
                build_elsewhere(node, references);
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
        if (right_begin != begin && right_room + right.node.count > input_.room_end) {
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

    /// For scenes whose every plane leaves nearly all references on one side, or on both.
    void build_elsewhere(const OpenNode& node, const References& references) {
        const ReferenceBuffer buffer(subtree_room(node.count));
        copy_references(references, node.count, buffer.references());
        const SubtreeInput input{input_.soup, input_.parameters, input_.cancel,    nullptr, buffer.references(),
                                 0,           node.count,        buffer.capacity()};
        SubtreeBuilder(input, output_).build(node, input.begin, input.room);
    }

    const SubtreeInput& input_;
    SubtreeOutput& output_;
    SplitSearch search_{*input_.parameters};
    CarefulNode careful_node_{input_, search_, output_};
    std::vector<Waiting*> waiting_;  ///< from the root down
};

void build_subtree(const SubtreeInput& input, const OpenNode& node, SubtreeOutput& output) {
    SubtreeBuilder(input, output).build(node, input.begin, input.room);
}

Split find_split(const OpenNode& node, const References& references, const BuildParameters& parameters) {
    return SplitSearch(parameters)(node, references);
}

constexpr BuildKernels kKernels{make_references, count_bins, count_bins_along, choose_split, choose_finer_split,
                                find_split,      partition,  build_subtree,    write_blocks};

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace espalier {

const BuildKernels& build_kernels() {
    switch (simd_target()) {
#if defined(__x86_64__)
        case HWY_AVX3_DL:
            return N_AVX3_DL::kKernels;
        case HWY_AVX2:
            return N_AVX2::kKernels;
        default:
            return N_SSE4::kKernels;
#else
        default:
            return N_NEON::kKernels;
#endif
    }
}

}  // namespace espalier
#endif
