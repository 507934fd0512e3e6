// SPDX-License-Identifier: GPL-3.0-or-later
// The triangle test, eight triangles against one ray: a float filter with a proven error bound, and the exact decision
// for the few triangles that pass it. The only test there is, so that every path gives the same hit. Compiled once per
// instruction set (see traversal.cpp).

#if defined(ESPALIER_KDTREE_TRIANGLE_TEST_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_KDTREE_TRIANGLE_TEST_INL_H_
#undef ESPALIER_KDTREE_TRIANGLE_TEST_INL_H_
#else
#define ESPALIER_KDTREE_TRIANGLE_TEST_INL_H_
#endif

#include <hwy/highway.h>

#include <bit>
#include <cmath>
#include <cstdint>
#include <limits>

#include "geometry/exact_hit.h"
#include "kdtree/node.h"
#include "kdtree/traversal.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// The frame in which a ray runs along +z through the origin: axes permuted so that z is the direction's largest
/// component, then sheared (Woop, Benthin and Wald 2013).
struct ShearedRay {
    int kx, ky, kz;
    float ox, oy, oz;  ///< the origin, permuted
    float sx, sy, sz;

    explicit ShearedRay(Vec3f origin, Vec3f direction) {
        const Vec3f d{std::abs(direction.x), std::abs(direction.y), std::abs(direction.z)};
        kz = d.x > d.y ? (d.x > d.z ? 0 : 2) : (d.y > d.z ? 1 : 2);
        kx = (kz + 1) % 3;
        ky = (kz + 2) % 3;
        ox = origin[kx];
        oy = origin[ky];
        oz = origin[kz];
        sz = 1.0F / direction[kz];
        sx = direction[kx] * sz;
        sy = direction[ky] * sz;
    }
};

/// The nearest hit so far, as exact arithmetic orders them.
class NearestHit {
 public:
    explicit NearestHit(const Ray& ray) : ray_(ray), reach_(ray.t_max) {}

    /// No hit farther than this, rounded up, can still count.
    float reach() const { return reach_; }
    bool found() const { return hit_.triangle >= 0; }

    /// Takes the triangle in if the ray hits it within its interval, nearer than the hit so far or as near with a lower
    /// index.
    HWY_NOINLINE bool offer(const TriangleBlock& block, uint32_t lane) {
        Vec3f corner[3];
        for (int k = 0; k < 3; ++k) {
            corner[k] = {block.vertex[k][0][lane], block.vertex[k][1][lane], block.vertex[k][2][lane]};
        }
        ExactHit candidate;
        candidate.triangle = static_cast<int32_t>(block.triangle[lane]);
        if (candidate.triangle == hit_.triangle || !hit_exactly(ray_.origin, ray_.direction, corner, candidate) ||
            compare_distance(ray_.origin, ray_.direction, candidate, ray_.t_min) < 0 ||
            compare_distance(ray_.origin, ray_.direction, candidate, ray_.t_max) > 0) {
            return false;
        }
        if (found()) {
            const int order = compare_distance(ray_.origin, ray_.direction, candidate, hit_);
            if (order > 0 || (order == 0 && candidate.triangle > hit_.triangle)) {
                return false;
            }
        }
        hit_ = candidate;
        reach_ = round_to_float(hit_.t + hit_.error) * (1 + 0x1p-22F) + 0x1p-140F;
        return true;
    }

    Hit result() {
        if (!found()) {
            return {ray_.t_max, 0, 0, -1};
        }
        finish_distance(ray_.origin, ray_.direction, hit_);
        return {round_to_float(hit_.t), static_cast<float>(hit_.u), static_cast<float>(hit_.v), hit_.triangle};
    }

 private:
    /// Infinite beyond the largest float, where the language leaves a cast open.
    static float round_to_float(double t) {
        return t > double{std::numeric_limits<float>::max()} ? std::numeric_limits<float>::infinity()
                                                             : static_cast<float>(t);
    }

    const Ray& ray_;
    float reach_;
    ExactHit hit_{0, 0, 0, 0, {}, -1};
};

