// SPDX-License-Identifier: GPL-3.0-or-later
// Rays made ready for the box test and the triangle test, and tested against the root, a register of them at a time.
// Compiled once per instruction set (see traversal.cpp).

#if defined(ESPALIER_KDTREE_RAY_BATCH_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_KDTREE_RAY_BATCH_INL_H_
#undef ESPALIER_KDTREE_RAY_BATCH_INL_H_
#else
#define ESPALIER_KDTREE_RAY_BATCH_INL_H_
#endif

#include <hwy/highway.h>

#include <algorithm>
#include <bit>
#include <cstddef>
#include <cstdint>
#include <limits>

#include "kdtree/node.h"
#include "kdtree/size_class.h"
#include "kdtree/traced_ray-inl.h"
#include "kdtree/traversal.h"
#include "kdtree/triangle_test-inl.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// Rays component by component.
template <class V>
struct RayColumns {
    V origin[3];
    V direction[3];
    V t_min;
    V t_max;

    /// A register of rays from `rays` on.
    template <class D>
    HWY_INLINE RayColumns(D d, const Ray* rays) {
        static_assert(sizeof(Ray) == 8 * sizeof(float));
        // A ray is a pair of quadruples: origins get into even lanes, directions into odd ones.
        const auto* from = reinterpret_cast<const float*>(rays);
        V low[4];
        V high[4];
        hn::LoadInterleaved4(d, from, low[0], low[1], low[2], low[3]);
        hn::LoadInterleaved4(d, from + 4 * hn::Lanes(d), high[0], high[1], high[2], high[3]);
        for (size_t axis = 0; axis < 3; ++axis) {
            origin[axis] = hn::ConcatEven(d, high[axis], low[axis]);
            direction[axis] = hn::ConcatOdd(d, high[axis], low[axis]);
        }
        t_min = hn::ConcatEven(d, high[3], low[3]);
        t_max = hn::ConcatOdd(d, high[3], low[3]);
    }
};

/// As Axes, for rays in lanes: what an axis turns into once z is the one of the direction's largest component.
template <class V>
class LaneAxes {
 public:
    HWY_INLINE explicit LaneAxes(const V (&direction)[3]) {
        const V size[3] = {hn::Abs(direction[0]), hn::Abs(direction[1]), hn::Abs(direction[2])};
        x_over_y_ = hn::Gt(size[0], size[1]);
        not_z_ = hn::Gt(hn::Max(size[0], size[1]), size[2]);
    }

    HWY_INLINE V pick(const V (&from)[3], size_t axis) const {
        return hn::IfThenElse(not_z_, hn::IfThenElse(x_over_y_, from[(axis + 1) % 3], from[(axis + 2) % 3]),
                              from[axis]);
    }

 private:
    hn::Mask<hn::DFromV<V>> x_over_y_;
    hn::Mask<hn::DFromV<V>> not_z_;
};

/// Where rays meet planes across one axis: at depths plane * inverse + shift, where the shift already holds a margin,
/// towards the ray's start for near planes and away from it for far ones.
///
/// With u = 2^-24: inverse is off by a relative u, its product with the origin by another, and the sum by one of its
/// result. The error of a plane's depth is therefore below 2.1 u of it, for which there is room in a ray's reach and in
/// the comparison of near with far depths, and 2.1 u |origin * inverse|, which the margin covers. Without fused
/// operations the plane's own product adds u |plane * inverse|.
///
/// A component below 2^-25 of the largest is made that large. Within the depths at which the tree lies, at most
/// `farthest` = extent + |origin|, that moves the ray by less than 2^-24 times that; the margin takes the double.
template <class V>
struct Slab {
    V inverse;
    V near_shift;
    V far_shift;

    /// steepness: the direction's largest component over this one, without signs; deviation: how far rays may pass
    /// beside the origin along the axis.
    HWY_INLINE Slab(V origin, V steepness, hn::Mask<hn::DFromV<V>> negative, float extent, V farthest, V deviation) {
        const hn::DFromV<V> d;
        inverse = hn::IfThenElse(negative, hn::Neg(steepness), steepness);
        const V shift = hn::Neg(hn::Mul(origin, inverse));
        V room = hn::Abs(shift);
#if !HWY_NATIVE_FMA
        room = hn::MulAdd(hn::Set(d, extent), steepness, room);
#else
        (void)extent;
#endif
        const V flat =
            hn::IfThenElseZero(hn::Ge(steepness, hn::Set(d, 0x1p24F)), hn::Mul(farthest, hn::Set(d, 0x1p-22F)));
        const V margin =
            hn::MulAdd(hn::Add(flat, deviation), steepness, hn::MulAdd(room, hn::Set(d, 0x1p-22F), hn::Set(d, kTiny)));
        near_shift = hn::Sub(shift, margin);
        far_shift = hn::Add(shift, margin);
    }
};

