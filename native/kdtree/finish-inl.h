// SPDX-License-Identifier: GPL-3.0-or-later
// The distance and the place of known hits, in double. Compiled once per instruction set (see traversal.cpp).

#if defined(ESPALIER_KDTREE_FINISH_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_KDTREE_FINISH_INL_H_
#undef ESPALIER_KDTREE_FINISH_INL_H_
#else
#define ESPALIER_KDTREE_FINISH_INL_H_
#endif

#include <hwy/highway.h>

#include <algorithm>
#include <bit>
#include <cstddef>
#include <cstdint>
#include <span>
#include <type_traits>

#include "kdtree/candidate.h"
#include "kdtree/packet-inl.h"
#include "kdtree/traced_ray-inl.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

template <class V>
HWY_INLINE void cross(const V (&a)[3], const V (&b)[3], V (&result)[3]) {
    for (size_t axis = 0; axis < 3; ++axis) {
        const size_t next = (axis + 1) % 3;
        const size_t last = (axis + 2) % 3;
        result[axis] = hn::Sub(hn::Mul(a[next], b[last]), hn::Mul(a[last], b[next]));
    }
}

template <class V>
HWY_INLINE V dot(const V (&a)[3], const V (&b)[3]) {
    return hn::Add(hn::Add(hn::Mul(a[0], b[0]), hn::Mul(a[1], b[1])), hn::Mul(a[2], b[2]));
}

/// Floats as T.
template <class D, class VF>
HWY_INLINE hn::Vec<D> widened(D d, VF v) {
    if constexpr (std::is_same_v<hn::TFromD<D>, double>) {
        return hn::PromoteTo(d, v);
    } else {
        return v;
    }
}

/// What decides where rays from one origin hit a triangle, whatever their direction (Moeller and Trumbore 1997, in
/// another order): with det = d . normal, t = volume / det, u = d . u_normal / det, v = d . v_normal / det.
template <class V>
struct HitEquations {
    V normal[3];
    V u_normal[3];
    V v_normal[3];
    V volume;
    V least_det;  ///< of directions of size 1, for V to suffice; infinite where it does for none

    /// No operation is fused, so that every instruction set takes the same way. With e = 2^-53, D, S, A and B the
    /// largest components of the direction, the first corner as seen from the origin and the two edges from there, det
    /// is off by less than 41 e D A B, the volume by 47 e S A B, and the other products by 41 e D S max(A, B)
    /// (EXACTNESS.md, 12). Float, for the path that does without exactness, is taken as it comes.
    HWY_INLINE HitEquations(const V (&origin)[3], const V (&corner)[3][3]) {
        const hn::DFromV<V> d;
        V seen[3];
        V edge[2][3];
        for (size_t axis = 0; axis < 3; ++axis) {
            seen[axis] = hn::Sub(corner[0][axis], origin[axis]);
            edge[0][axis] = hn::Sub(corner[1][axis], corner[0][axis]);
            edge[1][axis] = hn::Sub(corner[2][axis], corner[0][axis]);
        }
        cross(edge[0], edge[1], normal);
        cross(edge[1], seen, u_normal);
        cross(seen, edge[0], v_normal);
        volume = dot(seen, normal);
        if constexpr (std::is_same_v<hn::TFromV<V>, double>) {
            const V distance = largest_of(seen);
            const V size[2] = {largest_of(edge[0]), largest_of(edge[1])};
            const V area = hn::Mul(size[0], size[1]);
            const V side = hn::Mul(distance, hn::Max(size[0], size[1]));
            const V least = hn::Max(hn::Mul(area, hn::Set(d, 42 * 0x1p-25)), hn::Mul(side, hn::Set(d, 42 * 0x1p-30)));
            const auto is_volume_good =
                hn::Ge(hn::Abs(volume), hn::Mul(hn::Mul(distance, area), hn::Set(d, 48 * 0x1p-25)));
            least_det = hn::IfThenElse(is_volume_good, least, hn::Inf(d));
        }
    }
};

/// Where rays hit, by the equations of what they hit; size: of the largest components of their directions.
template <class VF>
struct Solution {
    VF t;
    VF u;
    VF v;
    uint32_t open = 0;  ///< lanes for which double does not suffice

    template <class V>
    HWY_INLINE Solution(const V (&direction)[3], V size, const HitEquations<V>& equations) {
        const hn::DFromV<V> d;
        const V det = dot(direction, equations.normal);
        const V scale = hn::Div(hn::Set(d, 1), det);
        // Beyond the largest float, t becomes infinite. A zero has no sign: that of the origin's zeros would show in
        // it, and rays of a packet may differ in those.
        t = narrowed(hn::Add(hn::Mul(equations.volume, scale), hn::Zero(d)));
        u = narrowed(hn::Max(hn::Mul(dot(direction, equations.u_normal), scale), hn::Zero(d)));
        v = narrowed(hn::Max(hn::Mul(dot(direction, equations.v_normal), scale), hn::Zero(d)));
        if constexpr (std::is_same_v<hn::TFromV<V>, double>) {
            const auto is_sure = hn::Ge(hn::Abs(det), hn::Mul(equations.least_det, size));
            open = static_cast<uint32_t>(mask_bits(d, hn::Not(is_sure)));
        }
    }

