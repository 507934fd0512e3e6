// SPDX-License-Identifier: GPL-3.0-or-later
// Min-max binning after Shevtsov, Soupikov and Kapustin 2007, section 4: counts of boxes that begin before and end
// behind each plane. Compiled once per instruction set (see build_kernels.cpp).

#if defined(ESPALIER_KDTREE_SLICE_COUNTS_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_KDTREE_SLICE_COUNTS_INL_H_
#undef ESPALIER_KDTREE_SLICE_COUNTS_INL_H_
#else
#define ESPALIER_KDTREE_SLICE_COUNTS_INL_H_
#endif

#include <hwy/highway.h>

#include <algorithm>
#include <array>

#include "kdtree/build_kernels.h"
#include "kdtree/slices-inl.h"

#if HWY_TARGET == HWY_AVX3_DL
// All processors with the rest of it have these instructions, too, and simd_target.cpp asks for them.
HWY_PUSH_ATTRIBUTES(HWY_TARGET_STR ",gfni")
#else
HWY_BEFORE_NAMESPACE();
#endif
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

#if HWY_TARGET == HWY_AVX3_DL
/// For planes 0 to 7 and 8 to 15, a bit for each that lies behind the slice whose number is that of the byte.
constexpr std::array<std::array<uint8_t, 64>, 2> make_planes_behind() {
    std::array<std::array<uint8_t, 64>, 2> tables{};
    for (size_t i = 0; i < 64; ++i) {
        for (size_t plane = i % 16 + 1; plane < kSlices; ++plane) {
            uint8_t& bits = tables[plane / 8][i];
            bits = static_cast<uint8_t>(bits | 1U << plane % 8);
        }
    }
    return tables;
}

constexpr std::array<uint8_t, 64> make_transposition() {
    std::array<uint8_t, 64> from{};
    for (size_t i = 0; i < 64; ++i) {
        from[i] = static_cast<uint8_t>(i % 8 * 8 + i / 8);
    }
    return from;
}

/// Per eight bytes the identity, as an 8x8 matrix of bits.
HWY_INLINE __m512i identity_matrices() { return _mm512_set1_epi64(static_cast<int64_t>(0x8040201008040201U)); }

/// For eight slices each, and planes 0 to 7 or 8 to 15, a byte per plane: which of the slices lie before it, in
/// reverse. Looked up by slice it is bits of planes behind; eight such bytes are an 8x8 matrix, which is transposed.
HWY_INLINE __m512i slices_before_planes(__m512i slices, size_t half) {
    alignas(64) static constexpr auto kPlanesBehind = make_planes_behind();
    const __m512i by_slice = _mm512_shuffle_epi8(_mm512_load_si512(kPlanesBehind[half].data()), slices);
    return _mm512_gf2p8affine_epi64_epi8(identity_matrices(), by_slice, 0);
}

/// Puts the bytes of each plane side by side.
HWY_INLINE __m512i gather_planes(__m512i bytes) {
    alignas(64) static constexpr auto kTransposition = make_transposition();
    return _mm512_permutexvar_epi8(_mm512_load_si512(kTransposition.data()), bytes);
}

/// Counts for each plane the slices before it: population counts of bytes.
class SliceCounter {
 public:
    HWY_INLINE SliceCounter() { bytes_[0] = bytes_[1] = totals_[0] = totals_[1] = _mm512_setzero_si512(); }
    HWY_INLINE void add(hn::Vec<hn::Full512<int8_t>> slices) {
        for (size_t half = 0; half < 2; ++half) {
            bytes_[half] = _mm512_add_epi8(bytes_[half], _mm512_popcnt_epi8(slices_before_planes(slices.raw, half)));
        }
    }
    /// Adds the bytes' counts to the totals: at the latest after kMostVectors.
    HWY_INLINE void empty_bytes() {
        for (size_t half = 0; half < 2; ++half) {
            const __m512i sums = _mm512_sad_epu8(gather_planes(bytes_[half]), _mm512_setzero_si512());
            totals_[half] = _mm512_add_epi64(totals_[half], sums);
            bytes_[half] = _mm512_setzero_si512();
        }
    }
    HWY_INLINE void add_to(uint32_t (&counts)[kPlanes]) const {
        const __m512i both = _mm512_inserti64x4(_mm512_castsi256_si512(_mm512_cvtepi64_epi32(totals_[0])),
                                                _mm512_cvtepi64_epi32(totals_[1]), 1);
        _mm512_store_si512(counts, _mm512_add_epi32(_mm512_load_si512(counts), both));
    }
    static constexpr uint32_t kMostVectors = 255 / 8;

