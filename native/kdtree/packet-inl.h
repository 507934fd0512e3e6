// SPDX-License-Identifier: GPL-3.0-or-later
// Many rays on one way through the tree, where all of them start or all of them end in the same point: rays of a
// camera, or of a lamp. Compiled once per instruction set (see traversal.cpp).

#if defined(ESPALIER_KDTREE_PACKET_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_KDTREE_PACKET_INL_H_
#undef ESPALIER_KDTREE_PACKET_INL_H_
#else
#define ESPALIER_KDTREE_PACKET_INL_H_
#endif

#include <hwy/highway.h>

#include <bit>
#include <cmath>
#include <cstdint>
#include <limits>

#include "kdtree/candidate.h"
#include "kdtree/focus_view-inl.h"
#include "kdtree/mailboxes.h"
#include "kdtree/on_demand.h"
#include "kdtree/ray_batch-inl.h"
#include "kdtree/traced_ray-inl.h"
#include "kdtree/triangle_test-inl.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// Rays through one point, the focus: their common origin, or the end (t = 1) that they share up to rounding. Seen from
/// the focus they run in directions of one octant with the same largest component z; depths are measured along it.
template <bool kAnyHit, bool kExact>
class Packet {
 public:
    /// Fewer share too little of their way; more lose where triangles are as small as pixels (OPTIMIZATION.md).
    static constexpr size_t kRays = 32;
    static constexpr size_t kMostParts = 4;

    explicit Packet(const Tree& tree)
        : nodes_(tree.wide_nodes.data()),
          blocks_(tree.blocks.data()),
          on_demand_(tree.on_demand.get()),
          extent_(extent_of(tree.bounds)) {}

    /// Sets the rays up if they make a packet.
    HWY_INLINE bool gather(const Ray* rays) {
        for (size_t lane = 0; lane < kRays; lane += 64 / sizeof(Ray)) {
            __builtin_prefetch(rays + kRays + lane);  // the next packet's
        }
        has_focus_ = false;
        if (!meet(rays[0], rays[kRays - 1])) {
            return false;
        }
        unpack(rays);
        return set_up();
    }

    /// Sets up some of the rays, a bit each.
    HWY_INLINE bool gather(const Ray* rays, uint32_t members) {
        unpack(rays);
        leave_out_all_but(members);
        return set_up();
    }

    /// Parts rays that have a focus, but made no packet, by the way they run. Returns the number of parts, or 0 where
    /// they would be too many.
    HWY_NOINLINE size_t part(uint32_t (&parts)[kMostParts]) const {
        static_assert(kRays == 32);
        size_t count = 0;
        uint32_t rest = has_focus_ ? ~0U : 0;
        while (rest != 0) {
            const uint32_t members = like(static_cast<size_t>(std::countr_zero(rest))) & rest;
            if (members == 0 || count == kMostParts) {
                return 0;
            }
            parts[count++] = members;
            rest &= ~members;
        }
        return count;
    }

    /// Traces the rays that have been set up.
    HWY_NOINLINE void trace() {
        mailboxes_.next_packet();
        size_t stacked = 0;
        for (size_t pushed = stacked_;;) {
            for (const size_t end = stacked + pushed; stacked != end; ++stacked) {
                prefetch(places_[stacked]);
            }
            pushed = 0;
            do {
                if (stacked == 0) {
                    return;
                }
                --stacked;
            } while (depths_[stacked] > reach_ || !any_enters(places_[stacked]));
            uint32_t child = nodes_[places_[stacked] / WideNode::kWidth].child[places_[stacked] % WideNode::kWidth];
            if (WideNode::is_unopened(child)) [[unlikely]] {
                child = on_demand_->open(child);
            }
            if ((child & WideNode::kLeafFlag) == 0) {
                pushed = visit_node(child, stacked);
                continue;
            }
            const uint32_t first = WideNode::first_block(child);
            const uint32_t end = first + WideNode::blocks(child);
            for (uint32_t block = first; block < end; block += kBlocksPerStep) {
                visit_blocks(block, block + 1 < end ? 1 : 0);
            }
            if (kAnyHit && reach_ < 0) {
                return;
            }
        }
    }

    uint32_t place(size_t lane) const { return place_[lane]; }
    /// The rays, a bit each, that end at this place.
    HWY_INLINE uint32_t rays_at(uint32_t place) const {
        uint32_t found = 0;
        for (size_t lane = 0; lane < kRays; lane += kLanes) {
            found |= mask_bits(du, hn::Eq(hn::Load(du, place_ + lane), hn::Set(du, place))) << lane;
        }
        return found;
    }
    const uint32_t* triangles() const { return triangle_; }
    const float* direction(size_t axis) const { return direction_[axis]; }
    /// Of the directions' largest components, once a ray has met something.
    size_t main_axis() const { return focus_.z / kBlockSize; }
    const float* t_max() const { return t_max_; }

