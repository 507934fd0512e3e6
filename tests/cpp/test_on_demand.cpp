// SPDX-License-Identifier: GPL-3.0-or-later
#include <gtest/gtest.h>

#include <atomic>
#include <cmath>

#include "kdtree/on_demand.h"
#include "kdtree/parallel.h"
#include "kdtree/traversal.h"
#include "meshes.h"
#include "rays.h"

namespace espalier {
namespace {

Mesh make_large() { return make_soup(60'000, 21, 0.03F); }

Tree build_on_demand(const Mesh& mesh, Quality quality = Quality::kBalanced, int threads = 1) {
    return build(mesh.soup(), {.quality = quality, .threads = threads, .on_demand_from = 0});
}

struct Found {
    std::vector<Hit> hits;
    std::vector<uint8_t> blocked;
    bool operator==(const Found& other) const {
        return blocked == other.blocked && std::equal(hits.begin(), hits.end(), other.hits.begin(), other.hits.end(),
                                                      [](const Hit& a, const Hit& b) {
                                                          return a.triangle == b.triangle && a.t == b.t && a.u == b.u &&
                                                                 a.v == b.v;
                                                      });
    }
};

Found trace(const Tree& tree, std::span<const Ray> rays) {
    Found found{std::vector<Hit>(rays.size()), std::vector<uint8_t>(rays.size())};
    intersect(tree, rays, found.hits);
    occluded(tree, rays, found.blocked);
    return found;
}

/// Rays from one point, which are traced as packets.
std::vector<Ray> make_fan(Vec3f eye, Vec3f towards, size_t count) {
    std::vector<Ray> rays;
    for (size_t i = 0; i < count; ++i) {
        const auto x = static_cast<float>(i % 4) * 0.002F;
        const size_t row = i / 4;
        const auto y = static_cast<float>(row) * 0.002F;
        rays.push_back({eye, 0, towards + Vec3f{x, y, 0}, INFINITY});
    }
    return rays;
}

TEST(OnDemand, HitsWhatAWholeTreeHits) {
    const Mesh meshes[] = {make_large(), make_sphere(60, 80), make_furball(400), make_grid(25)};
    for (const Mesh& mesh : meshes) {
        std::vector<Ray> rays = make_rays(mesh, 1000, 22);
        const std::vector<Ray> fan = make_fan({0.4F, 0.4F, -3}, {0, 0, 1}, 256);
        rays.insert(rays.end(), fan.begin(), fan.end());
        const Found expected = trace(build(mesh.soup(), {}), rays);
        for (const Quality quality : {Quality::kDraft, Quality::kBalanced, Quality::kBest, Quality::kExact}) {
            if (quality == Quality::kExact && mesh.soup().size() > 50'000) {
                continue;  // one subtree, and no other than in the smaller meshes
            }
            const Tree tree = build_on_demand(mesh, quality);
            EXPECT_EQ(tree.on_demand->opened(), 0U);
            EXPECT_TRUE(trace(tree, rays) == expected);
            EXPECT_GT(tree.on_demand->opened(), 0U);
            EXPECT_TRUE(trace(tree, rays) == expected) << "and again, when all is open";
        }
    }
}

TEST(OnDemand, OpensOnlyWhatRaysEnter) {
    const Mesh mesh = make_large();
    const Tree tree = build_on_demand(mesh);
    const uint32_t subtrees = tree.on_demand->subtrees();
    EXPECT_GE(subtrees, 16U);
    trace(tree, make_fan({5, 5, 5}, {1, 0, 0}, 64));
    EXPECT_EQ(tree.on_demand->opened(), 0U) << "they look away";
    trace(tree, make_fan({0.5F, 0.5F, -3}, {0, 0, 1}, 64));
    EXPECT_GT(tree.on_demand->opened(), 0U);
    EXPECT_LT(tree.on_demand->opened(), tree.on_demand->subtrees() / 2);
    EXPECT_GT(tree.on_demand->subtrees(), subtrees) << "large ones are opened in steps";
}

TEST(OnDemand, ThreadsMayOpenTheSameAtTheSameTime) {
    const Mesh mesh = make_large();
    const std::vector<Ray> rays = make_rays(mesh, 1000, 23);
    const Found expected = trace(build(mesh.soup(), {}), rays);
    for (const int builders : {1, 4, 4}) {
        const Tree tree = build_on_demand(mesh, Quality::kBalanced, builders);
        std::atomic<int> same{0};
        parallel_for(4, 4, [&](size_t) { same += trace(tree, rays) == expected ? 1 : 0; });
        EXPECT_EQ(same.load(), 4);
    }
}

TEST(OnDemand, TakesWhatCannotBeSplit) {
    Mesh copies;
    for (int i = 0; i < 5000; ++i) {
        copies.add_triangle({0, 0, 0}, {1, 0, 0}, {0, 1, 0});
    }
    Mesh broken;
    broken.add_triangle({0, 0, NAN}, {1, 0, 0}, {0, 1, 0});
    Mesh one;
    one.add_triangle({0, 0, 0}, {1, 0, 0}, {0, 1, 0});
    const std::vector<Ray> rays = make_fan({0.1F, 0.1F, -3}, {0, 0, 1}, 64);
    for (const Mesh& mesh : {copies, broken, one, Mesh{}, make_grid(60), make_furball(3000)}) {
        EXPECT_TRUE(trace(build_on_demand(mesh), rays) == trace(build(mesh.soup(), {}), rays));
    }
    EXPECT_EQ(build_on_demand(broken).report.rejected_faces.not_finite, 1U);
}

}  // namespace
}  // namespace espalier
