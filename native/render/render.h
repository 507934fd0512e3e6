// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <atomic>
#include <cstdint>
#include <span>
#include <stdexcept>

#include "kdtree/tree.h"
#include "render/camera.h"
#include "render/film.h"
#include "render/light.h"
#include "render/scene.h"

namespace espalier {

struct RenderSettings {
    Vec3d world_color{0.0, 0.0, 0.0};  // background and, where it is not black, light from all sides; linear
    int samples = 4;                   // per pixel; a single one goes through the pixel's centre
    int threads = 0;                   // 0: all the machine has
};

struct TraceReport {
    double trace_ms = 0.0;
    int threads = 0;
    int samples = 0;
    uint64_t primary_rays = 0;
    uint64_t shadow_rays = 0;
    double mrays_per_s = 0.0;
};

class RenderCancelled : public std::runtime_error {
 public:
    RenderCancelled() : std::runtime_error("the picture was cancelled") {}
};

/// Draws the scene on `film`: direct light on diffuse surfaces, with shadows. Without lights a soft sky lights the
/// scene. The same picture, bit for bit, for any number of threads. `tree` must have been built from scene.soup().
/// Throws RenderCancelled soon after `cancel` is set; tiles finished by then stay on the film.
TraceReport render_picture(const Scene& scene, const Tree& tree, const Camera& camera, std::span<const Light> lights,
                           const RenderSettings& settings, Film& film, const std::atomic<bool>& cancel);

}  // namespace espalier