 private:
    using View = FocusView<kExact>;
    using D = hn::CappedTag<float, 16>;
    using V = hn::Vec<D>;
    static constexpr D d{};                         // NOLINT(readability-identifier-naming): as in functions
    static constexpr hn::RebindToUnsigned<D> du{};  // NOLINT(readability-identifier-naming)
    static constexpr size_t kLanes = hn::MaxLanes(D());
    static constexpr auto kLaneBits = static_cast<uint32_t>((uint64_t{1} << kLanes) - 1);
    static constexpr size_t kCapacity = WideNode::kMostLevels * (WideNode::kWidth - 1) + 3 * WideNode::kWidth;
    /// Directions that differ by more are no packet.
    static constexpr float kWidest = 0.125F;

    /// Lays the rays out component by component.
    HWY_INLINE void unpack(const Ray* rays) {
        rays_ = rays;
        for (size_t lane = 0; lane < kRays; lane += kLanes) {
            const RayColumns<V> given(d, rays + lane);
            for (size_t axis = 0; axis < 3; ++axis) {
                hn::Store(given.origin[axis], d, origin_[axis] + lane);
                hn::Store(given.direction[axis], d, direction_[axis] + lane);
            }
            hn::Store(given.t_min, d, t_min_ + lane);
            hn::Store(given.t_max, d, t_max_ + lane);
        }
    }

    HWY_INLINE Vec3f origin_of(size_t lane) const { return {origin_[0][lane], origin_[1][lane], origin_[2][lane]}; }
    HWY_INLINE Vec3f direction_of(size_t lane) const {
        return {direction_[0][lane], direction_[1][lane], direction_[2][lane]};
    }

    /// The rays, a bit each, that make a packet with this one.
    HWY_INLINE uint32_t like(size_t leader) const {
        const Way way(direction_of(leader));
        uint32_t found = 0;
        for (size_t lane = 0; lane < kRays; lane += kLanes) {
            const auto off = [&](int axis) {
                const V slope = hn::Div(hn::Load(d, direction_[axis] + lane), hn::Load(d, direction_[way.z] + lane));
                return hn::Abs(hn::Sub(slope, hn::Set(d, way.towards[axis] / way.towards[way.z])));
            };
            const auto is_near = hn::Le(hn::Max(off(way.x), off(way.y)), hn::Set(d, kWidest / 2));
            found |= mask_bits(d, hn::And(is_near, runs(way, lane))) << lane;
        }
        return found;
    }

    /// Puts rays that end before they begin, and else are as the first of those that remain, in place of the others.
    HWY_INLINE void leave_out_all_but(uint32_t members) {
        const auto leader = static_cast<size_t>(std::countr_zero(members));
        const auto replace = [&](float* values, float by) {
            const V value = hn::Set(d, by);
            for (size_t lane = 0; lane < kRays; lane += kLanes) {
                const auto stays = mask_of(d, members >> lane & kLaneBits);
                hn::Store(hn::IfThenElse(stays, hn::Load(d, values + lane), value), d, values + lane);
            }
        };
        for (size_t axis = 0; axis < 3; ++axis) {
            replace(origin_[axis], origin_[axis][leader]);
            replace(direction_[axis], direction_[axis][leader]);
        }
        replace(t_min_, 0);
        replace(t_max_, -1);
    }

    /// Whether two rays start in one point or, for any hit, end in one up to rounding, as all of a packet do.
    static HWY_INLINE bool meet(const Ray& a, const Ray& b) {
        return a.origin == b.origin || (kAnyHit && end_together(a.origin + a.direction, b.origin + b.direction));
    }

    /// Seen from farther away than any triangle may lie, products would overflow.
    static HWY_INLINE bool end_together(Vec3f end, Vec3f other) {
        const Vec3f off = other - end;
        const float size = std::abs(end.x) + std::abs(end.y) + std::abs(end.z);
        return size <= kMaxCoordinate && std::abs(off.x) + std::abs(off.y) + std::abs(off.z) <= size * 0x1p-20F;
    }

    HWY_NOINLINE bool set_up() {
        const Vec3f first = origin_of(0);
        const Vec3f last = origin_of(kRays - 1);
        if (first == last && all_start_at(first)) {
            is_reversed_ = false;
            return set_up_around(first, {0, 0, 0});
        }
        if constexpr (kAnyHit) {
            const Vec3f end = first + direction_of(0);
            if (end_together(end, last + direction_of(kRays - 1))) {
                return to_focus(end);
            }
        }
        return false;
    }

