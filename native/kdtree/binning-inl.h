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
#include "kdtree/compress-inl.h"
#include "kdtree/sah-inl.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// Equal slices of an interval.
struct Slices {
    float origin;
    float scale;  ///< slices per unit, 0 if the interval is too thin to be cut

    Slices(float lower, float upper)
        : origin(lower), scale(can_be_cut(lower, upper) ? static_cast<float>(kSlices) / (upper - lower) : 0.0F) {}
    static bool can_be_cut(float lower, float upper) { return upper - lower > 0x1p-96F; }
};

/// Where planes `first` and following of the slices cut [lower, upper]; the ends exactly.
template <class D>
HWY_INLINE hn::Vec<D> slice_positions(D d, float lower, float upper, int first) {
    const hn::RebindToSigned<D> di;
    const auto plane = hn::Iota(di, first);
    const auto fraction = hn::Mul(hn::ConvertTo(d, plane), hn::Set(d, 1.0F / static_cast<float>(kSlices)));
    const auto between = hn::Add(hn::Set(d, lower), hn::Mul(hn::Set(d, upper - lower), fraction));
    return hn::IfThenElse(hn::RebindMask(d, hn::Eq(plane, hn::Set(di, kSlices))), hn::Set(d, upper), between);
}

/// How far a box that is counted on one side of a plane between slices may reach beyond it: rounding of (x - lower) *
/// scale against that of the plane's position. EXACTNESS.md, 5.
inline float reach_beyond_slices(float lower, float upper) {
    return (upper - lower) * 0x1p-20F + std::max(std::abs(lower), std::abs(upper)) * 0x1p-22F + 0x1p-120F;
}

/// A count that no node reaches, small enough for signed comparison.
constexpr uint64_t kMostReferences = 0x7ffffffe;

/// References quantised to slices, a byte each.
template <uint32_t kSize>
struct Quantised {
    static_assert(kSize % 64 == 0);
    alignas(64) int8_t begin[kSize];
    alignas(64) int8_t end[kSize];
};

/// The bytes of two vectors of 16-bit numbers below 128, alternating.
template <class V16, class D8>
HWY_INLINE hn::Vec<D8> join_bytes(D8 d8, V16 even, V16 odd) {
    return hn::BitCast(d8, hn::Or(even, hn::ShiftLeft<8>(odd)));
}

/// Puts the bytes that came from four vectors a, b, c, d through ReorderDemote2To and join_bytes in order again: each
/// block of 16 holds a0 c0 a1 c1 a2 c2 a3 c3 b0 d0 ...
template <class D8>
HWY_INLINE hn::Vec<D8> in_order(D8 d8, hn::Vec<D8> bytes) {
    const hn::Repartition<int32_t, D8> d32;
    constexpr size_t kDwords = hn::MaxLanes(hn::Repartition<int32_t, D8>());
    alignas(16) static constexpr int8_t kFromBlock[16] = {0, 2, 4, 6, 8, 10, 12, 14, 1, 3, 5, 7, 9, 11, 13, 15};
    const auto grouped = hn::TableLookupBytes(bytes, hn::LoadDup128(d8, kFromBlock));
    if constexpr (kDwords == 4) {
        return grouped;
    }
    alignas(64) int32_t from[kDwords];
    for (size_t i = 0; i < kDwords; ++i) {
        from[i] = static_cast<int32_t>(4 * (i % (kDwords / 4)) + i / (kDwords / 4));
    }
    return hn::BitCast(d8, hn::TableLookupLanes(hn::BitCast(d32, grouped), hn::SetTableIndices(d32, from)));
}

/// Truncates numbers that an int can hold. Highway's ConvertTo takes four more instructions for those it cannot.
template <class DI, class VF>
HWY_INLINE hn::Vec<DI> truncate(DI di, VF v) {
#if HWY_TARGET == HWY_AVX3_DL
    if constexpr (hn::MaxLanes(DI()) == 16) {
        return hn::Vec<DI>{_mm512_cvttps_epi32(v.raw)};
    }
#elif HWY_TARGET == HWY_AVX2
    if constexpr (hn::MaxLanes(DI()) == 8) {
        return hn::Vec<DI>{_mm256_cvttps_epi32(v.raw)};
    }
#elif HWY_TARGET == HWY_SSE4
    return hn::Vec<DI>{_mm_cvttps_epi32(v.raw)};
#endif
    return hn::ConvertTo(di, v);
}