 private:
    __m512i bytes_[2];
    __m512i totals_[2];
};

inline void count_slices(int axis, const float* lower, const float* upper, uint32_t count, Slices slices,
                         BinCounts& counts) {
    constexpr uint32_t kChunk = 64 * SliceCounter::kMostVectors;
    SliceCounter begins;
    SliceCounter ends;
    for (uint32_t first = 0; first < count; first += kChunk) {
        quantise<false>(hn::Full512<float>(), lower + first, upper + first, slices, kSlices - 1,
                        std::min(kChunk, count - first), [&](uint32_t, const auto begin, const auto end) {
                            begins.add(begin);
                            ends.add(end);
                        });
        begins.empty_bytes();
        ends.empty_bytes();
    }
    begins.add_to(counts.left[axis]);
    ends.add_to(counts.ends_before[axis]);
}
#else
/// Vectors after which the counts of a byte lane may be full.
constexpr uint32_t kMostVectors = 255;

/// Bytes of [values, values + count) below first_bound, first_bound + 1, ...; count is a multiple of 64, and of at most
/// kMostVectors. A comparison is -1 in each lane where it holds.
template <int kPlanes>
HWY_INLINE void count_below(const int8_t* values, uint32_t count, int first_bound, uint32_t* totals) {
    const hn::ScalableTag<int8_t> d;
    const hn::RebindToUnsigned<decltype(d)> du;
    const hn::Repartition<uint64_t, decltype(d)> d64;
    hn::Vec<decltype(d)> below[kPlanes];
    for (auto& counts : below) {
        counts = hn::Zero(d);
    }
    for (uint32_t i = 0; i < count; i += static_cast<uint32_t>(hn::Lanes(d))) {
        const auto v = hn::Load(d, values + i);
        for (int k = 0; k < kPlanes; ++k) {
            const auto is_below = hn::Lt(v, hn::Set(d, static_cast<int8_t>(first_bound + k)));
            below[k] = hn::Sub(below[k], hn::VecFromMask(d, is_below));
        }
    }
    for (int k = 0; k < kPlanes; ++k) {
        const auto sum = hn::SumOfLanes(d64, hn::SumsOf8(hn::BitCast(du, below[k])));
        totals[first_bound + k] += static_cast<uint32_t>(hn::GetLane(sum));
    }
}

inline void count_slices(int axis, const float* lower, const float* upper, uint32_t count, Slices slices,
                         BinCounts& counts) {
    const hn::ScalableTag<float> df;
    const hn::Repartition<int8_t, decltype(df)> d8;
    constexpr uint32_t kChunk = kMostVectors * hn::MaxLanes(hn::ScalableTag<int8_t>()) / 64 * 64;
    constexpr int kGroup = (kSlices - 1) / 2;  // planes whose counters stay in registers
    static_assert(kSlices % 2 == 1);
    alignas(64) int8_t begins[kChunk];
    alignas(64) int8_t ends[kChunk];
    for (uint32_t first = 0; first < count; first += kChunk) {
        const uint32_t size = std::min(kChunk, count - first);
        const uint32_t padded = (size + 63) / 64 * 64;
        quantise<false>(df, lower + first, upper + first, slices, kSlices - 1, size,
                        [&](uint32_t i, const auto begin, const auto end) {
                            hn::Store(begin, d8, begins + i);
                            hn::Store(end, d8, ends + i);
                        });
        for (int j = 1; j < kSlices; j += kGroup) {
            count_below<kGroup>(begins, padded, j, counts.left[axis]);
            count_below<kGroup>(ends, padded, j, counts.ends_before[axis]);
        }
    }
}
#endif

inline void count_bins_along(int axis, Interval range, const References& references, uint32_t count,
                             BinCounts& counts) {
    if (Slices::can_be_cut(range.lower, range.upper)) {
        const auto a = static_cast<size_t>(axis);
        count_slices(axis, references.lower[a], references.upper[a], count, Slices(range.lower, range.upper), counts);
    }
}

inline void count_bins(const OpenNode& node, const References& references, uint32_t count, BinCounts& counts) {
    for (int axis = 0; axis < 3; ++axis) {
        const Interval range{node.tight.lower[axis], node.tight.upper[axis]};
        count_bins_along(axis, range, references, count, counts);
    }
}

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
