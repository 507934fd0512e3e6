// SPDX-License-Identifier: GPL-3.0-or-later
// The distance and the place of known hits, sixteen rays at a time in double. Compiled once per instruction set (see
// traversal.cpp).

#if defined(ESPALIER_KDTREE_FINISH_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_KDTREE_FINISH_INL_H_
#undef ESPALIER_KDTREE_FINISH_INL_H_
#else
#define ESPALIER_KDTREE_FINISH_INL_H_
#endif

#include <hwy/highway.h>

#include <bit>
#include <cstdint>
#include <span>
#include <type_traits>

#include "kdtree/candidate.h"
#include "kdtree/ray_batch-inl.h"
#include "kdtree/traced_ray-inl.h"
#include "kdtree/triangle_test-inl.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// Rays and the triangles they hit.
struct alignas(64) FinishBatch {
    static constexpr size_t kSize = 16;
    float origin[kSize][4];     ///< and t_min, which is not needed
    float direction[kSize][4];  ///< and t_max
    float corner[3][3][kSize];  ///< [corner][axis][lane]
    float t[kSize];
    float u[kSize];
    float v[kSize];

    HWY_INLINE void put(size_t lane, const Ray& ray, const TriangleBlock* blocks, uint32_t place) {
        const hn::CappedTag<float, 4> d;
        hn::Store(hn::LoadU(d, &ray.origin.x), d, origin[lane]);
        hn::Store(hn::LoadU(d, &ray.direction.x), d, direction[lane]);
        const float* from = blocks[place / kBlockSize].vertex[0][0] + place % kBlockSize;
        for (size_t k = 0; k < 3; ++k) {
            for (size_t axis = 0; axis < 3; ++axis) {
                corner[k][axis][lane] = from[(k * 3 + axis) * kBlockSize];
            }
        }
    }
};

