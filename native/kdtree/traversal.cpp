// SPDX-License-Identifier: GPL-3.0-or-later
#include "kdtree/traversal.h"

#include <algorithm>
#include <bit>

#include "geometry/float_environment.h"
#include "kdtree/simd_config.h"
#include "kdtree/simd_target.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "kdtree/traversal.cpp"
#include <hwy/foreach_target.h>
// Highway's own header has to follow foreach_target.h.
#include <hwy/highway.h>

#include "kdtree/triangle_test-inl.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {

/// A ray as the box test wants it: per axis which end of a box is near, and where to measure from. The relative error
/// of (plane - origin) / direction is at most gamma_3 = 3.01 u, u = 2^-24, however far the origin; the two reciprocals
/// take more than the double of it (pbrt 3rd ed., section 3.9). All t are at least 0, so a near distance may only be
/// made smaller and a far one larger.
struct BoxRay {
    float near_origin[3];
    float far_origin[3];
    float near_scale[3];
    float far_scale[3];
    bool negative[3];

    explicit BoxRay(const Ray& ray) {
        constexpr float kInfinity = std::numeric_limits<float>::infinity();
        for (int axis = 0; axis < 3; ++axis) {
            const float origin = ray.origin[axis];
            const float direction = ray.direction[axis];
            negative[axis] = direction < 0;
            near_origin[axis] = far_origin[axis] = origin;
            if (direction == 0) {
                // The ray stays in the slab or outside it: a bound less a neighbour of the origin, times infinity.
                // Where the bound is that neighbour the product is NaN; the ray then lies outside the slab, and it does
                // not matter whether the axis counts.
                near_origin[axis] = std::nextafter(origin, kInfinity);
                far_origin[axis] = std::nextafter(origin, -kInfinity);
                near_scale[axis] = far_scale[axis] = kInfinity;
            } else if (std::abs(direction) < 0x1p-120F) {
                // The reciprocal might overflow: leave the axis to the other two.
                near_origin[axis] = negative[axis] ? -kInfinity : kInfinity;
                far_origin[axis] = -near_origin[axis];
                near_scale[axis] = far_scale[axis] = negative[axis] ? -1.0F : 1.0F;
            } else {
                const float reciprocal = 1.0F / direction;
                near_scale[axis] = reciprocal * (1 - 0x1p-21F);
                far_scale[axis] = reciprocal * (1 + 0x1p-21F);
            }
        }
    }
    uint32_t octant() const { return (negative[0] ? 1U : 0U) | (negative[1] ? 2U : 0U) | (negative[2] ? 4U : 0U); }
};

/// Nodes that still have to be visited. 70 levels of wide nodes cover the deepest kd-tree, 48 levels if each opens but
/// its siblings, and below it the longest leaf, kMaxBlocks halved until parts of kMaxLeafBlocks are left.
struct TraversalStack {
    static constexpr int kCapacity = 70 * (WideNode::kWidth - 1) + 2 * WideNode::kWidth;
    uint32_t child[kCapacity];
    float distance[kCapacity];
    int count = 0;
};

/// Finds the children that the ray meets: the nearest goes to `next`, the others onto the stack, nearer ones later.
/// False if there is none.
HWY_INLINE bool meet_children(const BoxRay& ray, uint32_t octant, const WideNode& node, float t_min, float t_max,
                              TraversalStack& stack, uint32_t& next) {
    const hn::CappedTag<float, WideNode::kWidth> d;
    const hn::RebindToUnsigned<decltype(d)> du;
    constexpr size_t kLanes = hn::MaxLanes(hn::CappedTag<float, WideNode::kWidth>());
    alignas(32) float distances[WideNode::kWidth];
    uint32_t met = 0;
    for (size_t first = 0; first < WideNode::kWidth; first += kLanes) {
        auto entry = hn::Set(d, t_min);
        auto exit = hn::Set(d, t_max);
        for (int axis = 0; axis < 3; ++axis) {
            const float* lower = node.lower[axis] + first;
            const float* upper = node.upper[axis] + first;
            const auto near = hn::Load(d, ray.negative[axis] ? upper : lower);
            const auto far = hn::Load(d, ray.negative[axis] ? lower : upper);
            const auto t_near =
                hn::Mul(hn::Sub(near, hn::Set(d, ray.near_origin[axis])), hn::Set(d, ray.near_scale[axis]));
            const auto t_far = hn::Mul(hn::Sub(far, hn::Set(d, ray.far_origin[axis])), hn::Set(d, ray.far_scale[axis]));
            entry = hn::Max(t_near, entry);
            exit = hn::Min(t_far, exit);
        }
        // Products that underflow are off by an absolute error as well.
        const auto meets = hn::Le(entry, hn::Add(exit, hn::Set(d, 0x1p-140F)));
        if constexpr (kLanes == WideNode::kWidth && HWY_TARGET != HWY_SSE4) {
            // All eight in one register: permute by the octant's order and compress onto the stack, without a branch on
            // their number.
            const auto ranks = hn::Shr(hn::Set(du, node.order[octant]), hn::Mul(hn::Iota(du, 0), hn::Set(du, 3)));
            const auto order = hn::IndicesFromVec(d, hn::And(ranks, hn::Set(du, 7)));
            const auto child = hn::BitCast(du, hn::TableLookupLanes(hn::BitCast(d, hn::Load(du, node.child)), order));
            const auto distance = hn::TableLookupLanes(
                hn::IfThenElse(meets, hn::Min(entry, hn::Set(d, std::numeric_limits<float>::max())), hn::Inf(d)),
                order);
            const auto pushed = hn::Lt(distance, hn::Inf(d));
            uint8_t bits[8] = {};
            hn::StoreMaskBits(d, pushed, bits);
            if (bits[0] == 0) {
                return false;
            }
            hn::CompressStore(child, hn::RebindMask(du, pushed), du, stack.child + stack.count);
            hn::CompressStore(distance, pushed, d, stack.distance + stack.count);
            // The nearest is the last: taken from the node, since the stack's is still on its way to memory.
            stack.count += std::popcount(bits[0]) - 1;
            next = node.child[node.order[octant] >> (3 * (std::bit_width(bits[0]) - 1)) & 7U];
            return true;
        }
        hn::Store(entry, d, distances + first);
        uint8_t bits[8] = {};
        hn::StoreMaskBits(d, meets, bits);
        met |= static_cast<uint32_t>(bits[0]) << first;
    }
    uint32_t order = node.order[octant];
    for (int i = 0; i < WideNode::kWidth; ++i, order >>= 3) {
        const uint32_t slot = order & 7U;
        stack.child[stack.count] = node.child[slot];
        stack.distance[stack.count] = distances[slot];
        stack.count += static_cast<int>(met >> slot & 1U);
    }
    if (met == 0) {
        return false;
    }
    next = stack.child[--stack.count];
    return true;
}

