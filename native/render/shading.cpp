// SPDX-License-Identifier: GPL-3.0-or-later
#include "render/shading.h"

#include <cmath>

namespace espalier {
namespace {

/// A point that lies, once rounded to float, on the outer side of the triangle that `point` was lifted from.
Vec3f lift_off(const SurfacePoint& surface, Vec3d point) {
    const Vec3d normal = surface.geometric_normal;
    // Rounding moves each coordinate by at most 2^-24 of it; twice what that can take away along the normal is added
    // beforehand.
    const double rounding = std::abs(normal.x * point.x) + std::abs(normal.y * point.y) + std::abs(normal.z * point.z);
    return to_float(point + normal * (surface.error + rounding * 0x1p-23));
}

}  // namespace

std::optional<Ray> lift_ray(const SurfacePoint& surface) {
    const Vec3f start = lift_off(surface, surface.position);
    const Vec3f way = lift_off(surface, surface.position + surface.shadow_lift) - start;
    if (largest_of(to_double(way)) < 0x1p-100)
        return std::nullopt;
    return Ray{start, 0.0F, way, 1.0F};
}

Vec3f shadow_ray_start(const SurfacePoint& surface) {
    return lift_off(surface, surface.position + surface.shadow_lift);
}

}  // namespace espalier