    HWY_INLINE bool all_start_at(Vec3f focus) const {
        auto same = hn::FirstN(d, kLanes);
        for (size_t axis = 0; axis < 3; ++axis) {
            const V here = hn::Set(d, focus[static_cast<int>(axis)]);
            for (size_t lane = 0; lane < kRays; lane += kLanes) {
                same = hn::And(same, hn::Eq(hn::Load(d, origin_[axis] + lane), here));
            }
        }
        return hn::AllTrue(d, same);
    }

    /// Rays that end, at t = 1, in one point up to rounding, and not behind it.
    HWY_INLINE bool to_focus(Vec3f focus) {
        Vec3f deviation;
        for (size_t axis = 0; axis < 3; ++axis) {
            V largest = hn::Zero(d);
            for (size_t lane = 0; lane < kRays; lane += kLanes) {
                const V origin = hn::Load(d, origin_[axis] + lane);
                const V way = hn::Load(d, direction_[axis] + lane);
                const V end = hn::Add(origin, way);
                // The sum and the difference are off by u of their results.
                const V off = hn::MulAdd(hn::Abs(end), hn::Set(d, 0x1p-23F),
                                         hn::Mul(hn::Abs(hn::Sub(end, hn::Set(d, focus[static_cast<int>(axis)]))),
                                                 hn::Set(d, 1 + 0x1p-20F)));
                if (!hn::AllTrue(d, hn::Le(off, hn::Set(d, std::numeric_limits<float>::max())))) {
                    return false;
                }
                largest = hn::Max(largest, off);
                hn::Store(hn::Neg(way), d, direction_[axis] + lane);
            }
            deviation[static_cast<int>(axis)] = hn::GetLane(hn::MaxOfLanes(d, largest)) + kTiny;
        }
        for (size_t lane = 0; lane < kRays; lane += kLanes) {
            if (!hn::AllTrue(d, hn::Le(hn::Load(d, t_max_ + lane), hn::Set(d, 1.0F)))) {
                return false;
            }
        }
        is_reversed_ = true;
        return set_up_around(focus, deviation);
    }

    /// A direction, by its signs and by which of its components is the largest.
    struct Way {
        Vec3f towards;
        int x, y, z;

        HWY_INLINE explicit Way(Vec3f direction) : towards(direction) {
            const Axes axes(direction);
            x = static_cast<int>(axes.x);
            y = static_cast<int>(axes.y);
            z = static_cast<int>(axes.z);
        }
    };

    /// Which of the rays from `lane` on run that way, and are rays: what is none would take hits from those beside it.
    HWY_INLINE hn::Mask<D> runs(const Way& way, size_t lane) const {
        const V zero = hn::Zero(d);
        const V along[3] = {hn::Load(d, direction_[0] + lane), hn::Load(d, direction_[1] + lane),
                            hn::Load(d, direction_[2] + lane)};
        const auto turns = [&](int axis) {
            return way.towards[axis] < 0 ? hn::Ge(along[axis], zero) : hn::Lt(along[axis], zero);
        };
        const auto any_turns = hn::Or(turns(0), hn::Or(turns(1), turns(2)));
        const V size = hn::Abs(hn::Load(d, direction_[way.z] + lane));
        const auto is_steep = hn::And(hn::Ge(size, largest_of(along)), hn::Gt(size, zero));
        // Not equal to itself where the direction has an infinite component or a NaN, or t is NaN.
        const V all = hn::MulAdd(hn::Add(along[0], hn::Add(along[1], along[2])), zero,
                                 hn::Add(hn::Load(d, t_min_ + lane), hn::Load(d, t_max_ + lane)));
        return hn::AndNot(any_turns, hn::And(is_steep, hn::Eq(all, all)));
    }

    HWY_INLINE bool set_up_around(Vec3f focus, Vec3f deviation) {
        has_focus_ = true;
        const Way way(direction_of(0));
        for (size_t lane = 0; lane < kRays; lane += kLanes) {
            if (!hn::AllTrue(d, runs(way, lane))) {
                return false;
            }
        }
        const Slabs slabs(*this, focus, deviation);
        set_up_bounds(slabs, way);
        set_up_box_depths(way.z, deviation[way.z]);
        stacked_ = visit_node(0, 0);
        if (stacked_ == 0) {
            return true;
        }
        set_up_boxes(slabs, way);
        set_up_depths(way.z);
        return set_up_view(way, focus, deviation);
    }

    /// Where rays meet planes, given how steep they are.
    struct Slabs {
        float extent;
        V farthest;
        Vec3f focus;
        Vec3f deviation;

        HWY_INLINE Slabs(const Packet& packet, Vec3f f, Vec3f off)
            : extent(packet.extent_), farthest(hn::Set(d, extent + largest_of(f))), focus(f), deviation(off) {}

