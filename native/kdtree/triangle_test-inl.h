// SPDX-License-Identifier: GPL-3.0-or-later
// The triangle test, eight triangles against one ray: watertight after Woop, Benthin and Wald 2013. The only one there is, so that
// every path gives the same hit. Compiled once per instruction set (see traversal.cpp).

#if defined(ESPALIER_KDTREE_TRIANGLE_TEST_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_KDTREE_TRIANGLE_TEST_INL_H_
#undef ESPALIER_KDTREE_TRIANGLE_TEST_INL_H_
#else
#define ESPALIER_KDTREE_TRIANGLE_TEST_INL_H_
#endif

#include <hwy/highway.h>

#include <cmath>
#include <cstdint>
#include <limits>

#include "kdtree/node.h"
#include "kdtree/traversal.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// The frame in which a ray runs along +z through the origin: axes permuted so that z is the direction's largest component, then
/// sheared.
struct ShearedRay {
    int kx, ky, kz;
    float sx, sy, sz;
    Vec3f origin;
    float t_min;

    explicit ShearedRay(const Ray& ray) : origin(ray.origin), t_min(ray.t_min) {
        const Vec3f d{std::abs(ray.direction.x), std::abs(ray.direction.y), std::abs(ray.direction.z)};
        kz = d.x > d.y ? (d.x > d.z ? 0 : 2) : (d.y > d.z ? 1 : 2);
        kx = (kz + 1) % 3;
        ky = (kz + 2) % 3;
        if (ray.direction[kz] < 0) {  // keeps the winding
            std::swap(kx, ky);
        }
        sz = 1.0F / ray.direction[kz];
        sx = ray.direction[kx] * sz;
        sy = ray.direction[ky] * sz;
    }
};

/// Twice the signed areas that decide inside or outside, again in double: float could not tell them from zero. Products of
/// floats are exact in double, and so the sign is right.
inline void edge_functions(const double (&x)[3], const double (&y)[3], double (&e)[3]) {
    e[0] = x[2] * y[1] - y[2] * x[1];
    e[1] = x[0] * y[2] - y[0] * x[2];
    e[2] = x[1] * y[0] - y[1] * x[0];
}

/// Tests a block and keeps the nearest hit, of equal distances the lowest index. Returns whether anything was hit.
template <bool kAnyHit>
HWY_INLINE bool test_block(const ShearedRay& ray, const TriangleBlock& block, Hit& best) {
    const hn::CappedTag<float, kBlockSize> d;
    constexpr size_t kLanes = hn::MaxLanes(hn::CappedTag<float, kBlockSize>());
    using V = hn::Vec<decltype(d)>;
    bool any = false;
    for (size_t first = 0; first < kBlockSize; first += kLanes) {
        V x[3];
        V y[3];
        V z[3];
        for (int k = 0; k < 3; ++k) {
            z[k] = hn::Sub(hn::Load(d, block.vertex[k][ray.kz] + first), hn::Set(d, ray.origin[ray.kz]));
            x[k] = hn::Sub(hn::Sub(hn::Load(d, block.vertex[k][ray.kx] + first), hn::Set(d, ray.origin[ray.kx])),
                           hn::Mul(hn::Set(d, ray.sx), z[k]));
            y[k] = hn::Sub(hn::Sub(hn::Load(d, block.vertex[k][ray.ky] + first), hn::Set(d, ray.origin[ray.ky])),
                           hn::Mul(hn::Set(d, ray.sy), z[k]));
        }
        V u = hn::Sub(hn::Mul(x[2], y[1]), hn::Mul(y[2], x[1]));
        V v = hn::Sub(hn::Mul(x[0], y[2]), hn::Mul(y[0], x[2]));
        V w = hn::Sub(hn::Mul(x[1], y[0]), hn::Mul(y[1], x[0]));
        const V zero = hn::Zero(d);
        const auto on_edge = hn::Or(hn::Eq(u, zero), hn::Or(hn::Eq(v, zero), hn::Eq(w, zero)));
        if (HWY_UNLIKELY(!hn::AllFalse(d, on_edge))) {
            alignas(32) float xs[3][kLanes];
            alignas(32) float ys[3][kLanes];
            alignas(32) float es[3][kLanes];
            for (int k = 0; k < 3; ++k) {
                hn::Store(x[k], d, xs[k]);
                hn::Store(y[k], d, ys[k]);
            }
            for (size_t i = 0; i < kLanes; ++i) {
                double e[3];
                edge_functions({xs[0][i], xs[1][i], xs[2][i]}, {ys[0][i], ys[1][i], ys[2][i]}, e);
                for (int k = 0; k < 3; ++k) {
                    es[k][i] = static_cast<float>(e[k]);
                }
            }
            u = hn::Load(d, es[0]);
            v = hn::Load(d, es[1]);
            w = hn::Load(d, es[2]);
        }
        const auto none_negative = hn::And(hn::Ge(u, zero), hn::And(hn::Ge(v, zero), hn::Ge(w, zero)));
        const auto none_positive = hn::And(hn::Le(u, zero), hn::And(hn::Le(v, zero), hn::Le(w, zero)));
        const V det = hn::Add(u, hn::Add(v, w));
        const auto inside = hn::AndNot(hn::Eq(det, zero), hn::Or(none_negative, none_positive));
        if (hn::AllFalse(d, inside)) {
            continue;
        }
        const V scaled = hn::Add(hn::Mul(u, z[0]), hn::Add(hn::Mul(v, z[1]), hn::Mul(w, z[2])));
        const V t = hn::Mul(hn::Div(scaled, det), hn::Set(d, ray.sz));
        const auto hit = hn::And(inside, hn::And(hn::Ge(t, hn::Set(d, ray.t_min)), hn::Le(t, hn::Set(d, best.t))));
        if (hn::AllFalse(d, hit)) {
            continue;
        }
        if constexpr (kAnyHit) {
            return true;
        }
        alignas(32) float ts[kLanes];
        alignas(32) float us[kLanes];
        alignas(32) float vs[kLanes];
        hn::Store(hn::IfThenElse(hit, t, hn::Inf(d)), d, ts);
        hn::Store(hn::Div(v, det), d, us);
        hn::Store(hn::Div(w, det), d, vs);
        for (size_t i = 0; i < kLanes; ++i) {
            const auto triangle = static_cast<int32_t>(block.triangle[first + i]);
            if (ts[i] < best.t || (ts[i] == best.t && ts[i] != std::numeric_limits<float>::infinity() &&
                                   (best.triangle < 0 || triangle < best.triangle))) {
                best = {ts[i], us[i], vs[i], triangle};
                any = true;
            }
        }
    }
    return any;
}

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
