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

inline void write_blocks(const TriangleSoup& soup, const uint32_t* triangles, size_t count, TriangleBlock* blocks) {
    const hn::CappedTag<float, kBlockSize> d;
    const hn::RebindToUnsigned<decltype(d)> du;
    const auto missing = hn::Set(du, kNoTriangle);
    for (size_t b = 0; b < count; ++b) {
        for (size_t lane = 0; lane < kBlockSize; lane += hn::Lanes(d)) {
            const auto triangle = hn::LoadU(du, triangles + b * kBlockSize + lane);
            hn::Store(triangle, du, blocks[b].triangle + lane);
            const auto is_missing = hn::Eq(triangle, missing);
            alignas(32) uint32_t any[kBlockSize];
            hn::Store(hn::IfThenZeroElse(is_missing, triangle), du, any);  // lanes without a triangle read the first
            hn::Vec<decltype(d)> corners[3][3];
            load_corners(d, soup, any, corners);
            for (int corner = 0; corner < 3; ++corner) {
                for (int axis = 0; axis < 3; ++axis) {
                    hn::Store(hn::IfThenElse(hn::RebindMask(d, is_missing), hn::NaN(d), corners[corner][axis]), d,
                              blocks[b].vertex[corner][axis] + lane);
                }
            }
        }
    }
}

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
