// SPDX-License-Identifier: GPL-3.0-or-later
// The last references of a subtree, as one 64-bit mask: each candidate plane has a mask of the references to its left
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

class SmallNode {
 public:
    HWY_INLINE SmallNode(const References& references, const OpenNode& node, const BuildParameters& parameters,
                         SubtreeOutput& output)
        : parameters_(parameters),
          traversal_cost_(static_cast<float>(parameters.sah.traversal)),
          block_cost_(static_cast<float>(parameters.sah.block)),
          references_(references),
          output_(output) {
        for (int axis = 0; axis < 3; ++axis) {
            place_planes(axis, node.count, node.tight.lower[axis], node.tight.upper[axis]);
        }
        for (uint32_t i = 0; i < node.count; ++i) {
            float* box = boxes_[i];
            for (size_t axis = 0; axis < 3; ++axis) {
                box[axis] = references.lower[axis][i];
                box[axis + 4] = -references.upper[axis][i];
            }
            box[3] = box[7] = 0;
        }
        const uint64_t all = node.count == 64 ? ~uint64_t{0} : (uint64_t{1} << node.count) - 1;
        split(all, node);
    }

 private:
    static constexpr int kSlices = 31;
    static constexpr int kPlanes = 32;  ///< per axis, both ends of the tight box among them

    /// The planes of one axis and the masks of what begins before and ends behind each.
    HWY_INLINE void place_planes(int axis, uint32_t count, float lower, float upper) {
        const hn::CappedTag<float, 16> df;
        const hn::CappedTag<int8_t, 64> d8;
        const Slices slices(lower, upper, kSlices);
        float* positions = positions_ + axis * kPlanes;
        uint64_t* left = left_ + axis * kPlanes;
        uint64_t* right = right_ + axis * kPlanes;
        // How far a reference that is counted on one side of a plane may reach beyond it: rounding of (x - lower) *
        // scale against that of the plane's position.
        reach_[axis] = (upper - lower) * 0x1p-20F + std::max(std::abs(lower), std::abs(upper)) * 0x1p-22F + 0x1p-120F;
        if (slices.scale == 0) {
            std::fill(positions, positions + kPlanes, std::numeric_limits<float>::infinity());  // never inside the cell
            std::fill(left, left + kPlanes, 0);
            std::fill(right, right + kPlanes, 0);
            return;
        }
        Quantised q;
        const auto a = static_cast<size_t>(axis);
        quantise(df, references_.lower[a], references_.upper[a], slices, kSlices, count, q);
        for (uint32_t i = count; i < kSmallNode; ++i) {  // on no side of any plane
            q.begin[i] = kPlanes;
            q.end[i] = 0;
        }
        for (int j = 0; j < kPlanes; j += static_cast<int>(hn::Lanes(df))) {
            hn::Store(slice_positions(df, lower, upper, j, kSlices), df, positions + j);
        }
        for (int j = 0; j < kPlanes; ++j) {
            uint64_t begins_before = 0;
            uint64_t ends_behind = 0;
            for (size_t i = 0; i < kSmallNode; i += hn::Lanes(d8)) {
                const auto begin = hn::Load(d8, reinterpret_cast<const int8_t*>(q.begin) + i);
                const auto end = hn::Load(d8, reinterpret_cast<const int8_t*>(q.end) + i);
                const auto plane = hn::Set(d8, static_cast<int8_t>(j));
                const auto before = hn::Set(d8, static_cast<int8_t>(j - 1));
                uint8_t bytes[2][8] = {};
                hn::StoreMaskBits(d8, hn::Lt(begin, plane), bytes[0]);
                hn::StoreMaskBits(d8, hn::Gt(end, before), bytes[1]);
                uint64_t bits[2];
                std::memcpy(bits, bytes, sizeof bits);
                begins_before |= bits[0] << i;
                ends_behind |= bits[1] << i;
            }
            left[j] = begins_before;
            right[j] = ends_behind;
        }
        // The last plane is the end of the tight box: all lie before it, even what lies in it.
        left[kSlices] = ~uint64_t{0};
        right[kSlices] = 0;
    }

    using D64 = hn::ScalableTag<uint64_t>;
    using DF = hn::Rebind<float, D64>;

