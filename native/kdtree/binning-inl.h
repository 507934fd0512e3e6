// SPDX-License-Identifier: GPL-3.0-or-later
// Min-max binning after Shevtsov, Soupikov and Kapustin 2007, section 4: counts of boxes that begin before and end
// behind each plane. Compiled once per instruction set (see build_kernels.cpp).

#if defined(ESPALIER_KDTREE_BINNING_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_KDTREE_BINNING_INL_H_
#undef ESPALIER_KDTREE_BINNING_INL_H_
#else
#define ESPALIER_KDTREE_BINNING_INL_H_
#endif

#include <hwy/highway.h>

#include "kdtree/build_kernels.h"
#include "kdtree/sah-inl.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// Equal slices of an interval.
struct Slices {
    float origin;
    float scale;  ///< slices per unit, 0 if the interval is too thin to be cut

    Slices(float lower, float upper, int slices) : origin(lower), scale(static_cast<float>(slices) / (upper - lower)) {
        if (!(scale < 0x1p100F)) {
            scale = 0;
        }
    }
};

/// Where planes `first` and following of `slices` cut [lower, upper]; the ends exactly.
template <class D>
HWY_INLINE hn::Vec<D> slice_positions(D d, float lower, float upper, int first, int slices) {
    const hn::RebindToSigned<D> di;
    const auto plane = hn::Iota(di, first);
    const auto fraction = hn::Mul(hn::ConvertTo(d, plane), hn::Set(d, 1.0F / static_cast<float>(slices)));
    const auto between = hn::Add(hn::Set(d, lower), hn::Mul(hn::Set(d, upper - lower), fraction));
    return hn::IfThenElse(hn::RebindMask(d, hn::Eq(plane, hn::Set(di, slices))), hn::Set(d, upper), between);
}

/// A count that no node reaches, small enough for signed comparison.
constexpr uint64_t kMostReferences = 0x7ffffffe;

/// References quantised to slices, a byte each: how many planes they begin and end behind.
constexpr uint32_t kQuantisedChunk = 1024;
struct Quantised {
    alignas(64) uint8_t begin[kQuantisedChunk];
    alignas(64) uint8_t end[kQuantisedChunk];
};

/// begin: the last slice that starts at or before the lower bound. end: the last slice that starts before the upper
/// bound, and not before `begin`, so that a reference that lies in a plane counts behind it. Both at most `last`.
template <class D>
HWY_INLINE void quantise(D df, const float* lower, const float* upper, Slices slices, int last, uint32_t count,
                         Quantised& out) {
    const hn::RebindToSigned<D> di;
    const hn::Rebind<uint8_t, D> d8;
    const auto origin = hn::Set(df, slices.origin);
    const auto scale = hn::Set(df, slices.scale);
    const auto top = hn::Set(di, last);
    const auto one = hn::Set(di, 1);
    for (uint32_t i = 0; i < count; i += static_cast<uint32_t>(hn::Lanes(df))) {
        const auto low = hn::Mul(hn::Sub(hn::LoadU(df, lower + i), origin), scale);
        const auto high = hn::Mul(hn::Sub(hn::LoadU(df, upper + i), origin), scale);
        const auto begin = hn::Min(hn::ConvertTo(di, low), top);
        const auto end = hn::Min(hn::Sub(hn::ConvertTo(di, hn::Ceil(high)), one), top);
        hn::StoreU(hn::DemoteTo(d8, begin), d8, out.begin + i);
        hn::StoreU(hn::DemoteTo(d8, hn::Max(begin, end)), d8, out.end + i);
    }
}

/// Bytes of [values, values + count) below `bound`; count is a multiple of 64.
template <int kPlanes>
HWY_INLINE void count_below(const uint8_t* values, uint32_t count, int first_bound, uint32_t* totals) {
    const hn::ScalableTag<int8_t> d;
    uint32_t below[kPlanes] = {};
    for (uint32_t i = 0; i < count; i += static_cast<uint32_t>(hn::Lanes(d))) {
        const auto v = hn::Load(d, reinterpret_cast<const int8_t*>(values) + i);
        for (int k = 0; k < kPlanes; ++k) {
            below[k] +=
                static_cast<uint32_t>(hn::CountTrue(d, hn::Lt(v, hn::Set(d, static_cast<int8_t>(first_bound + k)))));
        }
    }
    for (int k = 0; k < kPlanes; ++k) {
        totals[k] += below[k];
    }
}

