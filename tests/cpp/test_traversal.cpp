// SPDX-License-Identifier: GPL-3.0-or-later
#include <gtest/gtest.h>

#include <algorithm>
#include <bit>
#include <numeric>
#include <random>

#include "kdtree/mailboxes.h"
#include "kdtree/plain_traversal.h"
#include "kdtree/traversal.h"
#include "meshes.h"
#include "rays.h"

namespace espalier {
namespace {

/// Bit for bit.
bool is_same(const Hit& a, const Hit& b) {
    return std::bit_cast<uint32_t>(a.t) == std::bit_cast<uint32_t>(b.t) &&
           std::bit_cast<uint32_t>(a.u) == std::bit_cast<uint32_t>(b.u) &&
           std::bit_cast<uint32_t>(a.v) == std::bit_cast<uint32_t>(b.v) && a.triangle == b.triangle;
}

/// The same triangles in a chain of nodes whose boxes are met by every ray: it tests them all, and nothing but the
/// triangle test decides.
Tree make_flat_list(const Mesh& mesh, uint32_t longest_leaf = WideNode::kMaxLeafBlocks) {
    Tree tree = build(mesh.soup(), {Quality::kBalanced, 1});
    const uint32_t count = mesh.soup().size();
    tree.blocks = LargeBuffer<TriangleBlock>(block_count(count));
    for (uint32_t i = 0; i < block_count(count) * kBlockSize; ++i) {
        TriangleBlock& block = tree.blocks[i / kBlockSize];
        block.triangle[i % kBlockSize] = i < count ? i : kNoTriangle;
        for (int corner = 0; corner < 3; ++corner) {
            for (int axis = 0; axis < 3; ++axis) {
                block.vertex[corner][axis][i % kBlockSize] = i < count ? mesh.soup().vertex(i, corner)[axis] : NAN;
            }
        }
    }
    const uint32_t leaves = (block_count(count) + longest_leaf - 1) / longest_leaf;
    tree.wide_nodes = LargeBuffer<WideNode>((leaves + WideNode::kWidth - 2) / (WideNode::kWidth - 1));
    uint32_t first = 0;
    for (uint32_t n = 0; n < tree.wide_nodes.size(); ++n) {
        WideNode& node = tree.wide_nodes[n];
        const bool has_next = n + 1 < tree.wide_nodes.size();
        for (int i = 0; i < WideNode::kWidth; ++i) {
            const bool is_link = i == WideNode::kWidth - 1 && has_next;
            const uint32_t blocks = is_link ? 0 : std::min(longest_leaf, block_count(count) - first);
            const bool used = is_link || blocks != 0;
            for (int axis = 0; axis < 3; ++axis) {
                node.lower[axis][i] = used ? -1e20F : INFINITY;
                node.upper[axis][i] = used ? 1e20F : -INFINITY;
            }
            if (used) {
                node.child[i] = is_link ? n + 1 : WideNode::leaf(first, blocks);
            }
            first += blocks;
        }
        for (uint32_t i = 0; i < WideNode::kWidth; ++i) {
            node.order[i] = 076543210U | i << WideNode::kSoonestShift;
        }
    }
    return tree;
}

/// The room is what tests leaves below the root: some of one block and some of two.
TEST(Traversal, MeetsLeavesBelowTheRoot) {
    const Mesh mesh = make_room();
    uint32_t of_blocks[3] = {};
    for (const Quality quality : {Quality::kDraft, Quality::kBalanced, Quality::kBest, Quality::kExact}) {
        const Tree tree = build(mesh.soup(), {quality, 1});
        const WideNode& root = tree.wide_nodes[0];
        for (size_t i = 0; i < WideNode::kWidth; ++i) {
            const bool is_used = root.lower[0][i] <= root.upper[0][i];
            const uint32_t blocks = WideNode::blocks(root.child[i]);
            if (is_used && (root.child[i] & WideNode::kLeafFlag) != 0 && blocks <= 2) {
                ++of_blocks[blocks];
            }
        }
    }
    EXPECT_GE(of_blocks[1], 4U);
    EXPECT_GE(of_blocks[2], 2U);
}

/// A copy in the leaf that a ray enters first, and behind it, just where the ray hits, the face with the lower index.
TEST(Traversal, AsksBehindALeafBelowTheRootForWhatIsAsNear) {
    Mesh mesh;
    const auto add = [&](float z) { mesh.add_triangle({-1, -1, z}, {2, -1, z}, {-1, 2, z}); };
    add(1);
    for (uint32_t i = 1; i < 2 * kBlockSize; ++i) {
        add(50);
    }
    add(1);
    Tree tree = make_flat_list(mesh, 1);
    WideNode& root = tree.wide_nodes[0];
    const float planes[3][2] = {{1, 1}, {50, 50}, {0.5F, 1}};
    for (size_t i = 0; i < 3; ++i) {
        root.lower[2][i] = planes[i][0];
        root.upper[2][i] = planes[i][1];
    }
    std::vector<Ray> rays(40, Ray{{0, 0, 0}, 0, {0, 0, 1}, INFINITY});
    for (size_t i = 0; i < rays.size(); ++i) {
        rays[i].origin.x = 0.01F * static_cast<float>(i);  // not one packet
    }
    std::vector<Hit> hits(rays.size());
    intersect(tree, rays, hits);
    EXPECT_EQ(std::count_if(hits.begin(), hits.end(), [](const Hit& hit) { return hit.triangle == 0; }), 40);
}

TEST(Mailboxes, KnowATriangleUntilTheNextPacket) {
    Mailboxes mailboxes;
    Mailboxes unused;
    for (uint32_t packet = 0; packet < 50; ++packet) {  // more than marks can tell apart
        mailboxes.next_packet();
        // Some of the packet and of the fifteenth and the sixteenth before it, and two that share a place.
        for (const uint32_t triangle : {1000 + packet % 15, 2000 + packet % 16, 511U, kMaxTriangles - 1}) {
            EXPECT_EQ(mailboxes.is_new(triangle), 1U) << triangle << " in packet " << packet;
            EXPECT_EQ(mailboxes.is_new(triangle), 0U) << triangle << " in packet " << packet;
        }
        EXPECT_EQ(mailboxes.is_new(511), 1U) << "the last one took its place";
        unused.next_packet();
        EXPECT_EQ(Mailboxes(unused).is_new(kMaxTriangles - 1), 1U) << "of packet " << packet;
    }
}

/// Whatever the tree, a ray hits what it would hit if every triangle were tested, bit for bit.
TEST(Traversal, LosesNoHit) {
    Mesh far = make_sphere(24, 32);
    for (float& x : far.positions) {
        x += 1e5F;
    }
    const Mesh meshes[] = {make_sphere(24, 32), make_soup(1500, 11), make_furball(300),
                           make_grid(20),       make_room(),         far};
    for (const Mesh& mesh : meshes) {
        const Tree list = make_flat_list(mesh);
        const std::vector<Ray> rays = make_rays(mesh, 3000, 12);
        std::vector<Hit> expected(rays.size());
        intersect(list, rays, expected);
        for (const Quality quality : {Quality::kDraft, Quality::kBalanced, Quality::kBest, Quality::kExact}) {
            const Tree tree = build(mesh.soup(), {quality, 1});
            std::vector<Hit> hits(rays.size());
            std::vector<uint8_t> blocked(rays.size());
            intersect(tree, rays, hits);
            occluded(tree, rays, blocked);
            uint32_t different = 0;
            uint32_t contradicted = 0;
            for (size_t i = 0; i < rays.size(); ++i) {
                different += hits[i].triangle != expected[i].triangle || hits[i].t != expected[i].t ? 1U : 0U;
                contradicted += (hits[i].triangle >= 0) != (blocked[i] != 0) ? 1U : 0U;
            }
            EXPECT_EQ(different, 0U);
            EXPECT_EQ(contradicted, 0U);
        }
    }
}

/// Rays as pictures have them, which are traced as packets: from one point, towards one point, and at its near side
/// hits whose distance ties with t_min or t_max.
std::vector<Ray> make_coherent_rays(const Mesh& mesh, uint32_t seed) {
    std::mt19937 random(seed);
    const auto uniform = [&] { return static_cast<float>(random() >> 8) * 0x1p-24F; };
    const Tree tree = build(mesh.soup(), {Quality::kDraft, 1});
    const float extent = length(tree.bounds.size());
    const Vec3f size{extent, extent, extent};
    const Vec3f middle = (tree.bounds.lower + tree.bounds.upper) * 0.5F;
    std::vector<Ray> rays;
    for (int view = 0; view < 12; ++view) {
        // Some views run straight along an axis; some spread too far for a packet, or across octants.
        const Vec3f eye = middle + size * Vec3f{view % 3 == 0 ? 0.0F : uniform() * 4 - 2, uniform() * 4 - 2,
                                                view % 4 == 0 ? 3.0F : uniform() * 4 - 2};
        const float width = view % 5 == 4 ? 0.5F : 0.01F;
        std::vector<Ray> camera;
        for (int patch = 0; patch < 12; ++patch) {
            const float* corner = &mesh.positions[size_t{3} * (random() % (mesh.positions.size() / 3))];
            const Vec3f target = patch % 4 != 0 ? Vec3f{corner[0], corner[1], corner[2]}
                                                : middle + size * Vec3f{uniform() - 0.5F, uniform() - 0.5F, 0};
            for (int i = 0; i < 16; ++i) {
                const Vec3f off = patch % 3 == 0 && i == 5 ? Vec3f{} : Vec3f{uniform() - 0.5F, uniform() - 0.5F, 0};
                camera.push_back({eye, 0, target + size * off * width - eye, INFINITY});
            }
        }
        std::vector<Hit> hits(camera.size());
        intersect(tree, camera, hits);
        for (size_t i = 0; i < camera.size(); ++i) {
            const Ray& ray = camera[i];
            rays.push_back(ray);
            if (hits[i].triangle >= 0 && i % 7 < 2) {
                (i % 7 == 0 ? rays.back().t_min : rays.back().t_max) = hits[i].t;
            }
        }
        const Vec3f lamp = middle + size * Vec3f{uniform() * 2 - 1, uniform() * 2 - 1, view % 2 == 0 ? 2.0F : 0.1F};
        for (size_t i = 0; i < camera.size(); ++i) {
            const float t = hits[i].triangle >= 0 ? hits[i].t * (1 - 0x1p-18F) : 1.0F;
            const Vec3f point = camera[i].origin + camera[i].direction * t;
            rays.push_back({point, 0, lamp - point, i % 5 == 0 ? 0.5F : 1.0F});
        }
    }
    return rays;
}

/// Traces rays at one triangle as a packet and one by one. Returns how many hit it, or 0 if the ways differ.
uint32_t hits_in_both_ways(const Vec3f (&corner)[3], const std::vector<Ray>& rays) {
    Mesh mesh{{}, {0, 1, 2}};
    for (const Vec3f& point : corner) {
        mesh.positions.insert(mesh.positions.end(), {point.x, point.y, point.z});
    }
    const Tree tree = build(mesh.soup(), {});
    std::vector<Hit> together(rays.size());
    intersect(tree, rays, together);
    uint32_t found = 0;
    for (size_t k = 0; k < rays.size(); ++k) {
        Hit alone{};
        intersect(tree, {&rays[k], 1}, {&alone, 1});
        if (!is_same(alone, together[k])) {
            return 0;
        }
        found += alone.triangle >= 0 ? 1U : 0U;
    }
    return found;
}

TEST(Traversal, FinishesAPacketsHitsAsThoseOfSingleRays) {
    constexpr size_t kRays = 32;
    constexpr float kInfinity = std::numeric_limits<float>::infinity();
    std::mt19937 random(5);
    std::uniform_real_distribution<float> uniform(-1, 1);
    const auto point = [&] { return Vec3f{uniform(random), uniform(random), uniform(random)}; };
    for (int i = 0; i < 200; ++i) {
        // So near its plane that double does not tell how near; all rays of one side hit, in the plane those of both.
        const Vec3f corner[3] = {point(), point(), point()};
        const Vec3f focus = (corner[0] + corner[1] + corner[2]) * (1.0F / 3);
        const Vec3f normal = normalize(cross(corner[1] - corner[0], corner[2] - corner[0]));
        uint32_t found = 0;
        for (const float side : {1.0F, -1.0F}) {
            std::vector<Ray> rays;
            for (size_t k = 0; k < kRays; ++k) {
                rays.push_back({focus, 0, normal * side + point() * 0.01F, kInfinity});
            }
            found += hits_in_both_ways(corner, rays);
        }
        EXPECT_TRUE(found == kRays || found == 2 * kRays) << found;
    }
    // Zeros of either sign are one point.
    const Vec3f at_zero[3] = {{-0.0F, -0.0F, -0.0F}, {1, -1, 0}, {0, 1, -1}};
    std::vector<Ray> rays(kRays, Ray{{-0.0F, -0.0F, -0.0F}, 0, {1, 1, 1}, kInfinity});
    rays[0].origin = {0, 0, 0};
    EXPECT_EQ(hits_in_both_ways(at_zero, rays), kRays);
}

/// Packets, streams and single rays give the same hits bit for bit, in any number and order.
TEST(Traversal, IsTheSameInAnyBatch) {
    Mesh far = make_sphere(24, 32);
    for (float& x : far.positions) {
        x += 1e4F;
    }
    const Mesh meshes[] = {make_sphere(24, 32), make_soup(1500, 11), make_furball(300),
                           make_grid(20),       make_room(),         far};
    for (const Mesh& mesh : meshes) {
        const Tree tree = build(mesh.soup(), {});
        const Tree list = make_flat_list(mesh);
        const std::vector<Ray> rays = make_coherent_rays(mesh, 5);
        std::vector<Hit> hits(rays.size());
        std::vector<uint8_t> blocked(rays.size());
        intersect(tree, rays, hits);
        occluded(tree, rays, blocked);

        size_t found = 0;
        size_t wrong_alone = 0;
        for (size_t i = 0; i < rays.size(); ++i) {
            Hit hit{};
            uint8_t is_blocked = 0;
            intersect(tree, {&rays[i], 1}, {&hit, 1});
            occluded(tree, {&rays[i], 1}, {&is_blocked, 1});
            found += hit.triangle >= 0 ? 1U : 0U;
            wrong_alone +=
                is_same(hit, hits[i]) && is_blocked == blocked[i] && (hit.triangle >= 0) == (is_blocked != 0) ? 0U : 1U;
        }
        EXPECT_GT(found, 30U);
        EXPECT_EQ(wrong_alone, 0U);

        std::vector<Hit> expected(rays.size());
        intersect(list, rays, expected);
        size_t wrong_in_tree = 0;
        for (size_t i = 0; i < rays.size(); ++i) {
            wrong_in_tree += is_same(hits[i], expected[i]) ? 0U : 1U;
        }
        EXPECT_EQ(wrong_in_tree, 0U);

        std::vector<size_t> order(rays.size());
        std::iota(order.begin(), order.end(), size_t{0});
        std::shuffle(order.begin(), order.end(), std::mt19937(3));
        std::vector<Ray> shuffled;
        for (const size_t i : order) {
            shuffled.push_back(rays[i]);
        }
        std::vector<Hit> shuffled_hits(rays.size());
        std::vector<uint8_t> shuffled_blocked(rays.size());
        // Odd pieces, so that packets begin anywhere.
        for (size_t begin = 0; begin < rays.size(); begin += 37) {
            const size_t count = std::min<size_t>(37, rays.size() - begin);
            intersect(tree, std::span(shuffled).subspan(begin, count), std::span(shuffled_hits).subspan(begin, count));
            occluded(tree, std::span(shuffled).subspan(begin, count),
                     std::span(shuffled_blocked).subspan(begin, count));
        }
        size_t wrong_shuffled = 0;
        for (size_t i = 0; i < rays.size(); ++i) {
            wrong_shuffled +=
                is_same(shuffled_hits[i], hits[order[i]]) && shuffled_blocked[i] == blocked[order[i]] ? 0U : 1U;
        }
        EXPECT_EQ(wrong_shuffled, 0U);
    }
}

/// 70 nodes below one another, each with seven leaves that have to wait: as much as a ray ever has to remember. The
/// first of the leaves that waited is the one that counts. They are too long to be tested as rays are set up.
TEST(Traversal, RemembersAllThatWaits) {
    constexpr uint32_t kLevels = 70;
    constexpr uint32_t kBlocks = 3;
    Mesh mesh;
    for (uint32_t i = 0; i < kLevels * (WideNode::kWidth - 1) * kBlocks * kBlockSize; ++i) {
        const float z = 1 + static_cast<float>(i);
        mesh.add_triangle({-1, -1, z}, {2, -1, z}, {-1, 2, z});
    }
    const Tree tree = make_flat_list(mesh, kBlocks);
    EXPECT_EQ(tree.wide_nodes.size(), kLevels);
    std::vector<Ray> rays;
    for (uint32_t i = 0; i < 100; ++i) {
        rays.push_back({{0, 0.001F * static_cast<float>(i), 0}, 0, {0, 0, 1}, INFINITY});
    }
    std::vector<Hit> hits(rays.size());
    for (const size_t count : {size_t{1}, rays.size()}) {
        intersect(tree, std::span(rays).first(count), std::span(hits).first(count));
        EXPECT_EQ(std::count_if(hits.begin(), hits.begin() + static_cast<long>(count),
                                [](const Hit& hit) { return hit.triangle == 0 && hit.t == 1; }),
                  static_cast<long>(count));
    }
    std::vector<uint8_t> blocked(rays.size());
    for (Ray& ray : rays) {
        ray.t_max = 1.5F;
    }
    occluded(tree, rays, blocked);
    EXPECT_EQ(std::count(blocked.begin(), blocked.end(), 1), static_cast<long>(rays.size()));

    // And so is each of the others, for rays that begin before it.
    rays.clear();
    for (uint32_t i = 0; i < kLevels * (WideNode::kWidth - 1); ++i) {
        const float t_min = 0.5F + static_cast<float>(i * kBlocks * kBlockSize);
        rays.push_back({{0, 0.001F * static_cast<float>(i % 100), 0}, t_min, {0, 0, 1}, INFINITY});
    }
    hits.resize(rays.size());
    intersect(tree, rays, hits);
    for (uint32_t i = 0; i < rays.size(); ++i) {
        EXPECT_EQ(hits[i].triangle, static_cast<int32_t>(i * kBlocks * kBlockSize));
    }
}

/// Nodes by hand, over two blocks of one triangle each: the first no ray meets, the second all.
class HandmadeNodes {
 public:
    explicit HandmadeNodes(uint32_t count) {
        Mesh mesh;
        mesh.add_triangle({-1, 50, 10}, {4, 50, 10}, {-1, 55, 10});
        mesh.add_triangle({-1, -1, 10}, {40, -1, 10}, {-1, 40, 10});
        tree_ = build(mesh.soup(), {Quality::kBalanced, 1});
        tree_.blocks = LargeBuffer<TriangleBlock>(2);
        for (uint32_t b = 0; b < 2; ++b) {
            for (uint32_t lane = 0; lane < kBlockSize; ++lane) {
                tree_.blocks[b].triangle[lane] = lane == 0 ? b : kNoTriangle;
                for (int corner = 0; corner < 3; ++corner) {
                    for (int axis = 0; axis < 3; ++axis) {
                        tree_.blocks[b].vertex[corner][axis][lane] =
                            lane == 0 ? mesh.soup().vertex(b, corner)[axis] : NAN;
                    }
                }
            }
        }
        tree_.wide_nodes = LargeBuffer<WideNode>(count);
        for (uint32_t n = 0; n < count; ++n) {
            for (uint32_t slot = 0; slot < WideNode::kWidth; ++slot) {
                for (int axis = 0; axis < 3; ++axis) {
                    tree_.wide_nodes[n].lower[axis][slot] = INFINITY;
                    tree_.wide_nodes[n].upper[axis][slot] = -INFINITY;
                }
                tree_.wide_nodes[n].order[slot] = 076543210U | slot << WideNode::kSoonestShift;  // slot 7 comes first
            }
        }
    }

