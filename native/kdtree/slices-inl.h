// SPDX-License-Identifier: GPL-3.0-or-later
// Equal slices of an interval: the planes between them, and in which slices references begin and end. Compiled once per
// instruction set (see build_kernels.cpp).

#if defined(ESPALIER_KDTREE_SLICES_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_KDTREE_SLICES_INL_H_
#undef ESPALIER_KDTREE_SLICES_INL_H_
#else
#define ESPALIER_KDTREE_SLICES_INL_H_
#endif

#include <hwy/highway.h>

#include "kdtree/build_kernels.h"

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

/// Bytes of 16-bit numbers, saturated; of both vectors by turns, a block of 16 bytes from each pair of blocks.
template <class DU8, class V16>
HWY_INLINE hn::Vec<DU8> narrow(DU8 d8, V16 first, V16 second) {
#if HWY_TARGET == HWY_AVX3_DL
    if constexpr (hn::MaxLanes(DU8()) == 64) {
        return hn::Vec<DU8>{_mm512_packus_epi16(first.raw, second.raw)};
    }
#elif HWY_TARGET == HWY_AVX2
    if constexpr (hn::MaxLanes(DU8()) == 32) {
        return hn::Vec<DU8>{_mm256_packus_epi16(first.raw, second.raw)};
    }
#elif HWY_TARGET == HWY_SSE4
    return hn::Vec<DU8>{_mm_packus_epi16(first.raw, second.raw)};
#endif
    const hn::Half<DU8> half;
    return hn::Combine(d8, hn::DemoteTo(half, second), hn::DemoteTo(half, first));
}

/// Puts the bytes that came from four vectors a, b, c, d through ReorderDemote2To and narrow in order again: each block
/// of 16 holds four of a, four of b, four of c and four of d.
template <class D8>
HWY_INLINE hn::Vec<D8> in_order(D8 d8, hn::Vec<D8> bytes) {
    const hn::Repartition<int32_t, D8> d32;
    constexpr size_t kDwords = hn::MaxLanes(hn::Repartition<int32_t, D8>());
    if constexpr (kDwords == 4) {
        return bytes;
    }
    alignas(64) int32_t from[kDwords];
    for (size_t i = 0; i < kDwords; ++i) {
        from[i] = static_cast<int32_t>(4 * (i % (kDwords / 4)) + i / (kDwords / 4));
    }
    return hn::BitCast(d8, hn::TableLookupLanes(hn::BitCast(d32, bytes), hn::SetTableIndices(d32, from)));
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

/// Quantises references to slices, a byte each, and calls use(first, begins, ends) for one vector of them after the
/// other. Begin: the last slice that starts at or before the lower bound. End: the last slice that starts before the
/// upper bound, and not before the begin, so that a reference that lies in a plane counts behind it. Both from 0 to
/// `last`. Padded to 64 with `last`. References keep their order within a vector if asked to.
template <bool kInOrder, class D, class F>
HWY_INLINE void quantise(D df, const float* lower, const float* upper, Slices slices, int last, uint32_t count,
                         const F& use) {
    const hn::RebindToSigned<D> di;
    const hn::Repartition<int16_t, D> d16;
    const hn::Repartition<int8_t, D> d8;
    const hn::Repartition<uint8_t, D> du8;
    constexpr uint32_t kLanes = hn::MaxLanes(D());
    const auto origin = hn::Set(df, slices.origin);
    const auto scale = hn::Set(df, slices.scale);
    // So that what ends in a plane ends before it; what ends less behind it than its position is rounded may, too.
    const auto end_scale = hn::Set(df, slices.scale * (1 - 0x1p-22F));
    const auto top = hn::Set(du8, static_cast<uint8_t>(last));
    const auto step = [&](uint32_t i, auto load) {
        // What lies outside the interval saturates.
        const auto bytes = [&](const float* values, auto by) {
            const auto of = [&](uint32_t k) { return truncate(di, hn::Mul(load(values, i + k * kLanes), by)); };
            const auto low = hn::ReorderDemote2To(d16, of(0), of(1));
            const auto high = hn::ReorderDemote2To(d16, of(2), of(3));
            return hn::Min(narrow(du8, low, high), top);
        };
        auto begins = bytes(lower, scale);
        auto ends = hn::Max(begins, bytes(upper, end_scale));
        if constexpr (kInOrder) {
            begins = in_order(du8, begins);
            ends = in_order(du8, ends);
        }
        use(i, hn::BitCast(d8, begins), hn::BitCast(d8, ends));
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

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
