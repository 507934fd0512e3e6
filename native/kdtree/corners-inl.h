// SPDX-License-Identifier: GPL-3.0-or-later
// The corners of several triangles as vectors. Whole vertices are loaded and transposed, which takes a third of the
// instructions of gathering coordinate by coordinate. Compiled once per instruction set (see build_kernels.cpp).

#if defined(ESPALIER_KDTREE_CORNERS_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_KDTREE_CORNERS_INL_H_
#undef ESPALIER_KDTREE_CORNERS_INL_H_
#else
#define ESPALIER_KDTREE_CORNERS_INL_H_
#endif

#include <hwy/highway.h>

#include "kdtree/tree.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// x, y, z of the vertex and something else; does not read past the last position.
HWY_INLINE hn::Vec<hn::Full128<float>> load_vertex(const TriangleSoup& soup, size_t vertex) {
    const hn::Full128<float> d;
    const float* position = soup.positions.data() + 3 * vertex;
    if (3 * vertex + 4 > soup.positions.size()) {
        const float last[4] = {position[0], position[1], position[2], 0};
        return hn::LoadU(d, last);
    }
    return hn::LoadU(d, position);
}

/// Rows i, i + 4, ... of a vector of lanes: one vertex for each block of four lanes.
template <class D>
HWY_INLINE hn::Vec<D> load_rows(D d, const TriangleSoup& soup, const uint32_t* triangles, size_t corner) {
    if constexpr (hn::MaxLanes(D()) == 4) {
        return load_vertex(soup, soup.triangles[3 * size_t{triangles[0]} + corner]);
    } else {
        const hn::Half<D> half;
        return hn::Combine(d, load_rows(half, soup, triangles + hn::MaxLanes(half), corner),
                           load_rows(half, soup, triangles, corner));
    }
}

/// corners[k][axis]: of corner k of as many triangles as there are lanes.
template <class D>
HWY_INLINE void load_corners(D d, const TriangleSoup& soup, const uint32_t* triangles, hn::Vec<D> (&corners)[3][3]) {
    const hn::Repartition<uint64_t, D> d64;
    for (size_t k = 0; k < 3; ++k) {
        const auto row0 = load_rows(d, soup, triangles, k);
        const auto row1 = load_rows(d, soup, triangles + 1, k);
        const auto row2 = load_rows(d, soup, triangles + 2, k);
        const auto row3 = load_rows(d, soup, triangles + 3, k);
        const auto xy01 = hn::BitCast(d64, hn::InterleaveLower(d, row0, row1));
        const auto xy23 = hn::BitCast(d64, hn::InterleaveLower(d, row2, row3));
        const auto z01 = hn::BitCast(d64, hn::InterleaveUpper(d, row0, row1));
        const auto z23 = hn::BitCast(d64, hn::InterleaveUpper(d, row2, row3));
        corners[k][0] = hn::BitCast(d, hn::InterleaveLower(d64, xy01, xy23));
        corners[k][1] = hn::BitCast(d, hn::InterleaveUpper(d64, xy01, xy23));
        corners[k][2] = hn::BitCast(d, hn::InterleaveLower(d64, z01, z23));
    }
}

/// Triangles of a leaf or a plane lie anywhere in the mesh: their indices are fetched ahead, and once those are there,
/// a corner, which as a rule lies beside the other two.
HWY_INLINE void prefetch_indices(const TriangleSoup& soup, uint32_t triangle) {
    __builtin_prefetch(soup.triangles.data() + 3 * size_t{triangle});
}
HWY_INLINE void prefetch_corner(const TriangleSoup& soup, uint32_t triangle) {
    __builtin_prefetch(soup.positions.data() + 3 * size_t{soup.triangles[3 * size_t{triangle}]});
}

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
