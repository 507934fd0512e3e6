// SPDX-License-Identifier: GPL-3.0-or-later
// Triangles as rays see them that run through one point: which of them no ray of a packet meets, and edge functions
// that each ray evaluates for itself. Compiled once per instruction set (see traversal.cpp).

#if defined(ESPALIER_KDTREE_FOCUS_VIEW_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_KDTREE_FOCUS_VIEW_INL_H_
#undef ESPALIER_KDTREE_FOCUS_VIEW_INL_H_
#else
#define ESPALIER_KDTREE_FOCUS_VIEW_INL_H_
#endif

#include <hwy/highway.h>

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "kdtree/node.h"
#include "kdtree/traced_ray-inl.h"
#include "kdtree/triangle_test-inl.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// The point that a packet's rays run through, and how they do: along z, by slopes that differ little.
struct Focus {
    uint32_t x, y, z;  ///< as in TracedRay
    float at_x, at_y, at_z;
    float slope_x, slope_y;    ///< of the packet's middle
    float spread_x, spread_y;  ///< more than what any ray's slopes differ from it
    float sign;                ///< of directions along z
    float along_error;         ///< how much a corner's position across the rays may be off, per distance
    float miss;                ///< and by the rays' not quite running through the focus

    /// Once all else is known; deviation: how far from the focus rays pass at most, summed over the axes.
    HWY_INLINE void set_errors(float deviation) {
        const float slope = std::max(std::abs(slope_x), std::abs(slope_y)) + 0x1p-64F;
        along_error = 0x1p-24F * (4.25F * slope + 11.5F * (spread_x + spread_y));
        miss = 1.3F * deviation;
    }
};

/// How far three corners lie together to one side of the packet's middle, along an axis; negative if on both.
template <class V>
HWY_INLINE V distance_beside(const V (&x)[3]) {
    return hn::Max(hn::Min(x[0], hn::Min(x[1], x[2])), hn::Neg(hn::Max(x[0], hn::Max(x[1], x[2]))));
}

/// What the triangles of a block, or of two, look like from the focus, sheared so that the packet's middle runs along
/// z.
template <bool kExact>
struct FocusView {
    static constexpr size_t kSize = kBlocksPerStep * kBlockSize;
    alignas(64) float normal[3][3][kSize];  ///< [edge][axis]: an edge function is n.z - off_y n.y - off_x n.x
    alignas(64) float bound[kSize];         ///< no edge function is off by more
    alignas(64) float depth[3][kSize];      ///< the first corner's, and of the others what they lie behind it
    alignas(64) float size[kSize];          ///< the largest |depth|

