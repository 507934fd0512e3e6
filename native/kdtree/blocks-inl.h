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

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

inline void write_blocks(const TriangleSoup& soup, const uint32_t* triangles, size_t count, TriangleBlock* blocks) {
    const hn::CappedTag<float, kBlockSize> d;
    const hn::RebindToSigned<decltype(d)> di;
    const auto* indices = reinterpret_cast<const int32_t*>(soup.triangles.data());
    const auto missing = hn::Set(di, static_cast<int32_t>(kNoTriangle));
    for (size_t b = 0; b < count; ++b) {
        for (size_t lane = 0; lane < kBlockSize; lane += hn::Lanes(d)) {
            const auto triangle = hn::LoadU(di, reinterpret_cast<const int32_t*>(triangles) + b * kBlockSize + lane);
            hn::Store(triangle, di, reinterpret_cast<int32_t*>(blocks[b].triangle) + lane);
            const auto is_missing = hn::Eq(triangle, missing);
            const auto any = hn::IfThenZeroElse(is_missing, triangle);  // lanes without a triangle read the first
            const auto corner0 = hn::Add(any, hn::Add(any, any));
            for (int corner = 0; corner < 3; ++corner) {
                const auto vertex = hn::GatherIndex(di, indices + corner, corner0);
                const auto index = hn::Add(vertex, hn::Add(vertex, vertex));
                for (int axis = 0; axis < 3; ++axis) {
                    const auto position = hn::GatherIndex(d, soup.positions.data() + axis, index);
                    hn::Store(hn::IfThenElse(hn::RebindMask(d, is_missing), hn::NaN(d), position), d,
                              blocks[b].vertex[corner][axis] + lane);
                }
            }
        }
    }
}

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