        HWY_INLINE Slab<V> slab(const Way& way, int axis, V steepness) const {
            const auto negative = hn::Lt(hn::Set(d, way.towards[axis]), hn::Zero(d));
            return Slab<V>(hn::Set(d, focus[axis]), steepness, negative, extent, farthest, hn::Set(d, deviation[axis]));
        }
    };

    /// For the two rays that bound the others. Leaves how steep each is.
    HWY_INLINE void set_up_bounds(const Slabs& slabs, const Way& way) {
        octant_ = 0;
        for (int axis = 0; axis < 3; ++axis) {
            const bool is_negative = way.towards[axis] < 0;
            octant_ |= is_negative ? 1U << axis : 0U;
            const auto planes = static_cast<uint32_t>(axis * WideNode::kWidth);
            near_planes_[axis] = planes + (is_negative ? 3 * WideNode::kWidth : 0);
            far_planes_[axis] = planes + (is_negative ? 0 : 3 * WideNode::kWidth);
            V least = hn::Set(d, kInfinity);
            V most = hn::Zero(d);
            for (size_t lane = 0; lane < kRays; lane += kLanes) {
                const V largest = hn::Abs(hn::Load(d, direction_[way.z] + lane));
                const V own =
                    hn::Max(hn::Abs(hn::Load(d, direction_[axis] + lane)), hn::Mul(largest, hn::Set(d, 0x1p-25F)));
                const V steepness = axis == way.z ? hn::Set(d, 1.0F) : hn::Div(largest, own);
                least = hn::Min(least, steepness);
                most = hn::Max(most, steepness);
                hn::Store(steepness, d, inverse_[axis] + lane);
            }
            const V ends[2] = {hn::MinOfLanes(d, least), hn::MaxOfLanes(d, most)};
            for (size_t end = 0; end < 2; ++end) {
                const Slab<V> slab = slabs.slab(way, axis, ends[end]);
                bound_inverse_[axis][end] = hn::GetLane(slab.inverse);
                bound_near_[axis][end] = hn::GetLane(slab.near_shift);
                bound_far_[axis][end] = hn::GetLane(slab.far_shift);
            }
        }
    }

    /// For each ray, by how steep it is.
    HWY_INLINE void set_up_boxes(const Slabs& slabs, const Way& way) {
        for (int axis = 0; axis < 3; ++axis) {
            for (size_t lane = 0; lane < kRays; lane += kLanes) {
                const Slab<V> slab = slabs.slab(way, axis, hn::Load(d, inverse_[axis] + lane));
                hn::Store(slab.inverse, d, inverse_[axis] + lane);
                hn::Store(slab.near_shift, d, near_shift_[axis] + lane);
                hn::Store(slab.far_shift, d, far_shift_[axis] + lane);
            }
        }
    }

    HWY_INLINE DepthLimits<V> limits_of(int kz, size_t lane) const {
        return DepthLimits<V>(hn::Load(d, t_min_ + lane), hn::Load(d, t_max_ + lane),
                              hn::Abs(hn::Load(d, direction_[kz] + lane)));
    }

    /// The depths at which boxes count, seen from the focus. No ray has hit anything.
    HWY_INLINE void set_up_box_depths(int kz, float deviation) {
        V least = hn::Set(d, kInfinity);
        for (size_t lane = 0; lane < kRays; lane += kLanes) {
            const DepthLimits<V> limits = limits_of(kz, lane);
            V box_start = limits.start;
            V box_reach = limits.reach;
            if (is_reversed_) {
                const V size = hn::Abs(hn::Load(d, direction_[kz] + lane));
                const V one = hn::Set(d, 1.0F);
                const V room = hn::MulAdd(size, hn::Set(d, 0x1p-21F), hn::Set(d, deviation));
                box_start = hn::Sub(hn::Mul(hn::Sub(one, hn::Load(d, t_max_ + lane)), size), room);
                box_reach = hn::MulAdd(hn::Sub(one, hn::Load(d, t_min_ + lane)), size, room);
            }
            hn::Store(box_start, d, box_start_ + lane);
            hn::Store(box_reach, d, box_reach_ + lane);
            hn::Store(hn::Set(du, kNoPlace), du, place_ + lane);
            hn::Store(hn::Set(du, kNoTriangle), du, triangle_ + lane);
            least = hn::Min(least, box_start);
        }
        entry_ = hn::GetLane(hn::MinOfLanes(d, least));
        update_reach();
    }

