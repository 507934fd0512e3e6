// SPDX-License-Identifier: GPL-3.0-or-later
// Points and directions drawn from distributions, one a lane. Products and sums are written as they are to be rounded,
// with no fused operations, so that all instruction sets agree. Compiled once per instruction set (see light_rays.cpp).

#if defined(ESPALIER_RENDER_SAMPLING_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_RENDER_SAMPLING_INL_H_
#undef ESPALIER_RENDER_SAMPLING_INL_H_
#else
#define ESPALIER_RENDER_SAMPLING_INL_H_
#endif

#include <hwy/highway.h>

#include <cstdint>
#include <numbers>

#include "geometry/vec.h"
#include "render/sampling.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

using RealTag = hn::CappedTag<double, 8>;
using Real = hn::Vec<RealTag>;
using RealMask = hn::Mask<RealTag>;
using Bits = hn::Vec<hn::Rebind<uint32_t, RealTag>>;

HWY_INLINE Real all_lanes(double value) { return hn::Set(RealTag(), value); }

/// A point, direction or colour in each lane.
struct RealVec3 {
    Real x, y, z;
};

HWY_INLINE RealVec3 all_lanes(Vec3d a) { return {all_lanes(a.x), all_lanes(a.y), all_lanes(a.z)}; }

HWY_INLINE RealVec3 operator+(const RealVec3& a, const RealVec3& b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
HWY_INLINE RealVec3 operator-(const RealVec3& a, const RealVec3& b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
HWY_INLINE RealVec3 operator-(const RealVec3& a) { return {hn::Neg(a.x), hn::Neg(a.y), hn::Neg(a.z)}; }
HWY_INLINE RealVec3 operator*(const RealVec3& a, const RealVec3& b) { return {a.x * b.x, a.y * b.y, a.z * b.z}; }
HWY_INLINE RealVec3 operator*(const RealVec3& a, Real s) { return {a.x * s, a.y * s, a.z * s}; }
HWY_INLINE RealVec3 operator/(const RealVec3& a, Real s) { return {a.x / s, a.y / s, a.z / s}; }
HWY_INLINE Real dot(const RealVec3& a, const RealVec3& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
HWY_INLINE Real length(const RealVec3& a) { return hn::Sqrt(dot(a, a)); }

/// Each a Sample2.
struct RealPair {
    Real x, y;
};

HWY_INLINE Bits hashed(Bits x) {
    const hn::DFromV<Bits> d;
    x = (x ^ hn::ShiftRight<16>(x)) * hn::Set(d, 0x7feb352dU);
    x = (x ^ hn::ShiftRight<15>(x)) * hn::Set(d, 0x846ca68bU);
    return x ^ hn::ShiftRight<16>(x);
}

/// In units of 2^-32. Of the conversions that there are, all take signed numbers.
HWY_INLINE Real fraction(Bits bits) {
    const hn::Rebind<int32_t, RealTag> di;
    const auto shifted = hn::BitCast(di, bits ^ hn::Set(hn::DFromV<Bits>(), 0x80000000U));
    return (hn::PromoteTo(RealTag(), shifted) + all_lanes(0x1p31)) * all_lanes(0x1p-32);
}

/// As scrambled() of one point in sampling.h.
HWY_INLINE RealPair scrambled(Bits x, Bits y, Bits seed) {
    const hn::DFromV<Bits> d;
    return {fraction(x ^ hashed(seed)), fraction(y ^ hashed(seed ^ hn::Set(d, kSecondScramble)))};
}

struct SineCosine {
    Real sine, cosine;
};

/// Of an angle of at most pi / 4 in size, by Taylor's series, each off by less than 1e-12.
HWY_INLINE SineCosine sine_cosine(Real angle) {
    const Real one = all_lanes(1.0);
    const Real square = angle * angle;
    Real sine = all_lanes(0.0);
    Real cosine = all_lanes(0.0);
    for (int n = 12; n > 0; n -= 2) {
        sine = (one + sine) * (square * all_lanes(-1.0 / (n * (n + 1))));
        cosine = (one + cosine) * (square * all_lanes(-1.0 / (n * (n - 1))));
    }
    return {angle + angle * sine, one + cosine};
}

/// Uniform on the unit disk; keeps strata together (Shirley and Chiu).
HWY_INLINE RealPair sample_disk(RealPair s) {
    const Real a = all_lanes(2.0) * s.x - all_lanes(1.0);
    const Real b = all_lanes(2.0) * s.y - all_lanes(1.0);
    const RealMask wide = hn::Gt(hn::Abs(a), hn::Abs(b));
    const Real radius = hn::IfThenElse(wide, a, b);
    const Real turn = all_lanes(std::numbers::pi / 4.0) * hn::IfThenElse(wide, b, a) / radius;
    // The middle divides nothing by nothing.
    const auto [sine, cosine] = sine_cosine(hn::IfThenZeroElse(hn::Eq(radius, all_lanes(0.0)), turn));
    return {radius * hn::IfThenElse(wide, cosine, sine), radius * hn::IfThenElse(wide, sine, cosine)};
}

/// Two unit vectors that complete the unit vector `n` to an orthonormal frame (Duff et al., 2017).
struct Tangents {
    RealVec3 x, y;
};
HWY_INLINE Tangents tangents(const RealVec3& n) {
    const Real one = all_lanes(1.0);
    const Real sign = hn::CopySign(one, n.z);
    const Real a = all_lanes(-1.0) / (sign + n.z);
    const Real b = n.x * n.y * a;
    return {{one + sign * n.x * n.x * a, sign * b, hn::Neg(sign) * n.x}, {b, sign + n.y * n.y * a, hn::Neg(n.y)}};
}

/// A direction about the unit vector `n` with density cos / pi.
HWY_INLINE RealVec3 sample_cosine(const RealVec3& n, RealPair s) {
    const RealPair d = sample_disk(s);
    const Tangents t = tangents(n);
    const Real height = hn::Sqrt(hn::Max(all_lanes(1.0) - d.x * d.x - d.y * d.y, all_lanes(0.0)));
    return t.x * d.x + t.y * d.y + n * height;
}

/// The point of the unit circle so many turns from (1, 0).
HWY_INLINE RealPair sample_circle(Real turns) {
    const Real quarters = hn::Floor(all_lanes(4.0) * turns + all_lanes(0.5));  // 0 to 4
    const auto [sine, cosine] = sine_cosine(all_lanes(std::numbers::pi / 2.0) * (all_lanes(4.0) * turns - quarters));
    const RealMask is_one = hn::Eq(quarters, all_lanes(1.0));
    const RealMask is_two = hn::Eq(quarters, all_lanes(2.0));
    const RealMask is_three = hn::Eq(quarters, all_lanes(3.0));
    const RealMask is_odd = hn::Or(is_one, is_three);
    const Real x = hn::IfThenElse(is_odd, hn::Neg(sine), cosine);
    const Real y = hn::IfThenElse(is_odd, cosine, sine);
    const RealMask is_beyond = hn::Or(is_two, is_three);
    return {hn::IfThenElse(is_beyond, hn::Neg(x), x), hn::IfThenElse(is_beyond, hn::Neg(y), y)};
}

/// A direction within the cone of half angle acos(cos_half) about the unit vector `axis`, uniform over its solid angle.
HWY_INLINE RealVec3 sample_cone(const RealVec3& axis, Real cos_half, RealPair s) {
    const Real one = all_lanes(1.0);
    const Real cos_theta = one - s.x * (one - cos_half);
    const Real sin_theta = hn::Sqrt(hn::Max(one - cos_theta * cos_theta, all_lanes(0.0)));
    const RealPair side = sample_circle(s.y);
    const Tangents t = tangents(axis);
    return axis * cos_theta + t.x * (sin_theta * side.x) + t.y * (sin_theta * side.y);
}

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
