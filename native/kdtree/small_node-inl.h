// SPDX-License-Identifier: GPL-3.0-or-later
// The last references of a subtree, as one bit mask: each candidate plane has a mask of the references to its left
// and one of those to its right, so that counts are population counts and children are intersections, and no reference
// is moved again. After the small nodes of Zhou, Hou, Wang and Guo 2008, section 3.3. Compiled once per instruction set
// (see build_kernels.cpp).

#if defined(ESPALIER_KDTREE_SMALL_NODE_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_KDTREE_SMALL_NODE_INL_H_
#undef ESPALIER_KDTREE_SMALL_NODE_INL_H_
#else
#define ESPALIER_KDTREE_SMALL_NODE_INL_H_
#endif

#include <hwy/highway.h>

#include <algorithm>
#include <bit>
#include <cstring>
#include <limits>

#include "kdtree/binning-inl.h"
#include "kdtree/build_kernels.h"
#include "kdtree/leaf_parts-inl.h"
#include "kdtree/slice_masks-inl.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// Finishes a node of at most 64 * kWords references.
template <size_t kWords>
class SmallNode {
 public:
    static constexpr uint32_t kCapacity = 64 * kWords;

    HWY_INLINE SmallNode(const References& references, const OpenNode& node, const BuildParameters& parameters,
                         SubtreeOutput& output)
        : parameters_(parameters),
          traversal_cost_(static_cast<float>(parameters.sah.traversal)),
          block_cost_(static_cast<float>(parameters.sah.block)),
          leaves_(references, node, parameters.arrange),
          output_(output) {
        for (int axis = 0; axis < 3; ++axis) {
            const auto a = static_cast<size_t>(axis);
            place_planes(axis, node.count, references.lower[a], references.upper[a], node.tight);
        }
        cost_ = split(Members<kWords>::first(node.count), node);
    }
    float cost() const { return cost_; }  ///< per ray that meets the node's cell

 private:
    using DF = hn::CappedTag<float, 16>;

    /// Per axis and plane the references that begin before the plane, or those that end behind it: half words, as wide
    /// as a lane that counts references.
    using PlaneMasks = uint32_t[3][2 * kWords][kPlanes];

    /// The planes of one axis and the masks of what begins before and ends behind each.
    HWY_INLINE void place_planes(int axis, uint32_t count, const float* lowers, const float* uppers,
                                 const Box3f& tight) {
        const DF df;
        const float lower = tight.lower[axis];
        const float upper = tight.upper[axis];
        const Slices slices(lower, upper);
        float* positions = positions_[axis];
        auto& left = left_[axis];
        auto& right = right_[axis];
        reach_[axis] = reach_beyond_slices(lower, upper);
        if (slices.scale == 0) {
            std::fill(positions, positions + kPlanes, std::numeric_limits<float>::infinity());  // never inside the cell
            std::memset(left, 0, sizeof left);
            std::memset(right, 0, sizeof right);
            return;
        }
        for (int j = 0; j < kPlanes; j += static_cast<int>(hn::Lanes(df))) {
            hn::Store(slice_positions(df, lower, upper, j), df, positions + j);
        }
        mask_slices(lowers, uppers, slices, count, left, right);
    }

    /// The cheapest plane inside the cell.
    HWY_INLINE CheapestPlane<DF> cheapest_plane(const Members<kWords>& members, const SplitCosts<DF>& costs,
                                                uint64_t affordable) const {
        const DF df;
        const hn::RebindToUnsigned<DF> du;
        const hn::RebindToSigned<DF> di;
        const auto round_up = hn::Set(du, kBlockSize - 1);
        const auto too_many = hn::Set(di, static_cast<int32_t>(std::min<uint64_t>(affordable, 2 * kCapacity) + 1));
        CheapestPlane cheapest(df);
        // Where the planes of an axis are one vector, half words without members cost less than a branch on their
        // number.
        constexpr bool kSkipsEmpty = hn::MaxLanes(DF()) < kPlanes;
        size_t half[2 * kWords];
        size_t halves = 0;
        for (size_t w = 0; w < 2 * kWords; ++w) {
            half[halves] = w;
            halves += !kSkipsEmpty || members.half(w) != 0 ? 1 : 0;
        }
        for (int axis = 0; axis < 3; ++axis) {
            for (int j = 0; j < kPlanes; j += static_cast<int>(hn::Lanes(df))) {
                auto left = hn::Zero(du);
                auto right = hn::Zero(du);
                for (size_t k = 0; k < halves; ++k) {
                    const size_t w = half[k];
                    const auto member_bits = hn::Set(du, members.half(w));
                    const auto of = [&](const PlaneMasks& masks) {
                        return hn::PopulationCount(hn::And(hn::Load(du, masks[axis][w] + j), member_bits));
                    };
                    left = hn::Add(left, of(left_));
                    right = hn::Add(right, of(right_));
                }
                const auto left_blocks = hn::ConvertTo(df, hn::BitCast(di, hn::ShiftRight<3>(hn::Add(left, round_up))));
                const auto right_blocks =
                    hn::ConvertTo(df, hn::BitCast(di, hn::ShiftRight<3>(hn::Add(right, round_up))));
                const auto cost = costs(axis, hn::Load(df, positions_[axis] + j), left_blocks, right_blocks);
                const auto is_affordable = hn::Lt(hn::BitCast(di, hn::Add(left, right)), too_many);
                cheapest.offer(axis * kPlanes + j,
                               hn::IfThenElse(hn::RebindMask(df, is_affordable), cost, hn::Inf(df)));
            }
        }
        return cheapest;
    }

