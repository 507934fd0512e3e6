// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include "render/matrix.h"

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

/// A light made ready to be sampled (see light_rays.h), relative to the scene's centre. Units and falloffs are those of
/// Cycles: a point of P watts has the radiant intensity P / 4 pi, an area of P watts the radiance P / (pi area).
struct Light {
    enum class Kind { kBulb, kSun, kArea, kSky };

    /// Throws std::invalid_argument when a number is not finite or negative where it must not be.
    Light(const LightInput& input, Vec3d scene_centre);

    /// A sky that surrounds the scene: `zenith` straight up, `nadir` straight down, linear in the height between.
    static Light sky(Vec3d zenith, Vec3d nadir);

    Kind kind = Kind::kSky;
    bool shadow = true;
    bool spot = false, ellipse = false;
    Vec3d position, axis;  // axis: unit, the way the light shines; spot: measures along it as span_x does across
    Vec3d strength;        // bulb, area: W/sr along the axis; sun: W/m²; sky: W/m²/sr at the zenith
    Vec3d nadir;           // sky: W/m²/sr
    Vec3d span_x, span_y;  // area: its sides; spot: rows that measure a direction across the cone
    double radius = 0.0;
    double cos_half = 1.0;   // of half the angle across a spot's cone or a sun's disk
    double spot_fade = 0.0;  // the range of cosines over which a spot fades

 private:
    Light() = default;
};

}  // namespace espalier
