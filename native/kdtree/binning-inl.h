// SPDX-License-Identifier: GPL-3.0-or-later
// The cheapest of the planes between slices, from the counts of references on their two sides. Compiled once per
// instruction set (see build_kernels.cpp).

#if defined(ESPALIER_KDTREE_BINNING_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_KDTREE_BINNING_INL_H_
#undef ESPALIER_KDTREE_BINNING_INL_H_
#else
#define ESPALIER_KDTREE_BINNING_INL_H_
#endif

#include <hwy/highway.h>

#include <algorithm>

#include "kdtree/build_kernels.h"
#include "kdtree/sah-inl.h"
#include "kdtree/slice_counts-inl.h"
#include "kdtree/slices-inl.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// A count that no node reaches, small enough for signed comparison.
constexpr uint64_t kMostReferences = 0x7ffffffe;

/// Expected blocks of nodes that are split further: whole blocks where they will soon be leaves.
template <class D, class DU = hn::RebindToUnsigned<D>>
HWY_INLINE hn::Vec<D> expected_blocks(D d, hn::Vec<DU> counts) {
    const hn::RebindToSigned<D> di;
    const auto whole = hn::ShiftRight<3>(hn::Add(counts, hn::Set(DU(), kBlockSize - 1)));
    const auto exact = hn::ConvertTo(d, hn::BitCast(di, whole));
    const auto fraction = hn::Mul(hn::ConvertTo(d, hn::BitCast(di, counts)), hn::Set(d, 1.0F / kBlockSize));
    constexpr int32_t kFew = 128;
    const auto is_small = hn::Lt(hn::BitCast(di, counts), hn::Set(di, kFew + 1));
    return hn::IfThenElse(hn::RebindMask(d, is_small), exact, fraction);
}

inline bool may_be_split(const OpenNode& node, const BuildParameters& parameters) {
    return node.depth < parameters.sah.max_depth && CellShape(node.cell).is_splittable();
}

/// What leaves a node whole.
inline Split leaf(const OpenNode& node, const BuildParameters& parameters) {
    const hn::CappedTag<float, 16> d;
    const auto blocks = expected_blocks(d, hn::Set(hn::RebindToUnsigned<decltype(d)>(), node.count));
    return {-1, 0, static_cast<float>(parameters.sah.block) * hn::GetLane(blocks)};
}

/// True for planes that leave both sides together no more references than the node may have.
template <class D, class DU = hn::RebindToUnsigned<D>>
HWY_INLINE hn::Mask<D> is_affordable(D d, const OpenNode& node, hn::Vec<DU> left, hn::Vec<DU> right) {
    const hn::RebindToSigned<D> di;
    const auto too_many =
        hn::Set(di, static_cast<int32_t>(std::min<uint64_t>(node.count + node.spare, kMostReferences) + 1));
    return hn::RebindMask(d, hn::Lt(hn::BitCast(di, hn::Add(left, right)), too_many));
}

/// Planes within a tight box have something on both sides, even if a sample has not: what the box is tight around.
inline void leave_no_side_empty(BinCounts& counts, const OpenNode& node) {
    for (int axis = 0; axis < 3; ++axis) {
        for (int plane = 1; plane < kSlices; ++plane) {
            counts.left[axis][plane] = std::max(counts.left[axis][plane], 1U);
            counts.ends_before[axis][plane] = std::min(counts.ends_before[axis][plane], node.count - 1);
        }
    }
}

/// The costs of the planes from `first` on that cut [lower, upper] into slices.
template <class D>
HWY_INLINE hn::Vec<D> slice_costs(D d, const SplitCosts<D>& costs, const OpenNode& node, int axis, float lower,
                                  float upper, const BinCounts& counts, int first) {
    const hn::RebindToUnsigned<D> du;
    const auto left = hn::Load(du, counts.left[axis] + first);
    const auto right = hn::Sub(hn::Set(du, node.count), hn::Load(du, counts.ends_before[axis] + first));
    const auto position = slice_positions(d, lower, upper, first);
    const auto cost = costs(axis, position, expected_blocks(d, left), expected_blocks(d, right));
    return hn::IfThenElse(is_affordable(d, node, left, right), cost, hn::Inf(d));
}

inline Split choose_split(const OpenNode& node, BinCounts& counts, const BuildParameters& parameters) {
    const hn::CappedTag<float, 16> d;
    if (!may_be_split(node, parameters)) {
        return {};
    }
    const CellShape shape(node.cell);
    const SplitCosts costs(d, node, shape, parameters.sah);
    CheapestPlane cheapest(d);
    for (int axis = 0; axis < 3; ++axis) {
        const float lower = node.tight.lower[axis];
        const float upper = node.tight.upper[axis];
        if (!Slices::can_be_cut(lower, upper)) {
            continue;
        }
        counts.left[axis][kSlices] = counts.ends_before[axis][kSlices] = node.count;
        for (int j = 0; j <= kSlices; j += static_cast<int>(hn::Lanes(d))) {
            cheapest.offer(axis * kPlanes + j, slice_costs(d, costs, node, axis, lower, upper, counts, j));
        }
    }
    if (!(cheapest.cost() < leaf(node, parameters).cost)) {
        return {};
    }
    const int axis = cheapest.index() / kPlanes;
    const int plane = cheapest.index() % kPlanes;
    const auto position = slice_positions(d, node.tight.lower[axis], node.tight.upper[axis], plane);
    return {axis, hn::GetLane(position), cheapest.cost()};
}

inline Split choose_finer_split(const OpenNode& node, Split split, Interval range, const BinCounts& counts,
                                const BuildParameters& parameters) {
    const hn::CappedTag<float, 16> d;
    const CellShape shape(node.cell);
    const SplitCosts costs(d, node, shape, parameters.sah);
    CheapestPlane cheapest(d);
    for (int j = 0; j <= kSlices; j += static_cast<int>(hn::Lanes(d))) {
        // The ends lie among the planes that were tried before, and their counts are not known here.
        const hn::RebindToSigned<decltype(d)> di;
        const auto plane = hn::Iota(di, j);
        const auto is_end = hn::Or(hn::Eq(plane, hn::Zero(di)), hn::Eq(plane, hn::Set(di, kSlices)));
        const auto cost = slice_costs(d, costs, node, split.axis, range.lower, range.upper, counts, j);
        cheapest.offer(j, hn::IfThenElse(hn::RebindMask(d, is_end), hn::Inf(d), cost));
    }
    if (!(cheapest.cost() < split.cost)) {
        return split;
    }
    const auto position = slice_positions(d, range.lower, range.upper, cheapest.index());
    return {split.axis, hn::GetLane(position), cheapest.cost()};
}

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