/// Fills in t, u and v; returns the lanes for which T does not suffice. No operation is fused, so that every
/// instruction set takes the same way.
///
/// Sheared as in the float filter, but in double, and times the direction's z, which saves a division. With e = 2^-53
/// and m = mz |direction z|, an edge function is then off by less than e s (4.25 s + 8.5 m) = bound (EXACTNESS.md, 12).
/// Errors of the weights move the depth by less than 3.25 bound / |det| times what the corners lie apart, at most 2 mz,
/// and other roundings by 2^-49 mz. Float, for the path that does without exactness, is taken as it comes.
template <class T>
HWY_INLINE uint32_t finish(FinishBatch& batch) {
    constexpr bool kExact = sizeof(T) == sizeof(double);
    const hn::CappedTag<T, FinishBatch::kSize> d;
    const hn::Rebind<float, decltype(d)> df;
    constexpr size_t kLanes = hn::MaxLanes(hn::CappedTag<T, FinishBatch::kSize>());
    using V = hn::Vec<decltype(d)>;
    using VF = hn::Vec<decltype(df)>;
    uint32_t open = 0;
    for (size_t first = 0; first < FinishBatch::kSize; first += kLanes) {
        VF unused;
        VF origin[3];
        VF direction[3];
        hn::LoadInterleaved4(df, batch.origin[first], origin[0], origin[1], origin[2], unused);
        hn::LoadInterleaved4(df, batch.direction[first], direction[0], direction[1], direction[2], unused);
        const LaneAxes<VF> axes(direction);
        const auto permute = [&](const VF(&from)[3], V(&to)[3]) {
            for (size_t axis = 0; axis < 3; ++axis) {
                if constexpr (kExact) {
                    to[axis] = hn::PromoteTo(d, axes.pick(from, axis));
                } else {
                    to[axis] = axes.pick(from, axis);
                }
            }
        };
        V from[3];
        V along[3];
        permute(origin, from);
        permute(direction, along);
        const auto store = [&](V value, float* to) {
            if constexpr (kExact) {
                hn::Store(hn::DemoteTo(df, value), df, to + first);
            } else {
                hn::Store(value, d, to + first);
            }
        };
        V z[3];
        V across[2][3];
        for (size_t k = 0; k < 3; ++k) {
            const VF given[3] = {hn::Load(df, batch.corner[k][0] + first), hn::Load(df, batch.corner[k][1] + first),
                                 hn::Load(df, batch.corner[k][2] + first)};
            V corner[3];
            permute(given, corner);
            z[k] = hn::Sub(corner[2], from[2]);
            for (size_t axis = 0; axis < 2; ++axis) {
                const V seen = hn::Sub(corner[axis], from[axis]);
                across[axis][k] = hn::Sub(hn::Mul(seen, along[2]), hn::Mul(along[axis], z[k]));
            }
        }
        const V(&x)[3] = across[0];
        const V(&y)[3] = across[1];
        V side[3];
        for (size_t k = 0; k < 3; ++k) {
            const size_t a = (k + 1) % 3;
            const size_t b = (k + 2) % 3;
            side[k] = hn::Sub(hn::Mul(x[b], y[a]), hn::Mul(y[b], x[a]));
        }
        const V det = hn::Add(hn::Add(side[0], side[1]), side[2]);
        const V scale = hn::Div(hn::Set(d, 1), hn::Mul(det, along[2]));
        const V per_det = hn::Mul(scale, along[2]);
        const V depth_sum = hn::Add(hn::Add(hn::Mul(side[0], z[0]), hn::Mul(side[1], z[1])), hn::Mul(side[2], z[2]));
        const V t = hn::Mul(depth_sum, scale);
        if constexpr (kExact) {
            const V mz = largest_of(z);
            const V m = hn::Mul(mz, hn::Abs(along[2]));
            const V s = hn::Add(hn::Add(largest_of(x), largest_of(y)), hn::Mul(m, hn::Set(d, 5.5 * 0x1p-53)));
            const V bound =
                hn::Mul(s, hn::Add(hn::Mul(s, hn::Set(d, 4.25 * 0x1p-53)), hn::Mul(m, hn::Set(d, 8.5 * 0x1p-53))));
            // The depth's error against 2^-28 of it, both times |det|.
            const V error =
                hn::Mul(mz, hn::Add(hn::Mul(bound, hn::Set(d, 6.5)), hn::Mul(hn::Abs(det), hn::Set(d, 0x1p-49))));
            const auto t_sure = hn::And(hn::Le(error, hn::Mul(hn::Abs(depth_sum), hn::Set(d, 0x1p-28))),
                                        hn::Le(hn::Abs(t), hn::Set(d, double{std::numeric_limits<float>::max()})));
            // Follows from that, unless all corners lie at depth 0.
            const auto place_sure = hn::Le(bound, hn::Mul(hn::Abs(det), hn::Set(d, 0x1p-30)));
            const auto sure = hn::And(t_sure, place_sure);
            open |= (~mask_bits(d, sure) & ((1U << kLanes) - 1)) << first;
        }
        store(t, batch.t);
        store(hn::Max(hn::Mul(side[1], per_det), hn::Zero(d)), batch.u);
        store(hn::Max(hn::Mul(side[2], per_det), hn::Zero(d)), batch.v);
    }
    return open;
}

/// Hits that wait to be finished together.
template <bool kExact>
class FinishQueue {
 public:
    FinishQueue(const TriangleBlock* blocks, std::span<const Ray> rays, std::span<Hit> hits)
        : blocks_(blocks), rays_(rays), hits_(hits) {}

    HWY_INLINE void add(uint32_t ray, uint32_t place) {
        // Not as soon as it is full: what was just written lane by lane cannot be read as a vector at once.
        if (count_ == FinishBatch::kSize) {
            flush();
        }
        batch_.put(count_, rays_[ray], blocks_, place);
        ray_[count_] = ray;
        place_[count_] = place;
        ++count_;
    }

    HWY_NOINLINE void flush() {
        if (count_ == 0) {
            return;
        }
        for (size_t lane = count_; lane < FinishBatch::kSize; ++lane) {
            batch_.put(lane, rays_[ray_[0]], blocks_, place_[0]);
        }
        const uint32_t open = finish<std::conditional_t<kExact, double, float>>(batch_);
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
