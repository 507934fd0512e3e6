// SPDX-License-Identifier: GPL-3.0-or-later
// Triangle blocks in SIMD order. Compiled once per instruction set (see build_kernels.cpp).

#if defined(ESPALIER_KDTREE_BLOCKS_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_KDTREE_BLOCKS_INL_H_
#undef ESPALIER_KDTREE_BLOCKS_INL_H_
#else
#define ESPALIER_KDTREE_BLOCKS_INL_H_
#endif

#include <hwy/highway.h>

#include "kdtree/build_kernels.h"
#include "kdtree/corners-inl.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// The longest side of each triangle's box.
template <class V>
HWY_INLINE V longest_side(const V (&corners)[3][3]) {
    V longest = hn::Zero(hn::DFromV<V>());
    for (int axis = 0; axis < 3; ++axis) {
        const V a = corners[0][axis];
        const V b = corners[1][axis];
        const V c = corners[2][axis];
        longest = hn::Max(longest, hn::Sub(hn::Max(a, hn::Max(b, c)), hn::Min(a, hn::Min(b, c))));
    }
    return longest;
}

/// Fetches triangles of the blocks that come after the one that is written.
HWY_INLINE void prefetch_blocks(const TriangleSoup& soup, const uint32_t* triangles, size_t block, size_t count) {
    constexpr size_t kIndicesAhead = 12;
    constexpr size_t kCornersAhead = 5;
    const auto triangle_or_first = [&](size_t b, size_t i) {
        const uint32_t triangle = triangles[b * kBlockSize + i];
        return triangle == kNoTriangle ? 0 : triangle;
    };
    if (block + kIndicesAhead < count) {
        for (size_t i = 0; i < kBlockSize; ++i) {
            prefetch_indices(soup, triangle_or_first(block + kIndicesAhead, i));
        }
    }
    if (block + kCornersAhead < count) {
        for (size_t i = 0; i < kBlockSize; i += 2) {  // neighbours share corners
            prefetch_corner(soup, triangle_or_first(block + kCornersAhead, i));
        }
    }
}

inline void write_blocks(const TriangleSoup& soup, SizeClasses classes, const uint32_t* triangles, size_t count,
                         TriangleBlock* blocks) {
    const hn::CappedTag<float, kBlockSize> d;
    const hn::RebindToUnsigned<decltype(d)> du;
    const auto missing = hn::Set(du, kNoTriangle);
    for (size_t b = 0; b < count; ++b) {
        prefetch_blocks(soup, triangles, b, count);
        auto longest = hn::Zero(d);
        for (size_t lane = 0; lane < kBlockSize; lane += hn::Lanes(d)) {
            const auto triangle = hn::LoadU(du, triangles + b * kBlockSize + lane);
            hn::Store(triangle, du, blocks[b].triangle + lane);
            const auto is_missing = hn::Eq(triangle, missing);
            alignas(32) uint32_t any[kBlockSize];
            hn::Store(hn::IfThenZeroElse(is_missing, triangle), du, any);  // lanes without a triangle read the first
            hn::Vec<decltype(d)> corners[3][3];
            load_corners(d, soup, any, corners);
            const auto no_corner = hn::RebindMask(d, is_missing);
            longest = hn::Max(longest, hn::IfThenZeroElse(no_corner, longest_side(corners)));
            for (int corner = 0; corner < 3; ++corner) {
                for (int axis = 0; axis < 3; ++axis) {
                    hn::Store(hn::IfThenElse(no_corner, hn::NaN(d), corners[corner][axis]), d,
                              blocks[b].vertex[corner][axis] + lane);
                }
            }
        }
        blocks[b].triangle[0] += classes.of(hn::GetLane(hn::MaxOfLanes(d, longest))) * kMaxTriangles;
    }
}

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
