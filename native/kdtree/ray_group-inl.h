// SPDX-License-Identifier: GPL-3.0-or-later
// Rays that set out side by side into one octant, as those of neighbouring pixels to a lamp or the sun do, led through
// the tree together until they part: a child's box is tested against all of them at once, a ray per lane. Compiled once
// per instruction set (see traversal.cpp).

#if defined(ESPALIER_KDTREE_RAY_GROUP_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_KDTREE_RAY_GROUP_INL_H_
#undef ESPALIER_KDTREE_RAY_GROUP_INL_H_
#else
#define ESPALIER_KDTREE_RAY_GROUP_INL_H_
#endif

#include <hwy/highway.h>

#include <bit>
#include <cstddef>
#include <cstdint>

#include "kdtree/compress-inl.h"
#include "kdtree/node.h"
#include "kdtree/ray_batch-inl.h"
#include "kdtree/traced_ray-inl.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// Of a batch, rays that look for any hit.
class RayGroup {
 public:
    /// Takes in so many of a batch, a bit for each, if they are enough and go into one octant; else returns false.
    HWY_INLINE bool gather(const RayBatch& batch, uint32_t rays) {
        if (static_cast<uint32_t>(std::popcount(rays)) < kLeast) {
            return false;
        }
        const auto first = static_cast<size_t>(std::countr_zero(rays));
        const auto last = static_cast<size_t>(std::bit_width(rays)) - 1;
        const uint32_t octant = batch.octant(first);
        if (batch.octant(last) != octant) {  // most that do not belong together are known by that
            return false;
        }
        batch.copy(columns_);
        if ((rays & ~columns_.in_octant(octant)) != 0) {
            return false;
        }
        for (uint32_t axis = 0; axis < 3; ++axis) {
            const uint32_t behind = octant >> axis & 1U;
            near_planes_[axis] = (axis + 3 * behind) * WideNode::kWidth;
            far_planes_[axis] = (axis + 3 * (1 - behind)) * WideNode::kWidth;
        }
        return true;
    }

    /// Walks from the root with so many of the rays, a bit for each, that look for any hit. Calls test(leaf, rays),
    /// which returns those that have hit something and so have ended, and part(child, rays) where no more than kFew
    /// go: if that returns true, it has taken over what they have to visit there. Returns those that have not ended.
    template <class Test, class Part>
    HWY_INLINE uint32_t walk(const WideNode* nodes, uint32_t rays, const Test& test, const Part& part) const {
        struct Waiting {
            uint32_t child;
            uint32_t rays;
        };
        Waiting stack[kCapacity];
        stack[0] = {0, rays};
        for (size_t size = 1; size != 0 && rays != 0;) {
            const Waiting next = stack[--size];
            const uint32_t here = next.rays & rays;
            if (here == 0) {
                continue;
            }
            if ((next.child & WideNode::kLeafFlag) != 0) {
                rays &= ~test(next.child, here);
                continue;
            }
            if (std::popcount(here) <= kFew && part(next.child, here)) {
                continue;
            }
            const WideNode& node = nodes[next.child];
            uint32_t entering[WideNode::kWidth];
            enter(node, entering);
            for (const uint32_t order : node.order) {
                const uint32_t slot = order >> WideNode::kSoonestShift;
                const uint32_t further = entering[slot] & here;
                stack[size] = {node.child[slot], further};
                size += at_most_one(further);
            }
        }
        return rays;
    }

 private:
    static constexpr uint32_t kLeast = 12;  ///< fewer are as fast alone
    static constexpr int kFew = 4;          ///< go on sooner alone: a group waits for what it reads, a stream does not
    /// The deepest tree's, and room for one that is not to be visited.
    static constexpr size_t kCapacity = WideNode::kMostLevels * (WideNode::kWidth - 1) + 2;

    /// For each child the rays that enter it, a bit for each.
    HWY_INLINE void enter(const WideNode& node, uint32_t (&entering)[WideNode::kWidth]) const {
        const RayBatch::D d;
        using V = hn::Vec<RayBatch::D>;
        const float* planes = node.lower[0];
        for (size_t child = 0; child < WideNode::kWidth; ++child) {
            entering[child] = 0;
            for (size_t lane = 0; lane < RayBatch::kSize; lane += hn::Lanes(d)) {
                BoxSpan<V> span{hn::Load(d, columns_.start + lane), hn::Load(d, columns_.reach + lane)};
                for (size_t axis = 0; axis < 3; ++axis) {
                    span.cut(hn::Set(d, planes[near_planes_[axis] + child]),
                             hn::Set(d, planes[far_planes_[axis] + child]), hn::Load(d, columns_.inverse[axis] + lane),
                             hn::Load(d, columns_.near_shift[axis] + lane),
                             hn::Load(d, columns_.far_shift[axis] + lane));
                }
                entering[child] |= static_cast<uint32_t>(mask_bits(d, span.meets())) << lane;
            }
        }
    }

    BoxColumns columns_;
    uint32_t near_planes_[3];  ///< as in TracedRay
    uint32_t far_planes_[3];
};

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
