// SPDX-License-Identifier: GPL-3.0-or-later
#include <gtest/gtest.h>

#include <algorithm>
#include <cstring>
#include <functional>
#include <random>
#include <set>
#include <thread>
#include <utility>

#include "kdtree/build_kernels.h"
#include "kdtree/candidate.h"
#include "kdtree/child_order.h"
#include "kdtree/size_class.h"
#include "kdtree/traversal.h"
#include "meshes.h"

namespace espalier {
namespace {

constexpr Quality kQualities[] = {Quality::kDraft, Quality::kBalanced, Quality::kBest, Quality::kExact};

template <class T>
bool same_bytes(const LargeBuffer<T>& a, const LargeBuffer<T>& b) {
    return a.size() == b.size() && (a.size() == 0 || std::memcmp(a.data(), b.data(), a.bytes()) == 0);
}

/// The kd-tree's own rules: depth first, every split inside its cell, every node and block in place exactly once.
void expect_well_formed(const Tree& tree) {
    uint32_t next_block = 0;
    const std::function<uint32_t(uint32_t, Box3f, int)> visit = [&](uint32_t index, Box3f cell, int depth) -> uint32_t {
        EXPECT_LE(depth, tree.report.sah_constants.max_depth);
        const KdNode node = tree.nodes[index];
        if (node.is_leaf()) {
            EXPECT_EQ(node.first_block(), next_block);
            next_block += block_count(node.references());
            for (uint32_t i = 0; i < block_count(node.references()) * kBlockSize; ++i) {
                const TriangleBlock& block = tree.blocks[node.first_block() + i / kBlockSize];
                EXPECT_EQ(block.triangle[i % kBlockSize] == kNoTriangle, i >= node.references());
            }
            return index + 1;
        }
        EXPECT_GT(node.split(), cell.lower[node.axis()]);
        EXPECT_LT(node.split(), cell.upper[node.axis()]);
        Box3f left = cell;
        left.upper[node.axis()] = node.split();
        Box3f right = cell;
        right.lower[node.axis()] = node.split();
        EXPECT_EQ(visit(index + 1, left, depth + 1), node.right_child());
        return visit(node.right_child(), right, depth + 1);
    };
    EXPECT_EQ(visit(0, tree.bounds, 0), tree.nodes.size());
    EXPECT_EQ(next_block, tree.blocks.size());
}

/// Calls f(first block, blocks, box) for every leaf that rays can reach.
void for_each_leaf(const Tree& tree, const std::function<void(uint32_t, uint32_t, const Box3f&)>& f) {
    const std::function<void(uint32_t)> visit = [&](uint32_t index) {
        const WideNode& node = tree.wide_nodes[index];
        for (int i = 0; i < WideNode::kWidth; ++i) {
            const Box3f box{{node.lower[0][i], node.lower[1][i], node.lower[2][i]},
                            {node.upper[0][i], node.upper[1][i], node.upper[2][i]}};
            if (box.is_empty()) {
                continue;
            }
            if ((node.child[i] & WideNode::kLeafFlag) != 0) {
                f(WideNode::first_block(node.child[i]), WideNode::blocks(node.child[i]), box);
            } else {
                visit(node.child[i]);
            }
        }
    };
    if (tree.wide_nodes.size() != 0) {
        visit(0);
    }
}

/// Whether a box holds a point that was formed in double, and so may lie off its triangle by 2^-50 of its coordinates:
/// far less than the margin of clipping, 2^-22 of them.
bool contains(const Box3f& box, Vec3d p) {
    const double rounding = 0x1p-49 * std::max({std::abs(p.x), std::abs(p.y), std::abs(p.z)});
    for (int axis = 0; axis < 3; ++axis) {
        if (!(box.lower[axis] - rounding <= p[axis] && p[axis] <= box.upper[axis] + rounding)) {
            return false;
        }
    }
    return true;
}

/// The points where a triangle's edges cross the tree's planes, a little to both sides: what clipping there has to
/// keep.
std::vector<Vec3d> crossings(const Vec3d (&corner)[3], const std::vector<KdNode>& splits) {
    std::vector<Vec3d> points;
    for (const KdNode& split : splits) {
        const int axis = split.axis();
        for (int k = 0; k < 3; ++k) {
            const Vec3d from = corner[k];
            const Vec3d edge = corner[(k + 1) % 3] - from;
            const double t = (split.split() - from[axis]) / edge[axis];
            if (t > 0 && t < 1) {
                points.push_back(from + edge * (t * (1 - 0x1p-40)));
                points.push_back(from + edge * std::min(t * (1 + 0x1p-40), 1.0));  // a plane may go through a corner
            }
        }
    }
    return points;
}

std::vector<uint32_t> faces_of(const TriangleBlock& block) {
    std::vector<uint32_t> faces;
    for (uint32_t lane = 0; lane < kBlockSize; ++lane) {
        if (block.triangle[lane] != kNoTriangle) {
            faces.push_back(triangle_at(&block, lane));
        }
    }
    return faces;
}

/// The size class of each block is that of its largest triangle, none of whose sides is longer than the class allows.
void expect_size_classes(const Mesh& mesh, const Tree& tree) {
    const SizeClasses classes(tree.bounds);
    for (const TriangleBlock& block : tree.blocks.span()) {
        float longest = 0;
        for (const uint32_t face : faces_of(block)) {
            Box3f box;
            for (uint32_t k = 0; k < 3; ++k) {
                box.extend(mesh.soup().vertex(face, k));
            }
            const Vec3f size = box.size();
            longest = std::max({longest, size.x, size.y, size.z});
        }
        const uint32_t size_class = block.triangle[0] / kMaxTriangles;
        EXPECT_EQ(size_class, classes.of(longest));
        EXPECT_LT(longest, classes.limit(size_class));
    }
}

/// Points of every triangle lie in a box that holds the triangle: no clipping may cut anything away.
void expect_everything_covered(const Mesh& mesh, const Tree& tree) {
    const TriangleSoup soup = mesh.soup();
    std::vector<std::vector<Box3f>> boxes(soup.size());
    for_each_leaf(tree, [&](uint32_t first, uint32_t blocks, const Box3f& box) {
        for (uint32_t b = first; b < first + blocks; ++b) {
            for (const uint32_t face : faces_of(tree.blocks[b])) {
                boxes[face].push_back(box);
            }
        }
    });
    const double weights[][2] = {{0, 0},        {1, 0},           {0, 1},   {0.5, 0.5},     {0.5, 0},
                                 {0.125, 0.25}, {1 / 3., 1 / 3.}, {0, 0.3}, {0.875, 0.0625}};
    std::vector<KdNode> splits;  // some 200 of them
    for (size_t i = 0; i < tree.nodes.size(); i += 1 + tree.nodes.size() / 400) {
        if (!tree.nodes[i].is_leaf()) {
            splits.push_back(tree.nodes[i]);
        }
    }
    uint32_t uncovered = 0;
    for (uint32_t i = 0; i < soup.size(); ++i) {
        const Vec3d corner[3] = {to_double(soup.vertex(i, 0)), to_double(soup.vertex(i, 1)),
                                 to_double(soup.vertex(i, 2))};
        std::vector<Vec3d> points = crossings(corner, splits);
        for (const auto& w : weights) {
            points.push_back(corner[0] + (corner[1] - corner[0]) * w[0] + (corner[2] - corner[0]) * w[1]);
        }
        for (const Vec3d& p : points) {
            uncovered +=
                std::none_of(boxes[i].begin(), boxes[i].end(), [&](const Box3f& box) { return contains(box, p); }) ? 1U
                                                                                                                   : 0U;
        }
    }
    EXPECT_EQ(uncovered, 0U);
}

Mesh moved(Mesh mesh, float offset, float scale) {
    for (float& x : mesh.positions) {
        x = x * scale + offset;
    }
    return mesh;
}

TEST(Tree, IsWellFormedAndCoversEveryTriangle) {
    const Mesh meshes[] = {make_sphere(40, 60),
                           make_soup(3000, 1),
                           make_furball(400),
                           make_grid(40),
                           moved(make_sphere(30, 40), 1e5F, 1),
                           moved(make_soup(2000, 2), 0, 1e-30F),
                           moved(make_soup(2000, 3), -3, 1e15F)};
    for (const Mesh& mesh : meshes) {
        for (const Quality quality : kQualities) {
            SCOPED_TRACE(testing::Message() << "mesh " << &mesh - meshes << ", quality " << static_cast<int>(quality));
            const Tree tree = build(mesh.soup(), {quality, 1});
            expect_well_formed(tree);
            expect_everything_covered(mesh, tree);
            expect_size_classes(mesh, tree);
        }
    }
}

void expect_same(const Tree& serial, const Tree& parallel) {
    EXPECT_TRUE(same_bytes(serial.nodes, parallel.nodes));
    EXPECT_TRUE(same_bytes(serial.wide_nodes, parallel.wide_nodes));
    EXPECT_TRUE(same_bytes(serial.blocks, parallel.blocks));
    EXPECT_EQ(serial.report.checksum, parallel.report.checksum);
    EXPECT_EQ(serial.bounds, parallel.bounds);
}

TEST(Tree, IsTheSameForEveryThreadCount) {
    const Mesh meshes[] = {make_sphere(120, 200), make_soup(40000, 4), make_furball(3000), make_grid(150)};
    for (const Mesh& mesh : meshes) {
        for (const Quality quality : kQualities) {
            const Tree serial = build(mesh.soup(), {quality, 1});
            for (const int threads : {2, 3, 4, 8, 16}) {
                SCOPED_TRACE(threads);
                expect_same(serial, build(mesh.soup(), {quality, threads}));
            }
        }
    }
}

/// A large scene with faults: a whole chunk of faces without an area, some here and there, and vertices of no face.
Mesh make_large_faulty() {
    Mesh mesh = make_sphere(540, 128);
    for (size_t face = 0; face < mesh.triangles.size() / 3; face += face < 2 * kChunk ? 1 : 1000) {
        if (face >= kChunk) {
            mesh.triangles[3 * face + 1] = mesh.triangles[3 * face];
        }
    }
    mesh.add_vertex({-1, -2, 7});
    mesh.add_vertex({NAN, 0, 0});
    return mesh;
}

TEST(Tree, SplitsLargeScenesAlikeOnAnyNumberOfThreads) {
    const Mesh meshes[] = {make_sphere(520, 128), make_soup(150000, 7, 0.02F), make_large_faulty()};
    for (const Mesh& mesh : meshes) {
        ASSERT_GE(mesh.soup().size(), kMultiwayFrom);
        const double best = build(mesh.soup(), {Quality::kBest, 1}).report.sah_cost;
        for (const Quality quality : {Quality::kDraft, Quality::kBalanced}) {
            SCOPED_TRACE(testing::Message() << "mesh " << &mesh - meshes << ", quality " << static_cast<int>(quality));
            const Tree serial = build(mesh.soup(), {quality, 1});
            expect_well_formed(serial);
            EXPECT_LT(serial.report.sah_cost, 1.15 * best);
            for (const int threads : {2, 3, 8}) {
                SCOPED_TRACE(threads);
                expect_same(serial, build(mesh.soup(), {quality, threads}));
            }
        }
    }
}

TEST(Tree, CoversEveryTriangleOfLargeScenes) {
    const Mesh mesh = make_soup(135000, 13, 0.1F);
    for (const Quality quality : {Quality::kDraft, Quality::kBalanced}) {
        const Tree tree = build(mesh.soup(), {quality, 2});
        ASSERT_EQ(tree.report.rejected_faces.no_area, 0U);
        expect_well_formed(tree);
        expect_everything_covered(mesh, tree);
        EXPECT_GT(tree.report.references, mesh.soup().size() * 5 / 4) << "hardly any triangle straddles a plane";
    }
}

TEST(Tree, KeepsWhatLiesFlatInTheEndOfALargeScene) {
    // With a vertex of no face beyond it, a plane in that end is the cheapest of those that a sample knows of.
    constexpr uint32_t kFaces = 140000;
    Mesh mesh;
    std::mt19937 random(3);
    const auto uniform = [&] { return static_cast<float>(random() >> 8) * 0x1p-24F; };
    for (uint32_t face = 0; face < kFaces; ++face) {
        const bool is_flat = face % 200 == 7;
        const float x = is_flat ? 10 : face == 0 ? 0 : uniform() * 9.99F;
        const float y = uniform() * (is_flat ? 0.9F : 0.99F);
        const float z = uniform() * (is_flat ? 0.9F : 0.99F);
        if (is_flat) {
            mesh.add_triangle({x, y, z}, {x, y + 0.05F, z}, {x, y, z + 0.05F});
        } else {
            mesh.add_triangle({x, y, z}, {x + 0.004F, y, z}, {x, y + 0.004F, z + 0.003F});
        }
    }
    mesh.add_vertex({30, 0, 0});
    for (const Quality quality : {Quality::kDraft, Quality::kBalanced}) {
        const Tree serial = build(mesh.soup(), {quality, 1});
        std::set<uint32_t> kept;
        for (const TriangleBlock& block : serial.blocks.span()) {
            for (const uint32_t triangle : block.triangle) {
                if (triangle != kNoTriangle) {
                    kept.insert(triangle & (kMaxTriangles - 1));
                }
            }
        }
        EXPECT_EQ(kept.size(), kFaces);
        expect_well_formed(serial);
        expect_same(serial, build(mesh.soup(), {quality, 2}));
    }
}

TEST(Tree, SplitsLargeNodesOfLargerScenesLikewise) {
    const Mesh mesh = make_grid(1100);
    ASSERT_GT(mesh.soup().size() / MultiwaySplit::kMostLeaves, kMultiwayFrom);
    const Tree serial = build(mesh.soup(), {Quality::kDraft, 1});
    expect_well_formed(serial);
    expect_same(serial, build(mesh.soup(), {Quality::kDraft, 2}));
}

TEST(Tree, ReportAddsUp) {
    const Mesh mesh = make_sphere(60, 90);
    const Tree tree = build(mesh.soup(), {Quality::kBalanced, 2});
    const BuildReport& report = tree.report;
    EXPECT_EQ(report.nodes, tree.nodes.size());
    EXPECT_EQ(report.leaves, (report.nodes + 1) / 2);
    EXPECT_EQ(report.triangles, mesh.triangles.size() / 3);
    EXPECT_GE(report.references, report.triangles);
    EXPECT_EQ(report.threads, 2);
    EXPECT_GT(report.sah_cost, report.sah_constants.traversal);
    const PhaseTimes& phases = report.phases_ms;
    const double sum = phases.bounds + phases.top_levels + phases.subtrees + phases.compaction + phases.layout;
    EXPECT_LE(sum, report.build_ms);
    EXPECT_GT(sum, 0.9 * report.build_ms);
    EXPECT_NE(report.checksum, build(make_sphere(60, 91).soup(), {Quality::kBalanced, 2}).report.checksum);
}

TEST(Tree, LeavesComeInPartsThatLieApart) {
    const Mesh mesh = make_sphere(60, 90);
    const auto area_in_parts = [&](Quality quality) {
        const Tree tree = build(mesh.soup(), {quality, 2});
        std::vector<std::pair<uint32_t, Box3f>> parts;
        for_each_leaf(tree, [&](uint32_t first, uint32_t, const Box3f& box) { parts.emplace_back(first, box); });
        std::sort(parts.begin(), parts.end(), [](const auto& a, const auto& b) { return a.first < b.first; });
        double whole = 0;
        double cut = 0;
        for (const KdNode& node : tree.nodes.span()) {
            if (!node.is_leaf() || node.references() == 0) {
                continue;
            }
            const auto begins = [](const auto& part, uint32_t block) { return part.first < block; };
            const uint32_t end = node.first_block() + block_count(node.references());
            auto part = std::lower_bound(parts.begin(), parts.end(), node.first_block(), begins);
            const auto last = std::lower_bound(part, parts.end(), end, begins);
            if (last - part > 1) {
                Box3f all;
                for (; part != last; ++part) {
                    cut += half_area(part->second);
                    all.extend(part->second);
                }
                whole += half_area(all);
            }
        }
        return std::pair(whole, cut);
    };
    EXPECT_EQ(area_in_parts(Quality::kDraft).first, 0);  // where the time to sort them is saved
    for (const Quality quality : {Quality::kBalanced, Quality::kBest, Quality::kExact}) {
        const auto [whole, cut] = area_in_parts(quality);
        EXPECT_GT(whole, 20);
        EXPECT_LT(cut, 1.3 * whole);
    }
}

TEST(Tree, TakesMeshesOfAlmostNothing) {
    for (const int threads : {1, 2}) {
        for (uint32_t count = 0; count <= 3; ++count) {
            const Mesh mesh = make_soup(count, 5);
            const Tree tree = build(mesh.soup(), {Quality::kBalanced, threads});
            EXPECT_EQ(tree.report.references, count);
            EXPECT_TRUE(std::isfinite(tree.report.sah_cost));
            expect_well_formed(tree);
            const Ray ray{{0.5F, 0.5F, 5}, 0, {0, 0, 1}, INFINITY};
            Hit hit{};
            intersect(tree, {&ray, 1}, {&hit, 1});
            EXPECT_EQ(hit.triangle, -1);
        }
    }
}

TEST(Tree, CountsBadFacesOfAnyRange) {
    Mesh mesh = make_sphere(20, 30);
    const auto sound = static_cast<uint32_t>(mesh.triangles.size() / 3);
    const uint32_t without_area = sound / 2;  // in the middle of sound ones
    mesh.triangles[3 * without_area + 1] = mesh.triangles[3 * without_area];
    mesh.add_triangle({0, 0, NAN}, {1, 0, 0}, {0, 1, 0});
    mesh.add_triangle({0, 0, 0}, {1e30F, 0, 0}, {0, 1, 0});
    const uint32_t end = sound + 2;
    for (uint32_t length : {0U, 1U, 3U, 16U, 17U, 33U, end}) {
        for (uint32_t begin = 0; begin + length <= end; ++begin) {
            const auto holds = [&](uint32_t face) { return face >= begin && face < begin + length ? 1U : 0U; };
            const RejectedFaces rejected = rejected_faces(mesh.soup(), begin, begin + length);
            ASSERT_EQ(rejected.no_area, holds(without_area)) << begin << " " << length;
            ASSERT_EQ(rejected.not_finite, holds(sound)) << begin << " " << length;
            ASSERT_EQ(rejected.too_large, holds(sound + 1)) << begin << " " << length;
        }
    }
}

TEST(Tree, SetsBadFacesAsideAndCountsThem) {
    for (const int threads : {1, 2}) {
        Mesh mesh = make_sphere(20, 30);
        const auto sound = static_cast<uint32_t>(mesh.triangles.size() / 3);
        mesh.add_triangle({0, 0, NAN}, {1, 0, 0}, {0, 1, 0});
        mesh.add_triangle({0, 0, 0}, {INFINITY, 0, 0}, {0, 1, 0});
        mesh.add_triangle({0, 0, 0}, {1e30F, 0, 0}, {0, 1, 0});
        mesh.add_triangle({1, 2, 3}, {1, 2, 3}, {1, 2, 3});
        mesh.add_triangle({0, 0, 0}, {1, 1, 1}, {3, 3, 3});
        mesh.add_triangle({0, 0, 0}, {0x1p-60F, 0x1p-60F, 0}, {0x1p-59F, 0x1p-60F, 0});  // tiny, but it has an area
        const Tree tree = build(mesh.soup(), {Quality::kBalanced, threads});
        EXPECT_EQ(tree.report.rejected_faces.not_finite, 2U);
        EXPECT_EQ(tree.report.rejected_faces.too_large, 1U);
        EXPECT_EQ(tree.report.rejected_faces.no_area, 2U);
        EXPECT_LE(tree.bounds.upper.x, 1.0F);
        std::vector<bool> held(mesh.triangles.size() / 3);
        for_each_leaf(tree, [&](uint32_t first, uint32_t blocks, const Box3f&) {
            for (uint32_t b = first; b < first + blocks; ++b) {
                for (const uint32_t face : faces_of(tree.blocks[b])) {
                    held[face] = true;
                }
            }
        });
        for (uint32_t i = 0; i < held.size(); ++i) {
            EXPECT_EQ(held[i], i < sound || i == held.size() - 1) << i;
        }
    }
}

TEST(Tree, BoundsItsReferencesOnHostileScenes) {
    Mesh copies;
    for (int i = 0; i < 100000; ++i) {
        copies.add_triangle({0, 0, 0}, {1, 0, 0.5F}, {0, 1, 0});
    }
    Mesh coplanar = make_soup(100000, 6, 1);
    for (size_t i = 2; i < coplanar.positions.size(); i += 3) {
        coplanar.positions[i] = 0.25F;
    }
    const Mesh meshes[] = {copies, coplanar, make_furball(60000)};
    for (const Mesh& mesh : meshes) {
        for (const Quality quality : kQualities) {
            const Tree tree = build(mesh.soup(), {quality, 2});
            EXPECT_LE(tree.report.references, uint64_t{7} * tree.report.triangles + 1024);
            expect_well_formed(tree);
        }
    }
    const Tree tree = build(copies.soup(), {Quality::kBalanced, 2});
    const Ray ray{{0.25F, 0.25F, -1}, 0, {0, 0, 1}, INFINITY};
    Hit hit{};
    intersect(tree, {&ray, 1}, {&hit, 1});
    EXPECT_EQ(hit.triangle, 0) << "of equal distances the lowest index wins";
}

/// Small triangles where a sample of the faces is taken (see multiway-inl.h), and elsewhere such as lie in all leaves.
Mesh make_misleading(uint32_t count) {
    constexpr uint32_t kGroup = 16;
    const uint32_t shift = sampling_shift(count);
    Mesh mesh = make_soup(count, 8, 0.001F);
    for (uint32_t face = 0; face < count; ++face) {
        const uint32_t group = face / kGroup;
        if ((group >> shift) * 0x9e3779b1U >> (32 - shift) != group % (1U << shift)) {
            float* corner = &mesh.positions[size_t{9} * face];
            std::fill(corner, corner + 3, 0.0F);
            std::fill(corner + 3, corner + 6, 1.0F);
        }
    }
    return mesh;
}

TEST(Tree, BoundsItsReferencesOnLargeHostileScenes) {
    Mesh copies;
    for (uint32_t i = 0; i < kMultiwayFrom; ++i) {
        copies.add_triangle({0, 0, 0}, {1, 0, 0.5F}, {0, 1, 0});
    }
    const std::pair<Mesh, Quality> scenes[] = {
        {copies, Quality::kBalanced},
        {make_furball(kMultiwayFrom), Quality::kDraft},
        {make_soup(kMultiwayFrom, 5, 4), Quality::kBalanced},
        {make_misleading(MultiwaySplit::kMostLeaves * kMultiwayLeaf), Quality::kDraft},
    };
    for (const auto& [mesh, quality] : scenes) {
        SCOPED_TRACE(testing::Message() << mesh.soup().size() << " faces, quality " << static_cast<int>(quality));
        const Tree serial = build(mesh.soup(), {quality, 1});
        EXPECT_LE(serial.report.references, uint64_t{7} * serial.report.triangles + 1024);
        expect_well_formed(serial);
        expect_same(serial, build(mesh.soup(), {quality, 2}));
    }
}

TEST(Tree, CanBeCancelled) {
    const Mesh mesh = make_soup(200000, 8);
    const std::atomic<bool> cancelled{true};
    for (const int threads : {1, 2}) {
        EXPECT_THROW(build(mesh.soup(), {Quality::kBalanced, threads, &cancelled}), BuildCancelled);
    }
    std::atomic<bool> later{false};
    std::thread canceller([&] {
        std::this_thread::sleep_for(std::chrono::milliseconds(3));
        later = true;
    });
    EXPECT_THROW(build(mesh.soup(), {Quality::kBest, 2, &later}), BuildCancelled);
    canceller.join();
}

TEST(Tree, CanBeBuiltByManyThreadsAtOnce) {
    const Mesh mesh = make_sphere(80, 120);
    const uint64_t expected = build(mesh.soup(), {Quality::kBalanced, 1}).report.checksum;
    std::vector<std::thread> callers;
    std::atomic<int> same{0};
    for (int i = 0; i < 4; ++i) {
        callers.emplace_back(
            [&] { same += build(mesh.soup(), {Quality::kBalanced, 3}).report.checksum == expected ? 1 : 0; });
    }
    for (std::thread& caller : callers) {
        caller.join();
    }
    EXPECT_EQ(same, 4);
}

}  // namespace
}  // namespace espalier