    static Members<kWords> on_side(const Members<kWords>& members, const PlaneMasks& masks, int axis, int plane) {
        Members<kWords> side;
        for (size_t w = 0; w < kWords; ++w) {
            const uint64_t high = masks[axis][2 * w + 1][plane];
            side.word[w] = members.word[w] & (high << 32 | masks[axis][2 * w][plane]);
        }
        return side;
    }

    /// Builds below a set of references; returns the cost of what was built, per ray that meets the cell.
    float split(const Members<kWords>& members, const OpenNode& node) {
        const float leaf_cost = block_cost_ * static_cast<float>(block_count(node.count));
        // A leaf of so few blocks is cheaper than any step.
        if (leaf_cost <= traversal_cost_ || node.depth >= parameters_.sah.max_depth) {
            write_leaf(members, node);
            return leaf_cost;
        }
        const CellShape shape(node.cell);
        if (!shape.is_splittable()) {
            write_leaf(members, node);
            return leaf_cost;
        }
        const DF df;
        const SplitCosts<DF> costs(df, node, shape, parameters_.sah);
        const CheapestPlane<DF> cheapest = cheapest_plane(members, costs, node.count + node.spare);
        if (!(cheapest.cost() < leaf_cost)) {
            write_leaf(members, node);
            return leaf_cost;
        }
        const int axis = cheapest.index() / kPlanes;
        const int plane = cheapest.index() % kPlanes;
        const Split split_at{axis, positions_[axis][plane], cheapest.cost()};
        const Members<kWords> left_members = on_side(members, left_, axis, plane);
        const Members<kWords> right_members = on_side(members, right_, axis, plane);
        OpenNode left;
        OpenNode right;
        open_children(node, split_at, {left_members.count(), right_members.count(), {}, {}}, left, right);

        const size_t first_triangle = output_.triangle_count();
        const size_t index = output_.open_inner();
        const float left_cost = split(left_members, left);
        const size_t right_child = output_.node_count();
        const float right_cost = split(right_members, right);
        const auto area = [&](const OpenNode& child) {
            return hn::GetLane(costs.relative_area(axis, hn::Set(df, child.cell.size()[axis])));
        };
        const float cost = traversal_cost_ + (area(left) * left_cost + area(right) * right_cost);
        if (leaf_cost <= cost) {  // the promise of the greedy choice was not kept: take the split back
            output_.rewind(index, first_triangle);
            write_leaf(members, node);
            return leaf_cost;
        }
        output_.close_inner(index, split_at, right_child);
        return cost;
    }

    /// The boxes of its members may reach beyond the cell: they were never clipped to it.
    void write_leaf(const Members<kWords>& members, const OpenNode& node) {
        Box3f bounds;
        for (int axis = 0; axis < 3; ++axis) {
            bounds.lower[axis] = node.cell.lower[axis] - reach_[axis];
            bounds.upper[axis] = node.cell.upper[axis] + reach_[axis];
        }
        leaves_.write(members, node.count, bounds, output_);
    }

    const BuildParameters& parameters_;
    float traversal_cost_;
    float block_cost_;
    float cost_;
    LeafParts<kWords> leaves_;
    SubtreeOutput& output_;
    float reach_[3];
    alignas(64) float positions_[3][kPlanes];
    alignas(64) PlaneMasks left_;
    alignas(64) PlaneMasks right_;
};

/// Finishes a node of at most parameters.small_node references; returns the cost of what was built.
inline float finish_small_node(const References& references, const OpenNode& node, const BuildParameters& parameters,
                               SubtreeOutput& output) {
    return parameters.small_node <= SmallNode<1>::kCapacity ? SmallNode<1>(references, node, parameters, output).cost()
                                                            : SmallNode<4>(references, node, parameters, output).cost();
}

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
