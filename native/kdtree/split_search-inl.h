// SPDX-License-Identifier: GPL-3.0-or-later
// The search for the plane of a node that one thread splits. Compiled once per instruction set (see
// build_kernels.cpp).

#if defined(ESPALIER_KDTREE_SPLIT_SEARCH_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_KDTREE_SPLIT_SEARCH_INL_H_
#undef ESPALIER_KDTREE_SPLIT_SEARCH_INL_H_
#else
#define ESPALIER_KDTREE_SPLIT_SEARCH_INL_H_
#endif

#include <hwy/highway.h>

#include <limits>

#include "kdtree/binning-inl.h"
#include "kdtree/build_kernels.h"
#include "kdtree/event_sweep-inl.h"
#include "kdtree/sah-inl.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// How a node's plane is searched.
class SplitSearch {
 public:
    explicit SplitSearch(const BuildParameters& parameters) : parameters_(parameters) {}

    /// is_counted: the last call was for the same references, in a cell from which it cut empty space.
    Split operator()(const OpenNode& node, const References& references, bool is_counted = false) {
        return parameters_.search == Search::kAllEvents ? sweep_all(node, references)
                                                        : narrow_down(node, references, is_counted);
    }

 private:
    Split sweep_all(const OpenNode& node, const References& references) {
        constexpr float kInfinity = std::numeric_limits<float>::infinity();
        Split best = leaf(node, parameters_);
        if (may_be_split(node, parameters_)) {
            for (int axis = 0; axis < 3; ++axis) {
                sweep_(node, references, parameters_, axis, {-kInfinity, kInfinity}, best);
            }
        }
        return best;
    }

    /// The cheapest plane between slices, then of thinner slices on both sides of it, then the cheapest event on both
    /// sides of that. Around the optimum the cost changes slowly, but jumps at events: many triangles of a scan begin
    /// and end at the same place.
    Split narrow_down(const OpenNode& node, const References& references, bool is_counted) {
        if (!is_counted) {
            counts_ = {};
            count_bins(node, references, node.count, counts_);
        }
        Split split = choose_split(node, counts_, parameters_);
        Interval range;
        if (parameters_.search == Search::kSlices || !finer_range(node, split, range)) {
            return split;
        }
        BinCounts finer{};
        count_bins_along(split.axis, range, references, node.count, finer);
        split = choose_finer_split(node, split, range, finer, parameters_);
        if (parameters_.search == Search::kEvents && node.count <= parameters_.one_thread) {
            const float slice = (range.upper - range.lower) * (1.0F / kSlices);
            sweep_(node, references, parameters_, split.axis, {split.position - slice, split.position + slice}, split);
        }
        return split;
    }

    const BuildParameters& parameters_;
    BinCounts counts_;
    EventSweep sweep_;
};

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