/// The depths from t_min to t_max, as TracedRay has them; largest: the direction's largest component, without sign.
template <class V>
struct DepthLimits {
    V start;
    V reach;
    V sure_start;
    V sure_end;

    HWY_INLINE DepthLimits(V t_min, V t_max, V largest) {
        const hn::DFromV<V> d;
        const V tiny = hn::Set(d, kTiny);
        const V below = hn::Set(d, 1 - 0x1p-21F);
        const V from = hn::Mul(t_min, largest);
        const V to = hn::Mul(t_max, largest);
        start = hn::Sub(hn::Mul(from, below), tiny);
        reach = hn::MulAdd(to, hn::Set(d, 1 + 0x1p-20F), tiny);
        sure_start = hn::MulAdd(from, hn::Set(d, 1 + 0x1p-21F), tiny);
        sure_end = hn::Sub(hn::Mul(to, below), tiny);
    }
};

/// What the box test asks of sixteen rays, as in TracedRay, a column each.
struct BoxColumns {
    static constexpr size_t kSize = 16;
    alignas(64) float inverse[3][kSize];
    alignas(64) float near_shift[3][kSize];
    alignas(64) float far_shift[3][kSize];
    alignas(64) float start[kSize];
    alignas(64) float reach[kSize];
    alignas(64) float octant[kSize];  ///< bits of a number

    /// The rays that go there, a bit for each.
    HWY_INLINE uint32_t in_octant(uint32_t wanted) const {
        const hn::CappedTag<float, kSize> d;
        const hn::RebindToUnsigned<decltype(d)> du;
        uint32_t rays = 0;
        for (size_t lane = 0; lane < kSize; lane += hn::Lanes(d)) {
            const auto is_there = hn::Eq(hn::BitCast(du, hn::Load(d, octant + lane)), hn::Set(du, wanted));
            rays |= static_cast<uint32_t>(mask_bits(d, hn::RebindMask(d, is_there))) << lane;
        }
        return rays;
    }
};

/// Sets single rays up, as many at once as fill any register.
class RayBatch {
 public:
    static constexpr size_t kSize = BoxColumns::kSize;
    using D = hn::CappedTag<float, kSize>;

    /// bounds: of the tree.
    explicit RayBatch(const Box3f& bounds) : bounds_(bounds), extent_(extent_of(bounds)) {
        const SizeClasses classes(bounds);
        for (uint32_t c = 0; c < SizeClasses::kCount; ++c) {
            sizes_[c] = classes.limit(c);
        }
    }

    /// kSize rays from `rays` on. Returns those that meet children of the root, a bit for each.
    HWY_INLINE uint32_t set_up(const Ray* rays, const WideNode& root) {
        V lean = hn::Zero(D());
        uint32_t meeting = 0;
        for (size_t first = 0; first < kSize; first += kLanes) {
            lean = hn::Max(lean, set_up_lanes(first, rays + first, root, meeting));
        }
        if constexpr (kAsksFirst) {
            if (const float most = hn::GetLane(hn::MaxOfLanes(D(), lean)); most > lean_) {
                lean_ = most;
                set_least_inside();
            }
        }
        return meeting;
    }

    /// Where steps ask first, by size class of a block: no edge function of a triangle that a ray hits is less inside,
    /// of any ray since the last reset.
    const float* least_inside() const { return least_inside_; }
    void reset() { lean_ = -1; }

    HWY_INLINE void copy(size_t lane, TracedRay& ray) const {
        static_assert(offsetof(TracedRay, place) == kQuads * 4 * sizeof(float));
        const hn::CappedTag<float, 4> d;
        auto* to = reinterpret_cast<float*>(&ray);
        for (size_t quad = 0; quad < kQuads; ++quad) {
            hn::Store(hn::Load(d, quads_[quad] + 4 * lane), d, to + 4 * quad);
        }
        ray.place = place_[lane];
    }

    uint32_t octant(size_t lane) const { return std::bit_cast<uint32_t>(number(lane, offsetof(TracedRay, octant))); }

