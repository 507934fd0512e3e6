// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <optional>

#include "render/matrix.h"
#include "render/sampling.h"

namespace espalier {

enum class LightKind { kPoint, kSun, kSpot, kArea };
enum class AreaShape { kRectangle, kEllipse };

/// A light as Blender describes it. It shines along the -Z axis of its matrix.
struct LightInput {
    LightKind kind = LightKind::kPoint;
    Matrix4 matrix;              // light to world
    Vec3d color{1.0, 1.0, 1.0};  // linear
    double energy = 0.0;         // W; of a sun W/m², on a surface that faces it
    double radius = 0.0;         // m, of a point or spot light
    double angle = 0.0;          // rad, across the sun's disk
    double spot_size = 0.0;      // rad, across the cone
    double spot_blend = 0.0;     // 0..1, the share of the cone over which it fades
    AreaShape shape = AreaShape::kRectangle;
    double size = 0.0, size_y = 0.0;  // m, before the matrix's scale
    bool shadow = true;
};

/// Light that may arrive at a point by one sample of a light, if nothing stands in between.
struct LightSample {
    Vec3d to_light;    // from the point to the sample; of a distant light a unit vector
    bool distant;      // nothing lies behind the sample
    Vec3d irradiance;  // W/m² on the surface, its tilt included
};

/// A light made ready to be sampled, relative to the scene's centre. Units and falloffs are those of Cycles:
/// a point of P watts has the radiant intensity P / 4 pi, an area of P watts the radiance P / (pi area).
class Light {
 public:
    /// Throws std::invalid_argument when a number is not finite or negative where it must not be.
    Light(const LightInput& input, Vec3d scene_centre);

    /// A sky that surrounds the scene: `zenith` straight up, `nadir` straight down, linear in the height between.
    static Light sky(Vec3d zenith, Vec3d nadir);

    /// `normal` is the unit shading normal at `point`; nothing arrives from below it. `s` picks the sample.
    std::optional<LightSample> sample(Vec3d point, Vec3d normal, Sample2 s) const;

    /// False only where no sample brings light; quicker than taking one.
    bool may_reach(Vec3d point, Vec3d normal) const;

    bool casts_shadow() const { return shadow_; }

 private:
    enum class Kind { kBulb, kSun, kArea, kSky };
    Light() = default;
    std::optional<LightSample> sample_bulb(Vec3d point, Vec3d normal, Sample2 s) const;
    std::optional<LightSample> sample_sun(Vec3d normal, Sample2 s) const;
    std::optional<LightSample> sample_area(Vec3d point, Vec3d normal, Sample2 s) const;
    LightSample sample_sky(Vec3d normal, Sample2 s) const;
    Vec3d to_spot_space(Vec3d from_light) const;
    double spot_falloff(Vec3d from_light) const;
    bool is_beyond_cone(Vec3d from_light) const;

    Kind kind_ = Kind::kSky;
    bool shadow_ = true;
    bool spot_ = false, ellipse_ = false;
    Vec3d position_, axis_;  // axis: unit, the way the light shines
    Vec3d strength_;         // bulb, area: W/sr along the axis; sun: W/m²; sky: W/m²/sr at the zenith
    Vec3d nadir_;            // sky: W/m²/sr
    Vec3d span_x_, span_y_;  // area: its sides; spot: rows that measure a direction across the cone
    double radius_ = 0.0, cos_half_ = 1.0, sin_half_ = 0.0, spot_fade_ = 0.0;
    double spot_stretch_ = 0.0;  // spot: measuring a vector across the cone lengthens it by no more (Frobenius norm)
};

}  // namespace espalier
