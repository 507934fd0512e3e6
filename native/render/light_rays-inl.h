// SPDX-License-Identifier: GPL-3.0-or-later
// Rays from surface points to samples of a light, a point per lane. Compiled once per instruction set (see
// light_rays.cpp).

#if defined(ESPALIER_RENDER_LIGHT_RAYS_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_RENDER_LIGHT_RAYS_INL_H_
#undef ESPALIER_RENDER_LIGHT_RAYS_INL_H_
#else
#define ESPALIER_RENDER_LIGHT_RAYS_INL_H_
#endif

#include <hwy/highway.h>

#include <bit>
#include <cstdint>
#include <numbers>

#include "kdtree/compress-inl.h"
#include "render/light_rays.h"
#include "render/sampling-inl.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// Light that may arrive at each lane's point by one sample of a light, if nothing stands in between.
struct LightSamples {
    RealVec3 to_light;    // from the point to the sample; of a distant light a unit vector
    RealVec3 irradiance;  // W/m² on the surface, its tilt included
    RealMask arrives;     // nothing does from below the shading normal
};

/// How much of a spot's light goes this way, 0 to 1.
HWY_INLINE Real spot_falloff(const Light& light, const RealVec3& from_light) {
    const RealVec3 local{dot(from_light, all_lanes(light.span_x)), dot(from_light, all_lanes(light.span_y)),
                         dot(from_light, all_lanes(light.axis))};
    const Real inside = local.z / length(local) - all_lanes(light.cos_half);
    const Real x = inside / all_lanes(light.spot_fade);
    const Real fading = x * x * (all_lanes(3.0) - all_lanes(2.0) * x);
    const Real falloff = hn::IfThenElse(hn::Ge(inside, all_lanes(light.spot_fade)), all_lanes(1.0), fading);
    return hn::IfThenElseZero(hn::Gt(inside, all_lanes(0.0)), falloff);
}

/// A bulb is a disk that always faces the point, as in Cycles with its default soft falloff.
HWY_INLINE LightSamples sample_bulb(const Light& light, const RealVec3& point, const RealVec3& normal, RealPair s) {
    const RealVec3 from_light = point - all_lanes(light.position);
    const Real distance = length(from_light);
    const RealPair disk = sample_disk(s);
    const Tangents side = tangents(from_light / distance);
    const RealVec3 to_light = (side.x * disk.x + side.y * disk.y) * all_lanes(light.radius) - from_light;
    const Real square = dot(to_light, to_light);
    const Real tilt = dot(normal, to_light);
    RealMask arrives = hn::Gt(tilt, all_lanes(0.0));
    Real falloff = all_lanes(1.0);
    if (light.spot) {
        falloff = spot_falloff(light, -to_light);
        arrives = hn::And(arrives, hn::Gt(falloff, all_lanes(0.0)));
    }
    // The cosine at the disk is distance / |to_light|, the one at the surface tilt / |to_light|.
    return {to_light, all_lanes(light.strength) * (falloff * distance * tilt / (square * square)), arrives};
}

HWY_INLINE LightSamples sample_sun(const Light& light, const RealVec3& normal, RealPair s) {
    const RealVec3 direction = sample_cone(all_lanes(-light.axis), all_lanes(light.cos_half), s);
    const Real tilt = dot(normal, direction);
    // The strength is what reaches a surface that faces the middle of the sun, whatever the sun's width: the mean
    // cosine over the cone, (1 + cos_half) / 2, is divided out.
    return {direction, all_lanes(light.strength) * (tilt * all_lanes(2.0) / all_lanes(1.0 + light.cos_half)),
            hn::Gt(tilt, all_lanes(0.0))};
}

HWY_INLINE LightSamples sample_area(const Light& light, const RealVec3& point, const RealVec3& normal, RealPair s) {
    RealPair place{s.x - all_lanes(0.5), s.y - all_lanes(0.5)};
    if (light.ellipse) {
        const RealPair disk = sample_disk(s);
        place = {disk.x * all_lanes(0.5), disk.y * all_lanes(0.5)};
    }
    const RealVec3 to_light =
        all_lanes(light.position) + all_lanes(light.span_x) * place.x + all_lanes(light.span_y) * place.y - point;
    const Real square = dot(to_light, to_light);
    const Real tilt = dot(normal, to_light);
    const Real emitted = hn::Neg(dot(all_lanes(light.axis), to_light));
    return {to_light, all_lanes(light.strength) * (emitted * tilt / (square * square)),
            hn::And(hn::Gt(tilt, all_lanes(0.0)), hn::Gt(emitted, all_lanes(0.0)))};
}

HWY_INLINE LightSamples sample_sky(const Light& light, const RealVec3& normal, RealPair s) {
    const RealVec3 direction = sample_cosine(normal, s);
    const Real height = all_lanes(0.5) + all_lanes(0.5) * direction.z;
    const RealVec3 radiance = all_lanes(light.nadir) * (all_lanes(1.0) - height) + all_lanes(light.strength) * height;
    return {direction, radiance * all_lanes(std::numbers::pi), hn::FirstN(RealTag(), LitPoints::kGroup)};
}

