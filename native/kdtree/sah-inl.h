// SPDX-License-Identifier: GPL-3.0-or-later
// The surface area heuristic, a vector of planes at a time: a step through an inner node against blocks of eight
// triangle tests. Compiled once per instruction set (see build_kernels.cpp).

#if defined(ESPALIER_KDTREE_SAH_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_KDTREE_SAH_INL_H_
#undef ESPALIER_KDTREE_SAH_INL_H_
#else
#define ESPALIER_KDTREE_SAH_INL_H_
#endif

#include <hwy/highway.h>

#include <limits>

#include "kdtree/build_kernels.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// A cell's sides in units of the longest, so that areas neither overflow nor vanish.
struct CellShape {
    float scale;  ///< 1 / longest side
    float inverse_area;
    float side[3];

    explicit CellShape(const Box3f& cell) {
        const Vec3f size = cell.size();
        scale = 1.0F / std::max({size.x, size.y, size.z});
        for (int axis = 0; axis < 3; ++axis) {
            side[axis] = size[axis] * scale;
        }
        inverse_area = 1.0F / (side[0] * side[1] + side[1] * side[2] + side[2] * side[0]);
    }
    bool is_splittable() const { return scale < 0x1p100F; }
};

/// What splits of one cell would cost.
template <class D>
class SplitCosts {
    using V = hn::Vec<D>;

 public:
    HWY_INLINE SplitCosts(D d, const OpenNode& node, const CellShape& shape, const SahConstants& sah)
        : d_(d),
          cell_(node.cell),
          shape_(shape),
          traversal_(static_cast<float>(sah.traversal)),
          block_(static_cast<float>(sah.block)),
          bonus_(static_cast<float>(sah.empty_bonus)) {}

    /// Area of the part of the cell with this extent along the axis, relative to the whole.
    HWY_INLINE V relative_area(int axis, V extent) const {
        const float b = shape_.side[(axis + 1) % 3];
        const float c = shape_.side[(axis + 2) % 3];
        return hn::Mul(
            hn::Add(hn::Set(d_, b * c), hn::Mul(hn::Mul(extent, hn::Set(d_, shape_.scale)), hn::Set(d_, b + c))),
            hn::Set(d_, shape_.inverse_area));
    }

    /// Cost of planes with so many blocks on either side, per ray that meets the cell; infinite outside the cell.
    HWY_INLINE V operator()(int axis, V position, V left_blocks, V right_blocks) const {
        const V lower = hn::Set(d_, cell_.lower[axis]);
        const V upper = hn::Set(d_, cell_.upper[axis]);
        const V children =
            hn::Mul(hn::Set(d_, block_), hn::Add(hn::Mul(relative_area(axis, hn::Sub(position, lower)), left_blocks),
                                                 hn::Mul(relative_area(axis, hn::Sub(upper, position)), right_blocks)));
        const auto one_is_empty = hn::Eq(hn::Min(left_blocks, right_blocks), hn::Zero(d_));
        const V cost = hn::Add(hn::Set(d_, traversal_),
                               hn::IfThenElse(one_is_empty, hn::Mul(children, hn::Set(d_, bonus_)), children));
        return hn::IfThenElse(hn::And(hn::Lt(lower, position), hn::Lt(position, upper)), cost, hn::Inf(d_));
    }

 private:
    D d_;
    const Box3f& cell_;
    const CellShape& shape_;
    float traversal_;
    float block_;
    float bonus_;
};

/// The cheapest of many planes; of equal ones the one with the lowest index, however many a vector holds.
template <class D>
class CheapestPlane {
    using DI = hn::RebindToSigned<D>;

 public:
    HWY_INLINE explicit CheapestPlane(D d) : d_(d), cost_(hn::Inf(d)), index_(hn::Zero(DI())) {}

    HWY_INLINE void offer(int first_index, hn::Vec<D> cost) {
        const auto better = hn::Lt(cost, cost_);
        cost_ = hn::IfThenElse(better, cost, cost_);
        index_ = hn::IfThenElse(hn::RebindMask(DI(), better), hn::Iota(DI(), first_index), index_);
    }
    HWY_INLINE float cost() const { return hn::GetLane(hn::MinOfLanes(d_, cost_)); }
    HWY_INLINE int index() const {
        const auto is_least = hn::Eq(cost_, hn::MinOfLanes(d_, cost_));
        const auto last = hn::Set(DI(), std::numeric_limits<int32_t>::max());
        return hn::GetLane(hn::MinOfLanes(DI(), hn::IfThenElse(hn::RebindMask(DI(), is_least), index_, last)));
    }

 private:
    D d_;
    hn::Vec<D> cost_;
    hn::Vec<DI> index_;
};

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
