// SPDX-License-Identifier: GPL-3.0-or-later
#include "render/light_rays.h"

#include "geometry/vec.h"
#include "kdtree/simd_config.h"
#include "kdtree/simd_target.h"
#include "render/shading.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "render/light_rays.cpp"
#include <hwy/foreach_target.h>
// Highway's own header has to follow foreach_target.h.
#include <hwy/highway.h>

#include "render/light_rays-inl.h"

#if HWY_ONCE
namespace espalier {

void LitPoints::clear() {
    groups.clear();
    size = 0;
}

void LitPoints::add(const SurfacePoint& surface, uint32_t pixel, SequencePoint sequence, uint32_t target) {
    const size_t lane = size++ % kGroup;
    if (lane == 0) {
        groups.emplace_back();
    }
    Group& group = groups.back();
    const Vec3f start = shadow_ray_start(surface);
    for (int axis = 0; axis < 3; ++axis) {
        group.position[axis][lane] = surface.position[axis];
        group.normal[axis][lane] = surface.shading_normal[axis];
        group.start[axis][lane] = start[axis];
        group.base_color[axis][lane] = surface.base_color[axis];
    }
    group.start_size[lane] = largest_of(surface.position + surface.shadow_lift);
    group.pixel[lane] = pixel;
    group.sequence_x[lane] = sequence.x;
    group.sequence_y[lane] = sequence.y;
    group.target[lane] = target;
}

size_t light_rays(const Light& light, const LitPoints& points, uint32_t dimension, std::span<Ray> rays,
                  std::span<Arrival> arrivals) {
    static const auto chosen = ESPALIER_OF_TARGET(light_rays);
    return chosen(light, points, dimension, rays.data(), arrivals.data());
}

}  // namespace espalier
#endif