    static uint32_t leaf(bool meets) { return WideNode::leaf(meets ? 1 : 0, 1); }
    void set_child(uint32_t node, uint32_t slot, uint32_t child, float end_of_x) {
        for (int axis = 0; axis < 3; ++axis) {
            tree_.wide_nodes[node].lower[axis][slot] = -1;
            tree_.wide_nodes[node].upper[axis][slot] = axis == 0 ? end_of_x : 60;
        }
        tree_.wide_nodes[node].child[slot] = child;
    }

    /// Of sixteen rays side by side, at x from 0 to 15.
    std::vector<uint8_t> blocked() const {
        std::vector<Ray> rays;
        for (uint32_t i = 0; i < 16; ++i) {
            const auto x = static_cast<float>(i);
            rays.push_back({{x, 0.5F + 0.01F * x, 0}, 0, {0, 0.001F, 1}, INFINITY});
        }
        std::vector<uint8_t> blocked(rays.size());
        occluded(tree_, rays, blocked);
        return blocked;
    }

 private:
    Tree tree_;
};

constexpr float kAllRays = 40;
constexpr float kFourRays = 3.5F;
std::vector<uint8_t> four_blocked() { return {1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0}; }

/// Four rays of a group pass through seven boxes at each of 70 nodes below one another that all of it enters: more than
/// they can take over. What blocks them lies in the very last of these.
TEST(Traversal, RaysOfAGroupRememberAllThatWaits) {
    constexpr uint32_t kLevels = 70;
    constexpr uint32_t kMissing = kLevels;
    constexpr uint32_t kMeeting = kLevels + 1;
    HandmadeNodes nodes(kLevels + 2);
    for (uint32_t n = 0; n < kLevels; ++n) {
        for (uint32_t slot = 0; slot < WideNode::kWidth; ++slot) {
            nodes.set_child(n, slot, n == 0 && slot == 0 ? kMeeting : kMissing, kFourRays);
        }
        if (n + 1 < kLevels) {
            nodes.set_child(n, WideNode::kWidth - 1, n + 1, kAllRays);
        }
    }
    nodes.set_child(kMissing, 0, HandmadeNodes::leaf(false), kFourRays);
    nodes.set_child(kMeeting, 0, HandmadeNodes::leaf(true), kFourRays);
    EXPECT_EQ(nodes.blocked(), four_blocked());
}

/// Four rays leave their group with as much as they can take over, and with a way of 68 more nodes, each of which lets
/// seven more wait, before what blocks them: it lies at that way's very end, or is the last of what they took over.
TEST(Traversal, RaysThatLeaveAGroupRememberAllThatWaits) {
    constexpr uint32_t kAbove = 6;  // nodes that all rays enter
    constexpr uint32_t kDown = 68;
    constexpr uint32_t kFirst = kAbove;  // of the way down
    constexpr uint32_t kMissing = kAbove + kDown;
    constexpr uint32_t kMeeting = kMissing + 1;
    for (const bool is_at_end : {true, false}) {
        HandmadeNodes nodes(kMissing + 2);
        for (uint32_t n = 0; n < kAbove; ++n) {
            for (uint32_t slot = 0; slot + 1 < WideNode::kWidth; ++slot) {
                nodes.set_child(n, slot, n == 0 && slot == 0 && !is_at_end ? kMeeting : kMissing, kFourRays);
            }
            const bool is_last = n + 1 == kAbove;
            nodes.set_child(n, WideNode::kWidth - 1, is_last ? kFirst : n + 1, is_last ? kFourRays : kAllRays);
        }
        for (uint32_t n = kFirst; n < kFirst + kDown; ++n) {
            const bool is_last = n + 1 == kFirst + kDown;
            for (uint32_t slot = 0; slot < WideNode::kWidth; ++slot) {
                nodes.set_child(n, slot, kMissing, kFourRays);
            }
            nodes.set_child(n, WideNode::kWidth - 1, is_last ? (is_at_end ? kMeeting : kMissing) : n + 1, kFourRays);
        }
        nodes.set_child(kMissing, 0, HandmadeNodes::leaf(false), kFourRays);
        nodes.set_child(kMeeting, 0, HandmadeNodes::leaf(true), kFourRays);
        EXPECT_EQ(nodes.blocked(), four_blocked()) << is_at_end;
    }
}

/// From places that lie side by side to all of a lamp: such rays are led through the tree together, and those that look
/// for the nearest hit are not.
TEST(Traversal, GroupsEndWhereTheirRaysDo) {
    std::mt19937 random(17);
    const auto uniform = [&] { return static_cast<float>(random() >> 8) * 0x1p-24F; };
    const Mesh meshes[] = {make_sphere(24, 32), make_soup(1500, 11), make_furball(3000), make_grid(20), make_room()};
    for (const Mesh& mesh : meshes) {
        const Tree tree = build(mesh.soup(), {});
        const float room = 0.2F * length(tree.bounds.size());
        const Vec3f size = tree.bounds.size() + Vec3f{room, room, room};
        const Vec3f lower = tree.bounds.lower - Vec3f{room, room, room} * 0.5F;
        const auto point = [&] { return Vec3f{uniform(), uniform(), uniform()}; };
        size_t blocked_rays = 0;
        size_t wrong = 0;
        constexpr size_t kRays = 16;
        constexpr uint32_t kGroups = 400;
        for (uint32_t group = 0; group < kGroups; ++group) {
            const Vec3f from = lower + size * point();
            const Vec3f to = lower + size * point();
            const float spread = group % 2 == 0 ? 0.02F : 0.2F;
            std::vector<Ray> rays;
            for (size_t i = 0; i < kRays; ++i) {
                const Vec3f origin = from + size * point() * spread;
                rays.push_back({origin, 0, to + size * point() * spread - origin, 1});
            }
            std::vector<uint8_t> blocked(kRays);
            std::vector<Hit> hits(kRays);
            occluded(tree, rays, blocked);
            intersect(tree, rays, hits);
            for (size_t i = 0; i < kRays; ++i) {
                blocked_rays += blocked[i];
                wrong += (hits[i].triangle >= 0) == (blocked[i] != 0) ? 0U : 1U;
            }
        }
        EXPECT_EQ(wrong, 0U);
        EXPECT_GT(blocked_rays, kGroups * kRays / 50);
        EXPECT_LT(blocked_rays, kGroups * kRays - kGroups * kRays / 50);
    }
}

/// The path that exactness is priced against takes the same way, and is only seldom wrong.
TEST(Traversal, PlainPathIsNearlyTheSame) {
    for (const Mesh& mesh : {make_sphere(24, 32), make_room()}) {
        const Tree tree = build(mesh.soup(), {});
        std::vector<Ray> rays = make_coherent_rays(mesh, 5);
        for (const Ray& ray : make_rays(mesh, 4000, 6)) {
            rays.push_back(ray);
        }
        std::erase_if(rays,
                      [](const Ray& ray) { return ray.t_min > 0 || ray.t_max < 1; });  // ties are for the exact path
        std::vector<Hit> hits(rays.size());
        std::vector<Hit> plain(rays.size());
        std::vector<uint8_t> blocked(rays.size());
        intersect(tree, rays, hits);
        plain_intersect(tree, rays, plain);
        plain_occluded(tree, rays, blocked);
        size_t different = 0;
        for (size_t i = 0; i < rays.size(); ++i) {
            const bool is_hit = hits[i].triangle >= 0;
            const bool is_near = !is_hit || std::abs(plain[i].t - hits[i].t) <= 1e-3F * hits[i].t + 1e-5F;
            different += (plain[i].triangle >= 0) == is_hit && (blocked[i] != 0) == is_hit && is_near ? 0U : 1U;
        }
        EXPECT_LT(different, rays.size() / 20);
    }
}

TEST(Traversal, WhatIsNoRayHarmsNoOther) {
    const auto make_none = [](Ray ray, size_t kind) {
        Vec3f& d = ray.direction;
        switch (kind % 7) {
            case 0:
                ray.origin.x = NAN;
                break;
            case 1:
                ray.origin.y = INFINITY;
                break;
            case 2:
                d = {0, 0, 0};
                break;
            case 3:
                d.x = -INFINITY;
                break;
            case 4:
                d = {INFINITY, INFINITY, INFINITY};
                break;
            case 5:
                ray.t_min = NAN;
                break;
            default:
                ray.t_max = NAN;
        }
        return ray;
    };
    for (const Mesh& mesh : {make_sphere(24, 32), make_room()}) {
        const Tree tree = build(mesh.soup(), {});
        // Each on its own way, and as packets.
        for (std::vector<Ray> rays : {make_rays(mesh, 3000, 12), make_coherent_rays(mesh, 5)}) {
            std::vector<Hit> expected(rays.size());
            std::vector<uint8_t> expected_blocked(rays.size());
            intersect(tree, rays, expected);
            occluded(tree, rays, expected_blocked);
            constexpr size_t kEvery = 37;  // another lane in each packet
            for (size_t i = 0; i < rays.size(); i += kEvery) {
                rays[i] = make_none(rays[i], i / kEvery);
            }
            std::vector<Hit> hits(rays.size());
            std::vector<uint8_t> blocked(rays.size());
            intersect(tree, rays, hits);
            occluded(tree, rays, blocked);
            size_t wrong = 0;
            for (size_t i = 0; i < rays.size(); ++i) {
                const bool same_hit = hits[i].triangle == expected[i].triangle && hits[i].t == expected[i].t;
                wrong += i % kEvery == 0 || (same_hit && blocked[i] == expected_blocked[i]) ? 0U : 1U;
            }
            EXPECT_EQ(wrong, 0U);
        }
    }
}

TEST(Traversal, KeepsToTheRaysInterval) {
    Mesh mesh;
    mesh.add_triangle({-1, -1, 1}, {2, -1, 1}, {-1, 2, 1});
    mesh.add_triangle({-1, -1, 2}, {2, -1, 2}, {-1, 2, 2});
    const Tree tree = build(mesh.soup(), {});
    const struct {
        float t_min, t_max;
        int triangle;
    } cases[] = {{0, INFINITY, 0},     {1, 1, 0},    {1.5F, INFINITY, 1}, {1.5F, 2, 1}, {1.25F, 1.75F, -1},
                 {2.5F, INFINITY, -1}, {0, 0.5F, -1}};
    for (const auto& c : cases) {
        const Ray ray{{0, 0, 0}, c.t_min, {0, 0, 1}, c.t_max};
        Hit hit{};
        uint8_t blocked = 0;
        intersect(tree, {&ray, 1}, {&hit, 1});
        occluded(tree, {&ray, 1}, {&blocked, 1});
        EXPECT_EQ(hit.triangle, c.triangle);
        EXPECT_EQ(blocked != 0, c.triangle >= 0);
        EXPECT_EQ(hit.t, c.triangle < 0 ? c.t_max : static_cast<float>(c.triangle + 1));
    }
}

/// Rays that end in one point, however far: products of its coordinates must not leave float's range.
TEST(Traversal, RaysMayEndTogetherAnywhere) {
    const Tree tree = build(make_sphere(24, 32).soup(), {});
    for (int exponent = 3; exponent < 100; ++exponent) {
        const float far = std::ldexp(1.7F, exponent);
        std::vector<Ray> rays;
        for (int i = 0; i < 32; ++i) {
            const auto step = static_cast<float>(i);
            const Vec3f direction{0.0371F * far * (1 + step * 0x1p-23F), 0.0237F * far * (1 + step * 0x1p-23F), far};
            rays.push_back({{0.01F * step - 0.3F, 0.01F * step, -3}, 0, direction, 1});
        }
        std::vector<uint8_t> blocked(rays.size());
        occluded(tree, rays, blocked);
        EXPECT_EQ(std::count(blocked.begin(), blocked.end(), 1), 32) << exponent;
    }
}

/// Seen from where they meet, what lies behind is at depths below zero, which the box test has no room for.
TEST(Traversal, RaysMayPassTheirCommonEnd) {
    Mesh mesh;
    mesh.add_triangle({-9, -9, -1}, {9, -9, -1}, {0, 9, -1});
    const Tree tree = build(mesh.soup(), {});
    for (const float t_max : {1.0F, 1.5F, INFINITY}) {
        std::vector<Ray> rays;
        for (int i = 0; i < 32; ++i) {
            const Vec3f from{0.01F * static_cast<float>(i), 0.02F, 2};
            rays.push_back({from, 0, -from, t_max});
        }
        std::vector<uint8_t> blocked(rays.size());
        occluded(tree, rays, blocked);
        EXPECT_EQ(std::count(blocked.begin(), blocked.end(), 1), t_max > 1 ? 32 : 0);
    }
}

/// Packets that meet a wall just where their rays end, or begin: the depth of its box is rounded, and may lie beyond.
TEST(Traversal, PacketsReachTheEndsOfTheirRays) {
    Mesh mesh;
    mesh.add_triangle({0.7F, -9, -9}, {0.7F, 9, -9}, {0.7F, 0, 9});
    const Tree tree = build(mesh.soup(), {});
    std::mt19937 random(4);
    const auto uniform = [&] { return static_cast<float>(random() >> 8) * 0x1p-24F; };
    for (int i = 0; i < 2000; ++i) {
        const Vec3f way = Vec3f{0.7F, uniform(), 1 + uniform()} * (1 + uniform());
        Ray from_eye{{}, 0, way, INFINITY};
        Ray to_lamp{way, 0, -way, 1};
        Hit hit{};
        intersect(tree, {&from_eye, 1}, {&hit, 1});
        from_eye.t_max = std::nextafter(hit.t, INFINITY);
        intersect(tree, {&to_lamp, 1}, {&hit, 1});
        to_lamp.t_min = std::nextafter(hit.t, -INFINITY);
        std::vector<Ray> packets(64, from_eye);
        std::fill(packets.begin() + 32, packets.end(), to_lamp);
        packets[32] = {way * 2.0F, 1, way * -2.0F, 1};  // so that lamp rays have nothing but their end in common
        std::vector<Hit> hits(packets.size());
        std::vector<uint8_t> blocked(packets.size());
        intersect(tree, packets, hits);
        occluded(tree, packets, blocked);
        for (size_t n = 0; n < packets.size(); ++n) {
            ASSERT_EQ(hits[n].triangle, n == 32 ? -1 : 0);
            ASSERT_EQ(blocked[n], n == 32 ? 0 : 1);
        }
    }
}

/// The first and the last of them start in one point, and some between do not.
TEST(Traversal, RaysOfOnePacketMayStartApart) {
    Mesh mesh;
    mesh.add_triangle({-1, -1, 0}, {1, -1, 0}, {0, 1, 0});
    const Tree tree = build(mesh.soup(), {});
    std::vector<Ray> rays(32, {{0, 0, 3}, 0, {0, 0, -1}, INFINITY});
    for (size_t i = 3; i < rays.size(); i += 8) {
        rays[i].origin.y = 9;
    }
    std::vector<Hit> hits(rays.size());
    std::vector<uint8_t> blocked(rays.size());
    intersect(tree, rays, hits);
    occluded(tree, rays, blocked);
    for (size_t i = 0; i < rays.size(); ++i) {
        EXPECT_EQ(hits[i].triangle, i % 8 == 3 ? -1 : 0);
        EXPECT_EQ(blocked[i], i % 8 == 3 ? 0 : 1);
    }
}

/// Rays of one packet that run into so many octants, in turn: what they hit is what each hits alone.
TEST(Traversal, RaysOfOnePacketMayPart) {
    const Mesh mesh = make_sphere(24, 32);
    const Tree tree = build(mesh.soup(), {});
    const Vec3f eye{0x1p-6F, 0x1p-5F, -0x1p-5F};  // few digits, so that rays to it end in one point
    std::mt19937 random(6);
    std::uniform_real_distribution<float> uniform(-0.03F, 0.03F);
    for (uint32_t parts = 1; parts <= 8; ++parts) {
        std::vector<Ray> rays;
        for (uint32_t i = 0; i < 64; ++i) {
            const uint32_t octant = i * 5 % parts;
            const Vec3f way{(octant & 1U) != 0 ? 1.0F : -1.0F, (octant & 2U) != 0 ? 0.7F : -0.7F,
                            (octant & 4U) != 0 ? 0.8F : -0.8F};
            const Vec3f end = way + Vec3f{uniform(random), uniform(random), uniform(random)};
            if (i < 32) {
                rays.push_back({eye, 0, end, i % 3 == 0 ? 0.5F : INFINITY});
            } else {
                rays.push_back({eye + end * (i % 3 == 0 ? 0.5F : 2.0F), 0, end * (i % 3 == 0 ? -0.5F : -2.0F), 1});
            }
        }
        std::vector<Hit> hits(rays.size());
        std::vector<uint8_t> blocked(rays.size());
        intersect(tree, rays, hits);
        occluded(tree, rays, blocked);
        for (size_t i = 0; i < rays.size(); ++i) {
            Hit alone{};
            intersect(tree, {&rays[i], 1}, {&alone, 1});
            EXPECT_EQ(alone.triangle < 0, i % 3 == 0) << i;
            EXPECT_TRUE(is_same(alone, hits[i])) << i;
            EXPECT_EQ(blocked[i], alone.triangle >= 0 ? 1 : 0) << i;
        }
    }
}

TEST(Traversal, ClosedMeshIsWatertight) {
    const Mesh mesh = make_sphere(48, 64);
    const Tree tree = build(mesh.soup(), {});
    std::vector<Ray> rays;
    for (size_t i = 0; i < mesh.positions.size(); i += 3) {
        const Vec3f corner{mesh.positions[i], mesh.positions[i + 1], mesh.positions[i + 2]};
        rays.push_back({{0.01F, 0.02F, -0.03F}, 0, corner - Vec3f{0.01F, 0.02F, -0.03F}, INFINITY});
    }
    for (uint32_t i = 0; i < mesh.soup().size(); ++i) {
        const Vec3f middle = (mesh.soup().vertex(i, 0) + mesh.soup().vertex(i, 1)) * 0.5F;
        rays.push_back({{}, 0, middle, INFINITY});
    }
    std::vector<Hit> hits(rays.size());
    intersect(tree, rays, hits);
    EXPECT_EQ(std::count_if(hits.begin(), hits.end(), [](const Hit& hit) { return hit.triangle < 0; }), 0);
}

/// A triangle of any size right ahead, with a reach that has to be decided: products under- and overflow at the ends.
TEST(Traversal, HitsTrianglesOfEverySize) {
    for (int exponent = -140; exponent <= 58; ++exponent) {
        const float s = std::ldexp(1.0F, exponent);
        Mesh mesh;
        mesh.add_triangle({-s, -s, 2 * s}, {s, -s, 2 * s}, {0, s, 2 * s});
        mesh.add_triangle({-s, -s, s}, {s, -s, s}, {0, s, s});
        const Tree tree = build(mesh.soup(), {});
        for (const float length : {1.0F, 0x1p-90F, 0x1p90F}) {
            if (!std::isnormal(s / length)) {
                continue;  // the distance is no float
            }
            for (const float t_max : {s / length, INFINITY}) {
                const Ray ray{{0, 0, 0}, 0, {0, 0, length}, t_max};
                Hit hit{};
                uint8_t blocked = 0;
                intersect(tree, {&ray, 1}, {&hit, 1});
                occluded(tree, {&ray, 1}, {&blocked, 1});
                EXPECT_EQ(hit.triangle, 1) << exponent << ' ' << length << ' ' << t_max;
                EXPECT_EQ(hit.t, s / length);
                EXPECT_EQ(blocked, 1);
            }
        }
    }
}

/// Alone, as a packet, and as many that make none.
TEST(Traversal, HitsBeyondTheLargestFloatAreInfinitelyFar) {
    Mesh mesh;
    mesh.add_triangle({-0x1p58F, -0x1p58F, 0x1p58F}, {0x1p58F, -0x1p58F, 0x1p58F}, {0, 0x1p58F, 0x1p58F});
    const Tree tree = build(mesh.soup(), {});
    for (const size_t count : {size_t{1}, size_t{32}, size_t{64}}) {
        std::vector<Ray> rays(count, {{0, 0, 0}, 0, {0, 0, 0x1p-90F}, INFINITY});
        if (count == 64) {
            for (size_t i = 0; i < count; ++i) {
                rays[i].origin.x = static_cast<float>(i);
            }
        }
        std::vector<Hit> hits(count);
        intersect(tree, rays, hits);
        for (const Hit& hit : hits) {
            EXPECT_EQ(hit.triangle, 0) << count;
            EXPECT_EQ(hit.t, INFINITY) << count;
            EXPECT_FLOAT_EQ(hit.u, 0.25F) << count;
            EXPECT_FLOAT_EQ(hit.v, 0.5F) << count;
        }
    }
}

TEST(Traversal, BarycentricsNameTheCorners) {
    Mesh mesh;
    mesh.add_triangle({0, 0, 0}, {4, 0, 0}, {0, 4, 0});
    const Tree tree = build(mesh.soup(), {});
    for (const float sign : {1.0F, -1.0F}) {
        const Ray ray{{1, 2, -3 * sign}, 0, {0, 0, sign}, INFINITY};
        Hit hit{};
        intersect(tree, {&ray, 1}, {&hit, 1});
        EXPECT_FLOAT_EQ(hit.t, 3);
        EXPECT_FLOAT_EQ(hit.u, 0.25F);
        EXPECT_FLOAT_EQ(hit.v, 0.5F);
    }
}

}  // namespace
}  // namespace espalier
