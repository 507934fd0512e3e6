// SPDX-License-Identifier: GPL-3.0-or-later
// Phase 1: the boxes of the faces that can be hit. Compiled once per instruction set (see build_kernels.cpp).

#if defined(ESPALIER_KDTREE_BOUNDS_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_KDTREE_BOUNDS_INL_H_
#undef ESPALIER_KDTREE_BOUNDS_INL_H_
#else
#define ESPALIER_KDTREE_BOUNDS_INL_H_
#endif

#include <hwy/highway.h>

#include <algorithm>
#include <cmath>
#include <iterator>
#include <numeric>

#include "geometry/triangle.h"
#include "kdtree/box_union-inl.h"
#include "kdtree/build_kernels.h"
#include "kdtree/corners-inl.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// A component of (v1 - v0) x (v2 - v0), and more than its error: EXACTNESS.md, 3.
template <class D, class V = hn::Vec<D>>
HWY_INLINE void cross_component(D d, const V (&v)[3][3], int axis, V& value, V& bound) {
    const int x = (axis + 1) % 3;
    const int y = (axis + 2) % 3;
    const V a = hn::Mul(hn::Sub(v[1][x], v[0][x]), hn::Sub(v[2][y], v[0][y]));
    const V b = hn::Mul(hn::Sub(v[1][y], v[0][y]), hn::Sub(v[2][x], v[0][x]));
    value = hn::Sub(a, b);
    bound = hn::Add(hn::Mul(hn::Add(hn::Abs(a), hn::Abs(b)), hn::Set(d, 0x1p-21F)), hn::Set(d, 0x1p-100F));
}

/// Writes the reference of one face, or counts why it has none.
inline void make_reference(const TriangleSoup& soup, uint32_t triangle, const References& out, uint32_t& count,
                           RejectedFaces& rejected) {
    const Vec3f v0 = soup.vertex(triangle, 0);
    const Vec3f v1 = soup.vertex(triangle, 1);
    const Vec3f v2 = soup.vertex(triangle, 2);
    if (const FaceFault fault = classify_face(v0, v1, v2); fault != FaceFault::kNone) {
        rejected.count(fault);
        return;
    }
    for (size_t axis = 0; axis < 3; ++axis) {
        const int a = static_cast<int>(axis);
        // Adding +0 turns -0 into +0, so that minima of equal zeros have one bit pattern whatever the order.
        out.lower[axis][count] = std::min({v0[a], v1[a], v2[a]}) + 0.0F;
        out.upper[axis][count] = std::max({v0[a], v1[a], v2[a]}) + 0.0F;
    }
    out.triangle[count++] = triangle;
}

/// The corners of as many faces from `first` on as there are lanes; of those further on, up to `end`, some are fetched.
/// Returns whether all can be hit for certain.
template <class D, class V = hn::Vec<D>>
HWY_INLINE bool load_faces(D d, const TriangleSoup& soup, uint32_t first, uint32_t end, V (&v)[3][3]) {
    constexpr uint32_t kLanes = hn::MaxLanes(D());
    constexpr uint32_t kAhead = 32;
    for (uint32_t face = first + kAhead; face < std::min(first + kAhead + kLanes, end); ++face) {
        prefetch_corner(soup, face);
    }
    uint32_t faces[kLanes];
    std::iota(std::begin(faces), std::end(faces), first);
    load_corners(d, soup, faces, v);
    const V zero = hn::Zero(d);
    const V limit = hn::Set(d, kMaxCoordinate);
    auto valid = hn::Eq(zero, zero);
    for (int k = 0; k < 3; ++k) {
        for (int axis = 0; axis < 3; ++axis) {
            v[k][axis] = hn::Add(v[k][axis], zero);
            valid = hn::And(valid, hn::Le(hn::Abs(v[k][axis]), limit));
        }
    }
    auto has_area = hn::Lt(zero, zero);
    for (int axis = 0; axis < 3; ++axis) {
        V value;
        V bound;
        cross_component(d, v, axis, value, bound);
        has_area = hn::Or(has_area, hn::Gt(hn::Abs(value), bound));
    }
    return hn::AllTrue(d, hn::And(valid, has_area));
}