    /// The depths at which triangles count, seen from each origin.
    HWY_INLINE void set_up_depths(int kz) {
        for (size_t lane = 0; lane < kRays; lane += kLanes) {
            const DepthLimits<V> limits = limits_of(kz, lane);
            hn::Store(limits.start, d, start_ + lane);
            hn::Store(limits.reach, d, reaches_ + lane);
            hn::Store(limits.sure_start, d, sure_start_ + lane);
            hn::Store(limits.sure_end, d, sure_before_ + lane);
        }
    }

    /// From the focus towards triangles, along all rays; false if they differ too much.
    HWY_INLINE bool set_up_view(const Way& way, Vec3f focus, Vec3f deviation) {
        V widest_x = hn::Zero(d);
        V widest_y = hn::Zero(d);
        for (size_t lane = 0; lane < kRays; lane += kLanes) {
            const V dz = hn::Load(d, direction_[way.z] + lane);
            const V sx = hn::Div(hn::Load(d, direction_[way.x] + lane), dz);
            const V sy = hn::Div(hn::Load(d, direction_[way.y] + lane), dz);
            hn::Store(sx, d, own_slope_x_ + lane);
            hn::Store(sy, d, own_slope_y_ + lane);
            hn::Store(hn::MulAdd(hn::Max(hn::Abs(sx), hn::Abs(sy)), hn::Set(d, 0x1p-24F), hn::Set(d, 0x1p-88F)), d,
                      slant_ + lane);
        }
        focus_.slope_x = 0.5F * (own_slope_x_[0] + own_slope_x_[kRays - 1]);
        focus_.slope_y = 0.5F * (own_slope_y_[0] + own_slope_y_[kRays - 1]);
        for (size_t lane = 0; lane < kRays; lane += kLanes) {
            const V off_x = hn::Sub(hn::Load(d, own_slope_x_ + lane), hn::Set(d, focus_.slope_x));
            const V off_y = hn::Sub(hn::Load(d, own_slope_y_ + lane), hn::Set(d, focus_.slope_y));
            widest_x = hn::Max(widest_x, hn::Abs(off_x));
            widest_y = hn::Max(widest_y, hn::Abs(off_y));
            hn::Store(off_x, d, off_x_ + lane);
            hn::Store(off_y, d, off_y_ + lane);
        }
        focus_.spread_x = hn::GetLane(hn::MaxOfLanes(d, widest_x)) * (1 + 0x1p-20F) + 0x1p-22F;
        focus_.spread_y = hn::GetLane(hn::MaxOfLanes(d, widest_y)) * (1 + 0x1p-20F) + 0x1p-22F;
        if (focus_.spread_x > kWidest || focus_.spread_y > kWidest) {
            return false;
        }
        focus_.x = static_cast<uint32_t>(way.x) * kBlockSize;
        focus_.y = static_cast<uint32_t>(way.y) * kBlockSize;
        focus_.z = static_cast<uint32_t>(way.z) * kBlockSize;
        focus_.at_x = focus[way.x];
        focus_.at_y = focus[way.y];
        focus_.at_z = focus[way.z];
        focus_.set_errors(deviation.x + deviation.y + deviation.z);
        focus_.sign = way.towards[way.z] < 0 ? -1.0F : 1.0F;
        return true;
    }

    HWY_INLINE void update_reach() {
        V most = hn::Set(d, -1.0F);
        for (size_t lane = 0; lane < kRays; lane += kLanes) {
            most = hn::Max(most, hn::Load(d, box_reach_ + lane));
        }
        reach_ = hn::GetLane(hn::MaxOfLanes(d, most));
    }

