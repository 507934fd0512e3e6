// SPDX-License-Identifier: GPL-3.0-or-later
#include "render/light.h"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <stdexcept>

namespace espalier {
namespace {

constexpr double kPi = std::numbers::pi;

/// More than rounding does to a sine or cosine, even of spots stretched 10^10 times as far one way as another.
constexpr double kRounding = 1e-6;

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

Light::Light(const LightInput& input, Vec3d scene_centre) : shadow_(input.shadow) {
    require(input.matrix.finite(), "matrix is not finite");
    require(is_finite(input.color) && std::isfinite(input.energy), "color and energy must be finite");
    const auto length_ok = [](double value) { return std::isfinite(value) && value >= 0.0; };
    require(length_ok(input.radius) && length_ok(input.size) && length_ok(input.size_y),
            "radius, size and size_y must be finite and not negative");
    require(input.angle >= 0.0 && input.angle <= kPi * 1.0001, "angle must be between 0 and pi");
    require(input.spot_size >= 0.0 && input.spot_size <= kPi * 1.0001, "spot_size must be between 0 and pi");
    require(input.spot_blend >= 0.0 && input.spot_blend <= 1.0, "spot_blend must be between 0 and 1");

    const Vec3d power = input.color * input.energy;
    position_ = input.matrix.translation() - scene_centre;
    axis_ = -normalize_or(input.matrix.column(2), {0.0, 0.0, 1.0});
    radius_ = input.radius;
    switch (input.kind) {
        case LightKind::kSpot:
            spot_ = true;
            cos_half_ = std::cos(input.spot_size * 0.5);
            sin_half_ = std::sin(input.spot_size * 0.5);
            spot_fade_ = (1.0 - cos_half_) * input.spot_blend;
            span_x_ = unscaled(input.matrix.column(0), {1.0, 0.0, 0.0});
            span_y_ = unscaled(input.matrix.column(1), {0.0, 1.0, 0.0});
            axis_ = -unscaled(input.matrix.column(2), {0.0, 0.0, 1.0});
            spot_stretch_ = std::sqrt(dot(span_x_, span_x_) + dot(span_y_, span_y_) + dot(axis_, axis_));
            [[fallthrough]];
        case LightKind::kPoint:
            kind_ = Kind::kBulb;
            strength_ = power / (4.0 * kPi);
            break;
        case LightKind::kSun:
            kind_ = Kind::kSun;
            cos_half_ = std::cos(std::min(input.angle, kPi) * 0.5);
            sin_half_ = std::sin(std::min(input.angle, kPi) * 0.5);
            strength_ = power;
            break;
        case LightKind::kArea:
            kind_ = Kind::kArea;
            ellipse_ = input.shape == AreaShape::kEllipse;
            span_x_ = input.matrix.column(0) * input.size;
            span_y_ = input.matrix.column(1) * input.size_y;
            strength_ = power / kPi;
            break;
    }
}

Light Light::sky(Vec3d zenith, Vec3d nadir) {
    Light light;
    light.strength_ = zenith;
    light.nadir_ = nadir;
    return light;
}

std::optional<LightSample> Light::sample(Vec3d point, Vec3d normal, Sample2 s) const {
    switch (kind_) {
        case Kind::kBulb:
            return sample_bulb(point, normal, s);
        case Kind::kSun:
            return sample_sun(normal, s);
        case Kind::kArea:
            return sample_area(point, normal, s);
        case Kind::kSky:
            return sample_sky(normal, s);
    }
    return std::nullopt;
}

bool Light::may_reach(Vec3d point, Vec3d normal) const {
    switch (kind_) {
        case Kind::kBulb: {
            const Vec3d from_light = point - position_;
            const double beyond = dot(normal, from_light) - radius_;
            const bool is_behind =
                beyond > 0.0 && beyond * beyond > kRounding * kRounding * dot(from_light, from_light);
            return !is_behind && !(spot_ && is_beyond_cone(from_light));
        }
        case Kind::kSun:
            return !(dot(normal, axis_) > sin_half_ + kRounding);
        case Kind::kArea:
        case Kind::kSky:
            break;
    }
    return true;
}

/// A bulb is a disk that always faces the point, as in Cycles with its default soft falloff.
std::optional<LightSample> Light::sample_bulb(Vec3d point, Vec3d normal, Sample2 s) const {
    const Vec3d from_light = point - position_;
    const double distance = length(from_light);
    if (!(distance > 0.0))
        return std::nullopt;
    const Sample2 disk = sample_disk(s);
    const Tangents side = tangents(from_light / distance);
    const Vec3d to_light = (side.x * disk.x + side.y * disk.y) * radius_ - from_light;
    const double square = dot(to_light, to_light);
    const double tilt = dot(normal, to_light);
    const double falloff = spot_ ? spot_falloff(-to_light) : 1.0;
    if (tilt <= 0.0 || falloff <= 0.0)
        return std::nullopt;
    // The cosine at the disk is distance / |to_light|, the one at the surface tilt / |to_light|.
    return LightSample{to_light, false, strength_ * (falloff * distance * tilt / (square * square))};
}

Vec3d Light::to_spot_space(Vec3d from_light) const {
    return {dot(from_light, span_x_), dot(from_light, span_y_), dot(from_light, axis_)};
}

/// Whether the point lies outside the cone as seen from every point of the bulb: to move by its radius turns the
/// direction by an angle whose sine is at most radius times stretch over distance.
bool Light::is_beyond_cone(Vec3d from_light) const {
    const Vec3d local = to_spot_space(from_light);
    const double distance = length(local);
    const double sine = radius_ * spot_stretch_ / distance;
    return sine < 1.0 && local.z < distance * (cos_half_ * std::sqrt(1.0 - sine * sine) - sin_half_ * sine - kRounding);
}

double Light::spot_falloff(Vec3d from_light) const {
    const Vec3d local = to_spot_space(from_light);
    const double cosine = local.z / length(local);
    if (!(cosine > cos_half_))
        return 0.0;
    if (cosine - cos_half_ >= spot_fade_)
        return 1.0;
    const double x = (cosine - cos_half_) / spot_fade_;
    return x * x * (3.0 - 2.0 * x);
}

std::optional<LightSample> Light::sample_sun(Vec3d normal, Sample2 s) const {
    const Vec3d direction = sample_cone(-axis_, cos_half_, s);
    const double tilt = dot(normal, direction);
    if (tilt <= 0.0)
        return std::nullopt;
    // The strength is what reaches a surface that faces the middle of the sun, whatever the sun's width: the mean
    // cosine over the cone, (1 + cos_half) / 2, is divided out.
    return LightSample{direction, true, strength_ * (tilt * 2.0 / (1.0 + cos_half_))};
}

std::optional<LightSample> Light::sample_area(Vec3d point, Vec3d normal, Sample2 s) const {
    Sample2 place{s.x - 0.5, s.y - 0.5};
    if (ellipse_) {
        const Sample2 disk = sample_disk(s);
        place = {disk.x * 0.5, disk.y * 0.5};
    }
    const Vec3d to_light = position_ + span_x_ * place.x + span_y_ * place.y - point;
    const double square = dot(to_light, to_light);
    const double tilt = dot(normal, to_light);
    const double emitted = -dot(axis_, to_light);
    if (tilt <= 0.0 || emitted <= 0.0)
        return std::nullopt;
    return LightSample{to_light, false, strength_ * (emitted * tilt / (square * square))};
}

LightSample Light::sample_sky(Vec3d normal, Sample2 s) const {
    const Vec3d direction = sample_cosine(normal, s);
    const double height = 0.5 + 0.5 * direction.z;
    return {direction, true, (nadir_ * (1.0 - height) + strength_ * height) * kPi};
}

}  // namespace espalier