    /// Fills all in. Returns the lanes that a ray of the packet may meet at depths from `entry` to `reach`, if its
    /// slopes are any that the packet's may be: those that neither an edge parts from the rays nor how far these reach
    /// to the side where a triangle is farthest.
    ///
    /// Edges are differences of corners as they are given, so that errors count by the edge and not by what lies
    /// between it and the packet's middle. With u = 2^-24, E the sum of the edges' largest sizes along x, y and z,
    /// m = mx + my, and g = (spread_x + spread_y) mz, an edge function is off by at most u E (13.6 m + 4 slope mz + 11
    /// g), and by 1.25 deviation E for lines that miss the focus; how far a corner lies beyond that reach by no more
    /// than that less E. Subnormal edges, whose errors are not so small, count as 2^-120. EXACTNESS.md, 8.
    HWY_INLINE uint32_t look(const Focus& focus, const BlockLoader& load, float entry, float reach) {
        const hn::CappedTag<float, kSize> d;
        constexpr size_t kLanes = hn::MaxLanes(hn::CappedTag<float, kSize>());
        using V = hn::Vec<decltype(d)>;
        const V slope_x = hn::Set(d, focus.slope_x);
        const V slope_y = hn::Set(d, focus.slope_y);
        uint32_t reached = 0;
        for (size_t first = 0; first < kSize; first += kLanes) {
            const auto corner = [&](size_t k, uint32_t axis) { return load(k * 3 * kBlockSize + first + axis); };
            V x[3];
            V y[3];
            V z_of[3];
            V edge_x[3];  // opposite corner k
            V edge_y[3];
            V edge_z[3];
            for (size_t k = 0; k < 3; ++k) {
                const size_t from = (k + 1) % 3;
                const size_t to = (k + 2) % 3;
                z_of[k] = hn::Sub(corner(k, focus.z), hn::Set(d, focus.at_z));
                x[k] = hn::NegMulAdd(slope_x, z_of[k], hn::Sub(corner(k, focus.x), hn::Set(d, focus.at_x)));
                y[k] = hn::NegMulAdd(slope_y, z_of[k], hn::Sub(corner(k, focus.y), hn::Set(d, focus.at_y)));
                edge_z[k] = hn::Sub(corner(to, focus.z), corner(from, focus.z));
                edge_x[k] = hn::NegMulAdd(slope_x, edge_z[k], hn::Sub(corner(to, focus.x), corner(from, focus.x)));
                edge_y[k] = hn::NegMulAdd(slope_y, edge_z[k], hn::Sub(corner(to, focus.y), corner(from, focus.y)));
            }
            const V mz = largest_of(z_of);
            V bound_here = hn::Zero(d);
            V margin = hn::Zero(d);
            if constexpr (kExact) {
                // Of the two edges at the first corner: the third is no longer than both together, and no corner lies
                // farther from the first.
                const V across = hn::Add(largest_of(edge_x[1], edge_x[2]), largest_of(edge_y[1], edge_y[2]));
                const V edge = hn::Add(across, hn::Add(largest_of(edge_z[1], edge_z[2]), hn::Set(d, kTiny)));
                const V m = hn::Add(across, hn::Add(hn::Abs(x[0]), hn::Abs(y[0])));
                margin = hn::MulAdd(hn::Set(d, focus.along_error), mz,
                                    hn::MulAdd(hn::Set(d, 14 * 0x1p-24F), m, hn::Set(d, focus.miss)));
                bound_here = hn::MulAdd(hn::Add(edge, edge), margin, hn::Set(d, kTiny));
            }
            V most_inside = hn::Zero(d);
            V least_inside = hn::Zero(d);
            for (size_t k = 0; k < 3; ++k) {
                const size_t from = (k + 1) % 3;
                const V nz = hn::MulSub(edge_x[k], y[from], hn::Mul(edge_y[k], x[from]));
                const V ny = hn::MulSub(edge_x[k], z_of[from], hn::Mul(edge_z[k], x[from]));
                const V nx = hn::MulSub(edge_z[k], y[from], hn::Mul(edge_y[k], z_of[from]));
                const V range = hn::MulAdd(hn::Abs(nx), hn::Set(d, focus.spread_x),
                                           hn::Mul(hn::Abs(ny), hn::Set(d, focus.spread_y)));
                const V high = hn::Add(nz, range);
                const V low = hn::Sub(nz, range);
                most_inside = k == 0 ? high : hn::Min(most_inside, high);
                least_inside = k == 0 ? low : hn::Max(least_inside, low);
                hn::Store(nx, d, normal[k][0] + first);
                hn::Store(ny, d, normal[k][1] + first);
                hn::Store(nz, d, normal[k][2] + first);
            }
            const auto possible = hn::Ge(hn::Max(most_inside, hn::Neg(least_inside)),
                                         hn::Neg(hn::Mul(bound_here, hn::Set(d, 1 + 0x1p-10F))));
            const V sign = hn::Set(d, focus.sign);
            const V corner_depth[3] = {hn::Mul(z_of[0], sign), hn::Mul(z_of[1], sign), hn::Mul(z_of[2], sign)};
            const V room = hn::MulAdd(mz, hn::Set(d, 0x1p-20F), hn::Set(d, kTiny));
            const V nearest = hn::Sub(hn::Min(corner_depth[0], hn::Min(corner_depth[1], corner_depth[2])), room);
            const V farthest = hn::Add(hn::Max(corner_depth[0], hn::Max(corner_depth[1], corner_depth[2])), room);
            const auto in_range = hn::And(hn::Le(nearest, hn::Set(d, reach)), hn::Ge(farthest, hn::Set(d, entry)));
            // Small triangles among wide rays are often parted from them by none of their own edges.
            const V beside = hn::Max(hn::NegMulAdd(hn::Set(d, focus.spread_x), mz, distance_beside(x)),
                                     hn::NegMulAdd(hn::Set(d, focus.spread_y), mz, distance_beside(y)));
            const auto among = hn::Le(beside, hn::MulAdd(hn::Set(d, 2.0F), margin, hn::Set(d, kTiny)));
            reached |= mask_bits(d, hn::And(hn::And(possible, in_range), among)) << first;
            hn::Store(bound_here, d, bound + first);
            hn::Store(corner_depth[0], d, depth[0] + first);
            hn::Store(hn::Sub(corner_depth[1], corner_depth[0]), d, depth[1] + first);
            hn::Store(hn::Sub(corner_depth[2], corner_depth[0]), d, depth[2] + first);
            hn::Store(mz, d, size + first);
        }
        return reached;
    }

    /// The edge functions of a triangle for rays whose slopes differ so much from the middle's.
    template <class D, class V = hn::Vec<D>>
    HWY_INLINE void sides(D d, uint32_t triangle, V off_x, V off_y, V (&side)[3]) const {
        for (size_t k = 0; k < 3; ++k) {
            side[k] = hn::NegMulAdd(
                off_x, hn::Set(d, normal[k][0][triangle]),
                hn::NegMulAdd(off_y, hn::Set(d, normal[k][1][triangle]), hn::Set(d, normal[k][2][triangle])));
        }
    }
};

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