    /// Stacks the children that some ray may meet; returns their number.
    HWY_INLINE size_t visit_node(uint32_t index, size_t stacked) {
        const WideNode& node = nodes_[index];
        const hn::CappedTag<float, WideNode::kWidth> d8;
        const hn::RebindToUnsigned<decltype(d8)> du8;
        constexpr size_t kHere = hn::MaxLanes(hn::CappedTag<float, WideNode::kWidth>());
        const float* planes = node.lower[0];
        alignas(32) float entries[WideNode::kWidth];
        uint32_t met = 0;
        for (size_t first = 0; first < WideNode::kWidth; first += kHere) {
            auto entry = hn::Set(d8, entry_);
            auto exit = hn::Set(d8, reach_);
            for (int axis = 0; axis < 3; ++axis) {
                const auto near = hn::Load(d8, planes + near_planes_[axis] + first);
                const auto far = hn::Load(d8, planes + far_planes_[axis] + first);
                const auto in0 =
                    hn::MulAdd(near, hn::Set(d8, bound_inverse_[axis][0]), hn::Set(d8, bound_near_[axis][0]));
                const auto in1 =
                    hn::MulAdd(near, hn::Set(d8, bound_inverse_[axis][1]), hn::Set(d8, bound_near_[axis][1]));
                const auto out0 =
                    hn::MulAdd(far, hn::Set(d8, bound_inverse_[axis][0]), hn::Set(d8, bound_far_[axis][0]));
                const auto out1 =
                    hn::MulAdd(far, hn::Set(d8, bound_inverse_[axis][1]), hn::Set(d8, bound_far_[axis][1]));
                entry = hn::Max(hn::Min(in0, in1), entry);
                exit = hn::Min(hn::Max(out0, out1), exit);
            }
            const auto meets = BoxSpan<decltype(entry)>{entry, exit}.meets();
#if HWY_TARGET != HWY_SSE4 && HWY_TARGET != HWY_NEON
            const auto ranks = hn::Shr(hn::Set(du8, node.order[octant_]), hn::Mul(hn::Iota(du8, 0), hn::Set(du8, 3)));
            const auto slots = hn::And(ranks, hn::Set(du8, 7));
            const auto depth =
                hn::TableLookupLanes(hn::IfThenElse(meets, entry, hn::Inf(d8)), hn::IndicesFromVec(d8, slots));
            const auto pushed = hn::Lt(depth, hn::Inf(d8));
            const auto place = hn::Add(slots, hn::Set(du8, index * WideNode::kWidth));
            return compress_pair(d8, pushed, place, places_ + stacked, depth, depths_ + stacked);
        }
#else
            hn::Store(entry, d8, entries + first);
            met |= mask_bits(d8, meets) << first;
        }
        (void)du8;
        size_t count = 0;
        uint32_t order = node.order[octant_];
        for (int i = 0; i < WideNode::kWidth; ++i, order >>= 3) {
            const uint32_t slot = order & 7U;
            places_[stacked + count] = index * WideNode::kWidth + slot;
            depths_[stacked + count] = entries[slot];
            count += met >> slot & 1U;
        }
        return count;
#endif
        (void)entries, (void)met;
        return 0;
    }

    /// A node, or the first two blocks of a leaf.
    HWY_INLINE void prefetch(uint32_t place) const {
        const uint32_t child = nodes_[place / WideNode::kWidth].child[place % WideNode::kWidth];
        if ((child & WideNode::kLeafFlag) != 0) {
            prefetch_lines<2 * sizeof(TriangleBlock) / 64>(blocks_ + WideNode::first_block(child));
        } else {
            prefetch_lines<sizeof(WideNode) / 64>(nodes_ + child);
        }
    }

    /// Whether any ray enters the box of a node's child.
    HWY_INLINE bool any_enters(uint32_t place) const {
        const float* planes = nodes_[place / WideNode::kWidth].lower[0] + place % WideNode::kWidth;
        for (size_t lane = 0; lane < kRays; lane += kLanes) {
            BoxSpan<V> span{hn::Load(d, box_start_ + lane), hn::Load(d, box_reach_ + lane)};
            for (int axis = 0; axis < 3; ++axis) {
                span.cut(hn::Set(d, planes[near_planes_[axis]]), hn::Set(d, planes[far_planes_[axis]]),
                         hn::Load(d, inverse_[axis] + lane), hn::Load(d, near_shift_[axis] + lane),
                         hn::Load(d, far_shift_[axis] + lane));
            }
            if (!hn::AllFalse(d, span.meets())) {
                return true;
            }
        }
        return false;
    }

    /// Tests the triangles of a block, or of two, that are not wholly beside the packet.
    HWY_INLINE void visit_blocks(uint32_t index, uint32_t second) {
        View view;
        uint32_t reached = view.look(focus_, BlockLoader(blocks_ + index, second), entry_, reach_);
        reached &= (1U << (kBlockSize * (1 + second))) - 1;
        // First which of them are new, and which of those rays meet, without a branch for each: those are hard to
        // foresee.
        uint32_t met[View::kSize];
        uint32_t meeting[View::kSize];
        size_t new_count = 0;
        for (; reached != 0; reached &= reached - 1) {
            met[new_count] = static_cast<uint32_t>(std::countr_zero(reached));
            new_count += mailboxes_.is_new(triangle_at(blocks_, index * kBlockSize + met[new_count]));
        }
        size_t count = 0;
        for (size_t i = 0; i < new_count; ++i) {
            met[count] = met[i];
            meeting[count] = rays_meeting(view, met[i]);
            count += meeting[count] != 0 ? 1 : 0;
        }
        bool taken = false;
        for (size_t i = 0; i < count; ++i) {
            const uint32_t place = index * kBlockSize + met[i];
            for (size_t lane = 0; lane < kRays; lane += kLanes) {
                if ((meeting[i] >> lane & kLaneBits) == 0) {
                    continue;
                }
                taken |= kAnyHit && is_reversed_ ? test_from_origins(lane, place)
                                                 : test_from_focus(view, met[i], lane, place);
            }
        }
        if (taken) {
            update_reach();
        }
    }

    HWY_INLINE void sides_from_focus(const View& view, uint32_t triangle, size_t lane, V (&side)[3]) const {
        view.sides(d, triangle, hn::Load(d, off_x_ + lane), hn::Load(d, off_y_ + lane), side);
    }

    HWY_INLINE hn::Mask<D> may_meet(const V (&side)[3], V bound, size_t lane) const {
        const auto inside = hn::Ge(depth_inside(side), hn::Neg(bound));
        return kAnyHit ? hn::And(inside, hn::Ge(hn::Load(d, reaches_ + lane), hn::Zero(d))) : inside;
    }

    /// The rays, a bit each, that may meet a triangle.
    HWY_INLINE uint32_t rays_meeting(const View& view, uint32_t triangle) const {
        uint32_t meeting = 0;
        for (size_t lane = 0; lane < kRays; lane += kLanes) {
            V side[3];
            sides_from_focus(view, triangle, lane, side);
            meeting |= mask_bits(d, may_meet(side, hn::Set(d, view.bound[triangle]), lane)) << lane;
        }
        return meeting;
    }

    HWY_INLINE bool test_from_focus(const View& view, uint32_t triangle, size_t lane, uint32_t place) {
        V side[3];
        sides_from_focus(view, triangle, lane, side);
        const V bound = hn::Set(d, view.bound[triangle]);
        const auto inside = may_meet(side, bound, lane);
        // Where the view from the packet's middle is too coarse for one of the rays, their own are finer.
        const V det = hn::Add(side[0], hn::Add(side[1], side[2]));
        const auto is_clear =
            hn::And(hn::Gt(depth_inside(side), bound), hn::Ge(hn::Abs(det), hn::Mul(bound, hn::Set(d, 64))));
        if (kExact && !hn::AllFalse(d, hn::AndNot(is_clear, inside))) {
            return test_from_origins(lane, place);
        }
        // As depth_range has it, but all that counts is sound, and much of it the same for all rays.
        const float r1 = view.depth[1][triangle];
        const float r2 = view.depth[2][triangle];
        const V inverse = hn::Div(hn::Set(d, 1), det);
        const V depth = depth_of(side, inverse, hn::Set(d, view.depth[0][triangle]), hn::Set(d, r1), hn::Set(d, r2));
        V error = hn::Zero(d);
        if constexpr (kExact) {
            error = hn::MulAdd(hn::Mul(bound, hn::Abs(inverse)),
                               hn::Set(d, kErrorOfWeights * std::max(std::abs(r1), std::abs(r2))),
                               hn::Set(d, kErrorOfRounding * view.size[triangle] + kTiny));
        }
        return take(lane, hn::Sub(depth, error), hn::Add(depth, error), inside, inside, place);
    }

    /// One triangle against each ray from its own origin, as test_blocks has it.
    HWY_INLINE bool test_from_origins(size_t lane, uint32_t place) {
        const float* corners = corners_at(blocks_, place);
        const ShearedRay<V> own{focus_.x,
                                focus_.y,
                                focus_.z,
                                hn::Neg(hn::Load(d, origin_[focus_.x / kBlockSize] + lane)),
                                hn::Neg(hn::Load(d, origin_[focus_.y / kBlockSize] + lane)),
                                hn::Neg(hn::Load(d, origin_[focus_.z / kBlockSize] + lane)),
                                hn::Load(d, own_slope_x_ + lane),
                                hn::Load(d, own_slope_y_ + lane),
                                hn::Load(d, slant_ + lane)};
        const Sheared<V> seen(own,
                              [&](size_t k, uint32_t axis) { return hn::Set(d, corners[k * 3 * kBlockSize + axis]); });
        const V mz = largest_of(seen.z);
        const V bound = kExact ? hn::Neg(seen.minus_edge_error(own.slant, mz)) : hn::Zero(d);
        const V inwards = depth_inside(seen.side);
        const auto inside = hn::And(hn::Ge(inwards, hn::Neg(bound)), hn::Ge(hn::Load(d, reaches_ + lane), hn::Zero(d)));
        if (hn::AllFalse(d, inside)) {
            return false;
        }
        const V(&z)[3] = seen.z;
        const DepthRange<V> range = depth_range<kExact>(seen.side, bound, mz, z[0], hn::Sub(z[1], z[0]),
                                                        hn::Sub(z[2], z[0]), is_reversed_ ? -focus_.sign : focus_.sign);
        const auto certain = kExact ? hn::And(range.is_sound, hn::Gt(inwards, bound)) : inside;
        return take(lane, range.lower, range.upper, inside, certain, place);
    }

    /// Takes in a triangle, between these depths, for the rays that may meet it and those that meet it for certain, as
    /// Stream does.
    HWY_INLINE bool take(size_t lane, V lower, V upper, hn::Mask<D> inside, hn::Mask<D> certain, uint32_t place) {
        const uint32_t triangle = triangle_at(blocks_, place);
        const V reach = hn::Load(d, reaches_ + lane);
        const V sure_before = hn::Load(d, sure_before_ + lane);
        const auto is_other = hn::Ne(hn::Load(du, triangle_ + lane), hn::Set(du, triangle));
        const auto counts = hn::And(hn::And(inside, hn::RebindMask(d, is_other)),
                                    hn::And(hn::Le(lower, reach), hn::Ge(upper, hn::Load(d, start_ + lane))));
        const auto sure = hn::And(hn::And(counts, certain),
                                  hn::And(hn::Ge(lower, hn::Load(d, sure_start_ + lane)), hn::Lt(upper, sure_before)));
        bool taken = !hn::AllFalse(d, sure);
        if (taken) {
            const auto sure_u = hn::RebindMask(du, sure);
            hn::Store(hn::IfThenElse(sure_u, hn::Set(du, place), hn::Load(du, place_ + lane)), du, place_ + lane);
            hn::Store(hn::IfThenElse(sure_u, hn::Set(du, triangle), hn::Load(du, triangle_ + lane)), du,
                      triangle_ + lane);
            if constexpr (kAnyHit) {
                hn::Store(hn::IfThenElse(sure, hn::Set(d, -1.0F), reach), d, reaches_ + lane);
                hn::Store(hn::IfThenElse(sure, hn::Set(d, -1.0F), hn::Load(d, box_reach_ + lane)), d,
                          box_reach_ + lane);
            } else {
                const V shortened = hn::MulAdd(upper, hn::Set(d, 1 + 0x1p-20F), hn::Set(d, kTiny));
                hn::Store(hn::IfThenElse(sure, lower, sure_before), d, sure_before_ + lane);
                hn::Store(hn::IfThenElse(sure, shortened, reach), d, reaches_ + lane);
                hn::Store(hn::IfThenElse(sure, shortened, reach), d, box_reach_ + lane);
            }
        }
        if constexpr (kExact) {
            const auto open = hn::AndNot(sure, counts);
            if (!hn::AllFalse(d, open)) {
                for (uint32_t rest = mask_bits(d, open); rest != 0; rest &= rest - 1) {
                    taken |= take_open(lane + static_cast<size_t>(std::countr_zero(rest)), triangle, place);
                }
            }
        }
        return taken;
    }

    HWY_NOINLINE bool take_open(size_t lane, uint32_t triangle, uint32_t place) {
        Nearest nearest{place_[lane], 0, 0};
        if (!take_exactly(rays_[lane], blocks_, place, nearest)) {
            return false;
        }
        place_[lane] = place;
        triangle_[lane] = triangle;
        sure_before_[lane] = std::min(sure_before_[lane], nearest.lower);
        reaches_[lane] = kAnyHit ? -1.0F : reach_behind(nearest.upper);
        box_reach_[lane] = reaches_[lane];
        return true;
    }

    const WideNode* nodes_;
    const TriangleBlock* blocks_;
    OnDemand* on_demand_;
    const Ray* rays_ = nullptr;
    float extent_;
    bool has_focus_ = false;
    bool is_reversed_ = false;  ///< the focus is where the rays end
    uint32_t octant_ = 0;
    size_t stacked_ = 0;  ///< children of the root that are to be visited
    uint32_t near_planes_[3], far_planes_[3];
    float bound_inverse_[3][2], bound_near_[3][2], bound_far_[3][2];  ///< of the least and the most steep ray
    float entry_, reach_;                                             ///< no box counts outside these depths
    Focus focus_;
    alignas(64) float direction_[3][kRays];  ///< seen from the focus
    alignas(64) float origin_[3][kRays], t_min_[kRays], t_max_[kRays];
    alignas(64) float inverse_[3][kRays], near_shift_[3][kRays], far_shift_[3][kRays];
    alignas(64) float own_slope_x_[kRays], own_slope_y_[kRays], slant_[kRays], off_x_[kRays], off_y_[kRays];
    alignas(64) float start_[kRays], reaches_[kRays], sure_start_[kRays];
    alignas(64) float sure_before_[kRays];  ///< a hit wholly before this is nearer than any so far, and than t_max
    alignas(64) float box_start_[kRays], box_reach_[kRays];
    alignas(64) uint32_t place_[kRays], triangle_[kRays];
    Mailboxes mailboxes_;
    uint32_t places_[kCapacity];  ///< what is to be visited: node * kWidth + slot of its child
    float depths_[kCapacity];
};

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