    HWY_INLINE void copy(BoxColumns& columns) const {
        const D d;
        for (size_t lane = 0; lane < kSize; lane += kLanes) {
            const auto load = [&](size_t quad, float (&xyz)[3][kSize], float (&last)[kSize]) {
                V column[4];
                hn::LoadInterleaved4(d, quads_[quad] + 4 * lane, column[0], column[1], column[2], column[3]);
                for (size_t axis = 0; axis < 3; ++axis) {
                    hn::Store(column[axis], d, xyz[axis] + lane);
                }
                hn::Store(column[3], d, last + lane);
            };
            load(offsetof(TracedRay, inverse) / kQuadBytes, columns.inverse, columns.start);
            load(offsetof(TracedRay, near_shift) / kQuadBytes, columns.near_shift, columns.reach);
            load(offsetof(TracedRay, far_shift) / kQuadBytes, columns.far_shift, columns.octant);
        }
    }

    /// What the triangle test asks of a ray, as in TracedRay, and what holds for all triangles of the tree.
    struct AtLeaf {
        uint32_t x, y, z;
        float minus_ox, minus_oy, minus_oz;
        float sx, sy;
        float slant, sign, start, reach;
        float minus_edge_error;  ///< no Sheared::minus_edge_error is less
        float mz;                ///< no corner's |z| is larger
    };

    HWY_INLINE AtLeaf at_leaf(size_t lane) const {
        const auto get = [&](size_t offset) { return number(lane, offset); };
        const auto column = [&](size_t offset) { return std::bit_cast<uint32_t>(number(lane, offset)); };
        return {column(offsetof(TracedRay, x)),
                column(offsetof(TracedRay, y)),
                column(offsetof(TracedRay, z)),
                get(offsetof(TracedRay, minus_ox)),
                get(offsetof(TracedRay, minus_oy)),
                get(offsetof(TracedRay, minus_oz)),
                get(offsetof(TracedRay, sx)),
                get(offsetof(TracedRay, sy)),
                get(offsetof(TracedRay, slant)),
                get(offsetof(TracedRay, sign)),
                get(offsetof(TracedRay, start)),
                get(offsetof(TracedRay, reach)),
                minus_edge_error_[lane],
                mz_[lane]};
    }

    /// Whether a depth between these two lies within the ray's limits for certain.
    HWY_INLINE bool is_within(size_t lane, float lower, float upper) const {
        return lower >= number(lane, offsetof(TracedRay, sure_start)) &&
               upper <= number(lane, offsetof(TracedRay, sure_end));
    }

    /// The child of the root that a ray enters first, of one that enters some.
    uint32_t first_child(size_t lane) const { return first_child_[lane]; }

    /// Of the rays that enter some, those whose first is one of these; a bit for each ray and each child.
    HWY_INLINE uint32_t first_in(uint32_t children) const {
        const hn::RebindToUnsigned<D> du;
        uint32_t lanes = 0;
        for (size_t first = 0; first < kSize; first += kLanes) {
            const auto child = hn::Shl(hn::Set(du, 1), hn::Load(du, first_child_ + first));
            const auto is_among = hn::Ne(hn::And(child, hn::Set(du, children)), hn::Zero(du));
            lanes |= static_cast<uint32_t>(mask_bits(D(), hn::RebindMask(D(), is_among))) << first;
        }
        return lanes;
    }

    /// The children of the root that a ray enters no farther than `reach`, a bit for each.
    HWY_INLINE uint32_t entered(size_t lane, float reach) const {
        const hn::CappedTag<float, 4> d;
        const auto limit = hn::Set(d, std::min(reach, std::numeric_limits<float>::max()));
        const auto bits = [&](size_t half) {
            return static_cast<uint32_t>(mask_bits(d, hn::Le(hn::Load(d, entries_[half] + 4 * lane), limit)));
        };
        return bits(0) | bits(1) << 4;
    }

    /// Has a ray pass a child of the root by.
    void pass_by(size_t lane, uint32_t child) { entries_[child / 4][4 * lane + child % 4] = kInfinity; }

    /// Takes in that a ray hits something, at a depth between these two, which has it pass by what lies beyond.
    HWY_INLINE void shorten(size_t lane, uint32_t place, float lower, float upper) {
        const hn::CappedTag<float, 4> d;
        const float reach = reach_behind(upper);
        number(lane, offsetof(TracedRay, reach)) = reach;
        number(lane, offsetof(TracedRay, lower)) = lower;
        number(lane, offsetof(TracedRay, upper)) = upper;
        place_[lane] = place;
        for (auto& half : entries_) {
            const auto entry = hn::Load(d, half + 4 * lane);
            hn::Store(hn::IfThenElse(hn::Le(entry, hn::Set(d, reach)), entry, hn::Inf(d)), d, half + 4 * lane);
        }
    }