    /// The cheapest plane inside the cell.
    HWY_INLINE CheapestPlane<DF> cheapest_plane(uint64_t members, const SplitCosts<DF>& costs,
                                                uint64_t affordable) const {
        const D64 d64;
        const DF df;
        const hn::RebindToUnsigned<DF> du;
        const hn::RebindToSigned<DF> di;
        const auto member_bits = hn::Set(d64, members);
        const auto round_up = hn::Set(du, kBlockSize - 1);
        const auto too_many = hn::Set(di, static_cast<int32_t>(std::min<uint64_t>(affordable, 2 * kSmallNode) + 1));
        CheapestPlane cheapest(df);
        for (int axis = 0; axis < 3; ++axis) {
            for (int j = 0; j < kPlanes; j += static_cast<int>(hn::Lanes(d64))) {
                const int at = axis * kPlanes + j;
                const auto left =
                    hn::TruncateTo(du, hn::PopulationCount(hn::And(hn::Load(d64, left_ + at), member_bits)));
                const auto right =
                    hn::TruncateTo(du, hn::PopulationCount(hn::And(hn::Load(d64, right_ + at), member_bits)));
                const auto left_blocks = hn::ConvertTo(df, hn::BitCast(di, hn::ShiftRight<3>(hn::Add(left, round_up))));
                const auto right_blocks =
                    hn::ConvertTo(df, hn::BitCast(di, hn::ShiftRight<3>(hn::Add(right, round_up))));
                const auto cost = costs(axis, hn::Load(df, positions_ + at), left_blocks, right_blocks);
                const auto is_affordable = hn::Lt(hn::BitCast(di, hn::Add(left, right)), too_many);
                cheapest.offer(at, hn::IfThenElse(hn::RebindMask(df, is_affordable), cost, hn::Inf(df)));
            }
        }
        return cheapest;
    }

    /// Builds below a set of references; returns the cost of what was built, per ray that meets the cell.
    float split(uint64_t members, const OpenNode& node) {
        const float leaf_cost = block_cost_ * static_cast<float>(block_count(node.count));
        const CellShape shape(node.cell);
        // A leaf of one block is cheaper than any step.
        if (leaf_cost <= traversal_cost_ || node.depth >= parameters_.sah.max_depth || !shape.is_splittable()) {
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
        const int plane = cheapest.index();
        const Split split_at{plane / kPlanes, positions_[plane]};
        const uint64_t left_members = members & left_[plane];
        const uint64_t right_members = members & right_[plane];
        const Partition parts{static_cast<uint32_t>(std::popcount(left_members)),
                              static_cast<uint32_t>(std::popcount(right_members)),
                              {},
                              {}};
        OpenNode left;
        OpenNode right;
        open_children(node, split_at, parts, left, right);

        const size_t first_triangle = output_.triangle_count();
        const size_t index = output_.open_inner();
        const float left_cost = split(left_members, left);
        const size_t right_child = output_.node_count();
        const float right_cost = split(right_members, right);
        const auto area = [&](const OpenNode& child) {
            return hn::GetLane(costs.relative_area(split_at.axis, hn::Set(df, child.cell.size()[split_at.axis])));
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

    HWY_INLINE void write_leaf(uint64_t members, const OpenNode& node) {
        uint32_t* next = output_.add_leaf(node.count);
        const hn::CappedTag<float, 8> d;
        constexpr size_t kLanes = hn::MaxLanes(hn::CappedTag<float, 8>());
        alignas(64) float box[8];
        std::fill(box, box + 8, std::numeric_limits<float>::infinity());
        for (uint64_t rest = members; rest != 0; rest &= rest - 1) {
            const auto i = static_cast<size_t>(std::countr_zero(rest));
            *next++ = references_.triangle[i];
            for (size_t k = 0; k < 8; k += kLanes) {
                hn::Store(hn::Min(hn::Load(d, box + k), hn::Load(d, boxes_[i] + k)), d, box + k);
            }
        }
        Box3f tight;
        for (int axis = 0; axis < 3; ++axis) {
            tight.lower[axis] = std::max(box[axis], node.cell.lower[axis] - reach_[axis]) + 0.0F;
            tight.upper[axis] = std::min(-box[axis + 4], node.cell.upper[axis] + reach_[axis]) + 0.0F;
        }
        output_.last_box() = node.count == 0 ? Box3f{} : tight;
    }

    const BuildParameters& parameters_;
    float traversal_cost_;
    float block_cost_;
    const References& references_;
    SubtreeOutput& output_;
    float reach_[3];
    alignas(64) float positions_[3 * kPlanes];
    alignas(64) uint64_t left_[3 * kPlanes];
    alignas(64) uint64_t right_[3 * kPlanes];
    alignas(64) float boxes_[kSmallNode][8];  ///< lower bounds, then negated upper bounds: a union is one minimum
};

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
