// SPDX-License-Identifier: GPL-3.0-or-later
// The triangle test, eight triangles against one ray in float: what the ray meets for certain, what it may meet, and
// between which depths. What float cannot decide goes to exact arithmetic. Compiled once per instruction set (see
// traversal.cpp).

#if defined(ESPALIER_KDTREE_TRIANGLE_TEST_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_KDTREE_TRIANGLE_TEST_INL_H_
#undef ESPALIER_KDTREE_TRIANGLE_TEST_INL_H_
#else
#define ESPALIER_KDTREE_TRIANGLE_TEST_INL_H_
#endif

#include <hwy/highway.h>

#include <cstdint>

#include "kdtree/candidate.h"
#include "kdtree/node.h"
#include "kdtree/traced_ray-inl.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// Blocks that one step tests: as many as fill a register.
constexpr uint32_t kBlocksPerStep = hn::MaxLanes(hn::CappedTag<float, 2 * kBlockSize>()) == 2 * kBlockSize ? 2 : 1;

/// Whether rays are first asked if they may meet any of the triangles at all. Of one block they do in a quarter of the
/// steps, of two in half of them, which saves less than it costs.
constexpr bool kAsksFirst = kBlocksPerStep == 1;

/// What the float test says of the lanes it does not rule out. Lanes of a second block follow those of the first.
struct Verdict {
    alignas(64) float lower[kBlocksPerStep * kBlockSize];  ///< the true depth of a hit lies between these two
    alignas(64) float upper[kBlocksPerStep * kBlockSize];
    uint32_t certain;  ///< lanes that the line meets, by whatever depth
};

/// Reads blocks lane by lane, those of a second block behind the first's; a single block stands for both.
class BlockLoader {
 public:
    /// second: 1, or 0 for a single block. Not a choice, which compilers would make with a branch.
    HWY_INLINE BlockLoader(const TriangleBlock* block, uint32_t second)
        : first_(block->vertex[0][0]), second_(block[second].vertex[0][0]) {}

    HWY_INLINE auto operator()(size_t from) const {
        const hn::CappedTag<float, kBlocksPerStep * kBlockSize> d;
        if constexpr (kBlocksPerStep == 2) {
            const hn::Half<decltype(d)> half;
            return hn::Combine(d, hn::Load(half, second_ + from), hn::Load(half, first_ + from));
        } else {
            return hn::Load(d, first_ + from);
        }
    }

 private:
    const float* first_;
    [[maybe_unused]] const float* second_;
};

/// One ray for all lanes, or one for each.
template <class V>
struct ShearedRay {
    uint32_t x, y, z;  ///< as in TracedRay, and so are the others
    V minus_ox, minus_oy, minus_oz;
    V sx, sy;
    V slant;
};

template <class D, class SomeRay>
HWY_INLINE ShearedRay<hn::Vec<D>> sheared_for_all(D d, const SomeRay& ray) {
    return {ray.x,
            ray.y,
            ray.z,
            hn::Set(d, ray.minus_ox),
            hn::Set(d, ray.minus_oy),
            hn::Set(d, ray.minus_oz),
            hn::Set(d, ray.sx),
            hn::Set(d, ray.sy),
            hn::Set(d, ray.slant)};
}

/// Less than minus the error of any edge function of corners whose largest |x| and |y| make up `sum`; lean: how far
/// they may move by their z being rounded. EXACTNESS.md, 8.
template <class V>
HWY_INLINE V minus_edge_error_within(V sum, V lean) {
    const hn::DFromV<V> d;
    const V s = hn::MulAdd(hn::Set(d, 5.5F), lean, sum);
    const V slope = hn::MulAdd(hn::Set(d, 10.5F), lean, hn::Mul(hn::Set(d, 3.25F * 0x1p-24F), s));
    return hn::NegMulSub(s, slope, hn::Set(d, kTiny));
}

/// Triangles as a ray sees them, along +z through the origin, and their edge functions: the weights of the corners.
template <class V>
struct Sheared {
    V x[3];
    V y[3];
    V z[3];
    V side[3];

    /// load(k, axis): the coordinates of corner k, `axis` as in TracedRay.
    template <class Load>
    HWY_INLINE Sheared(const ShearedRay<V>& ray, const Load& load) {
        for (size_t k = 0; k < 3; ++k) {
            z[k] = hn::Add(ray.minus_oz, load(k, ray.z));
            x[k] = hn::NegMulAdd(ray.sx, z[k], hn::Add(ray.minus_ox, load(k, ray.x)));
            y[k] = hn::NegMulAdd(ray.sy, z[k], hn::Add(ray.minus_oy, load(k, ray.y)));
        }
        side[0] = hn::MulSub(x[2], y[1], hn::Mul(y[2], x[1]));
        side[1] = hn::MulSub(x[0], y[2], hn::Mul(y[0], x[2]));
        side[2] = hn::MulSub(x[1], y[0], hn::Mul(y[1], x[0]));
    }

