// SPDX-License-Identifier: GPL-3.0-or-later
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <set>

#include "geometry/float_environment.h"
#include "kdtree/parallel.h"
#include "rays.h"
#include "render/render.h"

namespace espalier {
namespace {

/// What a host's thread may have set: subnormals are flushed to zero, and rounding is upwards.
class HostSettings {
 public:
    HostSettings() {
#if defined(__x86_64__)
        _mm_setcsr(0x1f80 | 0x8040 | 0x4000);
#else
        write(uint64_t{1} << 24 | uint64_t{1} << 22);
#endif
    }
    ~HostSettings() { write(saved_); }
    HostSettings(const HostSettings&) = delete;
    HostSettings& operator=(const HostSettings&) = delete;

    /// Without the flags that say what has been rounded.
    static uint64_t read() {
#if defined(__x86_64__)
        return _mm_getcsr() & ~0x3fU;
#else
        uint64_t value;
        asm volatile("mrs %0, fpcr" : "=r"(value));
        return value;
#endif
    }
    /// Whether this thread rounds upwards and flushes.
    static bool are_felt() {
        volatile float tiny = 0x1p-126F;
        volatile float one = 1;
        return tiny * 0.5F == 0 && one + 0x1p-60F > 1;
    }

 private:
    static void write(uint64_t value) {
#if defined(__x86_64__)
        _mm_setcsr(static_cast<uint32_t>(value));
#else
        asm volatile("msr fpcr, %0" : : "r"(value) : "memory");
#endif
    }
    uint64_t saved_ = read();
};

struct Answers {
    uint64_t checksum;
    std::vector<Hit> hits;
    std::vector<uint8_t> blocked;
};

Answers build_and_trace(const Mesh& mesh, const std::vector<Ray>& rays, int threads) {
    const Tree tree = build(mesh.soup(), {Quality::kBalanced, threads});
    Answers answers{tree.report.checksum, std::vector<Hit>(rays.size()), std::vector<uint8_t>(rays.size())};
    intersect(tree, rays, answers.hits);
    occluded(tree, rays, answers.blocked);
    return answers;
}

TEST(FloatEnvironment, ComesBackAfterwards) {
    const HostSettings host;
    const uint64_t before = HostSettings::read();
    ASSERT_TRUE(HostSettings::are_felt());
    {
        const FloatEnvironment ours;
        EXPECT_FALSE(HostSettings::are_felt());
    }
    EXPECT_TRUE(HostSettings::are_felt());
    EXPECT_EQ(HostSettings::read(), before);
}

/// Coordinates of a few thousand times the smallest float, and coordinates that round at every step.
TEST(FloatEnvironment, OfTheHostChangesNothing) {
    Mesh subnormal = make_soup(300, 9);
    for (float& x : subnormal.positions) {
        x *= 0x1p-136F;
    }
    for (const Mesh& mesh : {subnormal, make_soup(3000, 10)}) {
        const std::vector<Ray> rays = make_rays(mesh, 500, 3);
        const Answers expected = build_and_trace(mesh, rays, 1);
        for (const int threads : {1, 3}) {
            const HostSettings host;
            const uint64_t before = HostSettings::read();
            const Answers answers = build_and_trace(mesh, rays, threads);
            EXPECT_EQ(HostSettings::read(), before);
            EXPECT_EQ(answers.checksum, expected.checksum);
            EXPECT_EQ(std::memcmp(answers.hits.data(), expected.hits.data(), rays.size() * sizeof(Hit)), 0);
            EXPECT_EQ(answers.blocked, expected.blocked);
        }
    }
}

TEST(FloatEnvironment, OfTheHostIsNotThatOfThePool) {
    const HostSettings host;
    int felt[3] = {};
    run_on_threads(
        3, [](void* context, int worker) { static_cast<int*>(context)[worker] = HostSettings::are_felt() ? 1 : 2; },
        felt);
    EXPECT_EQ(felt[0], 1);
    EXPECT_EQ(felt[1], 2);
    EXPECT_EQ(felt[2], 2);
}

TEST(FloatEnvironment, OfTheHostMovesNoVertexAndNoLight) {
    const Mesh sphere = make_sphere(12, 16);
    const MeshInput mesh{"m", sphere.positions, sphere.triangles, NormalKind::kFlat, {}, {}};
    const Matrix4 matrix{{{{0.9, -0.6, 0.1, 1.0 / 3}, {0.6, 0.7, 0.1, 0.1}, {0.1, 0.2, 1.1, 0.7}, {0, 0, 0, 1}}}};
    const std::vector<Placement> placements{{"o", 0, matrix, {0}}};
    const std::vector<float> color{0.9F, 0.7F, 0.3F};
    const auto place = [&] { return Scene(std::span(&mesh, 1), placements, color, 1); };
    const Scene scene = place();
    const Tree tree = build(scene.soup(), {});
    const Camera camera(Projection::kOrthographic, Matrix4{{{{1, 0, 0, 0}, {0, 1, 0, 0}, {0, 0, 1, 9}, {0, 0, 0, 1}}}},
                        Matrix4{{{{0.7, 0, 0, 0}, {0, 0.7, 0, 0}, {0, 0, -0.1, 0}, {0, 0, 0, 1}}}}, scene.centre());
    const auto draw = [&] {
        Film film(16, 16);
        std::vector<float> pixels(size_t{4} * 16 * 16);
        render_picture(scene, tree, camera, {}, {.threads = 1}, film, false);
        film.copy_finished(pixels);
        return pixels;
    };
    const std::vector<float> expected = draw();
    ASSERT_GT(std::set<float>(expected.begin(), expected.end()).size(), 100U);

    const HostSettings host;
    const Scene again = place();
    EXPECT_TRUE(std::ranges::equal(again.soup().positions, scene.soup().positions));
    EXPECT_EQ(draw(), expected);
}

#if defined(__x86_64__)
__attribute__((target("fma"), noinline))
#else
__attribute__((noinline))
#endif
double multiply_and_add(double a, double b, double c) {
    return a * b + c;
}

/// The sources are compiled so that a product is rounded before it is added to something, even where the processor
/// could do both at once. Otherwise t, u and v, and the costs by which planes are chosen, depend on the machine. This
/// file is compiled with the same options.
TEST(FloatEnvironment, ProductsAreRoundedBeforeTheyAreAdded) {
#if defined(__x86_64__)
    if (!__builtin_cpu_supports("fma")) {
        GTEST_SKIP() << "this processor has no fused operations";
    }
#endif
    volatile double a = 1 + 0x1p-30;  // known at run time only
    EXPECT_EQ(multiply_and_add(a, a, -(1 + 0x1p-29)), 0);
    EXPECT_EQ(std::fma(a, a, -(1 + 0x1p-29)), 0x1p-60) << "what a fused operation gives";
}

}  // namespace
}  // namespace espalier
