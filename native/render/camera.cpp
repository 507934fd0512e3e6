// SPDX-License-Identifier: GPL-3.0-or-later
#include "render/camera.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <stdexcept>

namespace espalier {
namespace {

/// Solves projection * p = clip for the homogeneous p, by elimination with row pivoting.
std::array<double, 4> unproject_homogeneous(const Matrix4& projection, const std::array<double, 4>& clip) {
    auto m = projection.rows;
    auto p = clip;
    for (size_t k = 0; k < 4; ++k) {
        size_t pivot = k;
        for (size_t r = k + 1; r < 4; ++r) {
            if (std::abs(m[r][k]) > std::abs(m[pivot][k]))
                pivot = r;
        }
        std::swap(m[k], m[pivot]);
        std::swap(p[k], p[pivot]);
        if (m[k][k] == 0.0)
            throw std::invalid_argument("camera: projection cannot be inverted");
        for (size_t r = k + 1; r < 4; ++r) {
            const double factor = m[r][k] / m[k][k];
            for (size_t c = k; c < 4; ++c)
                m[r][c] -= factor * m[k][c];
            p[r] -= factor * p[k];
        }
    }
    for (size_t k = 4; k-- > 0;) {
        for (size_t c = k + 1; c < 4; ++c)
            p[k] -= m[k][c] * p[c];
        p[k] /= m[k][k];
    }
    return p;
}

Vec3d unproject(const Matrix4& projection, double x, double y, double z) {
    const auto p = unproject_homogeneous(projection, {x, y, z, 1.0});
    if (p[3] == 0.0)
        throw std::invalid_argument("camera: projection has its clip planes at infinity");
    return Vec3d{p[0], p[1], p[2]} * (1.0 / p[3]);
}

/// Where the view through (x, y) of the clip square meets the plane one unit in front of the camera.
Vec3d on_unit_plane(const Matrix4& projection, double x, double y) {
    const Vec3d p = unproject(projection, x, y, -1.0);
    return p * (-1.0 / p.z);
}

Vec3d on_camera_plane(const Matrix4& projection, double x, double y) {
    const Vec3d p = unproject(projection, x, y, -1.0);
    return {p.x, p.y, 0.0};
}

}  // namespace

Camera::Camera(Projection kind, const Matrix4& matrix_world, const Matrix4& projection, Vec3d scene_centre) {
    if (!matrix_world.finite())
        throw std::invalid_argument("camera: matrix_world is not finite");
    if (!projection.finite())
        throw std::invalid_argument("camera: projection is not finite");
    const bool perspective = projection.rows[3][3] == 0.0;
    if (perspective != (kind == Projection::kPerspective)) {
        throw std::invalid_argument(perspective ? "camera: type is ORTHO but projection is a perspective"
                                                : "camera: type is PERSP but projection is orthographic");
    }
    const Vec3d axis_x = normalize_or(matrix_world.column(0), {1.0, 0.0, 0.0});
    const Vec3d axis_y = normalize_or(matrix_world.column(1), {0.0, 1.0, 0.0});
    const Vec3d axis_z = normalize_or(matrix_world.column(2), {0.0, 0.0, 1.0});
    const auto to_world = [&](Vec3d v) { return axis_x * v.x + axis_y * v.y + axis_z * v.z; };
    const Vec3d position = matrix_world.translation() - scene_centre;

    const double near_depth = -unproject(projection, 0.0, 0.0, -1.0).z;
    const double far_depth = -unproject(projection, 0.0, 0.0, 1.0).z;
    if (!(near_depth < far_depth))
        throw std::invalid_argument("camera: projection has its near plane behind its far plane");

    const auto corner = perspective ? on_unit_plane : on_camera_plane;
    const Vec3d base = to_world(corner(projection, -1.0, -1.0));
    const Vec3d dx = to_world(corner(projection, 1.0, -1.0)) - base;
    const Vec3d dy = to_world(corner(projection, -1.0, 1.0)) - base;
    if (perspective) {
        if (!(near_depth > 0.0))
            throw std::invalid_argument("camera: a perspective projection needs its near plane in front of the camera");
        origin_ = position;
        direction_ = base, direction_dx_ = dx, direction_dy_ = dy;
        near_ = static_cast<float>(near_depth), far_ = static_cast<float>(far_depth);
    } else {
        // A clip range that begins behind the camera moves the origins back, so that t never starts below zero.
        const double start = std::min(0.0, near_depth);
        direction_ = axis_z * -1.0;
        origin_ = position + base + direction_ * start, origin_dx_ = dx, origin_dy_ = dy;
        near_ = static_cast<float>(near_depth - start), far_ = static_cast<float>(far_depth - start);
    }
}

Ray Camera::ray(double x, double y) const {
    return {to_float(origin_ + origin_dx_ * x + origin_dy_ * y), near_,
            to_float(direction_ + direction_dx_ * x + direction_dy_ * y), far_};
}

}  // namespace espalier
