// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include "kdtree/traversal.h"
#include "render/light.h"
#include "render/scene.h"

namespace espalier {

/// The ray from a surface to a light sample; if it is blocked, the light does not arrive. It starts strictly on the
/// side to which the geometric normal points, as near to the surface as float coordinates allow, so it never meets the
/// face it starts on.
Ray shadow_ray(const SurfacePoint& surface, const LightSample& sample);

}  // namespace espalier
