// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <array>
#include <cmath>

#include "geometry/vec.h"

namespace espalier {

/// `v` at unit length, or `fallback` where v has no direction.
inline Vec3d normalize_or(Vec3d v, Vec3d fallback) {
    const double size = length(v);
    return size > 0.0 && std::isfinite(size) ? v / size : fallback;
}

/// A 4x4 matrix in double, row-major, that acts on column vectors.
struct Matrix4 {
    std::array<std::array<double, 4>, 4> rows{};

    Vec3d column(int index) const {
        const auto c = static_cast<size_t>(index);
        return {rows[0][c], rows[1][c], rows[2][c]};
    }
    Vec3d translation() const { return column(3); }

    /// An affine map of a point; the last row is taken to be 0 0 0 1.
    Vec3d point(Vec3d p) const { return vector(p) + translation(); }
    Vec3d vector(Vec3d v) const { return column(0) * v.x + column(1) * v.y + column(2) * v.z; }

    bool finite() const {
        for (const auto& row : rows) {
            for (const double value : row) {
                if (!std::isfinite(value))
                    return false;
            }
        }
        return true;
    }
};

/// The map that carries normals when `matrix` carries points, up to length and sign: the inverse transpose times the
/// determinant, which also exists where a scale is zero.
inline std::array<Vec3d, 3> normal_columns(const Matrix4& matrix) {
    const Vec3d x = matrix.column(0), y = matrix.column(1), z = matrix.column(2);
    return {cross(y, z), cross(z, x), cross(x, y)};
}

}  // namespace espalier
