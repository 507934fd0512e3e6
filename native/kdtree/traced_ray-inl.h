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
#include "kdtree/node.h"
#include "kdtree/traversal.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

constexpr float kInfinity = std::numeric_limits<float>::infinity();

/// More than underflow can take from any sum of products here, and no subnormal number itself: those cost some
/// processors more than a hundred cycles an operation.
constexpr float kTiny = 0x1p-120F;

template <class D, class M>
HWY_INLINE uint32_t mask_bits(D d, M mask) {
    uint8_t bits[8] = {};
    hn::StoreMaskBits(d, mask, bits);
    return bits[0] | uint32_t{bits[1]} << 8;
}

#if HWY_TARGET == HWY_AVX2
/// Per mask of eight lanes the numbers of its set lanes in order, 4 bits each. Highway has such a table too, but copies
/// it onto the stack at each use.
struct CompressTable {
    uint32_t lanes[256];
    constexpr CompressTable() : lanes() {
        for (uint32_t mask = 0; mask < 256; ++mask) {
            uint32_t shift = 0;
            for (uint32_t lane = 0; lane < 8; ++lane) {
                if ((mask >> lane & 1U) != 0) {
                    lanes[mask] |= lane << shift;
                    shift += 4;
                }
            }
        }
    }
};
inline constexpr CompressTable kCompressTable;
#endif

