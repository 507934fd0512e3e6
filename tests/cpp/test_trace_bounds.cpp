// SPDX-License-Identifier: GPL-3.0-or-later
// The tracer's inequalities of native/EXACTNESS.md, measured as in test_build_bounds.cpp.
#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cstring>
#include <numeric>
#include <utility>
#include <vector>

#include "exact_kit.h"
#include "geometry/exact_hit.h"
#include "geometry/expansion.h"
#include "kdtree/simd_config.h"
#include "runnable.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "test_trace_bounds.cpp"
#include <hwy/foreach_target.h>
// Highway's own header has to follow foreach_target.h.
#include <hwy/highway.h>

#include "kdtree/finish-inl.h"
#include "kdtree/focus_view-inl.h"
#include "kdtree/ray_batch-inl.h"
#include "kdtree/stream-inl.h"
#include "kdtree/triangle_test-inl.h"

#ifndef ESPALIER_TEST_TRACE_BOUNDS_TYPES
#define ESPALIER_TEST_TRACE_BOUNDS_TYPES
namespace espalier {

/// What the code under test computes for one case.
struct DepthsResult {
    float near[3], far[3];              ///< of the planes of a box
    float near_shift[3], far_shift[3];  ///< per axis
    float entry, exit;                  ///< of the box
    float entry_of_child;               ///< of the root, whose box it is; infinite if it is not met
    bool meets_root;
    bool meets_others;    ///< whose boxes are inverted
    bool is_like_a_node;  ///< what is stacked of the root is what would be of any node
};
struct FilterResult {
    float side[3], bound;
    float mz;
    float bound_in_tree, mz_in_tree;  ///< no triangle's is larger
    float least_inside;  ///< where a step asks first, what is no further inside is ruled out before its bound is known
    bool possible, certain;
    float lower, upper;
};
/// What one ray of a packet sees of a triangle.
struct SeenFromFocus {
    Vec3f focus;
    float deviation;  ///< by how much the ray misses it, summed over the axes
    float slope[2];   ///< of the packet's middle
    float spread;     ///< of the packet along both axes, if the ray's slopes do not differ by more
};
struct ViewResult {
    bool reached, open;
    float side[3], bound;
};
struct FinishResult {
    bool open;
    float t, u, v;
};

}  // namespace espalier
#endif

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

inline size_t lane_of(const Ray& ray) { return std::bit_cast<uint32_t>(ray.origin.x) / 3 % RayBatch::kSize; }

/// Returns the rays of the batch that meet the root.
inline uint32_t set_up(const Ray& ray, RayBatch& batch, const WideNode& root) {
    // Among rays that need no room.
    Ray rays[RayBatch::kSize];
    std::fill(std::begin(rays), std::end(rays), Ray{{}, 0, {1, 0, 0}, 0});
    rays[lane_of(ray)] = ray;
    return batch.set_up(rays, root);
}

inline TracedRay traced_by(const RayBatch& batch, const Ray& ray) {
    TracedRay traced;
    batch.copy(lane_of(ray), traced);
    return traced;
}

inline DepthsResult depths_of(const Ray& ray, float extent, const Box3f& box) {
    const hn::CappedTag<float, 4> d;
    RayBatch batch({{-extent, -extent, -extent}, {extent, extent, extent}});
    const size_t lane = lane_of(ray);
    const size_t child = (lane + 3) % WideNode::kWidth;
    WideNode root{};
    for (uint32_t i = 0; i < WideNode::kWidth; ++i) {
        root.child[i] = i + 1;
        root.order[i] = 076543210;  // octal: each in its place
    }
    for (size_t axis = 0; axis < 3; ++axis) {
        std::fill(std::begin(root.lower[axis]), std::end(root.lower[axis]), kInfinity);
        std::fill(std::begin(root.upper[axis]), std::end(root.upper[axis]), -kInfinity);
        root.lower[axis][child] = box.lower[static_cast<int>(axis)];
        root.upper[axis][child] = box.upper[static_cast<int>(axis)];
    }
    const uint32_t meeting = set_up(ray, batch, root);
    const TracedRay traced = traced_by(batch, ray);
    DepthsResult result;
    const ChildEntries entries = batch.root_entries(lane);
    float entry[WideNode::kWidth];
    std::memcpy(entry, &entries, sizeof entry);
    result.entry_of_child = entry[child];
    result.meets_root = (meeting >> lane & 1U) != 0;
    entry[child] = kInfinity;
    result.meets_others = *std::min_element(std::begin(entry), std::end(entry)) < kInfinity;
    StreamRay at_root;
    StreamRay at_node;
    for (StreamRay* stream_ray : {&at_root, &at_node}) {
        batch.copy(lane, *stream_ray);
        stream_ray->clear_stack();
    }
    stack_children<true>(at_root, root, entries, Order::kNearest);
    visit_node<true>(at_node, root, Order::kNearest);
    const auto count = at_root.top - at_root.children;
    result.is_like_a_node = at_node.top - at_node.children == count &&
                            std::equal(at_root.children, at_root.top, at_node.children) &&
                            std::equal(at_root.depths, at_root.depths + count, at_node.depths);
    result.entry = traced.start;
    result.exit = traced.reach;
    for (int axis = 0; axis < 3; ++axis) {
        const bool negative = (traced.octant >> axis & 1U) != 0;
        const auto depth = [&](float plane, float shift) {
            return hn::GetLane(hn::MulAdd(hn::Set(d, plane), hn::Set(d, traced.inverse[axis]), hn::Set(d, shift)));
        };
        result.near_shift[axis] = traced.near_shift[axis];
        result.far_shift[axis] = traced.far_shift[axis];
        result.near[axis] = depth(negative ? box.upper[axis] : box.lower[axis], traced.near_shift[axis]);
        result.far[axis] = depth(negative ? box.lower[axis] : box.upper[axis], traced.far_shift[axis]);
        result.entry = std::max(result.entry, result.near[axis]);
        result.exit = std::min(result.exit, result.far[axis]);
    }
    return result;
}