 private:
    template <class V>
    static HWY_INLINE VF narrowed(V value) {
        if constexpr (std::is_same_v<hn::TFromV<V>, double>) {
            return hn::DemoteTo(hn::DFromV<VF>(), value);
        } else {
            return value;
        }
    }
};

/// Hits in columns.
template <size_t kSize>
struct HitColumns {
    alignas(64) float t[kSize];
    alignas(64) float u[kSize];
    alignas(64) float v[kSize];

    /// Of the triangles with these numbers, kNoTriangle where there is none.
    HWY_INLINE void write(const uint32_t* triangles, Hit* hits) const {
        static_assert(sizeof(Hit) == 4 * sizeof(float) && offsetof(Hit, triangle) == 3 * sizeof(float));
        const hn::CappedTag<float, 16> d;
        const hn::RebindToUnsigned<decltype(d)> du;
        for (size_t lane = 0; lane < kSize; lane += hn::Lanes(d)) {
            hn::StoreInterleaved4(hn::Load(d, t + lane), hn::Load(d, u + lane), hn::Load(d, v + lane),
                                  hn::BitCast(d, hn::Load(du, triangles + lane)), d,
                                  reinterpret_cast<float*>(hits + lane));
        }
    }
};

/// Rays and the triangles they hit.
struct alignas(64) FinishBatch : HitColumns<16> {
    static constexpr size_t kSize = 16;
    float origin[kSize][4];     ///< and t_min, which is not needed
    float direction[kSize][4];  ///< and t_max
    float corner[3][3][kSize];  ///< [corner][axis][lane]

    HWY_INLINE void put_ray(size_t lane, const Ray& ray, const TriangleBlock* blocks, uint32_t place) {
        const hn::CappedTag<float, 4> d;
        hn::Store(hn::LoadU(d, &ray.origin.x), d, origin[lane]);
        hn::Store(hn::LoadU(d, &ray.direction.x), d, direction[lane]);
        const float* from = corners_at(blocks, place);
        for (size_t k = 0; k < 3; ++k) {
            for (size_t axis = 0; axis < 3; ++axis) {
                corner[k][axis][lane] = from[(k * 3 + axis) * kBlockSize];
            }
        }
    }

    /// Fills in t, u and v; returns the lanes for which T does not suffice.
    template <class T>
    HWY_INLINE uint32_t finish() {
        const hn::CappedTag<T, kSize> d;
        const hn::Rebind<float, decltype(d)> df;
        constexpr size_t kLanes = hn::MaxLanes(hn::CappedTag<T, kSize>());
        using V = hn::Vec<decltype(d)>;
        uint32_t open = 0;
        for (size_t first = 0; first < kSize; first += kLanes) {
            const auto columns = [&](const float (&rows)[kSize][4], V(&to)[3]) {
                hn::Vec<decltype(df)> column[4];
                hn::LoadInterleaved4(df, rows[first], column[0], column[1], column[2], column[3]);
                for (size_t axis = 0; axis < 3; ++axis) {
                    to[axis] = widened(d, column[axis]);
                }
            };
            V from[3];
            V along[3];
            V triangle[3][3];
            columns(origin, from);
            columns(direction, along);
            for (size_t k = 0; k < 3; ++k) {
                for (size_t axis = 0; axis < 3; ++axis) {
                    triangle[k][axis] = widened(d, hn::Load(df, corner[k][axis] + first));
                }
            }
            const Solution<hn::Vec<decltype(df)>> found(along, largest_of(along), HitEquations<V>(from, triangle));
            hn::Store(found.t, df, t + first);
            hn::Store(found.u, df, u + first);
            hn::Store(found.v, df, v + first);
            open |= found.open << first;
        }
        return open;
    }
};

/// Takes in where rays have hit, and fills their hits in: those of packets that hit few triangles at once, others when
/// sixteen have come together.
template <bool kExact>
class FinishQueue {
 public:
    FinishQueue(const TriangleBlock* blocks, std::span<const Ray> rays, std::span<Hit> hits)
        : blocks_(blocks), rays_(rays), hits_(hits) {}

    /// Writes so many rays down as having missed, from number `first` on. Before they are traced: whether one has hit
    /// cannot be foreseen, and in order they are written faster than one by one as they end.
    HWY_INLINE void begin(uint32_t first, size_t count) {
        for (size_t i = first; i < first + count; ++i) {
            hits_[i] = missed(rays_[i]);
        }
    }

    /// A ray that begin() was called for.
    HWY_INLINE void add(uint32_t ray, uint32_t place) {
        ray_[count_] = ray;
        place_[count_] = place;
        count_ += place != kNoPlace ? 1 : 0;
        if (count_ == FinishBatch::kSize) {
            flush();
        }
    }