inline void count_bins(const References& references, uint32_t count, const Box3f& tight, int bins, BinCounts& counts) {
    const hn::ScalableTag<float> df;
    constexpr int kGroup = 5;  // planes whose counters stay in registers
    constexpr uint8_t kNever = 127;
    for (int axis = 0; axis < 3; ++axis) {
        const Slices slices(tight.lower[axis], tight.upper[axis], bins);
        if (slices.scale == 0) {
            continue;
        }
        const auto a = static_cast<size_t>(axis);
        for (uint32_t begin = 0; begin < count; begin += kQuantisedChunk) {
            const uint32_t size = std::min(kQuantisedChunk, count - begin);
            const uint32_t padded = (size + 63) / 64 * 64;
            Quantised q;
            quantise(df, references.lower[a] + begin, references.upper[a] + begin, slices, bins - 1, size, q);
            std::fill(q.begin + size, q.begin + padded, kNever);
            std::fill(q.end + size, q.end + padded, kNever);
            uint32_t ends_before[kMaxBins + kGroup] = {};
            uint32_t begins_before[kMaxBins + kGroup] = {};
            for (int j = 1; j < bins; j += kGroup) {
                count_below<kGroup>(q.begin, padded, j, begins_before + j);
                count_below<kGroup>(q.end, padded, j, ends_before + j);
            }
            for (int j = 1; j < bins; ++j) {
                counts.left[axis][j] += begins_before[j];
                counts.right[axis][j] += size - ends_before[j];
            }
        }
    }
}

/// Expected blocks of nodes that are split further: whole blocks where they will soon be leaves.
template <class D, class DU = hn::RebindToUnsigned<D>>
HWY_INLINE hn::Vec<D> expected_blocks(D d, hn::Vec<DU> counts) {
    const hn::RebindToSigned<D> di;
    const auto whole = hn::ShiftRight<3>(hn::Add(counts, hn::Set(DU(), kBlockSize - 1)));
    const auto exact = hn::ConvertTo(d, hn::BitCast(di, whole));
    const auto fraction = hn::Mul(hn::ConvertTo(d, hn::BitCast(di, counts)), hn::Set(d, 1.0F / kBlockSize));
    const auto is_small = hn::Lt(hn::BitCast(di, counts), hn::Set(di, static_cast<int32_t>(kSmallNode + 1)));
    return hn::IfThenElse(hn::RebindMask(d, is_small), exact, fraction);
}

inline Split choose_split(const OpenNode& node, BinCounts& counts, const BuildParameters& parameters) {
    const hn::ScalableTag<float> d;
    const hn::RebindToUnsigned<decltype(d)> du;
    const hn::RebindToSigned<decltype(d)> di;
    const CellShape shape(node.cell);
    if (node.depth >= parameters.sah.max_depth || !shape.is_splittable()) {
        return {};
    }
    const int bins = parameters.bins;
    const SplitCosts costs(d, node, shape, parameters.sah);
    const auto too_many =
        hn::Set(di, static_cast<int32_t>(std::min<uint64_t>(node.count + node.spare, kMostReferences) + 1));
    CheapestPlane cheapest(d);
    for (int axis = 0; axis < 3; ++axis) {
        const float lower = node.tight.lower[axis];
        const float upper = node.tight.upper[axis];
        if (Slices(lower, upper, bins).scale == 0) {
            continue;
        }
        counts.left[axis][0] = counts.right[axis][bins] = 0;
        counts.left[axis][bins] = counts.right[axis][0] = node.count;
        const auto last = hn::Set(di, bins);
        for (int j = 0; j <= bins; j += static_cast<int>(hn::Lanes(d))) {
            const auto position = slice_positions(d, lower, upper, j, bins);
            const auto left = hn::Load(du, counts.left[axis] + j);
            const auto right = hn::Load(du, counts.right[axis] + j);
            const auto cost = costs(axis, position, expected_blocks(d, left), expected_blocks(d, right));
            const auto counts_as =
                hn::AndNot(hn::Gt(hn::Iota(di, j), last), hn::Lt(hn::BitCast(di, hn::Add(left, right)), too_many));
            cheapest.offer(axis * (bins + 1) + j, hn::IfThenElse(hn::RebindMask(d, counts_as), cost, hn::Inf(d)));
        }
    }
    const auto leaf_cost =
        static_cast<float>(parameters.sah.block) * hn::GetLane(expected_blocks(d, hn::Set(du, node.count)));
    if (!(cheapest.cost() < leaf_cost)) {
        return {};
    }
    const int axis = cheapest.index() / (bins + 1);
    const auto position =
        slice_positions(d, node.tight.lower[axis], node.tight.upper[axis], cheapest.index() % (bins + 1), bins);
    return {axis, hn::GetLane(position)};
}

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