/// Walks the ray through the tree, nearest children first. For any hit stops at the first and returns its block.
template <bool kAnyHit>
HWY_INLINE const TriangleBlock* trace(const Tree& tree, const Ray& ray, const ShearedRay& sheared,
                                      NearestHit& nearest) {
    const BoxRay box_ray(ray);
    const uint32_t octant = box_ray.octant();
    const WideNode* nodes = tree.wide_nodes.data();
    const TriangleBlock* blocks = tree.blocks.data();
    TraversalStack stack;
    for (uint32_t child = 0;;) {
        if ((child & WideNode::kLeafFlag) == 0) {
            if (meet_children(box_ray, octant, nodes[child], ray.t_min, nearest.reach(), stack, child)) {
                continue;
            }
        } else {
            const TriangleBlock* block = blocks + WideNode::first_block(child);
            for (const TriangleBlock* end = block + WideNode::blocks(child); block != end; ++block) {
                if (test_block<kAnyHit>(ray, sheared, *block, nearest) && kAnyHit) {
                    return block;
                }
            }
        }
        do {
            if (stack.count == 0) {
                return nullptr;
            }
            --stack.count;
        } while (stack.distance[stack.count] > nearest.reach());
        child = stack.child[stack.count];
    }
}

void intersect(const Tree& tree, std::span<const Ray> rays, std::span<Hit> hits) {
    for (size_t i = 0; i < rays.size(); ++i) {
        NearestHit nearest(rays[i]);
        trace<false>(tree, rays[i], ShearedRay(rays[i].origin, rays[i].direction), nearest);
        hits[i] = nearest.result();
    }
}

void occluded(const Tree& tree, std::span<const Ray> rays, std::span<uint8_t> results) {
    const TriangleBlock* blocker = nullptr;  // what hides one point from a light often hides the next
    for (size_t i = 0; i < rays.size(); ++i) {
        const ShearedRay sheared(rays[i].origin, rays[i].direction);
        NearestHit nearest(rays[i]);
        if (blocker == nullptr || !test_block<true>(rays[i], sheared, *blocker, nearest)) {
            blocker = trace<true>(tree, rays[i], sheared, nearest);
        }
        results[i] = blocker != nullptr ? 1 : 0;
    }
}

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace espalier {
namespace {

struct TraceKernels {
    void (*intersect)(const Tree&, std::span<const Ray>, std::span<Hit>);
    void (*occluded)(const Tree&, std::span<const Ray>, std::span<uint8_t>);
};

TraceKernels choose_kernels() {
    switch (simd_target()) {
#if defined(__x86_64__)
        case HWY_AVX3_DL:
            return {N_AVX3_DL::intersect, N_AVX3_DL::occluded};
        case HWY_AVX2:
            return {N_AVX2::intersect, N_AVX2::occluded};
        default:
            return {N_SSE4::intersect, N_SSE4::occluded};
#else
        default:
            return {N_NEON::intersect, N_NEON::occluded};
#endif
    }
}

const TraceKernels& kernels() {
    static const TraceKernels chosen = choose_kernels();
    return chosen;
}

}  // namespace

void intersect(const Tree& tree, std::span<const Ray> rays, std::span<Hit> hits) {
    const FloatEnvironment environment;
    if (tree.wide_nodes.size() == 0) {
        std::transform(rays.begin(), rays.end(), hits.begin(), [](const Ray& ray) { return Hit{ray.t_max, 0, 0, -1}; });
        return;
    }
    kernels().intersect(tree, rays, hits);
}

void occluded(const Tree& tree, std::span<const Ray> rays, std::span<uint8_t> results) {
    const FloatEnvironment environment;
    if (tree.wide_nodes.size() == 0) {
        std::fill_n(results.begin(), rays.size(), uint8_t{0});
        return;
    }
    kernels().occluded(tree, rays, results);
}

}  // namespace espalier
#endif