/// What a ray that meets these children, a bit each, has on its stack.
inline std::vector<uint32_t> stack_of(const WideNode& node, uint32_t octant, uint32_t met, bool soonest_first) {
    alignas(32) float depths[WideNode::kWidth];
    for (uint32_t slot = 0; slot < WideNode::kWidth; ++slot) {
        depths[slot] = (met >> slot & 1U) != 0 ? static_cast<float>(slot) : kInfinity;
    }
    ChildEntries entries;
#if HWY_TARGET != HWY_SSE4 && HWY_TARGET != HWY_NEON
    entries.depth = hn::Load(hn::CappedTag<float, WideNode::kWidth>(), depths);
#else
    std::copy_n(depths, WideNode::kWidth, entries.depth);
    entries.met = met;
#endif
    StreamRay ray;
    ray.octant = octant;
    ray.clear_stack();
    if (soonest_first) {
        stack_children<false>(ray, node, entries, Order::kSoonest);
    } else {
        stack_children<true>(ray, node, entries, Order::kNearest);
    }
    return {ray.children + 1, ray.top};
}

inline TriangleBlock block_of(const Vec3f (&corner)[3]) {
    TriangleBlock block;
    for (uint32_t lane = 0; lane < kBlockSize; ++lane) {
        block.triangle[lane] = lane;
        for (int k = 0; k < 3; ++k) {
            for (int axis = 0; axis < 3; ++axis) {
                block.vertex[k][axis][lane] = corner[k][axis];
            }
        }
    }
    return block;
}

inline FilterResult filter(const Ray& ray, const Vec3f (&corner)[3], const Box3f& bounds) {
    TriangleBlock blocks[2] = {block_of(corner), block_of(corner)};
    Box3f box;
    for (const Vec3f& v : corner) {
        box.extend(v);
    }
    const Vec3f size = box.size();
    const uint32_t size_class = SizeClasses(bounds).of(std::max({size.x, size.y, size.z}));
    blocks[1].triangle[0] = size_class * kMaxTriangles;
    const TriangleBlock& block = blocks[1];
    RayBatch batch(bounds);
    set_up({bounds.lower, 0, {1, 0, 0}, 0}, batch, {});  // as do those before it
    set_up(ray, batch, {});
    const TracedRay traced = traced_by(batch, ray);
    const hn::CappedTag<float, kBlockSize> d;
    using V = hn::Vec<decltype(d)>;
    const ShearedRay<V> own = sheared_for_all(d, traced);
    const Sheared<V> seen(own, [&](size_t k, uint32_t axis) { return hn::Load(d, block.vertex[k][0] + axis); });
    const V mz = largest_of(seen.z);
    const V bound = hn::Neg(seen.minus_edge_error(own.slant, mz));
    const RayBatch::AtLeaf at_leaf = batch.at_leaf(lane_of(ray));
    Verdict verdict{};
    constexpr bool kTwo = kBlocksPerStep == 2;
    constexpr uint32_t kLane = kTwo ? kBlockSize : 0;
    const uint32_t possible = test_blocks<true>(traced, blocks + (kTwo ? 0 : 1), kTwo ? 1 : 0, verdict);
    return {{hn::GetLane(seen.side[0]), hn::GetLane(seen.side[1]), hn::GetLane(seen.side[2])},
            hn::GetLane(bound),
            hn::GetLane(mz),
            -at_leaf.minus_edge_error,
            at_leaf.mz,
            batch.least_inside()[size_class],
            (possible >> kLane & 1U) != 0,
            (possible >> kLane & verdict.certain >> kLane & 1U) != 0,
            verdict.lower[kLane],
            verdict.upper[kLane]};
}

/// As Packet sets it up, for a packet of this ray and others.
inline ViewResult look(const Ray& ray, const Vec3f (&corner)[3], const SeenFromFocus& seen) {
    const TriangleBlock block = block_of(corner);
    const Axes axes(ray.direction);
    const auto part = [](Vec3f v, uint32_t axis) { return v[static_cast<int>(axis)]; };
    const float along = part(ray.direction, axes.z);
    const float off[2] = {part(ray.direction, axes.x) / along - seen.slope[0],
                          part(ray.direction, axes.y) / along - seen.slope[1]};
    const auto spread = [&](float own) { return std::max(std::abs(own), seen.spread) * (1 + 0x1p-20F) + 0x1p-22F; };
    Focus focus{axes.x * kBlockSize,
                axes.y * kBlockSize,
                axes.z * kBlockSize,
                part(seen.focus, axes.x),
                part(seen.focus, axes.y),
                part(seen.focus, axes.z),
                seen.slope[0],
                seen.slope[1],
                spread(off[0]),
                spread(off[1]),
                0,
                0,
                0};
    // Seen from where it ends, a ray runs the other way.
    focus.sign = std::copysign(1.0F, along) * (seen.deviation > 0 ? -1.0F : 1.0F);
    focus.set_errors(seen.deviation);
    FocusView<true> view;
    const uint32_t reached = view.look(focus, BlockLoader(&block, 0), -seen.deviation, kInfinity);
    const hn::CappedTag<float, 4> d;
    hn::Vec<decltype(d)> side[3];
    view.sides(d, 0, hn::Set(d, off[0]), hn::Set(d, off[1]), side);
    const bool open = std::abs(hn::GetLane(depth_inside(side))) <= view.bound[0];
    return {
        (reached & 1U) != 0, open, {hn::GetLane(side[0]), hn::GetLane(side[1]), hn::GetLane(side[2])}, view.bound[0]};
}

