// SPDX-License-Identifier: GPL-3.0-or-later
#include "render/light.h"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <stdexcept>

namespace espalier {
namespace {

constexpr double kPi = std::numbers::pi;

void require(bool holds, const char* what) {
    if (!holds)
        throw std::invalid_argument(what);
}

/// `axis` measured in units of its own length, so that a dot product with it undoes the scale.
Vec3d unscaled(Vec3d axis, Vec3d fallback) {
    const double square = dot(axis, axis);
    return square > 0.0 ? axis / square : fallback;
}

}  // namespace

Light::Light(const LightInput& input, Vec3d scene_centre) : shadow(input.shadow) {
    require(input.matrix.finite(), "matrix is not finite");
    require(is_finite(input.color) && std::isfinite(input.energy), "color and energy must be finite");
    const auto length_ok = [](double value) { return std::isfinite(value) && value >= 0.0; };
    require(length_ok(input.radius) && length_ok(input.size) && length_ok(input.size_y),
            "radius, size and size_y must be finite and not negative");
    require(input.angle >= 0.0 && input.angle <= kPi * 1.0001, "angle must be between 0 and pi");
    require(input.spot_size >= 0.0 && input.spot_size <= kPi * 1.0001, "spot_size must be between 0 and pi");
    require(input.spot_blend >= 0.0 && input.spot_blend <= 1.0, "spot_blend must be between 0 and 1");

    const Vec3d power = input.color * input.energy;
    position = input.matrix.translation() - scene_centre;
    axis = -normalize_or(input.matrix.column(2), {0.0, 0.0, 1.0});
    radius = input.radius;
    switch (input.kind) {
        case LightKind::kSpot:
            spot = true;
            cos_half = std::cos(input.spot_size * 0.5);
            spot_fade = (1.0 - cos_half) * input.spot_blend;
            span_x = unscaled(input.matrix.column(0), {1.0, 0.0, 0.0});
            span_y = unscaled(input.matrix.column(1), {0.0, 1.0, 0.0});
            axis = -unscaled(input.matrix.column(2), {0.0, 0.0, 1.0});
            [[fallthrough]];
        case LightKind::kPoint:
            kind = Kind::kBulb;
            strength = power / (4.0 * kPi);
            break;
        case LightKind::kSun:
            kind = Kind::kSun;
            cos_half = std::cos(std::min(input.angle, kPi) * 0.5);
            strength = power;
            break;
        case LightKind::kArea:
            kind = Kind::kArea;
            ellipse = input.shape == AreaShape::kEllipse;
            span_x = input.matrix.column(0) * input.size;
            span_y = input.matrix.column(1) * input.size_y;
            strength = power / kPi;
            break;
    }
}

Light Light::sky(Vec3d zenith, Vec3d nadir) {
    Light light;
    light.strength = zenith;
    light.nadir = nadir;
    return light;
}

}  // namespace espalier