/// The lanes of a block that the ray may hit within [t_min, reach]; every lane that it does hit is among them.
///
/// With u = 2^-24 and mx, my, mz the largest |x|, |y| and |z| of the corners seen from the origin: a sheared coordinate
/// is off by at most u (2 mx + 5 mz), since the shear carries two roundings, z one, their product and the difference
/// one each and x one. An edge function, a difference of two products of such, is then off by at most u (12 mx my + 10
/// mz (mx + my)) + 50 u^2 mz^2, and `bound` is above that by more than the roundings of its own sum.
HWY_INLINE uint32_t possible_hits(const ShearedRay& sheared, const TriangleBlock& block, float t_min, float reach) {
    const hn::CappedTag<float, kBlockSize> d;
    constexpr size_t kLanes = hn::MaxLanes(hn::CappedTag<float, kBlockSize>());
    using V = hn::Vec<decltype(d)>;
    uint32_t possible = 0;
    for (size_t first = 0; first < kBlockSize; first += kLanes) {
        V x[3];
        V y[3];
        V z[3];
        for (int k = 0; k < 3; ++k) {
            z[k] = hn::Sub(hn::Load(d, block.vertex[k][sheared.kz] + first), hn::Set(d, sheared.oz));
            x[k] = hn::Sub(hn::Sub(hn::Load(d, block.vertex[k][sheared.kx] + first), hn::Set(d, sheared.ox)),
                           hn::Mul(hn::Set(d, sheared.sx), z[k]));
            y[k] = hn::Sub(hn::Sub(hn::Load(d, block.vertex[k][sheared.ky] + first), hn::Set(d, sheared.oy)),
                           hn::Mul(hn::Set(d, sheared.sy), z[k]));
        }
        const auto largest = [](const V(&c)[3]) {
            return hn::Max(hn::Max(hn::Abs(c[0]), hn::Abs(c[1])), hn::Abs(c[2]));
        };
        const V mx = largest(x);
        const V my = largest(y);
        const V mz = hn::Max(largest(z), hn::Set(d, 0x1p-115F));  // so that the bound covers a shear that underflows
        // u (13.5 mx my + 10.5 mz (mx + my) + 64 u mz^2), one factor each.
        const V bound = hn::Add(
            hn::Mul(hn::Set(d, 0x1p-24F), hn::Add(hn::Mul(hn::Mul(hn::Set(d, 13.5F), mx), my),
                                                  hn::Mul(mz, hn::Add(hn::Mul(hn::Set(d, 10.5F), hn::Add(mx, my)),
                                                                      hn::Mul(hn::Set(d, 0x1p-18F), mz))))),
            hn::Set(d, 0x1p-140F));
        const V u = hn::Sub(hn::Mul(x[2], y[1]), hn::Mul(y[2], x[1]));
        const V v = hn::Sub(hn::Mul(x[0], y[2]), hn::Mul(y[0], x[2]));
        const V w = hn::Sub(hn::Mul(x[1], y[0]), hn::Mul(y[1], x[0]));
        const V least = hn::Min(u, hn::Min(v, w));
        const V most = hn::Max(u, hn::Max(v, w));
        // Lanes without a triangle are NaN and fail both.
        const auto inside = hn::Or(hn::Ge(least, hn::Neg(bound)), hn::Le(most, bound));
        if (hn::AllFalse(d, inside)) {
            continue;
        }
        // The distance along z is the mean of the corners' z by weights u, v and w. Errors of the weights count by the
        // spread of the z, which is at most 2 mz; the rest is below 16 u mz, or underflow. Where the weights' sum is no
        // larger than its error, or so small that its reciprocal may overflow, any distance is possible.
        const V det = hn::Add(u, hn::Add(v, w));
        const V inverse = hn::Div(hn::Set(d, 1), det);
        const V mean = hn::Add(hn::Mul(hn::Mul(u, inverse), z[0]),
                               hn::Add(hn::Mul(hn::Mul(v, inverse), z[1]), hn::Mul(hn::Mul(w, inverse), z[2])));
        const V doubt = hn::Mul(hn::Set(d, 8), bound);
        const V sure = hn::Sub(hn::Abs(det), doubt);
        const V error =
            hn::Add(hn::Mul(hn::Add(hn::Div(doubt, sure), hn::Set(d, 0x1p-19F)), mz), hn::Set(d, 0x1p-140F));
        const V t = hn::Mul(mean, hn::Set(d, sheared.sz));
        const V t_error = hn::Mul(error, hn::Set(d, std::abs(sheared.sz)));
        const auto too_far = hn::Gt(hn::Sub(t, t_error), hn::Set(d, reach));
        const auto too_near = hn::Lt(hn::Add(t, t_error), hn::Set(d, t_min));
        const auto ruled_out = hn::And(hn::Gt(sure, hn::Set(d, 0x1p-120F)), hn::Or(too_far, too_near));
        uint8_t bits[8] = {};
        hn::StoreMaskBits(d, hn::AndNot(ruled_out, inside), bits);
        possible |= static_cast<uint32_t>(bits[0]) << first;
    }
    return possible;
}

/// Offers every triangle of the block that the ray may hit. Returns whether one was taken.
template <bool kAnyHit>
HWY_INLINE bool test_block(const Ray& ray, const ShearedRay& sheared, const TriangleBlock& block, NearestHit& nearest) {
    bool taken = false;
    for (uint32_t lanes = possible_hits(sheared, block, ray.t_min, nearest.reach()); lanes != 0; lanes &= lanes - 1) {
        taken |= nearest.offer(block, static_cast<uint32_t>(std::countr_zero(lanes)));
        if (kAnyHit && taken) {
            return true;
        }
    }
    return taken;
}

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