/// Stores those lanes of two vectors that a mask selects, without gaps; what lies behind them is overwritten. Returns
/// their number.
template <class D>
HWY_INLINE size_t compress_pair(D d, hn::Mask<D> mask, hn::Vec<hn::RebindToUnsigned<D>> a, uint32_t* to_a, hn::Vec<D> b,
                                float* to_b) {
    const hn::RebindToUnsigned<D> du;
#if HWY_TARGET == HWY_AVX2
    const uint32_t bits = mask_bits(d, mask);
    const auto packed = hn::Set(du, kCompressTable.lanes[bits]);
    const auto lanes = hn::And(hn::Shr(packed, hn::Mul(hn::Iota(du, 0), hn::Set(du, 4))), hn::Set(du, 7));
    hn::StoreU(hn::TableLookupLanes(a, hn::IndicesFromVec(du, lanes)), du, to_a);
    hn::StoreU(hn::TableLookupLanes(b, hn::IndicesFromVec(d, lanes)), d, to_b);
    return static_cast<size_t>(std::popcount(bits));
#else
    hn::StoreU(hn::Compress(a, hn::RebindMask(du, mask)), du, to_a);
    hn::StoreU(hn::Compress(b, mask), d, to_b);
    return hn::CountTrue(d, mask);
#endif
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

/// The largest coordinate of the tree, of either sign.
inline float extent_of(const Tree& tree) {
    float extent = 0;
    for (int axis = 0; axis < 3; ++axis) {
        extent = std::max({extent, std::abs(tree.bounds.lower[axis]), std::abs(tree.bounds.upper[axis])});
    }
    return extent;
}

/// Distances are depths: measured along the direction's largest component, z, so depth = t |direction[z]|. They neither
/// overflow nor underflow where t would.
struct alignas(64) TracedRay {
    // Box test: a plane's depth is plane * inverse + shift, where the shift already holds a margin, towards the ray's
    // start for near planes and away from it for far ones.
    float inverse[4];
    float near_shift[4];
    float far_shift[4];
    float start;  ///< no depth below this counts
    float reach;  ///< nor one beyond this; both with room for the errors of box and triangle tests
    uint32_t octant;
    uint32_t near_planes[4];  ///< from the node's first float to the planes that the ray meets first, per axis
    uint32_t far_planes[4];
    // Triangle test: axes permuted so that z is the direction's largest component, then sheared (Woop, Benthin and
    // Wald 2013).
    uint32_t x, y, z;  ///< from a corner's first float to its coordinates on that axis
    float ox, oy, oz;  ///< the origin, permuted
    float sx, sy;
    float slant;       ///< how much a corner's z, rounded, moves its x and y
    float sign;        ///< of the direction along z
    float sure_start;  ///< a depth not below this lies beyond t_min for certain
    float sure_end;    ///< nor one above this beyond t_max
    // The nearest hit so far.
    uint32_t place;
    float lower;  ///< its true depth lies between these two
    float upper;

    /// With u = 2^-24: inverse is off by a relative u, its product with the origin by another, and the sum by one of
    /// its result. The error of a plane's depth is therefore below 2.1 u of it, for which there is room in `reach` and
    /// in the comparison of near with far depths, and 2.1 u |origin * inverse|, which the margin covers. Without fused
    /// operations the plane's own product adds u |plane * inverse|.
    ///
    /// A component below 2^-25 of the largest is made that large. Within the depths at which the tree lies, at most
    /// extent + |origin|, that moves the ray by less than 2^-24 times that; the margin takes the double.
    HWY_INLINE void start_from(const Ray& given, float extent) {
        // Without branches, which rays in all directions would make the processor guess wrong.
        static_assert(sizeof(Ray) == 8 * sizeof(float));
        const hn::CappedTag<float, 4> d;
        const hn::RebindToUnsigned<decltype(d)> du;
        const auto origin = hn::LoadU(d, &given.origin.x);        // and t_min
        const auto direction = hn::LoadU(d, &given.direction.x);  // and t_max
        const Axes axes(given.direction);
        const float largest =
            std::max({std::abs(given.direction.x), std::abs(given.direction.y), std::abs(given.direction.z)});

        const auto negative = hn::Lt(direction, hn::Zero(d));
        octant = mask_bits(d, negative) & 7U;
        const auto steepness =
            hn::Div(hn::Set(d, largest), hn::Max(hn::Abs(direction), hn::Set(d, largest * 0x1p-25F)));
        const auto signed_steepness = hn::IfThenElse(negative, hn::Neg(steepness), steepness);
        const auto shift = hn::Neg(hn::Mul(origin, signed_steepness));
        const float farthest =
            extent + std::max({std::abs(given.origin.x), std::abs(given.origin.y), std::abs(given.origin.z)});
        auto room = hn::Abs(shift);
#if !HWY_NATIVE_FMA
        room = hn::MulAdd(hn::Set(d, extent), steepness, room);
#endif
        const auto flat = hn::IfThenElseZero(hn::Ge(steepness, hn::Set(d, 0x1p24F)), hn::Set(d, farthest * 0x1p-22F));
        const auto margin = hn::MulAdd(flat, steepness, hn::MulAdd(room, hn::Set(d, 0x1p-22F), hn::Set(d, kTiny)));
        hn::StoreU(signed_steepness, d, inverse);
        hn::StoreU(hn::Sub(shift, margin), d, near_shift);
        hn::StoreU(hn::Add(shift, margin), d, far_shift);
        const auto first = hn::Mul(hn::Iota(du, 0), hn::Set(du, WideNode::kWidth));
        const auto second = hn::Add(first, hn::Set(du, 3 * WideNode::kWidth));
        const auto negative_u = hn::RebindMask(du, negative);
        hn::StoreU(hn::IfThenElse(negative_u, second, first), du, near_planes);
        hn::StoreU(hn::IfThenElse(negative_u, first, second), du, far_planes);

        start = given.t_min * largest * (1 - 0x1p-21F) - kTiny;
        sure_start = given.t_min * largest * (1 + 0x1p-21F) + kTiny;
        sure_end = given.t_max * largest * (1 - 0x1p-21F) - kTiny;
        x = axes.x * kBlockSize;
        y = axes.y * kBlockSize;
        z = axes.z * kBlockSize;
        alignas(16) float o[4];
        alignas(16) float along[4];
        hn::Store(origin, d, o);
        hn::Store(direction, d, along);
        ox = o[axes.x];
        oy = o[axes.y];
        oz = o[axes.z];
        sx = along[axes.x] / along[axes.z];
        sy = along[axes.y] / along[axes.z];
        slant = 0x1p-24F * (std::max(std::abs(sx), std::abs(sy)) + 0x1p-64F);
        sign = std::copysign(1.0F, along[axes.z]);
        place = kNoPlace;
        shorten(0, given.t_max * largest);
        lower = kInfinity;
    }

    /// Takes in that a hit's depth lies between these two.
    void shorten(float from, float to) {
        lower = from;
        upper = to;
        reach = to * (1 + 0x1p-20F) + kTiny;
    }
};

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
