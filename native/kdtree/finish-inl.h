// SPDX-License-Identifier: GPL-3.0-or-later
// The distance and the place of known hits, eight rays at a time in double. Compiled once per instruction set (see
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

#include "kdtree/candidate.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// Rays and the triangles they hit, side by side.
struct alignas(64) FinishBatch {
    static constexpr size_t kSize = 8;
    float origin[3][kSize];
    float direction[3][kSize];
    float corner[3][3][kSize];  ///< [corner][axis][lane]
    float t[kSize];
    float u[kSize];
    float v[kSize];
};

/// Fills in t, u and v; returns the lanes for which double does not suffice. No operation is fused, so that every
/// instruction set takes the same way.
///
/// As in exact_hit.cpp: an edge function is off by less than 2^-49 times the sum of its terms' sizes. Where each
/// outweighs its error and their sum 2^24 times its own, u and v are off by less than 2^-22.9. The error of t adds what
/// those of the weights move it among the corners, and 16 roundings of the largest coordinate along the ray.
HWY_INLINE uint32_t finish_in_double(FinishBatch& batch) {
    const hn::CappedTag<double, FinishBatch::kSize> d;
    const hn::Rebind<float, decltype(d)> df;
    constexpr size_t kLanes = hn::MaxLanes(hn::CappedTag<double, FinishBatch::kSize>());
    using V = hn::Vec<decltype(d)>;
    uint32_t open = 0;
    for (size_t first = 0; first < FinishBatch::kSize; first += kLanes) {
        const auto load = [&](const float* from) { return hn::PromoteTo(d, hn::Load(df, from + first)); };
        V dir[3];
        V p[3][3];
        V edge[3][3];  // opposite corner k
        for (size_t axis = 0; axis < 3; ++axis) {
            const V origin = load(batch.origin[axis]);
            dir[axis] = load(batch.direction[axis]);
            const V corner[3] = {load(batch.corner[0][axis]), load(batch.corner[1][axis]), load(batch.corner[2][axis])};
            for (size_t k = 0; k < 3; ++k) {
                p[k][axis] = hn::Sub(corner[k], origin);
                edge[k][axis] = hn::Sub(corner[(k + 2) % 3], corner[(k + 1) % 3]);
            }
        }
        V side[3];
        V side_error[3];
        for (size_t k = 0; k < 3; ++k) {
            const V(&a)[3] = p[(k + 1) % 3];
            const V(&b)[3] = edge[k];
            V value[3];
            V size[3];
            for (size_t axis = 0; axis < 3; ++axis) {
                const V left = hn::Mul(a[(axis + 1) % 3], b[(axis + 2) % 3]);
                const V right = hn::Mul(a[(axis + 2) % 3], b[(axis + 1) % 3]);
                value[axis] = hn::Mul(dir[axis], hn::Sub(left, right));
                size[axis] = hn::Mul(hn::Abs(dir[axis]), hn::Add(hn::Abs(left), hn::Abs(right)));
            }
            side[k] = hn::Add(hn::Add(value[0], value[1]), value[2]);
            side_error[k] = hn::Mul(hn::Add(hn::Add(size[0], size[1]), size[2]), hn::Set(d, 0x1p-49));
        }
        const V det = hn::Add(hn::Add(side[0], side[1]), side[2]);
        const V error = hn::Add(hn::Add(side_error[0], side_error[1]), side_error[2]);

        const auto x_over_y = hn::Gt(hn::Abs(dir[0]), hn::Abs(dir[1]));
        const V larger = hn::IfThenElse(x_over_y, dir[0], dir[1]);
        const auto is_z = hn::Le(hn::Abs(larger), hn::Abs(dir[2]));
        const V along = hn::IfThenElse(is_z, dir[2], larger);
        V z[3];
        for (size_t k = 0; k < 3; ++k) {
            z[k] = hn::IfThenElse(is_z, p[k][2], hn::IfThenElse(x_over_y, p[k][0], p[k][1]));
        }
        const V spread = hn::Sub(hn::Max(z[0], hn::Max(z[1], z[2])), hn::Min(z[0], hn::Min(z[1], z[2])));
        const V size = hn::Max(hn::Abs(z[0]), hn::Max(hn::Abs(z[1]), hn::Abs(z[2])));
        const V scale = hn::Div(hn::Set(d, 1), hn::Mul(det, along));
        const V per_det = hn::Mul(scale, along);
        const V t =
            hn::Mul(hn::Add(hn::Add(hn::Mul(side[0], z[0]), hn::Mul(side[1], z[1])), hn::Mul(side[2], z[2])), scale);
        // In depth: 1.01 error spread / |det| + 2^-49 size, against 2^-28 of the depth.
        const V depth_error = hn::Add(hn::Mul(hn::Mul(error, hn::Set(d, 1.0625)), hn::Mul(spread, hn::Abs(per_det))),
                                      hn::Mul(size, hn::Set(d, 0x1p-49)));
        const V allowed = hn::Mul(hn::Abs(hn::Mul(t, along)), hn::Set(d, 0x1p-28));
        const auto sides_sure = hn::And(
            hn::And(hn::Gt(hn::Abs(side[0]), side_error[0]), hn::Gt(hn::Abs(side[1]), side_error[1])),
            hn::And(hn::Gt(hn::Abs(side[2]), side_error[2]), hn::Ge(hn::Abs(det), hn::Mul(error, hn::Set(d, 0x1p24)))));
        const auto sure =
            hn::And(sides_sure, hn::And(hn::Le(depth_error, allowed),
                                        hn::Le(hn::Abs(t), hn::Set(d, double{std::numeric_limits<float>::max()}))));
        hn::Store(hn::DemoteTo(df, t), df, batch.t + first);
        hn::Store(hn::DemoteTo(df, hn::Mul(side[1], per_det)), df, batch.u + first);
        hn::Store(hn::DemoteTo(df, hn::Mul(side[2], per_det)), df, batch.v + first);
        uint8_t bits[8] = {};
        hn::StoreMaskBits(d, sure, bits);
        const auto all = (1U << kLanes) - 1;
        open |= (~static_cast<uint32_t>(bits[0]) & all) << first;
    }
    return open;
}