HWY_INLINE LightSamples sample_light(const Light& light, const RealVec3& point, const RealVec3& normal, RealPair s) {
    switch (light.kind) {
        case Light::Kind::kBulb:
            return sample_bulb(light, point, normal, s);
        case Light::Kind::kSun:
            return sample_sun(light, normal, s);
        case Light::Kind::kArea:
            return sample_area(light, point, normal, s);
        case Light::Kind::kSky:
            break;
    }
    return sample_sky(light, normal, s);
}

/// Rays as columns, a lane each; they begin at 0.
struct RayColumns {
    RealVec3 direction;
    Real t_max;
};

/// From `start` to a sample at a distance. The end is drawn back by more than the error of a hit, so that a lamp in a
/// surface is not hidden by that surface.
HWY_INLINE RayColumns rays_to(const RealVec3& to_light, const RealVec3& point, const RealVec3& start, Real start_size) {
    const RealVec3 end = point + to_light;
    const Real end_size = hn::Max(hn::Max(hn::Abs(end.x), hn::Abs(end.y)), hn::Abs(end.z));
    const Real end_error = (end_size + start_size) * all_lanes(0x1p-20) / length(to_light);
    return {end - start, hn::Max(all_lanes(1.0) - end_error, all_lanes(0.0))};
}

HWY_INLINE RealVec3 load(const double (&columns)[3][LitPoints::kGroup], size_t lane) {
    const RealTag d;
    return {hn::Load(d, columns[0] + lane), hn::Load(d, columns[1] + lane), hn::Load(d, columns[2] + lane)};
}

HWY_INLINE RealVec3 load(const float (&columns)[3][LitPoints::kGroup], size_t lane) {
    const RealTag d;
    const hn::Rebind<float, RealTag> df;
    return {hn::PromoteTo(d, hn::Load(df, columns[0] + lane)), hn::PromoteTo(d, hn::Load(df, columns[1] + lane)),
            hn::PromoteTo(d, hn::Load(df, columns[2] + lane))};
}

inline size_t light_rays(const Light& light, const LitPoints& points, uint32_t dimension, Ray* rays,
                         Arrival* arrivals) {
    const RealTag d;
    const hn::Rebind<float, RealTag> df;
    const hn::Rebind<uint32_t, RealTag> du;
    constexpr size_t kLanes = hn::MaxLanes(RealTag());
    const auto key = hn::Set(du, dimension_key(dimension));
    const bool is_distant = light.kind == Light::Kind::kSun || light.kind == Light::Kind::kSky;
    size_t count = 0;
    for (size_t first = 0; first < points.size; first += kLanes) {
        const LitPoints::Group& group = points.groups[first / LitPoints::kGroup];
        const size_t lane = first % LitPoints::kGroup;
        const RealVec3 point = load(group.position, lane);
        const RealPair s = scrambled(hn::Load(du, group.sequence_x + lane), hn::Load(du, group.sequence_y + lane),
                                     hashed(hn::Load(du, group.pixel + lane) ^ key));
        const LightSamples samples = sample_light(light, point, load(group.normal, lane), s);
        const RealVec3 reflected = load(group.base_color, lane) * samples.irradiance * all_lanes(std::numbers::inv_pi);
        RayColumns ray{samples.to_light, hn::Inf(d)};
        if (!is_distant) {
            ray = rays_to(samples.to_light, point, load(group.start, lane), hn::Load(d, group.start_size + lane));
        }

        alignas(64) float direction[3][kLanes];
        alignas(64) float t_max[kLanes];
        alignas(64) double radiance[3][kLanes];
        hn::Store(hn::DemoteTo(df, ray.direction.x), df, direction[0]);
        hn::Store(hn::DemoteTo(df, ray.direction.y), df, direction[1]);
        hn::Store(hn::DemoteTo(df, ray.direction.z), df, direction[2]);
        hn::Store(hn::DemoteTo(df, ray.t_max), df, t_max);
        hn::Store(reflected.x, d, radiance[0]);
        hn::Store(reflected.y, d, radiance[1]);
        hn::Store(reflected.z, d, radiance[2]);
        const RealMask counts = hn::And(samples.arrives, hn::FirstN(d, points.size - first));
        for (uint64_t rest = mask_bits(d, counts); rest != 0; rest &= rest - 1) {
            const auto i = static_cast<size_t>(std::countr_zero(rest));
            rays[count] = {{group.start[0][lane + i], group.start[1][lane + i], group.start[2][lane + i]},
                           0.0F,
                           {direction[0][i], direction[1][i], direction[2][i]},
                           t_max[i]};
            arrivals[count] = {group.target[lane + i], {radiance[0][i], radiance[1][i], radiance[2][i]}};
            ++count;
        }
    }
    return count;
}

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
