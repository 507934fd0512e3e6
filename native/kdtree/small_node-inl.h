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

#include <bit>
#include <cstring>

#include "kdtree/binning-inl.h"
#include "kdtree/build_kernels.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// A set of references as a bit mask, in words that hold as many bits as a lane that counts references.
template <size_t kWords>
struct Members {
    uint32_t word[kWords];

    uint32_t count() const {
        uint32_t sum = 0;
        for (const uint32_t bits : word) {
            sum += static_cast<uint32_t>(std::popcount(bits));
        }
        return sum;
    }
};

/// Finishes a node of at most 32 * kWords references.
template <size_t kWords>
class SmallNode {
 public:
    static constexpr uint32_t kCapacity = 32 * kWords;

    HWY_INLINE SmallNode(const References& references, const OpenNode& node, const BuildParameters& parameters,
                         SubtreeOutput& output)
        : parameters_(parameters),
          traversal_cost_(static_cast<float>(parameters.sah.traversal)),
          block_cost_(static_cast<float>(parameters.sah.block)),
          triangles_(references.triangle),
          output_(output) {
        for (int axis = 0; axis < 3; ++axis) {
            const auto a = static_cast<size_t>(axis);
            place_planes(axis, node.count, references.lower[a], references.upper[a], node.tight);
        }
        store_boxes(references, node.count);
        Members<kWords> all;
        for (uint32_t w = 0; w < kWords; ++w) {
            const uint32_t left = node.count > 32 * w ? node.count - 32 * w : 0;
            all.word[w] = left >= 32 ? ~0U : (1U << left) - 1;
        }
        cost_ = split(all, node);
    }
    float cost() const { return cost_; }  ///< per ray that meets the node's cell

 private:
    /// Per axis, word and plane: the references that begin before the plane, and those that end behind it.
    using PlaneMasks = uint32_t[3][kWords][kPlanes];

    /// The planes of one axis and the masks of what begins before and ends behind each.
    HWY_INLINE void place_planes(int axis, uint32_t count, const float* lowers, const float* uppers,
                                 const Box3f& tight) {
        const hn::CappedTag<float, 16> df;
        const hn::CappedTag<int8_t, 64> d8;
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
        Quantised<kCapacity> q;
        quantise<true>(df, lowers, uppers, slices, kSlices, count, q);
        for (int j = 0; j < kPlanes; j += static_cast<int>(hn::Lanes(df))) {
            hn::Store(slice_positions(df, lower, upper, j), df, positions + j);
        }
        for (int j = 0; j < kSlices; ++j) {
            const auto plane = hn::Set(d8, static_cast<int8_t>(j));
            const auto before = hn::Set(d8, static_cast<int8_t>(j - 1));
            for (size_t i = 0; i < kCapacity; i += hn::Lanes(d8)) {
                const auto begin = hn::Load(d8, q.begin + i);
                const auto end = hn::Load(d8, q.end + i);
                store_bits(d8, hn::Lt(begin, plane), i, j, left);
                store_bits(d8, hn::Gt(end, before), i, j, right);
            }
        }
        // The last plane is the end of the tight box: all lie before it, even what lies in it.
        for (size_t w = 0; w < kWords; ++w) {
            left[w][kSlices] = ~0U;
            right[w][kSlices] = 0;
        }
    }

    template <class D>
    static HWY_INLINE void store_bits(D d, hn::Mask<D> mask, size_t first, int plane,
                                      uint32_t (&masks)[kWords][kPlanes]) {
        const uint64_t bits = mask_bits(d, mask);
        if constexpr (hn::MaxLanes(D()) == 16) {
            uint32_t& word = masks[first / 32][plane];
            word = first % 32 == 0 ? static_cast<uint32_t>(bits) : word | static_cast<uint32_t>(bits << 16);
        } else {
            for (size_t k = 0; k < hn::MaxLanes(D()) / 32; ++k) {
                masks[first / 32 + k][plane] = static_cast<uint32_t>(bits >> (32 * k));
            }
        }
    }