    /// Less than minus the error of any of the three edge functions; mz: the largest |z| of the corners.
    HWY_INLINE V minus_edge_error(V slant, V mz) const {
        return minus_edge_error_within(hn::Add(largest_of(x), largest_of(y)), hn::Mul(slant, mz));
    }
};

/// How far inside the least convincing of three edge functions lies.
template <class V>
HWY_INLINE V depth_inside(const V (&side)[3]) {
    return hn::Max(hn::Min(side[0], hn::Min(side[1], side[2])), hn::Neg(hn::Max(side[0], hn::Max(side[1], side[2]))));
}

/// Between which depths the lines meet triangles' planes.
template <class V>
struct DepthRange {
    V lower;
    V upper;
    hn::Mask<hn::DFromV<V>> is_sound;  ///< both are finite
};

/// How far a depth may be off: per share of det that its error takes and depth between the corners, and per depth for
/// rounding (see depth_range).
constexpr float kErrorOfWeights = 8.5F;
constexpr float kErrorOfRounding = 0x1p-19F;

/// z0 + (v r1 + w r2) / det, given the reciprocal of det.
template <class V>
HWY_INLINE V depth_of(const V (&side)[3], V inverse, V z0, V r1, V r2) {
    return hn::MulAdd(hn::Mul(side[1], inverse), r1, hn::MulAdd(hn::Mul(side[2], inverse), r2, z0));
}

/// Of hits inside triangles whose edge functions are off by at most `bound`, whose first corners lie at z0 and the
/// others r1 and r2 behind it, mz the largest |z|; sign: of the direction along z.
///
/// The depth is z0 + (v (z1 - z0) + w (z2 - z0)) / det for weights u, v, w and their sum det. Where |det| >= 32 bound,
/// the true weights of a lane that is not ruled out are at most 1.2 of det in size; with r the larger of |z1 - z0| and
/// |z2 - z0|, errors of v and w move the depth by 2 bound r / |det|, those of det, at most 4 bound with its own
/// roundings, by 4 * 1.3 bound r / |det|, and the difference between det and its true value makes that 8.3 at most. The
/// z are off by u mz each and the other operations by less than 24 u mz together: 2^-19 mz covers them.
template <bool kExact, class V>
HWY_INLINE DepthRange<V> depth_range(const V (&side)[3], V bound, V mz, V z0, V r1, V r2, float sign) {
    const hn::DFromV<V> d;
    const V det = hn::Add(side[0], hn::Add(side[1], side[2]));
    const V inverse = hn::Div(hn::Set(d, 1), det);
    const V depth = hn::Mul(depth_of(side, inverse, z0, r1, r2), hn::Set(d, sign));
    if constexpr (!kExact) {
        return {depth, depth, hn::Eq(depth, depth)};
    }
    // So small a det that it may have no reciprocal makes this infinite.
    const V share = hn::Mul(bound, hn::Abs(inverse));
    const auto is_sound = hn::Le(share, hn::Set(d, 1.0F / 33));
    const V doubt = hn::Mul(share, largest_of(r1, r2));
    const V error =
        hn::MulAdd(hn::Set(d, kErrorOfWeights), doubt, hn::MulAdd(hn::Set(d, kErrorOfRounding), mz, hn::Set(d, kTiny)));
    return {hn::IfThenElse(is_sound, hn::Sub(depth, error), hn::Set(d, -kInfinity)),
            hn::IfThenElse(is_sound, hn::Add(depth, error), hn::Set(d, kInfinity)), is_sound};
}

/// The lanes of a block that the ray may hit, by whatever depth, and others that come near; least_inside: no edge
/// function of a triangle that it hits is less inside.
template <bool kExact, class SomeRay>
HWY_INLINE uint32_t lanes_in_question(const SomeRay& ray, const TriangleBlock& block, float least_inside) {
    const hn::CappedTag<float, kBlockSize> d;
    constexpr size_t kLanes = hn::MaxLanes(hn::CappedTag<float, kBlockSize>());
    using V = hn::Vec<decltype(d)>;
    const ShearedRay<V> sheared = sheared_for_all(d, ray);
    const V least = hn::Set(d, kExact ? least_inside : 0);
    uint32_t lanes = 0;
    for (size_t first = 0; first < kBlockSize; first += kLanes) {
        const Sheared<V> seen(sheared,
                              [&](size_t k, uint32_t axis) { return hn::Load(d, block.vertex[k][0] + first + axis); });
        // Lanes without a triangle are NaN and fail.
        lanes |= mask_bits(d, hn::Ge(depth_inside(seen.side), least)) << first;
    }
    return lanes;
}

