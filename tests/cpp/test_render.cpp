// SPDX-License-Identifier: GPL-3.0-or-later
#include <gtest/gtest.h>

#include <cmath>
#include <set>

#include "render/camera.h"
#include "render/film.h"
#include "render/render.h"
#include "render/sampling.h"
#include "render/scene.h"
#include "render/shading.h"
#include "uniform_random.h"

namespace espalier {
namespace {

Matrix4 identity() {
    Matrix4 matrix;
    for (size_t i = 0; i < 4; ++i) {
        matrix.rows[i][i] = 1.0;
    }
    return matrix;
}

/// The sign of the distance of a float point from the plane of three float points, in long double.
long double side_of_plane(Vec3f p, Vec3f a, Vec3f b, Vec3f c) {
    using Wide = Vec3<long double>;
    const auto wide = [](Vec3f v) { return Wide{v.x, v.y, v.z}; };
    return dot(wide(p) - wide(a), cross(wide(b) - wide(a), wide(c) - wide(a)));
}

TEST(Render, ShadowRaysStartStrictlyOnTheirSideAndNear) {
    UniformRandom random;
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

        const Vec3f start = shadow_ray_start(surface);
        const TriangleSoup soup = scene.soup();
        const Vec3f a = soup.vertex(0, 0), b = soup.vertex(0, 1), c = soup.vertex(0, 2);
        const Vec3d wound = cross(to_double(b) - to_double(a), to_double(c) - to_double(a));
        const bool front = dot(wound, surface.geometric_normal) > 0;
        EXPECT_GT(front ? side_of_plane(start, a, b, c) : -side_of_plane(start, a, b, c), 0.0L);
        const double away = length(to_double(start) - surface.position);
        EXPECT_LE(away, 4e-7 * (length(surface.position) + surface.error * 0x1p24));
    }
}

TEST(Render, SamplesAreStratifiedInEachRunOfAPowerOfTwo) {
    for (const uint32_t seed : {0U, 1U, 77777U}) {
        for (uint32_t first = 0; first < 64; first += 16) {
            std::set<int> columns, rows, cells;
            for (uint32_t i = first; i < first + 16; ++i) {
                const Sample2 s = scrambled(sequence_point(i), seed);
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

TEST(Render, NormalsStayPerpendicularUnderAnyMap) {
    UniformRandom random;
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
