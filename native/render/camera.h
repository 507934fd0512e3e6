// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include "kdtree/traversal.h"
#include "render/matrix.h"

namespace espalier {

enum class Projection { kPerspective, kOrthographic };

/// Turns points of the picture into rays by inverting a projection matrix (OpenGL's convention: the camera looks along
/// -Z, the clip volume is the cube from -1 to 1). All in double; a ray is rounded to float once, relative to the
/// scene's centre.
class Camera {
 public:
    /// `matrix_world` places the camera; its scale is ignored, as Blender does. Throws std::invalid_argument when a
    /// matrix is not finite, cannot be inverted, or does not belong to the stated kind of projection.
    Camera(Projection kind, const Matrix4& matrix_world, const Matrix4& projection, Vec3d scene_centre);

    /// The ray through (x, y) of the picture, 0..1 from left to right and from bottom to top. A ray's t is the depth
    /// along the view axis, its range the camera's clip range.
    Ray ray(double x, double y) const;

 private:
    // Origins and directions are affine in x and y for both kinds of projection.
    Vec3d origin_, origin_dx_{0.0, 0.0, 0.0}, origin_dy_{0.0, 0.0, 0.0};
    Vec3d direction_, direction_dx_{0.0, 0.0, 0.0}, direction_dy_{0.0, 0.0, 0.0};
    float near_, far_;
};

}  // namespace espalier