    HWY_INLINE ChildEntries root_entries(size_t lane) const {
        const hn::CappedTag<float, 4> d;
        const auto first = hn::Load(d, entries_[0] + 4 * lane);
        const auto others = hn::Load(d, entries_[1] + 4 * lane);
#if HWY_TARGET != HWY_SSE4 && HWY_TARGET != HWY_NEON
        return {hn::Combine(hn::CappedTag<float, WideNode::kWidth>(), others, first)};
#else
        ChildEntries entries;
        hn::Store(first, d, entries.depth);
        hn::Store(others, d, entries.depth + 4);
        entries.met = entered(lane, kInfinity);
        return entries;
#endif
    }

 private:
    static constexpr size_t kQuads = 8;
    static constexpr size_t kQuadBytes = 4 * sizeof(float);
    using V = hn::Vec<D>;
    static constexpr size_t kLanes = hn::MaxLanes(D());

    /// Of a ray what lies so many bytes behind the beginning of a TracedRay.
    HWY_INLINE const float& number(size_t lane, size_t offset) const {
        return quads_[offset / kQuadBytes][4 * lane + offset % kQuadBytes / sizeof(float)];
    }
    HWY_INLINE float& number(size_t lane, size_t offset) {
        return quads_[offset / kQuadBytes][4 * lane + offset % kQuadBytes / sizeof(float)];
    }

    /// What Sheared::minus_edge_error comes to for the largest triangles of each size that a ray can hit, and less.
    /// EXACTNESS.md, 8.
    void set_least_inside() {
        for (uint32_t c = 0; c < SizeClasses::kCount; ++c) {
            const float s = 4.0625F * sizes_[c] + 16 * lean_;
            least_inside_[c] = -s * (3.3125F * 0x1p-24F * s + 10.625F * lean_) - 2 * kTiny;
        }
    }

    /// Returns how far x and y of a corner may move by its z being rounded; infinitely far for what is no ray.
    HWY_INLINE V set_up_lanes(size_t first, const Ray* rays, const WideNode& root, uint32_t& meeting) {
        const D d;
        const hn::RebindToUnsigned<D> du;
        const RayColumns<V> given(d, rays);
        const LaneAxes<V> axes(given.direction);
        const V along = axes.pick(given.direction, 2);
        const V largest = hn::Abs(along);
        const V farthest = hn::Add(hn::Set(d, extent_), largest_of(given.origin));
        V inverse[3];
        V near_shift[3];
        V far_shift[3];
        V near_planes[3];
        V far_planes[3];
        auto octant = hn::Zero(du);
        hn::Mask<D> is_negative[3];
        for (uint32_t axis = 0; axis < 3; ++axis) {
            is_negative[axis] = hn::Lt(given.direction[axis], hn::Zero(d));
            const V own = hn::Max(hn::Abs(given.direction[axis]), hn::Mul(largest, hn::Set(d, 0x1p-25F)));
            const Slab<V> slab(given.origin[axis], hn::Div(largest, own), is_negative[axis], extent_, farthest,
                               hn::Zero(d));
            inverse[axis] = slab.inverse;
            near_shift[axis] = slab.near_shift;
            far_shift[axis] = slab.far_shift;
            const auto negative_u = hn::RebindMask(du, is_negative[axis]);
            octant = hn::Or(octant, hn::IfThenElseZero(negative_u, hn::Set(du, 1U << axis)));
            const auto first_planes = hn::Set(du, axis * WideNode::kWidth);
            const auto other_planes = hn::Set(du, (axis + 3) * WideNode::kWidth);
            near_planes[axis] = hn::BitCast(d, hn::IfThenElse(negative_u, other_planes, first_planes));
            far_planes[axis] = hn::BitCast(d, hn::IfThenElse(negative_u, first_planes, other_planes));
        }
        const V columns[3] = {hn::BitCast(d, hn::Set(du, 0)), hn::BitCast(d, hn::Set(du, kBlockSize)),
                              hn::BitCast(d, hn::Set(du, 2 * kBlockSize))};
        const V sx = hn::Div(axes.pick(given.direction, 0), along);
        const V sy = hn::Div(axes.pick(given.direction, 1), along);
        const V slant = hn::Mul(hn::Add(hn::Max(hn::Abs(sx), hn::Abs(sy)), hn::Set(d, 0x1p-64F)), hn::Set(d, 0x1p-24F));
        V farthest_z = hn::Zero(d);
        for (int axis = 0; axis < 3; ++axis) {
            farthest_z = hn::Max(farthest_z, largest_of(hn::Sub(hn::Set(d, bounds_.lower[axis]), given.origin[axis]),
                                                        hn::Sub(hn::Set(d, bounds_.upper[axis]), given.origin[axis])));
        }
        const DepthLimits<V> limits(given.t_min, given.t_max, largest);
        const auto store = [&](size_t quad, V a, V b, V c, V e) {
            hn::StoreInterleaved4(a, b, c, e, d, quads_[quad] + 4 * first);
        };
        store(0, inverse[0], inverse[1], inverse[2], limits.start);
        store(1, near_shift[0], near_shift[1], near_shift[2], limits.reach);
        store(2, far_shift[0], far_shift[1], far_shift[2], hn::BitCast(d, octant));
        store(3, near_planes[0], near_planes[1], near_planes[2], hn::CopySign(hn::Set(d, 1.0F), along));
        store(4, far_planes[0], far_planes[1], far_planes[2], slant);
        store(5, axes.pick(columns, 0), axes.pick(columns, 1), axes.pick(columns, 2), sx);
        const V minus_origin[3] = {hn::Neg(given.origin[0]), hn::Neg(given.origin[1]), hn::Neg(given.origin[2])};
        store(6, axes.pick(minus_origin, 0), axes.pick(minus_origin, 1), axes.pick(minus_origin, 2), sy);
        store(7, limits.sure_start, limits.sure_end, hn::Inf(d), hn::Mul(given.t_max, largest));
        hn::Store(hn::Set(du, kNoPlace), du, place_ + first);
        hn::Store(farthest_z, d, mz_ + first);
        meeting |= enter_root(first, root, is_negative, inverse, near_shift, far_shift, limits) << first;
        // A ray that is no ray must not take hits from those beside it.
        const V lean = hn::Mul(slant, farthest_z);
        hn::Store(minus_edge_error_within(hn::Mul(hn::Set(d, 4.0625F), farthest_z), lean), d,
                  minus_edge_error_ + first);
        return hn::IfThenElse(hn::Le(lean, hn::Set(d, std::numeric_limits<float>::max())), lean, hn::Inf(d));
    }

