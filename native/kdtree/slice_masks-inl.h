// SPDX-License-Identifier: GPL-3.0-or-later
// Which references begin before and which end behind each plane between slices, as bit masks. Compiled once per
// instruction set (see build_kernels.cpp).

#if defined(ESPALIER_KDTREE_SLICE_MASKS_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_KDTREE_SLICE_MASKS_INL_H_
#undef ESPALIER_KDTREE_SLICE_MASKS_INL_H_
#else
#define ESPALIER_KDTREE_SLICE_MASKS_INL_H_
#endif

#include <hwy/highway.h>

#include "kdtree/build_kernels.h"
#include "kdtree/compress-inl.h"
#include "kdtree/slice_counts-inl.h"
#include "kdtree/slices-inl.h"

#if HWY_TARGET == HWY_AVX3_DL
HWY_PUSH_ATTRIBUTES(HWY_TARGET_STR ",gfni")
#else
HWY_BEFORE_NAMESPACE();
#endif
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

#if HWY_TARGET == HWY_AVX3_DL
/// Per plane, of 64 slices, those before it: the bits of planes 0 to 7 or 8 to 15.
HWY_INLINE __m512i slices_before(__m512i slices, size_t half) {
    const __m512i reversed = slices_before_planes(slices, half);
    return gather_planes(_mm512_gf2p8affine_epi64_epi8(reversed, identity_matrices(), 0));
}

/// For up to 64 references, two rows of masks: of the first 32, and of the others.
HWY_INLINE void store_masks(__m512i low_planes, __m512i high_planes, uint32_t (*rows)[kPlanes]) {
    const __m512i even = _mm512_set_epi32(30, 28, 26, 24, 22, 20, 18, 16, 14, 12, 10, 8, 6, 4, 2, 0);
    const __m512i odd = _mm512_or_si512(even, _mm512_set1_epi32(1));
    _mm512_store_si512(rows[0], _mm512_permutex2var_epi32(low_planes, even, high_planes));
    _mm512_store_si512(rows[1], _mm512_permutex2var_epi32(low_planes, odd, high_planes));
}

inline void mask_slices(const float* lower, const float* upper, Slices slices, uint32_t count,
                        uint32_t (*left)[kPlanes], uint32_t (*right)[kPlanes]) {
    const __m512i last_plane = _mm512_set_epi64(-1, 0, 0, 0, 0, 0, 0, 0);
    const __m512i all = _mm512_set1_epi64(-1);
    quantise<true>(hn::Full512<float>(), lower, upper, slices, kSlices, count,
                   [&](uint32_t i, const auto begin, const auto end) {
                       store_masks(slices_before(begin.raw, 0),
                                   _mm512_or_si512(slices_before(begin.raw, 1), last_plane), left + i / 32);
                       store_masks(_mm512_xor_si512(slices_before(end.raw, 0), all),
                                   _mm512_andnot_si512(_mm512_or_si512(slices_before(end.raw, 1), last_plane), all),
                                   right + i / 32);
                   });
}
#else
/// Stores a mask of so many references from `first` on.
template <class D>
HWY_INLINE void store_mask(D d, hn::Mask<D> mask, uint32_t first, int plane, uint32_t (*masks)[kPlanes]) {
    const uint64_t bits = mask_bits(d, mask);
    uint32_t& word = masks[first / 32][plane];
    if constexpr (hn::MaxLanes(D()) == 16) {
        word = first % 32 == 0 ? static_cast<uint32_t>(bits) : word | static_cast<uint32_t>(bits << 16);
    } else {
        static_assert(hn::MaxLanes(D()) == 32);
        word = static_cast<uint32_t>(bits);
    }
}

/// For each plane those of `count` references that begin before it, and those that end behind it, 32 a row, up to the
/// next multiple of 64. The last plane is the end of the tight box: all lie before it, even what lies in it.
inline void mask_slices(const float* lower, const float* upper, Slices slices, uint32_t count,
                        uint32_t (*left)[kPlanes], uint32_t (*right)[kPlanes]) {
    const hn::ScalableTag<float> df;
    const hn::Repartition<int8_t, decltype(df)> d8;
    quantise<true>(df, lower, upper, slices, kSlices, count, [&](uint32_t i, const auto begin, const auto end) {
        for (int j = 0; j < kSlices; ++j) {
            store_mask(d8, hn::Lt(begin, hn::Set(d8, static_cast<int8_t>(j))), i, j, left);
            store_mask(d8, hn::Gt(end, hn::Set(d8, static_cast<int8_t>(j - 1))), i, j, right);
        }
        left[i / 32][kSlices] = ~0U;
        right[i / 32][kSlices] = 0;
    });
}
#endif

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
