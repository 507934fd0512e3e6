// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <optional>

#include "kdtree/traversal.h"
#include "render/scene.h"

namespace espalier {

/// The way from the triangle to the smooth surface that shadow rays start on. If it is blocked, something thin lies
/// between the two, and the surface's lift has to go. None where there is no lift to speak of.
std::optional<Ray> lift_ray(const SurfacePoint& surface);

/// Where shadow rays start: strictly on the side to which the geometric normal points, as near to the surface as float
/// coordinates allow.
Vec3f shadow_ray_start(const SurfacePoint& surface);

}  // namespace espalier
