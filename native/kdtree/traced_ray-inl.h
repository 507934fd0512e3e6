// SPDX-License-Identifier: GPL-3.0-or-later
// A ray as the box test and the triangle test want it. Compiled once per instruction set (see traversal.cpp).

#if defined(ESPALIER_KDTREE_TRACED_RAY_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_KDTREE_TRACED_RAY_INL_H_
#undef ESPALIER_KDTREE_TRACED_RAY_INL_H_
#else
#define ESPALIER_KDTREE_TRACED_RAY_INL_H_
#endif

#include <hwy/highway.h>

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstdint>
#include <limits>

#include "kdtree/candidate.h"
#include "kdtree/compress-inl.h"
#include "kdtree/node.h"
#include "kdtree/traversal.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

constexpr float kInfinity = std::numeric_limits<float>::infinity();

/// More than underflow can take from any sum of products here, and no subnormal number itself: those cost some
/// processors more than a hundred cycles an operation.
constexpr float kTiny = 0x1p-120F;

/// A mask of such bits as mask_bits returns.
template <class D>
HWY_INLINE hn::Mask<D> mask_of(D d, uint32_t bits) {
    const uint64_t room = bits;  // Highway reads 8 bytes
    return hn::LoadMaskBits(d, reinterpret_cast<const uint8_t*>(&room));
}

/// 0 for 0, 1 for all other numbers below 2^31, without a branch.
HWY_INLINE uint32_t at_most_one(uint32_t number) { return (0U - number) >> 31; }

/// Has so many lines of 64 bytes fetched. A number known when compiling: a loop that is not unrolled costs more than it
/// gains.
template <size_t kLines>
HWY_INLINE void prefetch_lines(const void* from) {
    for (size_t line = 0; line < kLines; ++line) {
        __builtin_prefetch(static_cast<const char*>(from) + 64 * line);
    }
}

/// The larger of the sizes of two numbers.
template <class V>
HWY_INLINE V largest_of(V a, V b) {
#if HWY_TARGET <= HWY_AVX3
    // One operation.
    if constexpr (sizeof(V) == 64 && sizeof(hn::TFromV<V>) == sizeof(float)) {
        return V{_mm512_range_ps(a.raw, b.raw, 0xb)};
    } else if constexpr (sizeof(V) == 64) {
        return V{_mm512_range_pd(a.raw, b.raw, 0xb)};
    }
#endif
    return hn::Max(hn::Abs(a), hn::Abs(b));
}

template <class V>
HWY_INLINE V largest_of(const V (&c)[3]) {
    return largest_of(largest_of(c[0], c[1]), c[2]);
}

/// Stores those lanes of two vectors that a mask selects, without gaps; what lies behind them is overwritten. Returns
/// their number.
template <class D>
HWY_INLINE size_t compress_pair(D d, hn::Mask<D> mask, hn::Vec<hn::RebindToUnsigned<D>> a, uint32_t* to_a, hn::Vec<D> b,
                                float* to_b) {
    const Compression compression(d, mask);
    compression.store(hn::RebindToUnsigned<D>(), a, to_a);
    compression.store(d, b, to_b);
    return static_cast<size_t>(std::popcount(compression.bits()));
}

/// The axes in such an order that z has a direction's largest component; found without branches, which rays in all
/// directions would make the processor guess wrong.
struct Axes {
    uint32_t x, y, z;

    HWY_INLINE explicit Axes(Vec3f direction) {
        constexpr uint32_t kAfter[4] = {1, 2, 0, 1};
        const Vec3f size{std::abs(direction.x), std::abs(direction.y), std::abs(direction.z)};
        z = std::max(size.x, size.y) > size.z ? (size.x > size.y ? 0U : 1U) : 2U;
        x = kAfter[z];
        y = kAfter[z + 1];
    }
};

/// The largest coordinate of a box, of either sign.
inline float extent_of(const Box3f& bounds) {
    float extent = 0;
    for (int axis = 0; axis < 3; ++axis) {
        extent = std::max({extent, std::abs(bounds.lower[axis]), std::abs(bounds.upper[axis])});
    }
    return extent;
}

/// How far a ray has to be followed that has a hit no farther than `upper`.
HWY_INLINE float reach_behind(float upper) { return upper * (1 + 0x1p-20F) + kTiny; }

/// Distances are depths: measured along the direction's largest component, z, so depth = t |direction[z]|. They neither
/// overflow nor underflow where t would. RayBatch fills rays in, four words at a time, but for the last.
struct alignas(16) TracedRay {
    // Box test: a plane's depth is plane * inverse + shift, see Slab.
    float inverse[3];
    float start;  ///< no depth below this counts
    float near_shift[3];
    float reach;  ///< nor one beyond this; both with room for the errors of box and triangle tests
    float far_shift[3];
    uint32_t octant;
    uint32_t near_planes[3];  ///< from the node's first float to the planes that the ray meets first, per axis
    float sign;               ///< of the direction along z
    uint32_t far_planes[3];
    // Triangle test: axes permuted so that z is the direction's largest component, then sheared (Woop, Benthin and
    // Wald 2013).
    float slant;       ///< how much a corner's z, rounded, moves its x and y
    uint32_t x, y, z;  ///< from a corner's first float to its coordinates on that axis
    float sx;
    float minus_ox, minus_oy, minus_oz;  ///< the origin, permuted, negative: a sum reads its other part from memory
    float sy;
    float sure_start;  ///< a depth not below this lies beyond t_min for certain
    float sure_end;    ///< nor one above this beyond t_max
    // The nearest hit so far.
    float lower;  ///< its true depth lies between these two
    float upper;
    uint32_t place;

    /// Takes in that a hit's depth lies between these two.
    void shorten(float from, float to) {
        lower = from;
        upper = to;
        reach = reach_behind(to);
    }
};

/// The depths between which rays lie inside boxes, a ray or a box per lane.
template <class V>
struct BoxSpan {
    V entry;
    V exit;

    /// Takes in two planes across one axis.
    HWY_INLINE void cut(V near, V far, V inverse, V near_shift, V far_shift) {
        entry = hn::Max(hn::MulAdd(near, inverse, near_shift), entry);
        exit = hn::Min(hn::MulAdd(far, inverse, far_shift), exit);
    }

    HWY_INLINE auto meets() const { return hn::Le(entry, hn::Mul(exit, hn::Set(hn::DFromV<V>(), 1 + 0x1p-21F))); }

    /// Where the boxes are entered; infinitely far away where they are not.
    HWY_INLINE V entry_or_infinity() const { return hn::IfThenElse(meets(), entry, hn::Inf(hn::DFromV<V>())); }
};

/// Where a ray enters a node's children.
struct ChildEntries {
#if HWY_TARGET != HWY_SSE4 && HWY_TARGET != HWY_NEON
    hn::Vec<hn::CappedTag<float, WideNode::kWidth>> depth;  ///< infinite for those that it does not enter
#else
    alignas(16) float depth[WideNode::kWidth];
    uint32_t met = 0;  ///< those that it enters, a bit for each
#endif
};

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
