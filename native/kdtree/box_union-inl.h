// SPDX-License-Identifier: GPL-3.0-or-later
// The box around many. Compiled once per instruction set (see build_kernels.cpp).

#if defined(ESPALIER_KDTREE_BOX_UNION_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_KDTREE_BOX_UNION_INL_H_
#undef ESPALIER_KDTREE_BOX_UNION_INL_H_
#else
#define ESPALIER_KDTREE_BOX_UNION_INL_H_
#endif

#include <hwy/highway.h>

#include "geometry/vec.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// The union of boxes, a vector of them at a time.
template <class D>
class BoxUnion {
    using V = hn::Vec<D>;
    using M = hn::Mask<D>;

 public:
    explicit HWY_INLINE BoxUnion(D d) : d_(d) {
        for (int axis = 0; axis < 3; ++axis) {
            lower_[axis] = hn::Inf(d);
            upper_[axis] = hn::Neg(hn::Inf(d));
        }
    }
    HWY_INLINE void extend(int axis, V lower, V upper) {
        lower_[axis] = hn::Min(lower_[axis], lower);
        upper_[axis] = hn::Max(upper_[axis], upper);
    }
    HWY_INLINE void extend(int axis, M which, V lower, V upper) {
        lower_[axis] = hn::IfThenElse(which, hn::Min(lower_[axis], lower), lower_[axis]);
        upper_[axis] = hn::IfThenElse(which, hn::Max(upper_[axis], upper), upper_[axis]);
    }
    HWY_INLINE Box3f box() const {
        Box3f box;
        for (int axis = 0; axis < 3; ++axis) {
            box.lower[axis] = hn::GetLane(hn::MinOfLanes(d_, lower_[axis]));
            box.upper[axis] = hn::GetLane(hn::MaxOfLanes(d_, upper_[axis]));
        }
        return box;
    }

 private:
    D d_;
    V lower_[3];
    V upper_[3];
};

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