inline uint32_t make_references(const TriangleSoup& soup, uint32_t begin, uint32_t end, const References& out,
                                Box3f& bounds, RejectedFaces& rejected) {
    const hn::ScalableTag<float> df;
    const hn::RebindToUnsigned<decltype(df)> du;
    const uint32_t lanes = static_cast<uint32_t>(hn::Lanes(df));
    BoxUnion seen(df);
    uint32_t count = 0;
    uint32_t triangle = begin;
    for (; triangle + lanes <= end; triangle += lanes) {
        hn::Vec<decltype(df)> v[3][3];
        if (!load_faces(df, soup, triangle, end, v)) {
            for (uint32_t lane = 0; lane < lanes; ++lane) {
                const uint32_t at = count;
                make_reference(soup, triangle + lane, out, count, rejected);
                if (count > at) {
                    bounds.extend(out.box(at));
                }
            }
            continue;
        }
        for (int axis = 0; axis < 3; ++axis) {
            const auto a = static_cast<size_t>(axis);
            const auto low = hn::Min(v[0][a], hn::Min(v[1][a], v[2][a]));
            const auto high = hn::Max(v[0][a], hn::Max(v[1][a], v[2][a]));
            hn::StoreU(low, df, out.lower[a] + count);
            hn::StoreU(high, df, out.upper[a] + count);
            seen.extend(axis, low, high);
        }
        hn::StoreU(hn::Iota(du, triangle), du, out.triangle + count);
        count += lanes;
    }
    for (; triangle < end; ++triangle) {
        const uint32_t at = count;
        make_reference(soup, triangle, out, count, rejected);
        if (count > at) {
            bounds.extend(out.box(at));
        }
    }
    bounds.extend(seen.box());
    return count;
}

inline RejectedFaces count_rejected(const TriangleSoup& soup, uint32_t begin, uint32_t end) {
    const hn::ScalableTag<float> d;
    constexpr uint32_t kLanes = hn::MaxLanes(hn::ScalableTag<float>());
    RejectedFaces rejected;
    for (uint32_t first = begin; first < end; first += kLanes) {
        hn::Vec<decltype(d)> v[3][3];
        const bool is_whole = first + kLanes <= end;
        if (is_whole && load_faces(d, soup, first, end, v)) {
            continue;
        }
        for (uint32_t face = first; face < std::min(first + kLanes, end); ++face) {
            rejected.count(classify_face(soup.vertex(face, 0), soup.vertex(face, 1), soup.vertex(face, 2)));
        }
    }
    return rejected;
}

/// The box of those of the vertices [begin, end) that a face can have.
inline Box3f bound_vertices(const TriangleSoup& soup, size_t begin, size_t end) {
    const hn::ScalableTag<float> d;
    constexpr size_t kLanes = hn::MaxLanes(hn::ScalableTag<float>());
    const auto limit = hn::Set(d, kMaxCoordinate);
    BoxUnion seen(d);
    Box3f box;
    size_t vertex = begin;
    for (; vertex + kLanes <= end; vertex += kLanes) {
        hn::Vec<decltype(d)> v[3];
        hn::LoadInterleaved3(d, soup.positions.data() + 3 * vertex, v[0], v[1], v[2]);
        auto valid = hn::Le(hn::Abs(v[0]), limit);
        valid = hn::And(valid, hn::And(hn::Le(hn::Abs(v[1]), limit), hn::Le(hn::Abs(v[2]), limit)));
        for (int axis = 0; axis < 3; ++axis) {
            seen.extend(axis, valid, v[axis], v[axis]);
        }
    }
    for (; vertex < end; ++vertex) {
        const float* v = soup.positions.data() + 3 * vertex;
        if (std::abs(v[0]) <= kMaxCoordinate && std::abs(v[1]) <= kMaxCoordinate && std::abs(v[2]) <= kMaxCoordinate) {
            box.extend(Vec3f{v[0], v[1], v[2]});
        }
    }
    box.extend(seen.box());
    return box;
}

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