    /// The boxes reference by reference, upper bounds negated: a union is two minima.
    HWY_INLINE void store_boxes(const References& references, uint32_t count) {
        const hn::CappedTag<float, 16> d;
        for (uint32_t i = 0; i < count; i += static_cast<uint32_t>(hn::Lanes(d))) {
            hn::StoreInterleaved4(hn::LoadU(d, references.lower[0] + i), hn::LoadU(d, references.lower[1] + i),
                                  hn::LoadU(d, references.lower[2] + i), hn::Zero(d), d, lowers_[i]);
            hn::StoreInterleaved4(hn::Neg(hn::LoadU(d, references.upper[0] + i)),
                                  hn::Neg(hn::LoadU(d, references.upper[1] + i)),
                                  hn::Neg(hn::LoadU(d, references.upper[2] + i)), hn::Zero(d), d, uppers_[i]);
        }
    }

    using DF = hn::CappedTag<float, 16>;

    /// The cheapest plane inside the cell.
    HWY_INLINE CheapestPlane<DF> cheapest_plane(const Members<kWords>& members, const SplitCosts<DF>& costs,
                                                uint64_t affordable) const {
        const DF df;
        const hn::RebindToUnsigned<DF> du;
        const hn::RebindToSigned<DF> di;
        const auto round_up = hn::Set(du, kBlockSize - 1);
        const auto too_many = hn::Set(di, static_cast<int32_t>(std::min<uint64_t>(affordable, 2 * kCapacity) + 1));
        CheapestPlane cheapest(df);
        for (int axis = 0; axis < 3; ++axis) {
            for (int j = 0; j < kPlanes; j += static_cast<int>(hn::Lanes(df))) {
                auto left = hn::Zero(du);
                auto right = hn::Zero(du);
                for (size_t w = 0; w < kWords; ++w) {
                    const auto member_bits = hn::Set(du, members.word[w]);
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
            side.word[w] = members.word[w] & masks[axis][w][plane];
        }
        return side;
    }

    /// Builds below a set of references; returns the cost of what was built, per ray that meets the cell.
    float split(const Members<kWords>& members, const OpenNode& node) {
        const float leaf_cost = block_cost_ * static_cast<float>(block_count(node.count));
        // A leaf of one block is cheaper than any step.
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

    HWY_INLINE void write_leaf(const Members<kWords>& members, const OpenNode& node) {
        uint32_t* next = output_.add_leaf(node.count);
        const hn::Full128<float> d;
        auto lower = hn::Inf(d);
        auto upper = hn::Inf(d);
        for (size_t w = 0; w < kWords; ++w) {
            for (uint32_t rest = members.word[w]; rest != 0; rest &= rest - 1) {
                const size_t i = 32 * w + static_cast<size_t>(std::countr_zero(rest));
                *next++ = triangles_[i];
                lower = hn::Min(lower, hn::Load(d, lowers_[i]));
                upper = hn::Min(upper, hn::Load(d, uppers_[i]));
            }
        }
        alignas(16) float box[2][4];
        hn::Store(lower, d, box[0]);
        hn::Store(upper, d, box[1]);
        Box3f tight;
        for (int axis = 0; axis < 3; ++axis) {
            tight.lower[axis] = std::max(box[0][axis], node.cell.lower[axis] - reach_[axis]) + 0.0F;
            tight.upper[axis] = std::min(-box[1][axis], node.cell.upper[axis] + reach_[axis]) + 0.0F;
        }
        output_.last_box() = node.count == 0 ? Box3f{} : tight;
    }

    const BuildParameters& parameters_;
    float traversal_cost_;
    float block_cost_;
    float cost_;
    const uint32_t* triangles_;
    SubtreeOutput& output_;
    float reach_[3];
    alignas(64) float positions_[3][kPlanes];
    alignas(64) PlaneMasks left_;
    alignas(64) PlaneMasks right_;
    alignas(64) float lowers_[kCapacity][4];
    alignas(64) float uppers_[kCapacity][4];
};

/// Finishes a node of at most parameters.small_node references; returns the cost of what was built.
inline float finish_small_node(const References& references, const OpenNode& node, const BuildParameters& parameters,
                               SubtreeOutput& output) {
    return parameters.small_node <= SmallNode<2>::kCapacity ? SmallNode<2>(references, node, parameters, output).cost()
                                                            : SmallNode<8>(references, node, parameters, output).cost();
}

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