/// The same in float, for the path that does without exactness.
HWY_INLINE void finish_in_float(FinishBatch& batch) {
    const hn::CappedTag<float, FinishBatch::kSize> d;
    constexpr size_t kLanes = hn::MaxLanes(hn::CappedTag<float, FinishBatch::kSize>());
    using V = hn::Vec<decltype(d)>;
    for (size_t first = 0; first < FinishBatch::kSize; first += kLanes) {
        V p[3][3];
        V dir[3];
        for (size_t axis = 0; axis < 3; ++axis) {
            dir[axis] = hn::Load(d, batch.direction[axis] + first);
            for (size_t k = 0; k < 3; ++k) {
                p[k][axis] =
                    hn::Sub(hn::Load(d, batch.corner[k][axis] + first), hn::Load(d, batch.origin[axis] + first));
            }
        }
        const auto side = [&](const V(&a)[3], const V(&b)[3]) {
            V sum = hn::Zero(d);
            for (size_t axis = 0; axis < 3; ++axis) {
                const size_t y = (axis + 1) % 3;
                const size_t z = (axis + 2) % 3;
                sum = hn::MulAdd(dir[axis], hn::MulSub(a[y], b[z], hn::Mul(a[z], b[y])), sum);
            }
            return sum;
        };
        const V u = side(p[2], p[0]);
        const V v = side(p[0], p[1]);
        const V w = side(p[1], p[2]);
        const V inverse = hn::Div(hn::Set(d, 1), hn::Add(u, hn::Add(v, w)));
        V along = hn::Zero(d);
        V square = along;
        for (size_t axis = 0; axis < 3; ++axis) {
            const V point = hn::MulAdd(u, p[1][axis], hn::MulAdd(v, p[2][axis], hn::Mul(w, p[0][axis])));
            along = hn::MulAdd(hn::Mul(point, inverse), dir[axis], along);
            square = hn::MulAdd(dir[axis], dir[axis], square);
        }
        hn::Store(hn::Div(along, square), d, batch.t + first);
        hn::Store(hn::Mul(u, inverse), d, batch.u + first);
        hn::Store(hn::Mul(v, inverse), d, batch.v + first);
    }
}

/// Hits that wait to be finished together.
template <bool kExact>
class FinishQueue {
 public:
    FinishQueue(const TriangleBlock* blocks, std::span<const Ray> rays, std::span<Hit> hits)
        : blocks_(blocks), rays_(rays), hits_(hits) {}

    HWY_INLINE void add(uint32_t ray, uint32_t place) {
        ray_[count_] = ray;
        place_[count_] = place;
        if (++count_ == FinishBatch::kSize) {
            flush();
        }
    }

    HWY_NOINLINE void flush() {
        if (count_ == 0) {
            return;
        }
        FinishBatch batch;
        for (size_t i = 0; i < FinishBatch::kSize; ++i) {
            const size_t from = i < count_ ? i : 0;
            const Ray& ray = rays_[ray_[from]];
            const TriangleBlock& block = blocks_[place_[from] / kBlockSize];
            const uint32_t lane = place_[from] % kBlockSize;
            for (size_t axis = 0; axis < 3; ++axis) {
                batch.origin[axis][i] = ray.origin[static_cast<int>(axis)];
                batch.direction[axis][i] = ray.direction[static_cast<int>(axis)];
                for (size_t k = 0; k < 3; ++k) {
                    batch.corner[k][axis][i] = block.vertex[k][axis][lane];
                }
            }
        }
        uint32_t open = 0;
        if constexpr (kExact) {
            open = finish_in_double(batch);
        } else {
            finish_in_float(batch);
        }
        for (size_t i = 0; i < count_; ++i) {
            const uint32_t ray = ray_[i];
            hits_[ray] = {batch.t[i], batch.u[i], batch.v[i], static_cast<int32_t>(triangle_at(blocks_, place_[i]))};
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
    uint32_t ray_[FinishBatch::kSize];
    uint32_t place_[FinishBatch::kSize];
    size_t count_ = 0;
};

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
