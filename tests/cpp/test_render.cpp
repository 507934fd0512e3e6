// SPDX-License-Identifier: GPL-3.0-or-later
#include <gtest/gtest.h>

#include <cmath>
#include <map>
#include <numbers>
#include <random>
#include <set>

#include "render/camera.h"
#include "render/film.h"
#include "render/light.h"
#include "render/render.h"
#include "render/sampling.h"
#include "render/scene.h"
#include "render/shading.h"

namespace espalier {
namespace {

Matrix4 identity() {
    Matrix4 matrix;
    for (size_t i = 0; i < 4; ++i) {
        matrix.rows[i][i] = 1.0;
    }
    return matrix;
}

class Random {
 public:
    double uniform(double low, double high) { return std::uniform_real_distribution<double>(low, high)(engine_); }
    Vec3d point(double size) { return {uniform(-size, size), uniform(-size, size), uniform(-size, size)}; }

 private:
    std::mt19937 engine_{12345};
};

/// The sign of the distance of a float point from the plane of three float points, in long double.
long double side_of_plane(Vec3f p, Vec3f a, Vec3f b, Vec3f c) {
    using Wide = Vec3<long double>;
    const auto wide = [](Vec3f v) { return Wide{v.x, v.y, v.z}; };
    return dot(wide(p) - wide(a), cross(wide(b) - wide(a), wide(c) - wide(a)));
}

TEST(Render, ShadowRaysStartStrictlyOnTheirSideAndNear) {
    Random random;
    for (int i = 0; i < 20000; ++i) {
        const double size = std::exp2(random.uniform(-12, 12));
        const Vec3d offset = random.point(std::exp2(random.uniform(-12, 16)));
        std::vector<float> positions;
        for (int corner = 0; corner < 3; ++corner) {
            const Vec3f p = to_float(offset + random.point(size));
            positions.insert(positions.end(), {p.x, p.y, p.z});
        }
        const std::vector<uint32_t> triangle{0, 1, 2};
        const std::vector<float> white{1.0F, 1.0F, 1.0F};
        const MeshInput mesh{"m", positions, triangle, NormalKind::kFlat, {}, {}};
        const Scene scene(std::span(&mesh, 1), std::vector<Placement>{{"o", 0, identity(), {0}}}, white, 1);
        if (scene.objects()[0].rejected.no_area != 0) {
            continue;
        }
        const double u = random.uniform(0, 1), v = random.uniform(0, 1 - u);
        const Vec3d direction = random.point(1.0);
        const SurfacePoint surface = scene.surface(0, u, v, direction);
        EXPECT_LE(dot(surface.geometric_normal, direction), 0.0) << "the normal faces the ray";
        EXPECT_NEAR(length(surface.geometric_normal), 1.0, 1e-12);

        const Ray ray = shadow_ray(surface, {surface.geometric_normal, true, {}});
        const TriangleSoup soup = scene.soup();
        const Vec3f a = soup.vertex(0, 0), b = soup.vertex(0, 1), c = soup.vertex(0, 2);
        const Vec3d wound = cross(to_double(b) - to_double(a), to_double(c) - to_double(a));
        const bool front = dot(wound, surface.geometric_normal) > 0;
        EXPECT_GT(front ? side_of_plane(ray.origin, a, b, c) : -side_of_plane(ray.origin, a, b, c), 0.0L);
        const double away = length(to_double(ray.origin) - surface.position);
        EXPECT_LE(away, 4e-7 * (length(surface.position) + surface.error * 0x1p24));
    }
}

TEST(Render, NearbyLightsAreReachedNotPassed) {
    SurfacePoint surface{};
    surface.position = {10.0, 20.0, 30.0};
    surface.geometric_normal = surface.shading_normal = {0.0, 0.0, 1.0};
    const Ray ray = shadow_ray(surface, {{1.0, 2.0, 3.0}, false, {}});
    EXPECT_EQ(ray.t_min, 0.0F);
    EXPECT_LT(ray.t_max, 1.0F);
    EXPECT_GT(ray.t_max, 0.9999F);
    EXPECT_NEAR(ray.origin.x + ray.direction.x, 11.0, 1e-5);
    EXPECT_NEAR(ray.origin.z + ray.direction.z, 33.0, 1e-5);
    EXPECT_TRUE(std::isinf(shadow_ray(surface, {{0.0, 0.0, 1.0}, true, {}}).t_max));
}

TEST(Render, SamplesAreStratifiedInEachRunOfAPowerOfTwo) {
    for (const uint32_t seed : {0U, 1U, 77777U}) {
        for (uint32_t first = 0; first < 64; first += 16) {
            std::set<int> columns, rows, cells;
            for (uint32_t i = first; i < first + 16; ++i) {
                const Sample2 s = sample_2d(i, seed);
                EXPECT_TRUE(s.x >= 0 && s.x < 1 && s.y >= 0 && s.y < 1);
                columns.insert(static_cast<int>(s.x * 16));
                rows.insert(static_cast<int>(s.y * 16));
                cells.insert(static_cast<int>(s.x * 4) * 4 + static_cast<int>(s.y * 4));
            }
            EXPECT_EQ(columns.size(), 16U);
            EXPECT_EQ(rows.size(), 16U);
            EXPECT_EQ(cells.size(), 16U);
        }
    }
}

/// Lights of each kind, moved, turned, stretched, sheared and flattened, with widths from none to the widest.
LightInput some_light(Random& random) {
    constexpr LightKind kKinds[] = {LightKind::kPoint, LightKind::kSpot, LightKind::kSun, LightKind::kArea};
    const auto happens = [&](double share) { return random.uniform(0, 1) < share; };
    const auto angle = [&] {
        return happens(0.1) ? 0.0 : happens(0.1) ? std::numbers::pi : random.uniform(0, std::numbers::pi);
    };
    LightInput input{};
    input.kind = kKinds[static_cast<size_t>(random.uniform(0, 4))];
    const Vec3d z = normalize(random.point(1.0));
    const Tangents sides = tangents(z);
    const Vec3d columns[3] = {sides.x, sides.y, z};
    const Vec3d at = random.point(2.0);
    for (size_t column = 0; column < 3; ++column) {
        const double stretch = happens(0.05) ? 0.0 : random.uniform(0.3, 3.0);
        const Vec3d shear = happens(0.5) ? random.point(2.0) : Vec3d{0.0, 0.0, 0.0};
        for (size_t i = 0; i < 3; ++i) {
            const int axis = static_cast<int>(i);
            input.matrix.rows[i][column] = stretch * (columns[column][axis] + shear[axis]);
            input.matrix.rows[i][3] = at[axis];
        }
    }
    input.color = {1.0, 1.0, 1.0};
    input.energy = 1.0;
    input.radius = happens(0.2) ? 0.0 : happens(0.2) ? 1e-12 : random.uniform(0, 1.5);
    input.angle = angle();
    input.spot_size = angle();
    input.size = input.size_y = 1.0;
    return input;
}

TEST(Render, LightsReachWhatAnySampleOfThemReaches) {
    Random random;
    std::map<LightKind, int> unreached;
    std::map<LightKind, int> samples;
    for (int i = 0; i < 40000; ++i) {
        const LightInput input = some_light(random);
        const Light light(input, {0.0, 0.0, 0.0});
        const Vec3d point = random.point(4.0);
        const Vec3d normal = normalize(random.point(1.0));
        const bool may_reach = light.may_reach(point, normal);
        unreached[input.kind] += may_reach ? 0 : 1;
        for (uint32_t s = 0; s < 16; ++s) {
            const bool reaches = light.sample(point, normal, sample_2d(s, static_cast<uint32_t>(i))).has_value();
            samples[input.kind] += reaches ? 1 : 0;
            ASSERT_TRUE(may_reach || !reaches) << i;
        }
    }
    // Of ten thousand points each, half lie behind a lamp; of those before a spot most are outside its cone.
    EXPECT_GT(unreached[LightKind::kPoint], 3000);
    EXPECT_GT(unreached[LightKind::kSpot], 6000);
    EXPECT_GT(unreached[LightKind::kSun], 1500);
    for (const LightKind kind : {LightKind::kPoint, LightKind::kSpot, LightKind::kSun}) {
        EXPECT_GT(samples[kind], 12000) << static_cast<int>(kind);
    }
}

TEST(Render, AnglesAreWithinTheirErrorAllTheWayRound) {
    constexpr int kSteps = 4096;
    for (int i = -kSteps; i <= kSteps; ++i) {
        const double angle = std::numbers::pi / 4 * i / kSteps;
        const SineCosine found = sine_cosine(angle);
        EXPECT_NEAR(found.sine, std::sin(angle), 1e-12);
        EXPECT_NEAR(found.cosine, std::cos(angle), 1e-12);
    }
    for (int i = 0; i < kSteps; ++i) {
        const double turns = (i + 0.25) / kSteps;
        const Sample2 place = sample_circle(turns);
        EXPECT_NEAR(place.x, std::cos(2 * std::numbers::pi * turns), 2e-12);
        EXPECT_NEAR(place.y, std::sin(2 * std::numbers::pi * turns), 2e-12);
    }
}

/// A quarter of the points lies within half the radius, an eighth in each eighth of the turn.
TEST(Render, DiskIsCoveredEvenly) {
    constexpr uint32_t kSamples = 4096;
    uint32_t inner = 0;
    uint32_t eighth[8] = {};
    for (uint32_t i = 0; i < kSamples; ++i) {
        const Sample2 place = sample_disk(sample_2d(i, 11));
        const double square = place.x * place.x + place.y * place.y;
        EXPECT_LE(square, 1 + 1e-11);
        inner += square < 0.25 ? 1 : 0;
        ++eighth[(place.x < 0 ? 1 : 0) + (place.y < 0 ? 2 : 0) + (std::abs(place.x) < std::abs(place.y) ? 4 : 0)];
    }
    EXPECT_NEAR(inner, kSamples * 0.25, 16);
    for (const uint32_t count : eighth) {
        EXPECT_NEAR(count, kSamples * 0.125, 16);
    }
}

TEST(Render, DirectionsFollowTheirDensity) {
    Random random;
    for (int i = 0; i < 20; ++i) {
        const Vec3d axis = i == 0 ? Vec3d{0, 0, -1} : normalize(random.point(1.0));
        double mean_cosine = 0.0, lowest = 1.0;
        for (uint32_t s = 0; s < 1024; ++s) {
            const Vec3d hemisphere = sample_cosine(axis, sample_2d(s, 5));
            EXPECT_NEAR(length(hemisphere), 1.0, 1e-9);
            EXPECT_GE(dot(hemisphere, axis), -1e-9);
            mean_cosine += dot(hemisphere, axis) / 1024;
            lowest = std::min(lowest, dot(sample_cone(axis, 0.8, sample_2d(s, 6)), axis));
        }
        EXPECT_NEAR(mean_cosine, 2.0 / 3.0, 1e-3);
        EXPECT_GE(lowest, 0.8 - 1e-9);
        EXPECT_LT(lowest, 0.801);
    }
}

TEST(Render, NormalsStayPerpendicularUnderAnyMap) {
    Random random;
    for (int i = 0; i < 1000; ++i) {
        Matrix4 matrix = identity();
        for (size_t row = 0; row < 3; ++row) {
            for (size_t column = 0; column < 3; ++column) {
                matrix.rows[row][column] = random.uniform(-2, 2);
            }
        }
        const auto columns = normal_columns(matrix);
        const Vec3d n = random.point(1.0);
        const Vec3d along = cross(n, random.point(1.0));
        const Vec3d mapped = columns[0] * n.x + columns[1] * n.y + columns[2] * n.z;
        EXPECT_NEAR(dot(mapped, matrix.vector(along)), 0.0, 1e-12);
        EXPECT_GT(length(mapped), 0.0);
    }
}

TEST(Render, CameraRaysStartAndEndWhereTheProjectionSays) {
    Matrix4 projection;  // of a window from (-0.2, -0.1) to (0.6, 0.5) at depth 1, clipped at 0.5 and 100
    projection.rows[0] = {2 / 0.8, 0.0, 0.4 / 0.8, 0.0};
    projection.rows[1] = {0.0, 2 / 0.6, 0.4 / 0.6, 0.0};
    projection.rows[2] = {0.0, 0.0, -100.5 / 99.5, -100.0 / 99.5};
    projection.rows[3] = {0.0, 0.0, -1.0, 0.0};
    Matrix4 place = identity();
    place.rows[0][3] = 1e6, place.rows[1][3] = -5.0;
    const Camera camera(Projection::kPerspective, place, projection, {1e6 + 3.0, 0.0, 0.0});
    const Ray ray = camera.ray(0.25, 1.0);
    EXPECT_EQ(ray.origin, (Vec3f{-3.0F, -5.0F, 0.0F}));
    EXPECT_NEAR(ray.direction.x, 0.0, 1e-7);
    EXPECT_NEAR(ray.direction.y, 0.5, 1e-7);
    EXPECT_NEAR(ray.direction.z, -1.0, 1e-7);
    EXPECT_NEAR(ray.t_min, 0.5, 1e-6);
    EXPECT_NEAR(ray.t_max, 100.0, 1e-4);
    EXPECT_THROW(Camera(Projection::kOrthographic, place, projection, {}), std::invalid_argument);
    EXPECT_THROW(Camera(Projection::kPerspective, place, Matrix4{}, {}), std::invalid_argument);
}

TEST(Render, TilesCoverTheFilmOnceFromTheMiddleOutwards) {
    for (const auto& [width, height] : {std::pair{1, 1}, std::pair{50, 33}, std::pair{16, 64}}) {
        Film film(width, height);
        std::vector<int> covered(static_cast<size_t>(width * height));
        for (const Film::Tile& tile : film.tiles()) {
            for (int y = tile.y; y < tile.y + tile.height; ++y) {
                for (int x = tile.x; x < tile.x + tile.width; ++x) {
                    ++covered.at(static_cast<size_t>(y) * width + x);
                }
            }
        }
        EXPECT_EQ(covered, std::vector<int>(covered.size(), 1));
        const Film::Tile first = film.tiles().front();
        EXPECT_LE(std::abs(2 * first.x + first.width - width), Film::kTileSize);
        EXPECT_LE(std::abs(2 * first.y + first.height - height), Film::kTileSize);
    }
}

TEST(Render, FilmShowsOnlyWhatIsFinished) {
    Film film(32, 16);
    for (int y = 0; y < 16; ++y) {
        for (int x = 0; x < 32; ++x) {
            film.pixel(x, y)[3] = 1.0F;
        }
    }
    std::vector<float> seen(32 * 16 * 4, 5.0F);
    film.copy_finished(seen);
    EXPECT_EQ(seen, std::vector<float>(seen.size(), 0.0F));
    EXPECT_EQ(film.progress(), 0.0);
    film.finish(1);
    EXPECT_EQ(film.progress(), 0.5);
    film.copy_finished(seen);
    const Film::Tile tile = film.tiles()[1];
    EXPECT_EQ(seen[4 * static_cast<size_t>(tile.x) + 3], 1.0F);
    EXPECT_EQ(seen[4 * static_cast<size_t>(16 - tile.x) + 3], 0.0F);
}

TEST(Render, TrianglesFindTheirPlacementBesideEmptyOnes) {
    const std::vector<float> corner{0, 0, 0, 1, 0, 0, 0, 1, 0};
    const std::vector<uint32_t> face{0, 1, 2}, faces{0, 1, 2, 2, 1, 0};
    const std::vector<float> colors{0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3};
    const std::vector<MeshInput> meshes{{"none", corner, {}, NormalKind::kFlat, {}, {}},
                                        {"one", corner, face, NormalKind::kFlat, {}, {}},
                                        {"two", corner, faces, NormalKind::kFlat, {}, {}}};
    const std::vector<Placement> placements{{"a", 0, identity(), {0}}, {"b", 2, identity(), {1}},
                                            {"a", 0, identity(), {0}}, {"c", 1, identity(), {2}},
                                            {"d", 2, identity(), {3}}, {"a", 0, identity(), {0}}};
    const Scene scene(meshes, placements, colors, 2);
    const float expected[] = {1, 1, 2, 3, 3};
    ASSERT_EQ(scene.triangle_count(), 5U);
    for (uint32_t triangle = 0; triangle < 5; ++triangle) {
        EXPECT_EQ(scene.surface(triangle, 0.2, 0.2, {0, 0, 1}).base_color.x, expected[triangle]);
    }
}

TEST(Render, CancelledPictureThrowsAndKeepsWhatIsFinished) {
    const std::vector<float> corner{-9, -9, 0, 9, -9, 0, 0, 9, 0};
    const std::vector<uint32_t> face{0, 1, 2};
    const std::vector<float> white{1, 1, 1};
    const MeshInput mesh{"m", corner, face, NormalKind::kFlat, {}, {}};
    const Scene scene(std::span(&mesh, 1), std::vector<Placement>{{"o", 0, identity(), {0}}}, white);
    const Tree tree = build(scene.soup(), {});
    Matrix4 projection = identity();
    projection.rows[2][2] = -0.1;
    const Camera camera(Projection::kOrthographic, identity(), projection, scene.centre());
    Film film(64, 64);
    std::atomic<bool> cancel{true};
    EXPECT_THROW(render_picture(scene, tree, camera, {}, {}, film, cancel), RenderCancelled);
    EXPECT_EQ(film.progress(), 0.0);
    cancel = false;
    const TraceReport report = render_picture(scene, tree, camera, {}, {.threads = 3}, film, cancel);
    EXPECT_EQ(film.progress(), 1.0);
    EXPECT_EQ(report.primary_rays, 64U * 64U * 4U);
}

}  // namespace
}  // namespace espalier
