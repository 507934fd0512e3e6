// SPDX-License-Identifier: GPL-3.0-or-later
#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <map>
#include <numbers>
#include <vector>

#include "render/light_rays.h"
#include "render/shading.h"
#include "uniform_random.h"

namespace espalier {
namespace {

constexpr double kPi = std::numbers::pi;

/// Three unit vectors at right angles to each other, the last one along `z`.
std::array<Vec3d, 3> frame_about(Vec3d z) {
    const Vec3d x = normalize(cross(std::abs(z.x) < 0.9 ? Vec3d{1, 0, 0} : Vec3d{0, 1, 0}, z));
    return {x, cross(z, x), z};
}

/// From none to the widest.
double some_angle(UniformRandom& random) {
    return random.happens(0.1) ? 0.0 : random.happens(0.1) ? kPi : random.uniform(0, kPi);
}

/// Lights of each kind, moved, turned, stretched, sheared and flattened.
LightInput some_light(UniformRandom& random) {
    constexpr LightKind kKinds[] = {LightKind::kPoint, LightKind::kSpot, LightKind::kSun, LightKind::kArea};
    LightInput input{};
    input.kind = kKinds[static_cast<size_t>(random.uniform(0, 4))];
    const std::array<Vec3d, 3> columns = frame_about(normalize(random.point(1.0)));
    const Vec3d at = random.point(2.0);
    for (size_t column = 0; column < 3; ++column) {
        const double stretch = random.happens(0.05) ? 0.0 : random.uniform(0.3, 3.0);
        const Vec3d shear = random.happens(0.5) ? random.point(2.0) : Vec3d{0.0, 0.0, 0.0};
        for (size_t i = 0; i < 3; ++i) {
            const int axis = static_cast<int>(i);
            input.matrix.rows[i][column] = stretch * (columns[column][axis] + shear[axis]);
            input.matrix.rows[i][3] = at[axis];
        }
    }
    input.color = {1.0, 2.0, 0.5};
    input.energy = 3.0;
    input.radius = random.happens(0.2) ? 0.0 : random.uniform(0, 1.5);
    input.angle = some_angle(random);
    input.spot_size = some_angle(random);
    input.spot_blend = random.happens(0.3) ? 0.0 : random.uniform(0, 1);
    input.shape = random.happens(0.5) ? AreaShape::kEllipse : AreaShape::kRectangle;
    input.size = random.uniform(0, 2);
    input.size_y = random.uniform(0, 2);
    return input;
}

SurfacePoint surface_at(Vec3d position, Vec3d normal) {
    SurfacePoint surface{};
    surface.position = position;
    surface.geometric_normal = surface.shading_normal = normal;
    surface.base_color = {1.0F, 1.0F, 1.0F};
    return surface;
}

struct LitRays {
    std::vector<Ray> rays;
    std::vector<Arrival> arrivals;
};

LitRays rays_of(const Light& light, const LitPoints& points, uint32_t dimension = 1) {
    LitRays lit{std::vector<Ray>(points.size), std::vector<Arrival>(points.size)};
    const size_t count = light_rays(light, points, dimension, lit.rays, lit.arrivals);
    lit.rays.resize(count);
    lit.arrivals.resize(count);
    return lit;
}

/// So many samples of a light as one point sees it.
LitRays samples_of(const Light& light, Vec3d position, Vec3d normal, uint32_t count) {
    LitPoints points;
    for (uint32_t i = 0; i < count; ++i) {
        points.add(surface_at(position, normal), 77, sequence_point(i), i);
    }
    return rays_of(light, points);
}

/// What should come of one sample, one point at a time and with the system's functions.
struct Expected {
    Vec3d to_light;
    Vec3d irradiance;
    double doubt;  // positive where it arrives; near zero rounding decides
};

Sample2 disk_by_angle(Sample2 s) {
    const double a = 2 * s.x - 1, b = 2 * s.y - 1;
    const bool wide = std::abs(a) > std::abs(b);
    const double angle = wide ? kPi / 4 * b / a : kPi / 2 - kPi / 4 * a / b;
    return {(wide ? a : b) * std::cos(angle), (wide ? a : b) * std::sin(angle)};
}

/// Duff and others' frame, as which way is x decides where a sample lies.
std::array<Vec3d, 2> sides_of(Vec3d n) {
    const double sign = std::copysign(1.0, n.z), a = -1.0 / (sign + n.z), b = n.x * n.y * a;
    return {Vec3d{1 + sign * n.x * n.x * a, sign * b, -sign * n.x}, Vec3d{b, sign + n.y * n.y * a, -n.y}};
}

double falloff_of_spot(const LightInput& input, Vec3d from_light) {
    Vec3d local;
    for (int column = 0; column < 3; ++column) {
        const Vec3d axis = input.matrix.column(column);
        const Vec3d unit = dot(axis, axis) > 0
                               ? axis / dot(axis, axis)
                               : Vec3d{column == 0 ? 1. : 0., column == 1 ? 1. : 0., column == 2 ? 1. : 0.};
        local[column] = dot(from_light, unit);
    }
    const double half = std::cos(input.spot_size / 2), cosine = -local.z / length(local);
    if (cosine <= half) {
        return cosine - half;
    }
    const double x = std::min(1.0, (cosine - half) / std::max(1e-300, (1 - half) * input.spot_blend));
    return x * x * (3 - 2 * x);
}

Expected expected_of(const LightInput& input, Vec3d point, Vec3d normal, Sample2 s) {
    const Vec3d power = input.color * input.energy;
    const Vec3d at = input.matrix.translation();
    const Vec3d back = normalize_or(input.matrix.column(2), {0, 0, 1});
    if (input.kind == LightKind::kSun) {
        const double half = std::cos(input.angle / 2), cosine = 1 - s.x * (1 - half);
        const double sine = std::sqrt(1 - cosine * cosine), turn = 2 * kPi * s.y;
        const auto [x, y] = sides_of(back);
        const Vec3d way = back * cosine + x * (sine * std::cos(turn)) + y * (sine * std::sin(turn));
        return {way, power * (dot(normal, way) * 2 / (1 + half)), dot(normal, way)};
    }
    if (input.kind == LightKind::kArea) {
        const Sample2 disk = disk_by_angle(s);
        const bool is_round = input.shape == AreaShape::kEllipse;
        const double x = is_round ? disk.x / 2 : s.x - 0.5, y = is_round ? disk.y / 2 : s.y - 0.5;
        const Vec3d way =
            at + input.matrix.column(0) * (x * input.size) + input.matrix.column(1) * (y * input.size_y) - point;
        const double cosine = dot(normal, way) / length(way), emitted = dot(back, way) / length(way);
        return {way, power / kPi * (emitted * cosine / dot(way, way)), std::min(cosine, emitted)};
    }
    const Vec3d from_light = point - at;
    const auto [x, y] = sides_of(normalize(from_light));
    const Sample2 disk = disk_by_angle(s);
    const Vec3d way = x * (disk.x * input.radius) + y * (disk.y * input.radius) - from_light;
    const double falloff = input.kind == LightKind::kSpot ? falloff_of_spot(input, -way) : 1.0;
    const double cosine = dot(normal, way) / length(way);
    return {way, power / (4 * kPi) * (falloff * cosine * length(from_light) / length(way) / dot(way, way)),
            std::min(cosine, falloff)};
}

TEST(LightRays, AreThoseOfOnePointAtATime) {
    UniformRandom random;
    std::map<LightKind, int> arrived, missed;
    for (uint32_t i = 0; i < 4000; ++i) {
        const LightInput input = some_light(random);
        const uint32_t dimension = 1 + i % 5;
        LitPoints points;
        std::vector<SurfacePoint> surfaces;
        std::vector<Expected> expected;
        for (uint32_t target = 0; target < 13; ++target) {  // the second group is not full
            SurfacePoint surface = surface_at(random.point(4.0), normalize(random.point(1.0)));
            surface.base_color = Vec3f{0.25F, 0.5F, 1.0F} * static_cast<float>(1 + target);
            surfaces.push_back(surface);
            const uint32_t pixel = i * 13 + target;
            points.add(surface, pixel, sequence_point(target), target);
            const uint32_t seed = hash_bits(pixel ^ dimension_key(dimension));
            expected.push_back(
                expected_of(input, surface.position, surface.shading_normal, scrambled(sequence_point(target), seed)));
        }
        const LitRays lit = rays_of(Light(input, {0, 0, 0}), points, dimension);
        size_t next = 0;
        for (uint32_t target = 0; target < 13; ++target) {
            const Expected& sample = expected[target];
            const bool arrives = next < lit.rays.size() && lit.arrivals[next].target == target;
            ASSERT_TRUE(arrives == (sample.doubt > 0) || std::abs(sample.doubt) < 1e-9) << i << ' ' << target;
            (arrives ? arrived : missed)[input.kind] += 1;
            if (!arrives || sample.doubt <= 0) {
                next += arrives ? 1 : 0;
                continue;
            }
            const Ray& ray = lit.rays[next];
            const double size = length(sample.to_light);
            EXPECT_LE(length(to_double(ray.direction) - sample.to_light), 1e-6 + 1e-7 * size);
            EXPECT_EQ(ray.origin, shadow_ray_start(surfaces[target]));
            EXPECT_EQ(ray.t_min, 0.0F);
            if (input.kind == LightKind::kSun) {
                EXPECT_EQ(ray.t_max, std::numeric_limits<float>::infinity());
            } else {  // it stops short of the lamp by more than the errors of both ends, and by little more
                const double short_by = (1 - static_cast<double>(ray.t_max)) * size;
                EXPECT_GE(short_by, 0x1p-20 * largest_of(surfaces[target].position) - 1e-7 * size);
                EXPECT_LE(short_by, 0x1p-18 * (length(surfaces[target].position) + size));
            }
            const Vec3d light = sample.irradiance * to_double(surfaces[target].base_color) / kPi;
            EXPECT_LE(length(lit.arrivals[next].radiance - light), 1e-8 * length(light) / std::min(1.0, sample.doubt))
                << i << ' ' << target;
            ++next;
        }
        ASSERT_EQ(next, lit.rays.size());
    }
    for (const LightKind kind : {LightKind::kPoint, LightKind::kSpot, LightKind::kSun, LightKind::kArea}) {
        EXPECT_GT(arrived[kind], 1000) << static_cast<int>(kind);
        EXPECT_GT(missed[kind], 2000) << static_cast<int>(kind);
    }
}

TEST(LightRays, StopShortOfNearbyLights) {
    LightInput input{};
    input.energy = 1.0;
    input.matrix.rows[0][3] = 11.0, input.matrix.rows[1][3] = 22.0, input.matrix.rows[2][3] = 33.0;
    const LitRays lit = samples_of(Light(input, {}), {10.0, 20.0, 30.0}, {0.0, 0.0, 1.0}, 1);
    ASSERT_EQ(lit.rays.size(), 1U);
    const Ray ray = lit.rays[0];
    EXPECT_EQ(ray.t_min, 0.0F);
    EXPECT_LT(ray.t_max, 1.0F);
    EXPECT_GT(ray.t_max, 0.9999F);
    EXPECT_NEAR(ray.origin.x + ray.direction.x, 11.0, 1e-5);
    EXPECT_NEAR(ray.origin.z + ray.direction.z, 33.0, 1e-5);
    const LitRays sky = samples_of(Light::sky({1, 1, 1}, {1, 1, 1}), {}, {0.0, 0.0, 1.0}, 1);
    ASSERT_EQ(sky.rays.size(), 1U);
    EXPECT_TRUE(std::isinf(sky.rays[0].t_max));
    // Nothing arrives where a lamp of no size is, nor is anything said of it that is no number.
    EXPECT_TRUE(samples_of(Light(input, {}), {11.0, 22.0, 33.0}, {0.0, 0.0, 1.0}, 8).rays.empty());
}

TEST(LightRays, ReachTheMiddleOfARoundLamp) {
    LightInput input{};
    input.energy = 1.0;
    input.radius = 0.5;
    const uint32_t seed = hash_bits(5 ^ dimension_key(1));
    const uint32_t half = 1U << 31;
    LitPoints points;
    points.add(surface_at({0, 0, -2}, {0, 0, 1}), 5, {half ^ hash_bits(seed), half ^ hash_bits(seed ^ kSecondScramble)},
               0);
    const LitRays lit = rays_of(Light(input, {}), points);
    ASSERT_EQ(lit.rays.size(), 1U);
    EXPECT_EQ(lit.rays[0].direction.x, 0.0F);
    EXPECT_EQ(lit.rays[0].direction.y, 0.0F);
    EXPECT_GT(lit.arrivals[0].radiance.x, 0.0);
}

/// A quarter of the samples of a round lamp lies within half its radius, an eighth in each eighth of the turn.
TEST(LightRays, CoverARoundLampEvenly) {
    constexpr uint32_t kSamples = 4096;
    LightInput input{};
    input.kind = LightKind::kArea;
    input.shape = AreaShape::kEllipse;
    input.energy = 1.0;
    input.size = input.size_y = 2.0;
    for (size_t i = 0; i < 3; ++i) {
        input.matrix.rows[i][i] = 1.0;
    }
    const LitRays lit = samples_of(Light(input, {}), {0, 0, -1}, {0, 0, 1}, kSamples);
    ASSERT_EQ(lit.rays.size(), kSamples);
    uint32_t inner = 0;
    uint32_t eighth[8] = {};
    for (const Ray& ray : lit.rays) {
        const double x = ray.direction.x, y = ray.direction.y;
        EXPECT_LE(x * x + y * y, 1 + 1e-6);
        inner += x * x + y * y < 0.25 ? 1 : 0;
        ++eighth[(x < 0 ? 1 : 0) + (y < 0 ? 2 : 0) + (std::abs(x) < std::abs(y) ? 4 : 0)];
    }
    EXPECT_NEAR(inner, kSamples * 0.25, 16);
    for (const uint32_t count : eighth) {
        EXPECT_NEAR(count, kSamples * 0.125, 16);
    }
}

/// Of a sky that is linear in height, a surface that looks up gets the mean of what is up and down, and a third of what
/// they differ by on top.
TEST(LightRays, BringMoreFromTheSkysBrighterSide) {
    for (const double up : {1.0, -1.0}) {
        const LitRays lit = samples_of(Light::sky({1, 1, 1}, {0.25, 0.25, 0.25}), {}, {0, 0, up}, 1024);
        double light = 0;
        for (const Arrival& arrival : lit.arrivals) {
            light += arrival.radiance.x / 1024;
        }
        EXPECT_NEAR(light, 0.625 + up * 0.25, 1e-3);
    }
}

/// From the sky with density cos / pi, from a sun within its cone and all round it.
TEST(LightRays, FollowTheirDensity) {
    UniformRandom random;
    for (int i = 0; i < 20; ++i) {
        const Vec3d normal = i == 0 ? Vec3d{0, 0, -1} : normalize(random.point(1.0));
        double mean_cosine = 0.0;
        Vec3d light{0, 0, 0};
        const LitRays sky = samples_of(Light::sky({1, 1, 1}, {1, 1, 1}), {}, normal, 1024);
        ASSERT_EQ(sky.rays.size(), 1024U);
        for (size_t s = 0; s < 1024; ++s) {
            const Vec3d way = to_double(sky.rays[s].direction);
            EXPECT_NEAR(length(way), 1.0, 1e-6);
            EXPECT_GE(dot(way, normal), -1e-6);
            mean_cosine += dot(way, normal) / 1024;
            light += sky.arrivals[s].radiance / 1024;
        }
        EXPECT_NEAR(mean_cosine, 2.0 / 3.0, 1e-3);
        EXPECT_NEAR(light.x, 1.0, 1e-9) << "a white surface under a white sky is white";

        LightInput input{};
        input.kind = LightKind::kSun;
        input.energy = 1.0;
        input.angle = 2 * std::acos(0.8);
        for (size_t row = 0; row < 3; ++row) {
            input.matrix.rows[row][2] = normal[static_cast<int>(row)];
        }
        double lowest = 1.0;
        Vec3d mean{0, 0, 0};
        for (const Ray& ray : samples_of(Light(input, {}), {}, normal, 1024).rays) {
            lowest = std::min(lowest, dot(to_double(ray.direction), normal));
            mean += to_double(ray.direction) / 1024;
        }
        EXPECT_GE(lowest, 0.8 - 1e-6);
        EXPECT_LT(lowest, 0.801);
        EXPECT_LE(length(mean - normal * 0.9), 1e-3);
    }
}

}  // namespace
}  // namespace espalier
