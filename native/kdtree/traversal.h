// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <cstdint>
#include <span>

#include "geometry/vec.h"
#include "kdtree/tree.h"

namespace espalier {

/// Points origin + t direction with t_min <= t <= t_max; 0 <= t_min. The direction need not have
/// unit length, but its largest component must lie between 2^-100 and 2^100, and no coordinate of the origin beyond
/// 2^60.
struct Ray {
    Vec3f origin;
    float t_min;
    Vec3f direction;
    float t_max;
};

/// The nearest hit, of equal distances the lowest triangle index. P = (1 - u - v) v0 + u v1 + v v2.
struct Hit {
    float t, u, v;
    int32_t triangle;  ///< -1: nothing was hit, and t is the ray's t_max
};

/// Closest hits of any number of rays, on the calling thread. Hand over many at once.
void intersect(const Tree& tree, std::span<const Ray> rays, std::span<Hit> hits);

/// 1 where a ray hits anything, else 0.
void occluded(const Tree& tree, std::span<const Ray> rays, std::span<uint8_t> results);

}  // namespace espalier
