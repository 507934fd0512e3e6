// SPDX-License-Identifier: GPL-3.0-or-later
// The last references of a subtree where quality counts most: every node is searched, partitioned and clipped as large
// ones are, and what does not pay in the end is taken back. Compiled once per instruction set (see build_kernels.cpp).

#if defined(ESPALIER_KDTREE_CAREFUL_NODE_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_KDTREE_CAREFUL_NODE_INL_H_
#undef ESPALIER_KDTREE_CAREFUL_NODE_INL_H_
#else
#define ESPALIER_KDTREE_CAREFUL_NODE_INL_H_
#endif

#include <hwy/highway.h>

#include "kdtree/build_kernels.h"
#include "kdtree/leaf_parts-inl.h"
#include "kdtree/partition-inl.h"
#include "kdtree/sah-inl.h"
#include "kdtree/small_node-inl.h"
#include "kdtree/split_search-inl.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// Finishes a node that is too small to be shared by threads. Both children of a node lie behind it, so that the node
/// is still there when its split turns out not to pay.
class CarefulNode {
 public:
    static constexpr uint32_t kCapacity = 1023;

    CarefulNode(const SubtreeInput& input, SplitSearch& search, SubtreeOutput& output)
        : input_(input),
          search_(search),
          output_(output),
          traversal_cost_(static_cast<float>(input.parameters->sah.traversal)),
          block_cost_(static_cast<float>(input.parameters->sah.block)) {}

    /// Builds below a node; returns the cost of what was built, per ray that meets the cell. From `room` on there is
    /// space for its children.
    float build(const OpenNode& node, const References& references, size_t room = 0) {
        const float leaf_cost = block_cost_ * static_cast<float>(block_count(node.count));
        if (leaf_cost <= traversal_cost_) {
            write_leaf(references, node);
            return leaf_cost;
        }
        if (node.count <= input_.parameters->small_node) {
            return finish_small_node(references, node, *input_.parameters, output_);
        }
        const Split split = search_(node, references);
        if (split.axis < 0) {
            write_leaf(references, node);
            return leaf_cost;
        }
        if (children_.references().triangle == nullptr) {
            children_ = ReferenceBuffer(size_t{8} * kCapacity);  // rarely half of it is used
        }
        const size_t right_room = room + node.count + kMargin;
        if (right_room + node.count > children_.capacity()) {
            return CarefulNode(input_, search_, output_).build(node, references);
        }
        const References left_place = children_.references().at(room);
        const References right_place = children_.references().at(right_room);
        const Partition parts =
            partition(*input_.soup, references, node.count, split, input_.parameters->clip, left_place, right_place);
        OpenNode left;
        OpenNode right;
        open_children(node, split, parts, left, right);
        const size_t first_triangle = output_.triangle_count();
        const size_t index = output_.open_inner();
        const size_t next_room = right_room + right.count;
        const float left_cost = build(left, left_place, next_room);
        const size_t right_child = output_.node_count();
        const float right_cost = build(right, right_place, next_room);

        const hn::CappedTag<float, 16> d;
        const CellShape shape(node.cell);
        const SplitCosts costs(d, node, shape, input_.parameters->sah);
        const auto area = [&](const OpenNode& child) {
            return hn::GetLane(costs.relative_area(split.axis, hn::Set(d, child.cell.size()[split.axis])));
        };
        const float cost = traversal_cost_ + (area(left) * left_cost + area(right) * right_cost);
        if (leaf_cost <= cost) {
            output_.rewind(index, first_triangle);
            write_leaf(references, node);
            return leaf_cost;
        }
        output_.close_inner(index, split, right_child);
        return cost;
    }

 private:
    HWY_NOINLINE void write_leaf(const References& references, const OpenNode& node) {
        using Parts = LeafParts<4>;
        // Without parts, or, rarely, with so many references that they are left as they are.
        if (part_count(block_count(node.count)) == 0 || node.count > Parts::kCapacity) {
            output_.add_leaf({references.triangle, node.count}, node.tight);
            return;
        }
        Parts(references, node, input_.parameters->arrange)
            .write(Members<4>::first(node.count), node.count, node.tight, output_);
    }

    static constexpr uint32_t kMargin = 16;  ///< references that vector code may write past the end

    const SubtreeInput& input_;
    SplitSearch& search_;
    SubtreeOutput& output_;
    float traversal_cost_;
    float block_cost_;
    ReferenceBuffer children_;  ///< made when a node is first split: most subtrees come without such nodes
};

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