/// begin: the last slice that starts at or before the lower bound. end: the last slice that starts before the upper
/// bound, and not before `begin`, so that a reference that lies in a plane counts behind it. Both from 0 to `last`.
/// Padded to vectors of 64 with `last`. References keep their order if asked to.
template <bool kInOrder, class D, uint32_t kSize>
HWY_INLINE void quantise(D df, const float* lower, const float* upper, Slices slices, int last, uint32_t count,
                         Quantised<kSize>& out) {
    const hn::RebindToSigned<D> di;
    const hn::Repartition<int16_t, D> d16;
    const hn::Repartition<int8_t, D> d8;
    constexpr uint32_t kLanes = hn::MaxLanes(D());
    const auto origin = hn::Set(df, slices.origin);
    const auto scale = hn::Set(df, slices.scale);
    // So that what ends in a plane ends before it; what ends less behind it than its position is rounded may, too.
    const auto end_scale = hn::Set(df, slices.scale * (1 - 0x1p-22F));
    const auto zero = hn::Zero(d16);
    const auto top = hn::Set(d16, static_cast<int16_t>(last));
    const auto step = [&](uint32_t i, auto load) {
        // What lies outside the interval saturates.
        const auto two_vectors = [&](const float* values, uint32_t k, auto by) {
            const auto low = truncate(di, hn::Mul(load(values, i + k * kLanes), by));
            const auto high = truncate(di, hn::Mul(load(values, i + (k + 1) * kLanes), by));
            return hn::Min(hn::ReorderDemote2To(d16, low, high), top);
        };
        const auto begin = [&](uint32_t k) { return hn::Max(zero, two_vectors(lower, k, scale)); };
        const auto end = [&](uint32_t k, auto least) { return hn::Max(least, two_vectors(upper, k, end_scale)); };
        const auto begin0 = begin(0);
        const auto begin1 = begin(2);
        auto begin_bytes = join_bytes(d8, begin0, begin1);
        auto end_bytes = join_bytes(d8, end(0, begin0), end(2, begin1));
        if constexpr (kInOrder) {
            begin_bytes = in_order(d8, begin_bytes);
            end_bytes = in_order(d8, end_bytes);
        }
        hn::Store(begin_bytes, d8, out.begin + i);
        hn::Store(end_bytes, d8, out.end + i);
    };
    const auto from_origin = [&](const float* values, uint32_t at) {
        return hn::Sub(hn::LoadU(df, values + at), origin);
    };
    uint32_t i = 0;
    for (; i + 4 * kLanes <= count; i += 4 * kLanes) {
        step(i, from_origin);
    }
    const auto far_behind = hn::Set(df, (1.0F + static_cast<float>(kSlices)) / slices.scale);
    for (; i < (count + 63) / 64 * 64; i += 4 * kLanes) {
        step(i, [&](const float* values, uint32_t at) {
            const auto exists = hn::FirstN(df, at < count ? count - at : 0);
            return hn::IfThenElse(exists, from_origin(values, at), far_behind);
        });
    }
}

/// Bytes of [values, values + count) below first_bound, first_bound + 1, ...; count is a multiple of 64.
template <int kPlanes>
HWY_INLINE void count_below(const int8_t* values, uint32_t count, int first_bound, uint32_t* totals) {
    const hn::ScalableTag<int8_t> d;
    uint32_t below[kPlanes] = {};
    for (uint32_t i = 0; i < count; i += static_cast<uint32_t>(hn::Lanes(d))) {
        const auto v = hn::Load(d, values + i);
        for (int k = 0; k < kPlanes; ++k) {
            below[k] +=
                static_cast<uint32_t>(hn::CountTrue(d, hn::Lt(v, hn::Set(d, static_cast<int8_t>(first_bound + k)))));
        }
    }
    for (int k = 0; k < kPlanes; ++k) {
        totals[first_bound + k] += below[k];
    }
}

inline void count_bins_along(int axis, const References& references, uint32_t count, float lower, float upper,
                             BinCounts& counts) {
    const hn::ScalableTag<float> df;
    constexpr uint32_t kChunk = 1024;
    constexpr int kGroup = (kSlices - 1) / 2;  // planes whose counters stay in registers
    static_assert(kSlices % 2 == 1);
    if (!Slices::can_be_cut(lower, upper)) {
        return;
    }
    const Slices slices(lower, upper);
    const auto a = static_cast<size_t>(axis);
    for (uint32_t begin = 0; begin < count; begin += kChunk) {
        const uint32_t size = std::min(kChunk, count - begin);
        const uint32_t padded = (size + 63) / 64 * 64;
        Quantised<kChunk> q;
        quantise<false>(df, references.lower[a] + begin, references.upper[a] + begin, slices, kSlices - 1, size, q);
        for (int j = 1; j < kSlices; j += kGroup) {
            count_below<kGroup>(q.begin, padded, j, counts.left[axis]);
            count_below<kGroup>(q.end, padded, j, counts.ends_before[axis]);
        }
    }
}

inline void count_bins(const References& references, uint32_t count, const Box3f& range, BinCounts& counts) {
    for (int axis = 0; axis < 3; ++axis) {
        count_bins_along(axis, references, count, range.lower[axis], range.upper[axis], counts);
    }
}

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