    /// Notes where rays enter the root's children. Returns those that enter some, a bit for each.
    HWY_INLINE uint32_t enter_root(size_t first, const WideNode& root, const hn::Mask<D> (&is_negative)[3],
                                   const V (&inverse)[3], const V (&near_shift)[3], const V (&far_shift)[3],
                                   const DepthLimits<V>& limits) {
        const D d;
        const hn::RebindToUnsigned<D> du;
        V nearest = hn::Inf(d);
        auto first_child = hn::Zero(du);
        for (size_t half = 0; half < 2; ++half) {
            V entries[4];
            for (size_t i = 0; i < 4; ++i) {
                const size_t child = 4 * half + i;
                BoxSpan<V> span{limits.start, limits.reach};
                for (size_t axis = 0; axis < 3; ++axis) {
                    const V lower = hn::Set(d, root.lower[axis][child]);
                    const V upper = hn::Set(d, root.upper[axis][child]);
                    span.cut(hn::IfThenElse(is_negative[axis], upper, lower),
                             hn::IfThenElse(is_negative[axis], lower, upper), inverse[axis], near_shift[axis],
                             far_shift[axis]);
                }
                entries[i] = span.entry_or_infinity();
                const auto is_nearer = hn::RebindMask(du, hn::Lt(entries[i], nearest));
                first_child = hn::IfThenElse(is_nearer, hn::Set(du, static_cast<uint32_t>(child)), first_child);
                nearest = hn::Min(nearest, entries[i]);
            }
            hn::StoreInterleaved4(entries[0], entries[1], entries[2], entries[3], d, entries_[half] + 4 * first);
        }
        hn::Store(first_child, du, first_child_ + first);
        return static_cast<uint32_t>(mask_bits(d, hn::Lt(nearest, hn::Inf(d))));
    }

    Box3f bounds_;
    float extent_;  ///< their largest coordinate
    float lean_ = -1;
    float sizes_[SizeClasses::kCount];
    float least_inside_[SizeClasses::kCount] = {};
    alignas(64) float quads_[kQuads][4 * kSize];
    alignas(64) uint32_t place_[kSize];
    alignas(64) float minus_edge_error_[kSize];
    alignas(64) float mz_[kSize];
    alignas(64) float entries_[2][4 * kSize];  ///< into four of the root's children each
    alignas(64) uint32_t first_child_[kSize];
};

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