    /// The packet's rays, from number `first` on.
    HWY_INLINE void add(uint32_t first, const Packet<false, kExact>& packet) {
        uint32_t places[kFew];
        uint32_t lanes[kFew];
        size_t count = 0;
        uint32_t rest = ~packet.rays_at(kNoPlace);
        static_assert(Packet<false, kExact>::kRays == 32);
        for (; rest != 0 && count < kFew; ++count) {
            places[count] = packet.place(static_cast<size_t>(std::countr_zero(rest)));
            lanes[count] = packet.rays_at(places[count]);
            rest &= ~lanes[count];
        }
        if (rest != 0) {
            begin(first, Packet<false, kExact>::kRays);
            for (uint32_t lane = 0; lane < Packet<false, kExact>::kRays; ++lane) {
                add(first + lane, packet.place(lane));
            }
            return;
        }
        finish_packet(first, packet, {places, count}, {lanes, count});
    }

    HWY_NOINLINE void flush() {
        if (count_ == 0) {
            return;
        }
        for (size_t lane = 0; lane < FinishBatch::kSize; ++lane) {
            const size_t i = lane < count_ ? lane : 0;
            batch_.put_ray(lane, rays_[ray_[i]], blocks_, place_[i]);
        }
        const uint32_t open = batch_.finish<Number>();
        for (size_t i = 0; i < count_; ++i) {
            const uint32_t ray = ray_[i];
            hits_[ray] = {batch_.t[i], batch_.u[i], batch_.v[i], static_cast<int32_t>(triangle_at(blocks_, place_[i]))};
        }
        for (uint32_t rest = open & ((1U << count_) - 1); rest != 0; rest &= rest - 1) {
            const auto i = static_cast<size_t>(std::countr_zero(rest));
            hits_[ray_[i]] = finish_exactly(rays_[ray_[i]], blocks_, place_[i]);
        }
        count_ = 0;
    }

 private:
    using Number = std::conditional_t<kExact, double, float>;
    /// More triangles are not worth their equations being solved for all rays.
    static constexpr size_t kFew = 8;

    HWY_NOINLINE void finish_packet(uint32_t first, const Packet<false, kExact>& packet,
                                    std::span<const uint32_t> places, std::span<const uint32_t> lanes) {
        constexpr size_t kRays = Packet<false, kExact>::kRays;
        const hn::CappedTag<Number, kRays> d;
        const hn::Rebind<float, decltype(d)> df;
        constexpr size_t kLanes = hn::MaxLanes(hn::CappedTag<Number, kRays>());
        using V = hn::Vec<decltype(d)>;
        HitColumns<kRays> columns;
        std::copy_n(packet.t_max(), kRays, columns.t);
        std::fill_n(columns.u, kRays, 0.0F);
        std::fill_n(columns.v, kRays, 0.0F);
        const Vec3f focus = rays_[first].origin;
        const V origin[3] = {hn::Set(d, Number{focus.x}), hn::Set(d, Number{focus.y}), hn::Set(d, Number{focus.z})};
        const size_t main_axis = packet.main_axis();
        uint32_t open = 0;
        for (size_t i = 0; i < places.size(); ++i) {
            const float* from = corners_at(blocks_, places[i]);
            V corner[3][3];
            for (size_t k = 0; k < 3; ++k) {
                for (size_t axis = 0; axis < 3; ++axis) {
                    corner[k][axis] = hn::Set(d, Number{from[(k * 3 + axis) * kBlockSize]});
                }
            }
            const HitEquations<V> equations(origin, corner);
            for (size_t lane = 0; lane < kRays; lane += kLanes) {
                const uint32_t here = lanes[i] >> lane & ((1U << kLanes) - 1);
                if (here != 0) {
                    V direction[3];
                    for (size_t axis = 0; axis < 3; ++axis) {
                        direction[axis] = widened(d, hn::Load(df, packet.direction(axis) + lane));
                    }
                    const Solution<hn::Vec<decltype(df)>> found(direction, hn::Abs(direction[main_axis]), equations);
                    const auto hit = mask_of(df, here);
                    const auto put = [&](hn::Vec<decltype(df)> value, float* to) {
#if HWY_TARGET == HWY_AVX3_DL
                        hn::BlendedStore(value, hit, df, to);
#else
                        // A masked store takes some processors twenty operations.
                        hn::Store(hn::IfThenElse(hit, value, hn::Load(df, to)), df, to);
#endif
                    };
                    put(found.t, columns.t + lane);
                    put(found.u, columns.u + lane);
                    put(found.v, columns.v + lane);
                    open |= (found.open & here) << lane;
                }
            }
        }
        columns.write(packet.triangles(), &hits_[first]);
        for (; open != 0; open &= open - 1) {
            const auto lane = static_cast<uint32_t>(std::countr_zero(open));
            hits_[first + lane] = finish_exactly(rays_[first + lane], blocks_, packet.place(lane));
        }
    }

    const TriangleBlock* blocks_;
    std::span<const Ray> rays_;
    std::span<Hit> hits_;
    FinishBatch batch_;
    uint32_t ray_[FinishBatch::kSize];
    uint32_t place_[FinishBatch::kSize];
    size_t count_ = 0;
};

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