/// Of triangles as Sheared has them, what their errors are found by.
template <class V>
struct EdgeLimits {
    V minus_error;  ///< no edge function is off by more than minus this
    V mz;           ///< no corner's |z| is larger
};

/// The lanes of a step's triangles that the ray may hit within [start, reach]; every lane that it does hit is among
/// them. load(from): coordinates that lie so many floats behind those of the first corners on the first axis;
/// limits(seen): the EdgeLimits of triangles, as Sheared has them.
///
/// With u = 2^-24, mx, my, mz the largest |x|, |y| and |z| of the corners seen from the origin, and n what the shear
/// makes of mz: a sheared coordinate is off by at most u (2 mx + 5 n), since the shear carries one rounding, z one,
/// their product and the difference one each and x one. An edge function, a difference of two products of such, is then
/// off by at most u (12 mx my + 10 n (mx + my)) + 50 u^2 n^2. With s = mx + my + 5.5 u n, and mx my <= (mx + my)^2 / 4,
/// that is less than u s (3.1 s + 10.1 n), and `bound` lies above by more than the roundings of its own sum. Fused
/// operations only leave roundings out. Underflow adds less than kTiny: a product's is below 2^-149, and a coordinate's
/// counts by at most 2^-149 s, which u s^2 outweighs from s = 2^-125 on.
template <bool kExact, class SomeRay, class Load, class Limits>
HWY_INLINE uint32_t test_lanes(const SomeRay& ray, const Load& load, const Limits& limits, Verdict& verdict) {
    const hn::CappedTag<float, kBlocksPerStep * kBlockSize> d;
    constexpr size_t kLanes = hn::MaxLanes(hn::CappedTag<float, kBlocksPerStep * kBlockSize>());
    using V = hn::Vec<decltype(d)>;
    const ShearedRay<V> sheared = sheared_for_all(d, ray);
    uint32_t possible = 0;
    uint32_t certain = 0;
    for (size_t first = 0; first < kBlockSize; first += kLanes) {
        const Sheared<V> seen(sheared,
                              [&](size_t k, uint32_t axis) { return load(k * 3 * kBlockSize + first + axis); });
        const V inwards = depth_inside(seen.side);  // lanes without a triangle are NaN and fail
        EdgeLimits<V> limit{hn::Zero(d), hn::Zero(d)};
        if constexpr (kExact) {
            limit = limits(seen);
        }
        const auto inside = hn::Ge(inwards, limit.minus_error);
        const V bound = hn::Neg(limit.minus_error);
        const V(&z)[3] = seen.z;
        const DepthRange<V> depth =
            depth_range<kExact>(seen.side, bound, limit.mz, z[0], hn::Sub(z[1], z[0]), hn::Sub(z[2], z[0]), ray.sign);
        const auto is_certain = kExact ? hn::And(depth.is_sound, hn::Gt(inwards, bound)) : inside;
        const auto counts = hn::And(
            inside, hn::And(hn::Le(depth.lower, hn::Set(d, ray.reach)), hn::Ge(depth.upper, hn::Set(d, ray.start))));
        hn::Store(depth.lower, d, verdict.lower + first);
        hn::Store(depth.upper, d, verdict.upper + first);
        possible |= mask_bits(d, counts) << first;
        certain |= mask_bits(d, is_certain) << first;
    }
    verdict.certain = certain;
    return possible;
}

/// Of a block, and of the one behind it where a step takes two and `second` is 1.
template <bool kExact>
HWY_INLINE uint32_t test_blocks(const TracedRay& ray, const TriangleBlock* block, uint32_t second, Verdict& verdict) {
    const auto limits = [&]<class V>(const Sheared<V>& seen) {
        const V mz = largest_of(seen.z);
        return EdgeLimits<V>{seen.minus_edge_error(hn::Set(hn::DFromV<V>(), ray.slant), mz), mz};
    };
    const uint32_t possible = test_lanes<kExact>(ray, BlockLoader(block, second), limits, verdict);
    return second == 0 ? possible & ((1U << kBlockSize) - 1) : possible;
}

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
