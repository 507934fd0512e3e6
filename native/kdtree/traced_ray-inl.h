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
    float inverse[3];
    float near_shift[3];
    float far_shift[3];
    float start;  ///< no depth below this counts
    float reach;  ///< nor one beyond this; both with room for the errors of box and triangle tests
    uint32_t octant;
    uint32_t near_planes[3];  ///< from the node's first float to the planes that the ray meets first, per axis
    uint32_t far_planes[3];
    // Triangle test: axes permuted so that z is the direction's largest component, then sheared (Woop, Benthin and
    // Wald 2013).
    uint32_t x, y, z;  ///< from a corner's first float to its coordinates on that axis
    float ox, oy, oz;  ///< the origin, permuted
    float sx, sy;
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
    void start_from(const Ray& given, float extent) {
        const Vec3f size{std::abs(given.direction.x), std::abs(given.direction.y), std::abs(given.direction.z)};
        const int kz = size.x > size.y ? (size.x > size.z ? 0 : 2) : (size.y > size.z ? 1 : 2);
        const int kx = kz == 2 ? 0 : kz + 1;
        const int ky = kx == 2 ? 0 : kx + 1;
        const float largest = size[kz];
        const float farthest =
            extent + std::max({std::abs(given.origin.x), std::abs(given.origin.y), std::abs(given.origin.z)});
        octant = 0;
        for (int axis = 0; axis < 3; ++axis) {
            const bool negative = given.direction[axis] < 0;
            octant |= negative ? 1U << axis : 0U;
            const bool is_flat = size[axis] < largest * 0x1p-25F;
            const float steepness = is_flat ? 0x1p25F : largest / size[axis];
            inverse[axis] = negative ? -steepness : steepness;
            const float shift = -given.origin[axis] * inverse[axis];
#if HWY_NATIVE_FMA
            const float room = std::abs(shift) * 0x1p-22F;
#else
            const float room = (std::abs(shift) + extent * steepness) * 0x1p-22F;
#endif
            const float margin = room + (is_flat ? farthest * 0x1p-23F * steepness : 0.0F) + kTiny;
            near_shift[axis] = shift - margin;
            far_shift[axis] = shift + margin;
            const auto first = static_cast<uint32_t>(axis * WideNode::kWidth);
            near_planes[axis] = first + (negative ? 3 * WideNode::kWidth : 0);
            far_planes[axis] = first + (negative ? 0 : 3 * WideNode::kWidth);
        }
        start = given.t_min * largest * (1 - 0x1p-21F) - kTiny;
        sure_start = given.t_min * largest * (1 + 0x1p-21F) + kTiny;
        sure_end = given.t_max * largest * (1 - 0x1p-21F) - kTiny;
        x = static_cast<uint32_t>(kx) * kBlockSize;
        y = static_cast<uint32_t>(ky) * kBlockSize;
        z = static_cast<uint32_t>(kz) * kBlockSize;
        ox = given.origin[kx];
        oy = given.origin[ky];
        oz = given.origin[kz];
        sx = given.direction[kx] / given.direction[kz];
        sy = given.direction[ky] / given.direction[kz];
        sign = given.direction[kz] < 0 ? -1.0F : 1.0F;
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