inline FinishResult finish(const Ray& ray, const Vec3f (&corner)[3]) {
    const TriangleBlock block = block_of(corner);
    FinishBatch batch;
    for (uint32_t lane = 0; lane < FinishBatch::kSize; ++lane) {
        batch.put_ray(lane, ray, &block, lane % kBlockSize);
    }
    const bool open = (batch.finish<double>() & 1U) != 0;
    return {open, batch.t[0], batch.u[0], batch.v[0]};
}

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace espalier {
namespace {

struct Code {
    const char* name;
    DepthsResult (*depths_of)(const Ray&, float, const Box3f&);
    std::vector<uint32_t> (*stack_of)(const WideNode&, uint32_t, uint32_t, bool);
    FilterResult (*filter)(const Ray&, const Vec3f (&)[3], const Box3f&);
    ViewResult (*look)(const Ray&, const Vec3f (&)[3], const SeenFromFocus&);
    FinishResult (*finish)(const Ray&, const Vec3f (&)[3]);
    bool asks_first;
};

std::vector<Code> code_under_test() {
#define ESPALIER_CODE(name, set)                                                                  \
    {                                                                                             \
        name, set::depths_of, set::stack_of, set::filter, set::look, set::finish, set::kAsksFirst \
    }
    return runnable<Code>({ESPALIER_FOR_EACH_SET(ESPALIER_CODE)});
#undef ESPALIER_CODE
}

class TraceBounds : public testing::TestWithParam<Code> {
 protected:
    static std::string named(const std::string& what) { return std::string(GetParam().name) + ": " + what; }
};

constexpr double kU = 0x1p-24;

/// A ray that comes near a triangle: aimed at a point of it, at an edge as often as not, and how far in float allows.
struct Aimed {
    Ray ray;
    Vec3f corner[3];
};

Aimed aim(Random& random, int low, int high) {
    Aimed aimed;
    const Vec3f base = random.point(low, high);
    const int shrink = static_cast<int>(random.below(16));
    for (Vec3f& corner : aimed.corner) {
        const Vec3f offset = random.point(low, high);
        corner = base + offset * std::ldexp(1.0F, -shrink);
    }
    aimed.ray.origin = random.point(low, high);
    const bool is_steep = random.below(4) == 0;
    double weight[3] = {random.fraction(), random.fraction(), random.below(2) == 0 ? 0.0 : random.fraction()};
    const double sum = weight[0] + weight[1] + weight[2] + 0x1p-60;
    const uint32_t first = random.below(3);
    Vec3d target;
    for (uint32_t k = 0; k < 3; ++k) {
        target += to_double(aimed.corner[(first + k) % 3]) * (weight[k] / sum);
    }
    if (random.below(4) == 0) {  // start on the triangle, but for a rounding
        aimed.ray.origin = to_float(target);
        aimed.ray.direction = random.point(-3, 0);
    } else {
        if (is_steep) {  // nearly along an axis
            const double most =
                std::ldexp(length(target - to_double(aimed.ray.origin)), -static_cast<int>(random.below(40)));
            aimed.ray.origin.y = static_cast<float>(target.y + most * random.fraction());
            aimed.ray.origin.z = static_cast<float>(target.z - most * random.fraction());
        }
        const Vec3d d = target - to_double(aimed.ray.origin);
        const double largest = std::max({std::abs(d.x), std::abs(d.y), std::abs(d.z)});
        const double scale = largest > 0 ? std::ldexp(1.0, -std::ilogb(largest)) : 0;
        aimed.ray.direction = to_float(d * (scale * static_cast<double>(random.mantissa())));
    }
    aimed.ray.t_min = 0;
    aimed.ray.t_max = HUGE_VALF;
    return aimed;
}

int largest_axis(Vec3f d) {
    const Vec3f a{std::abs(d.x), std::abs(d.y), std::abs(d.z)};
    return a.x > a.y ? (a.x > a.z ? 0 : 2) : (a.y > a.z ? 1 : 2);
}

/// The weights of the corners by Pluecker coordinates, and the distance: t = above / below.
struct ExactTriangle {
    Exact weight[3];
    Exact below;
    Exact above;

    ExactTriangle(const Ray& ray, const Vec3f (&corner)[3]) {
        const ExactVec d = exact(ray.direction);
        ExactVec p[3];
        for (int k = 0; k < 3; ++k) {
            p[k] = minus(exact(corner[k]), exact(ray.origin));
        }
        for (int k = 0; k < 3; ++k) {
            weight[k] = dot(d, cross(p[(k + 1) % 3], p[(k + 2) % 3]));
            below += weight[k];
        }
        above = dot(p[0], cross(p[1], p[2]));
    }
    bool is_hit() const {
        return below != 0 && sgn(weight[0]) * sgn(below) >= 0 && sgn(weight[1]) * sgn(below) >= 0 &&
               sgn(weight[2]) * sgn(below) >= 0;
    }
    Exact t() const { return above / below; }
};

/// Calls check(aimed, high) for rays near triangles of some area, of all sizes below 2^high.
template <class Check>
void for_each_aimed(Random& random, int count, const Check& check) {
    for (const auto& [low, high] : kRanges) {
        for (int i = 0; i < count; ++i) {
            const Aimed aimed = aim(random, low, high);
            if (has_area(aimed.corner)) {
                check(aimed, high);
            }
        }
    }
}

/// How far edge functions are off: sheared, they are the weights over the direction's largest component.
void add_edges(Share& share, const float (&side)[3], const ExactTriangle& truth, const Exact& along, float bound) {
    for (int k = 0; k < 3; ++k) {
        share.add(side[k] + truth.weight[k] / along, bound);
    }
}

/// Boxes as thin as floats allow around a point of a ray.
TEST_P(TraceBounds, OfTheBoxTestLetNoPointSlip) {
    Random random(4);
    Share share(named("depth of a box's plane, 6"));
    Share room(named("entry beyond exit, 6"));
    uint32_t slipped = 0;
    uint32_t would_slip = 0;
    uint32_t unlike_root = 0;
    uint32_t met_behind = 0;
    uint32_t boxes = 0;
    for (const auto& [low, high] : kRanges) {
        for (int i = 0; i < 6000; ++i) {
            Ray ray{random.point(low, high), 0, random.point(-3, 0), HUGE_VALF};
            if (i % 3 != 0) {  // nearly, or just, along an axis or in a plane
                for (int n = i % 3; n != 0; --n) {
                    const int axis = static_cast<int>(random.below(3));
                    const float tiny = std::ldexp(random.mantissa(), -static_cast<int>(random.below(40)));
                    const float values[] = {0.0F, -0.0F, tiny, -tiny, tiny * 0x1p-100F};
                    float* component = axis == 0 ? &ray.direction.x : axis == 1 ? &ray.direction.y : &ray.direction.z;
                    *component = values[random.below(5)];
                }
            }
            const int kz = largest_axis(ray.direction);
            const float largest = std::abs(ray.direction[kz]);
            if (largest < 0x1p-100F) {
                continue;
            }
            const ExactVec d = exact(ray.direction);
            const Exact depth = Exact(std::abs(random.number(low, high)));
            Box3f box;
            float extent = 0;
            for (int axis = 0; axis < 3; ++axis) {
                const Exact at =
                    exact(ray.origin)[static_cast<size_t>(axis)] + d[static_cast<size_t>(axis)] / largest * depth;
                float lower = static_cast<float>(at.get_d());
                lower = Exact(lower) > at ? std::nextafter(lower, -HUGE_VALF) : lower;
                box.lower[axis] = lower;
                box.upper[axis] = Exact(lower) == at ? lower : std::nextafter(lower, HUGE_VALF);
                extent = std::max({extent, std::abs(box.lower[axis]), std::abs(box.upper[axis])});
            }
            if (extent > kMaxCoordinate) {
                continue;
            }
            ++boxes;
            const DepthsResult result = GetParam().depths_of(ray, extent, box);
            slipped += result.entry <= result.exit * (1 + 0x1p-21F) ? 0U : 1U;
            Ray turned = ray;
            turned.direction = -ray.direction;
            const DepthsResult back = GetParam().depths_of(turned, extent, box);
            met_behind += back.meets_root ? 1U : 0U;
            for (const DepthsResult& r : {result, back}) {
                const bool meets = r.entry <= r.exit * (1 + 0x1p-21F);
                const bool is_alike = r.meets_root == meets && r.entry_of_child == (meets ? r.entry : HUGE_VALF) &&
                                      !r.meets_others && r.is_like_a_node;
                unlike_root += is_alike ? 0U : 1U;
            }
            if (result.exit > 0 && result.entry > result.exit) {
                room.add(Exact(result.entry) - result.exit, Exact(result.exit) * Exact(0x1p-21));
            }
            Exact entry = 0;
            Exact exit = Exact(0x1p100);
            for (int axis = 0; axis < 3; ++axis) {
                const Exact margin = (Exact(result.far_shift[axis]) - result.near_shift[axis]) / 2;
                if (size_of(d[static_cast<size_t>(axis)]) >= Exact(largest) * Exact(0x1p-25)) {
                    const bool negative = ray.direction[axis] < 0;
                    const auto check = [&](float plane, const Exact& centred) {
                        const Exact plane_depth =
                            (Exact(plane) - ray.origin[axis]) / d[static_cast<size_t>(axis)] * largest;
                        share.add(centred - plane_depth, margin + Exact(2.1 * kU) * size_of(plane_depth));
                    };
                    check(negative ? box.upper[axis] : box.lower[axis], result.near[axis] + margin);
                    check(negative ? box.lower[axis] : box.upper[axis], result.far[axis] - margin);
                }
                entry = std::max<Exact>(entry, result.near[axis] + margin);
                exit = std::min<Exact>(exit, result.far[axis] - margin);
            }
            would_slip += entry > exit ? 1U : 0U;
        }
    }
    EXPECT_EQ(slipped, 0U);
    EXPECT_EQ(unlike_root, 0U) << "a batch of rays meets the root as a ray meets a node";
    EXPECT_LT(met_behind, boxes / 2) << "of boxes behind them, rays meet only what is near";
    EXPECT_GT(would_slip, 100U) << "without margins rays would slip through: the cases are hard ones";
    EXPECT_LT(share.largest(), 1);
    EXPECT_GT(share.largest(), 0.2);
    EXPECT_LT(room.largest(), 1);
}

TEST_P(TraceBounds, OfTheFloatFilterHoldWhatItDoesNotDecide) {
    Random random(5);
    Share edges(named("edge functions, 8"));
    Share outsides(named("bound of a hit by size class, 8"));
    Share depths(named("depth of a hit, 8"));
    uint32_t lost = 0;
    uint32_t invented = 0;
    uint32_t undecided = 0;
    uint32_t decided = 0;
    for_each_aimed(random, 5000, [&](const Aimed& aimed, int high) {
        // As part of something larger, up to where all classes are for larger triangles.
        const Vec3f beside = random.point(high, high) * std::ldexp(1.0F, -static_cast<int>(random.below(20)));
        Box3f bounds{aimed.corner[0], aimed.corner[0]};
        for (const Vec3f& v : {aimed.corner[1], aimed.corner[2], aimed.corner[0] + beside}) {
            bounds.extend(v);
        }
        const FilterResult result = GetParam().filter(aimed.ray, aimed.corner, bounds);
        const ExactTriangle truth(aimed.ray, aimed.corner);
        const Exact along = aimed.ray.direction[largest_axis(aimed.ray.direction)];
        add_edges(edges, result.side, truth, along, result.bound);
        EXPECT_GE(result.bound_in_tree, result.bound);
        EXPECT_GE(result.mz_in_tree, result.mz);
        if (truth.is_hit() && GetParam().asks_first) {
            outsides.add(result.bound, -result.least_inside);
        }
        const bool counts = truth.is_hit() && truth.t() >= 0;
        lost += counts && !result.possible ? 1U : 0U;
        invented += result.certain && !truth.is_hit() ? 1U : 0U;
        decided += result.certain ? 1U : 0U;
        undecided += result.possible && !result.certain ? 1U : 0U;
        if (counts && result.possible && std::isfinite(result.upper)) {
            const Exact middle = (Exact(result.lower) + result.upper) / 2;
            depths.add(truth.t() * size_of(along) - middle, (Exact(result.upper) - result.lower) / 2);
        }
    });
    EXPECT_EQ(lost, 0U);
    EXPECT_EQ(invented, 0U);
    EXPECT_GT(undecided, 1000U);
    EXPECT_GT(decided, 1000U);
    EXPECT_LT(edges.largest(), 1);
    EXPECT_GT(edges.largest(), 0.1);
    EXPECT_LT(outsides.largest(), 1);
    EXPECT_EQ(outsides.largest() > 0.1, GetParam().asks_first);
    EXPECT_LT(depths.largest(), 1);
    EXPECT_GT(depths.largest(), 0.03);
}

/// A triangle that reaches from the farthest corner of the tree's box as the ray sees it, along a diagonal.
TEST_P(TraceBounds, OfAllTrianglesOfATreeHoldForTheFarthest) {
    Random random(12);
    Share bounds(named("bound of all triangles of a tree, 8"));
    for (int i = 0; i < 5000; ++i) {
        const float size = std::ldexp(random.mantissa(), static_cast<int>(random.below(60)) - 30);
        const auto sign = [&] { return random.below(2) == 0 ? 1.0F : -1.0F; };
        const Vec3f along{sign(), sign(), sign() * (1 + 0x1p-20F)};
        const Vec3f far_corner = Vec3f{-along.x, -along.y, std::copysign(1.0F, along.z)} * size;
        const auto inside = [&] { return (2 * random.fraction() - 1) * size; };
        const Vec3f corner[3] = {far_corner, {inside(), inside(), inside()}, {inside(), inside(), inside()}};
        const FilterResult result =
            GetParam().filter({{}, 0, along, HUGE_VALF}, corner, {{-size, -size, -size}, {size, size, size}});
        bounds.add(result.bound, result.bound_in_tree);
        EXPECT_EQ(result.mz, size);
        EXPECT_EQ(result.mz_in_tree, size);
    }
    EXPECT_LT(bounds.largest(), 1);
    EXPECT_GT(bounds.largest(), 0.9);
}

TEST_P(TraceBounds, ChildrenAreStackedInTheNodesOrder) {
    Random random(13);
    for (int i = 0; i < 500; ++i) {
        std::array<uint32_t, WideNode::kWidth> orders[2];
        WideNode node{};
        for (auto& slots : orders) {
            std::iota(slots.begin(), slots.end(), 0U);
            for (uint32_t last = WideNode::kWidth; last-- > 1;) {
                std::swap(slots[last], slots[random.below(last + 1)]);
            }
        }
        const uint32_t octant = random.below(8);
        const uint32_t met = random.below(256);
        std::vector<uint32_t> expected[2];
        for (uint32_t rank = 0; rank < WideNode::kWidth; ++rank) {
            node.child[rank] = 100 + rank;
            node.order[octant] |= orders[0][rank] << (3 * rank);
            node.order[rank] |= orders[1][rank] << WideNode::kSoonestShift;
            for (int k = 0; k < 2; ++k) {
                if ((met >> orders[k][rank] & 1U) != 0) {
                    expected[k].push_back(100 + orders[k][rank]);
                }
            }
        }
        EXPECT_EQ(GetParam().stack_of(node, octant, met, false), expected[0]);
        EXPECT_EQ(GetParam().stack_of(node, octant, met, true), expected[1]);
    }
}

TEST_P(TraceBounds, OfTheViewFromAFocusHoldForEveryRay) {
    Random random(10);
    Share edges(named("edge functions from a focus, 8"));
    uint32_t lost = 0;
    uint32_t undecided = 0;
    uint32_t beside = 0;
    uint32_t hits = 0;
    for_each_aimed(random, 5000, [&](const Aimed& aimed, int high) {
        Ray ray = aimed.ray;
        SeenFromFocus seen{ray.origin, 0, {0, 0}, 0};
        const bool ends_together = random.below(2) == 0;
        if (ends_together) {
            ray.direction = ray.direction * -std::ldexp(1.0F, high);
            ray.origin = seen.focus - ray.direction;
            ray.t_max = 1;
            const Vec3f end = ray.origin + ray.direction;
            for (int axis = 0; axis < 3; ++axis) {
                seen.deviation += std::abs(end[axis] - seen.focus[axis]) * (1 + 0x1p-20F) +
                                  std::abs(end[axis]) * 0x1p-23F + 0x1p-120F;
            }
        }
        const int kz = largest_axis(ray.direction);
        const float along = ray.direction[kz];
        if (std::abs(along) < 0x1p-100F || seen.deviation > kMaxCoordinate) {
            return;
        }
        seen.spread = std::ldexp(1.0F, -3 - static_cast<int>(random.below(20)));
        for (int k = 0; k < 2; ++k) {
            const float own = ray.direction[(kz + 1 + k) % 3] / along;
            seen.slope[k] = std::clamp(own + (4 * random.fraction() - 2) * seen.spread, -1.0F, 1.0F);
        }
        const ViewResult result = GetParam().look(ray, aimed.corner, seen);
        const ExactTriangle truth(ray, aimed.corner);
        add_edges(edges, result.side, truth, along, result.bound);
        const bool is_hit = truth.is_hit() && truth.t() >= 0 && (!ends_together || truth.t() <= 1);
        hits += is_hit ? 1U : 0U;
        lost += is_hit && !result.reached ? 1U : 0U;
        beside += result.reached ? 0U : 1U;
        undecided += result.open ? 1U : 0U;
    });
    EXPECT_EQ(lost, 0U);
    EXPECT_GT(hits, 3000U);
    EXPECT_GT(beside, 100U);
    EXPECT_GT(undecided, 1000U);
    EXPECT_LT(edges.largest(), 1);
    EXPECT_GT(edges.largest(), 0.1);
}

TEST_P(TraceBounds, OfTheViewFromAFocusHoldForSubnormalTriangles) {
    Random random(11);
    Share edges(named("the same, subnormal triangles, 8"));
    for (int i = 0; i < 20000; ++i) {
        Vec3f corner[3];
        for (Vec3f& at : corner) {
            const auto few = [&] { return (static_cast<float>(random.below(9)) - 4) * 0x1p-149F; };
            at = {few(), few(), few()};
        }
        if (!has_area(corner)) {
            continue;
        }
        const Vec3f far_point{0.5F - random.fraction(), 0.5F - random.fraction(), -1};
        const Ray ray{far_point * 0x1p54F, 0, {0.3F * random.fraction(), 0.3F * random.fraction(), 1}, HUGE_VALF};
        const float slope = 0.3F * random.fraction();
        const SeenFromFocus seen{ray.origin, 0, {slope, slope}, 0.125F};
        const ViewResult result = GetParam().look(ray, corner, seen);
        const ExactTriangle truth(ray, corner);
        add_edges(edges, result.side, truth, ray.direction.z, result.bound);
    }
    EXPECT_LT(edges.largest(), 1);
}

TEST_P(TraceBounds, OfTheFinishHoldInAFaceThroughTheOrigin) {
    const Ray ray{{0, 0, 0}, 0, {0.1F, 0.3F, 1.9858157634735107F}, HUGE_VALF};
    const Vec3f plain[3] = {{4, 1, 0}, {-3, 2, 0}, {-1, -3, 0}};
    EXPECT_TRUE(GetParam().finish(ray, plain).open) << "rounding might have made the distance 0";
    const Vec3f at_corner[3] = {{0, 0, 0}, {-3, 2, 0}, {-1, -3, 0}};
    const FinishResult result = GetParam().finish(ray, at_corner);
    EXPECT_FALSE(result.open);
    EXPECT_EQ(result.t, 0);
    EXPECT_EQ(result.u, 0);
    EXPECT_EQ(result.v, 0);
}

TEST_P(TraceBounds, OfTheFinishAreKept) {
    Random random(6);
    Share distance(named("t in ulps, 12"));
    Share place(named("u and v over 2^-22.4, 12"));
    uint32_t finished = 0;
    const auto judge = [&](const Ray& ray, const Vec3f(&corner)[3]) {
        const ExactTriangle truth(ray, corner);
        if (!truth.is_hit()) {
            return;
        }
        const FinishResult result = GetParam().finish(ray, corner);
        if (result.open) {
            return;
        }
        ++finished;
        const Exact t = truth.t();
        const int exponent = t == 0 ? -126 : std::max(std::ilogb(size_of(t).get_d()), -126);
        distance.add(Exact(result.t) - t, Exact(std::ldexp(1.0, exponent - 23)));
        place.add(Exact(result.u) - truth.weight[1] / truth.below, Exact(std::exp2(-22.4)));
        place.add(Exact(result.v) - truth.weight[2] / truth.below, Exact(std::exp2(-22.4)));
    };
    for_each_aimed(random, 5000, [&](const Aimed& aimed, int) { judge(aimed.ray, aimed.corner); });
    EXPECT_GT(finished, 3000U);
    const auto centred = [&] { return random.fraction() - 0.5F; };
    const auto point = [&] { return Vec3f{centred(), centred(), centred()}; };
    // Triangles so far away that u and v take in more than digits of double hold.
    finished = 0;
    for (int i = 0; i < 4000; ++i) {
        const Vec3f direction{std::round(20 * centred()), std::round(20 * centred()), 11};
        const float far = std::exp2(std::round(18 + 20 * random.fraction()));
        const Vec3f a = point();
        const Vec3f b = point();
        const Vec3f corner[3] = {a, b, -(a + b)};
        judge({direction * -far, 0, direction, HUGE_VALF}, corner);
    }
    EXPECT_GT(finished, 200U);
    // Rays from beside a corner that run along their triangle, so that its plane is met much farther away.
    finished = 0;
    for (int i = 0; i < 4000; ++i) {
        const Vec3f corner[3] = {{0, 0, 0}, point(), point()};
        const Vec3f beside = point() * std::exp2(-40 * random.fraction());
        const Vec3f target = (corner[1] + corner[2]) * (0.1F + 0.3F * random.fraction());
        judge({beside, 0, target - beside, HUGE_VALF}, corner);
    }
    EXPECT_GT(finished, 1000U);
    EXPECT_LT(distance.largest(), 0.625);
    EXPECT_GT(distance.largest(), 0.4);
    EXPECT_LT(place.largest(), 1);
}

INSTANTIATE_TEST_SUITE_P(OnEachSet, TraceBounds, testing::ValuesIn(code_under_test()),
                         [](const auto& code) { return std::string(code.param.name); });

TEST(DoubleBounds, OfSidesAndDistances) {
    Random random(7);
    Share side_share("sides in double, 9");
    Share distance_share("distance in double, 9");
    Share plane_share("distance to a plane in double, 9");
    Share place_share("u and v over 2^-22.9, 9");
    Share estimate_share("estimate of an expansion, 10");
    uint32_t different = 0;
    uint32_t open = 0;
    for_each_aimed(random, 6000, [&](const Aimed& aimed, int) {
        const Ray& ray = aimed.ray;
        const ExactTriangle truth(ray, aimed.corner);
        Vec3d p[3];
        for (int k = 0; k < 3; ++k) {
            p[k] = to_double(aimed.corner[k]) - to_double(ray.origin);
        }
        for (int k = 0; k < 3; ++k) {
            const Vec3d edge = to_double(aimed.corner[(k + 2) % 3]) - to_double(aimed.corner[(k + 1) % 3]);
            const Side side = measure_side(to_double(ray.direction), p[(k + 1) % 3], edge);
            side_share.add(side.value - truth.weight[k], side.error);
            open += std::abs(side.value) <= side.error ? 1U : 0U;
        }
        ExactHit hit;
        const bool is_hit = hit_exactly(ray.origin, ray.direction, aimed.corner, hit);
        different += is_hit != truth.is_hit() ? 1U : 0U;
        if (!is_hit) {
            return;
        }
        distance_share.add(hit.distance.t - truth.t(), hit.distance.error);
        if (const Distance plane = distance_to_plane(ray.origin, ray.direction, aimed.corner); plane.error < HUGE_VAL) {
            plane_share.add(plane.t - truth.t(), plane.error);
        }
        finish_hit(ray.origin, ray.direction, hit);
        place_share.add(hit.u - truth.weight[1] / truth.below, Exact(std::exp2(-22.9)));
        place_share.add(hit.v - truth.weight[2] / truth.below, Exact(std::exp2(-22.9)));
    });
    EXPECT_EQ(different, 0U);
    EXPECT_LT(side_share.largest(), 1);
    EXPECT_GT(side_share.largest(), 0.05);
    EXPECT_LT(distance_share.largest(), 1);
    EXPECT_GT(distance_share.largest(), 0.02);
    EXPECT_LT(plane_share.largest(), 1);
    EXPECT_GT(plane_share.largest(), 0.002);
    EXPECT_LT(place_share.largest(), 1);

    // Many parts whose sum nearly cancels.
    for (int i = 0; i < 20000; ++i) {
        Expansion sum;
        Exact truth = 0;
        for (int n = 0; n < 12; ++n) {
            const Vec3f f = random.point(-40, 20);
            const Vec3f g = n % 3 == 2 ? f : random.point(-40, 20);
            const Expansion product = Expansion::difference(f.x, g.y) * Expansion::difference(g.x, f.y);
            sum = n % 2 == 0 ? sum + product : sum - product;
            truth += (n % 2 == 0 ? 1 : -1) * ((Exact(f.x) - g.y) * (Exact(g.x) - f.y));
        }
        EXPECT_EQ(sum.sign(), sgn(truth));
        if (truth != 0) {
            estimate_share.add(sum.estimate() - truth, size_of(truth) * Exact(0x1p-51));
        }
    }
    EXPECT_LT(estimate_share.largest(), 1);
    EXPECT_GT(estimate_share.largest(), 0.1);
}

/// Triangles whose distances differ by little or not at all, and floats next to a distance.
TEST(DoubleBounds, LeaveNoComparisonOpen) {
    Random random(8);
    Share share("narrowed distance over 2^-27, 12");
    uint32_t wrong = 0;
    uint32_t close = 0;
    uint32_t equal = 0;
    for (const auto& [low, high] : kRanges) {
        for (int i = 0; i < 3000; ++i) {
            const Aimed aimed = aim(random, low, high);
            const Ray& ray = aimed.ray;
            Vec3f other[3] = {aimed.corner[1], aimed.corner[2], aimed.corner[0]};
            for (uint32_t n = random.below(3); n != 0; --n) {
                Vec3f& corner = other[random.below(3)];
                corner.x = std::nextafter(corner.x, random.below(2) == 0 ? HUGE_VALF : -HUGE_VALF);
            }
            ExactHit hit;
            ExactHit of_other;
            if (!has_area(aimed.corner) || !has_area(other) ||
                !hit_exactly(ray.origin, ray.direction, aimed.corner, hit) ||
                !hit_exactly(ray.origin, ray.direction, other, of_other)) {
                continue;
            }
            const Exact t = ExactTriangle(ray, aimed.corner).t();
            const Exact t_other = ExactTriangle(ray, other).t();
            wrong += compare_distance(ray.origin, ray.direction, hit, other) != sgn(Exact(t - t_other)) ? 1U : 0U;
            close += size_of(t - t_other) <= Exact(hit.distance.error) + of_other.distance.error ? 1U : 0U;
            equal += t == t_other ? 1U : 0U;
            auto limit = static_cast<float>(t.get_d());
            for (uint32_t n = random.below(2); n != 0; --n) {
                limit = std::nextafter(limit, HUGE_VALF);
            }
            wrong += compare_distance(ray.origin, ray.direction, hit, limit) != sgn(Exact(t - limit)) ? 1U : 0U;
            finish_hit(ray.origin, ray.direction, hit);
            share.add(hit.distance.t - t, size_of(t) * Exact(0x1p-27) + Exact(0x1p-1000));
        }
    }
    EXPECT_EQ(wrong, 0U);
    EXPECT_GT(close, 500U);
    EXPECT_GT(equal, 500U);
    EXPECT_LT(share.largest(), 1);
}

/// Triangles across an axis, some of them an ulp apart or one corner off their plane.
TEST(DoubleBounds, KnowWhatLiesInOnePlane) {
    Random random(10);
    uint32_t wrong = 0;
    uint32_t equal = 0;
    uint32_t close = 0;
    const auto centred = [&] { return random.fraction() - 0.5F; };
    for (int i = 0; i < 9000; ++i) {
        const int axis = i % 3;
        Vec3f centre{centred(), centred(), centred()};
        if (i % 2 == 0) {
            centre[axis] = 0;  // next to which floats lie closer than double tells
        }
        Vec3f corner[2][3];
        for (auto& triangle : corner) {
            const Vec3f a{centred(), centred(), centred()};
            const Vec3f b{centred(), centred(), centred()};
            const Vec3f from_centre[3] = {a, b, -(a + b)};
            for (int k = 0; k < 3; ++k) {
                triangle[k] = centre + from_centre[k];
                triangle[k][axis] = centre[axis];
            }
        }
        const uint32_t first = random.below(3);
        for (uint32_t moved = std::array{0U, 1U, 3U}[random.below(3)]; moved != 0; --moved) {
            float& place = corner[1][(first + moved) % 3][axis];
            place = std::nextafter(place, random.below(2) == 0 ? HUGE_VALF : -HUGE_VALF);
        }
        const Vec3f origin = centre + Vec3f{centred(), centred(), centred()};
        const Vec3f direction = centre - origin;
        ExactHit hit;
        ExactHit other;
        if (!has_area(corner[0]) || !has_area(corner[1]) || !hit_exactly(origin, direction, corner[0], hit) ||
            !hit_exactly(origin, direction, corner[1], other)) {
            continue;
        }
        const Ray ray{origin, 0, direction, HUGE_VALF};
        const int truth = sgn(Exact(ExactTriangle(ray, corner[0]).t() - ExactTriangle(ray, corner[1]).t()));
        wrong += compare_distance(origin, direction, hit, corner[1]) != truth ? 1U : 0U;
        (truth == 0 ? equal : close) += 1;
    }
    EXPECT_EQ(wrong, 0U);
    EXPECT_GT(equal, 1000U);
    EXPECT_GT(close, 1000U);
}

/// Rays from one point, or to one, beside the edges of one triangle: what packets make of them. Only answers
/// can be seen from here.
TEST(PacketBounds, LoseAndInventNothing) {
    Random random(9);
    uint32_t wrong = 0;
    uint32_t hits = 0;
    for (const auto& [low, high] : kRanges) {
        for (int i = 0; i < 600; ++i) {
            const Aimed aimed = aim(random, low, high);
            if (!has_area(aimed.corner)) {
                continue;
            }
            // Near a triangle that lies far out, ends differ by more than the test from there is off otherwise.
            const Vec3f side = aimed.corner[1] - aimed.corner[0];
            const float size = std::max({std::abs(side.x), std::abs(side.y), std::abs(side.z)});
            const Vec3f focus = random.below(2) == 0 ? aimed.ray.origin : aimed.corner[0] + random.point(3, 4) * size;
            const std::vector<float> positions{aimed.corner[0].x, aimed.corner[0].y, aimed.corner[0].z,
                                               aimed.corner[1].x, aimed.corner[1].y, aimed.corner[1].z,
                                               aimed.corner[2].x, aimed.corner[2].y, aimed.corner[2].z};
            const std::vector<uint32_t> triangle{0, 1, 2};
            const Tree tree = build({positions, triangle}, {Quality::kBalanced, 1});
            std::vector<Ray> rays;
            const bool ends_together = random.below(2) == 0;
            // Beside one edge, or all of them, by no more than coordinates are rounded out there.
            const uint32_t edges = random.below(2) == 0 ? 1 : 3;
            const Vec3d beside = to_double(random.point(-1, 0)) * (length(to_double(focus)) * 0x1p-25);
            for (int n = 0; n < 32; ++n) {
                const uint32_t k = random.below(edges);
                const double along = random.fraction();
                const Vec3d target =
                    to_double(aimed.corner[k]) * along + to_double(aimed.corner[(k + 1) % 3]) * (1 - along) + beside;
                const Vec3d to_target = target - to_double(focus);
                const Vec3f direction = to_float(to_target * (ends_together ? -2.0 : 0x1p-3));
                if (std::abs(direction[largest_axis(direction)]) < 0x1p-100F) {
                    break;
                }
                rays.push_back(ends_together ? Ray{to_float(to_double(focus) - to_double(direction)), 0, direction, 1}
                                             : Ray{focus, 0, direction, HUGE_VALF});
            }
            std::vector<Hit> found(rays.size());
            std::vector<uint8_t> blocked(rays.size());
            intersect(tree, rays, found);
            occluded(tree, rays, blocked);
            for (size_t n = 0; n < rays.size(); ++n) {
                const ExactTriangle truth(rays[n], aimed.corner);
                const bool is_hit =
                    truth.is_hit() && truth.t() >= 0 && (std::isinf(rays[n].t_max) || truth.t() <= rays[n].t_max);
                hits += is_hit ? 1U : 0U;
                wrong += is_hit == (found[n].triangle == 0) && is_hit == (blocked[n] != 0) ? 0U : 1U;
            }
        }
    }
    EXPECT_EQ(wrong, 0U);
    EXPECT_GT(hits, 2000U);
}

}  // namespace
}  // namespace espalier
#endif
