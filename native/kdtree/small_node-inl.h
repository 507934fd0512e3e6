// SPDX-License-Identifier: GPL-3.0-or-later
// The last references of a subtree, as one 64-bit mask: each candidate plane has a mask of the references to its left and one of those
// to its right, so that counts are population counts and children are intersections, and no reference is moved again. After the small
// nodes of Zhou, Hou, Wang and Guo 2008, section 3.3. Compiled once per instruction set (see build_kernels.cpp).

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

/// Appends a leaf with these triangles.
class LeafWriter {
   public:
    explicit LeafWriter(SubtreeOutput& output, uint32_t references) : output_(output) {
        const auto first = static_cast<uint32_t>(output.triangles.size());
        output.nodes.push_back(KdNode::leaf(first / kBlockSize, references));
        output.triangles.resize(first + size_t{block_count(references)} * kBlockSize, kNoTriangle);
        next_ = output.triangles.data() + first;
    }
    void add(uint32_t triangle) { *next_++ = triangle; }
    void finish(const Box3f& box) { output_.boxes.push_back(box); }

   private:
    SubtreeOutput& output_;
    uint32_t* next_;
};

class SmallNode {
   public:
    HWY_INLINE SmallNode(const References& references, const OpenNode& node, const BuildParameters& parameters, SubtreeOutput& output)
        : parameters_(parameters),
          traversal_(static_cast<float>(parameters.sah.traversal)),
          block_(static_cast<float>(parameters.sah.block)),
          bonus_(static_cast<float>(parameters.sah.empty_bonus)),
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
        split(all, node.cell, node.spare, node.depth);
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
        // How far a reference that is counted on one side of a plane may reach beyond it: rounding of (x - lower) * scale against that of
        // the plane's position.
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
        for (int j = 0; j < kPlanes; ++j) {
            positions[j] = slice_position(lower, upper, j, kSlices);
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

    struct Candidate {
        float cost;
        int plane;
    };

    /// The cheapest plane inside the cell; of equal ones the first by axis and position.
    HWY_INLINE Candidate best_plane(uint64_t members, const Box3f& cell, const CellShape& shape, uint64_t affordable) const {
        const hn::ScalableTag<uint64_t> d64;
        const hn::Rebind<uint32_t, decltype(d64)> d32;
        const hn::RebindToSigned<decltype(d32)> di;
        const hn::Rebind<float, decltype(d64)> df;
        const auto member_bits = hn::Set(d64, members);
        const auto round_up = hn::Set(d32, kBlockSize - 1);
        const auto too_many = hn::Set(di, static_cast<int32_t>(std::min<uint64_t>(affordable, 2 * kSmallNode) + 1));
        const auto infinite = hn::Inf(df);
        auto best_cost = infinite;
        auto best_index = hn::Zero(di);
        for (int axis = 0; axis < 3; ++axis) {
            const auto lower = hn::Set(df, cell.lower[axis]);
            const auto upper = hn::Set(df, cell.upper[axis]);
            const float b = shape.side[(axis + 1) % 3];
            const float c = shape.side[(axis + 2) % 3];
            const auto base = hn::Set(df, b * c);
            const auto slope = hn::Set(df, b + c);
            const auto scale = hn::Set(df, shape.scale);
            const auto inverse_area = hn::Set(df, shape.inverse_area);
            for (int j = 0; j < kPlanes; j += static_cast<int>(hn::Lanes(d64))) {
                const int at = axis * kPlanes + j;
                const auto left =
                    hn::TruncateTo(d32, hn::PopulationCount(hn::And(hn::Load(d64, left_ + at), member_bits)));
                const auto right =
                    hn::TruncateTo(d32, hn::PopulationCount(hn::And(hn::Load(d64, right_ + at), member_bits)));
                const auto left_blocks = hn::ConvertTo(df, hn::BitCast(di, hn::ShiftRight<3>(hn::Add(left, round_up))));
                const auto right_blocks = hn::ConvertTo(df, hn::BitCast(di, hn::ShiftRight<3>(hn::Add(right, round_up))));
                const auto position = hn::Load(df, positions_ + at);
                // Written as in CellShape::relative_area.
                const auto left_area =
                    hn::Mul(hn::Add(base, hn::Mul(hn::Mul(hn::Sub(position, lower), scale), slope)), inverse_area);
                const auto right_area =
                    hn::Mul(hn::Add(base, hn::Mul(hn::Mul(hn::Sub(upper, position), scale), slope)), inverse_area);
                auto children = hn::Mul(hn::Set(df, block_),
                                        hn::Add(hn::Mul(left_area, left_blocks), hn::Mul(right_area, right_blocks)));
                const auto one_is_empty = hn::Eq(hn::Min(left_blocks, right_blocks), hn::Zero(df));
                children = hn::IfThenElse(one_is_empty, hn::Mul(children, hn::Set(df, bonus_)), children);
                const auto inside = hn::And(hn::Lt(lower, position), hn::Lt(position, upper));
                const auto is_affordable = hn::RebindMask(df, hn::Lt(hn::BitCast(di, hn::Add(left, right)), too_many));
                const auto cost = hn::IfThenElse(hn::And(inside, is_affordable), hn::Add(hn::Set(df, traversal_), children), infinite);
                const auto better = hn::Lt(cost, best_cost);
                best_cost = hn::IfThenElse(better, cost, best_cost);
                best_index = hn::IfThenElse(hn::RebindMask(di, better), hn::Iota(di, at), best_index);
            }
        }
        const auto least = hn::MinOfLanes(df, best_cost);
        const auto none = hn::Set(di, std::numeric_limits<int32_t>::max());
        const auto first = hn::MinOfLanes(di, hn::IfThenElse(hn::RebindMask(di, hn::Eq(best_cost, least)), best_index, none));
        return {hn::GetLane(least), hn::GetLane(first)};
    }

    /// Builds below a set of references; returns the cost of what was built, per ray that meets the cell.
    float split(uint64_t members, const Box3f& cell, uint64_t spare, int depth) {
        const auto count = static_cast<uint32_t>(std::popcount(members));
        const float leaf_cost = block_ * static_cast<float>(block_count(count));
        const CellShape shape(cell);
        if (leaf_cost <= traversal_ || depth >= parameters_.sah.max_depth || !shape.is_splittable()) {
            write_leaf(members, count, cell);
            return leaf_cost;
        }
        const Candidate best = best_plane(members, cell, shape, count + spare);
        if (!(best.cost < leaf_cost)) {
            write_leaf(members, count, cell);
            return leaf_cost;
        }
        const int axis = best.plane / kPlanes;
        const float position = positions_[best.plane];
        const uint64_t left_members = members & left_[best.plane];
        const uint64_t right_members = members & right_[best.plane];
        OpenNode parent{cell, {}, count, spare, depth};
        OpenNode left;
        OpenNode right;
        open_children(parent, {axis, position},
                      {static_cast<uint32_t>(std::popcount(left_members)), static_cast<uint32_t>(std::popcount(right_members)), {}, {}},
                      left, right);

        const size_t node = output_.nodes.size();
        const size_t first_triangle = output_.triangles.size();
        output_.nodes.push_back(KdNode::leaf(0, 0));
        output_.boxes.emplace_back();
        const float left_cost = split(left_members, left.cell, left.spare, left.depth);
        const size_t right_child = output_.nodes.size();
        const float right_cost = split(right_members, right.cell, right.spare, right.depth);
        const float cost = traversal_ + (shape.relative_area(axis, position - cell.lower[axis]) * left_cost +
                                         shape.relative_area(axis, cell.upper[axis] - position) * right_cost);
        if (leaf_cost <= cost) {  // the promise of the greedy choice was not kept: take the split back
            output_.nodes.erase(output_.nodes.begin() + static_cast<std::ptrdiff_t>(node), output_.nodes.end());
            output_.boxes.resize(node);
            output_.triangles.resize(first_triangle);
            write_leaf(members, count, cell);
            return leaf_cost;
        }
        output_.nodes[node] = KdNode::inner(axis, position, static_cast<uint32_t>(right_child));
        Box3f box = output_.boxes[node + 1];
        box.extend(output_.boxes[right_child]);
        output_.boxes[node] = box;
        return cost;
    }

    HWY_INLINE void write_leaf(uint64_t members, uint32_t count, const Box3f& cell) {
        LeafWriter leaf(output_, count);
        const hn::CappedTag<float, 8> d;
        constexpr size_t kLanes = hn::MaxLanes(hn::CappedTag<float, 8>());
        alignas(64) float box[8];
        std::fill(box, box + 8, std::numeric_limits<float>::infinity());
        for (uint64_t rest = members; rest != 0; rest &= rest - 1) {
            const auto i = static_cast<size_t>(std::countr_zero(rest));
            leaf.add(references_.triangle[i]);
            for (size_t k = 0; k < 8; k += kLanes) {
                hn::Store(hn::Min(hn::Load(d, box + k), hn::Load(d, boxes_[i] + k)), d, box + k);
            }
        }
        Box3f tight;
        for (int axis = 0; axis < 3; ++axis) {
            tight.lower[axis] = std::max(box[axis], cell.lower[axis] - reach_[axis]) + 0.0F;
            tight.upper[axis] = std::min(-box[axis + 4], cell.upper[axis] + reach_[axis]) + 0.0F;
        }
        leaf.finish(count == 0 ? Box3f{} : tight);
    }

    const BuildParameters& parameters_;
    float traversal_;
    float block_;
    float bonus_;
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
