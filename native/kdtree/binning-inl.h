// SPDX-License-Identifier: GPL-3.0-or-later
// Min-max binning after Shevtsov, Soupikov and Kapustin 2007, section 4: counts of boxes that begin before and end behind each plane.
// Compiled once per instruction set (see build_kernels.cpp).

#if defined(ESPALIER_KDTREE_BINNING_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_KDTREE_BINNING_INL_H_
#undef ESPALIER_KDTREE_BINNING_INL_H_
#else
#define ESPALIER_KDTREE_BINNING_INL_H_
#endif

#include <hwy/highway.h>

#include "kdtree/build_kernels.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// Equal slices of an interval.
struct Slices {
    float origin;
    float scale;  ///< slices per unit, 0 if the interval is too thin to be cut

    Slices(float lower, float upper, int slices) : origin(lower), scale(static_cast<float>(slices) / (upper - lower)) {
        if (!(scale < 0x1p100F)) {
            scale = 0;
        }
    }
};

/// Where plane j of `slices` cuts [lower, upper]; the ends exactly.
inline float slice_position(float lower, float upper, int j, int slices) {
    if (j == 0) {
        return lower;
    }
    return j == slices ? upper : lower + (upper - lower) * (static_cast<float>(j) / static_cast<float>(slices));
}

/// References quantised to slices, a byte each: how many planes they begin and end behind.
constexpr uint32_t kQuantisedChunk = 1024;
struct Quantised {
    alignas(64) uint8_t begin[kQuantisedChunk];
    alignas(64) uint8_t end[kQuantisedChunk];
};

/// begin: the last slice that starts at or before the lower bound. end: the last slice that starts before the upper bound, and not before
/// `begin`, so that a reference that lies in a plane counts behind it. Both at most `last`.
template <class D>
HWY_INLINE void quantise(D df, const float* lower, const float* upper, Slices slices, int last, uint32_t count, Quantised& out) {
    const hn::RebindToSigned<D> di;
    const hn::Rebind<uint8_t, D> d8;
    const auto origin = hn::Set(df, slices.origin);
    const auto scale = hn::Set(df, slices.scale);
    const auto top = hn::Set(di, last);
    const auto one = hn::Set(di, 1);
    for (uint32_t i = 0; i < count; i += static_cast<uint32_t>(hn::Lanes(df))) {
        const auto low = hn::Mul(hn::Sub(hn::LoadU(df, lower + i), origin), scale);
        const auto high = hn::Mul(hn::Sub(hn::LoadU(df, upper + i), origin), scale);
        const auto begin = hn::Min(hn::ConvertTo(di, low), top);
        const auto end = hn::Min(hn::Sub(hn::ConvertTo(di, hn::Ceil(high)), one), top);
        hn::StoreU(hn::DemoteTo(d8, begin), d8, out.begin + i);
        hn::StoreU(hn::DemoteTo(d8, hn::Max(begin, end)), d8, out.end + i);
    }
}

/// Bytes of [values, values + count) below `bound`; count is a multiple of 64.
template <int kPlanes>
HWY_INLINE void count_below(const uint8_t* values, uint32_t count, int first_bound, uint32_t* totals) {
    const hn::ScalableTag<int8_t> d;
    uint32_t below[kPlanes] = {};
    for (uint32_t i = 0; i < count; i += static_cast<uint32_t>(hn::Lanes(d))) {
        const auto v = hn::Load(d, reinterpret_cast<const int8_t*>(values) + i);
        for (int k = 0; k < kPlanes; ++k) {
            below[k] += static_cast<uint32_t>(hn::CountTrue(d, hn::Lt(v, hn::Set(d, static_cast<int8_t>(first_bound + k)))));
        }
    }
    for (int k = 0; k < kPlanes; ++k) {
        totals[k] += below[k];
    }
}

inline void count_bins(const References& references, uint32_t count, const Box3f& tight, int bins, BinCounts& counts) {
    const hn::ScalableTag<float> df;
    constexpr int kGroup = 5;  // planes whose counters stay in registers
    constexpr uint8_t kNever = 127;
    for (int axis = 0; axis < 3; ++axis) {
        const Slices slices(tight.lower[axis], tight.upper[axis], bins);
        if (slices.scale == 0) {
            continue;
        }
        const auto a = static_cast<size_t>(axis);
        for (uint32_t begin = 0; begin < count; begin += kQuantisedChunk) {
            const uint32_t size = std::min(kQuantisedChunk, count - begin);
            const uint32_t padded = (size + 63) / 64 * 64;
            Quantised q;
            quantise(df, references.lower[a] + begin, references.upper[a] + begin, slices, bins - 1, size, q);
            std::fill(q.begin + size, q.begin + padded, kNever);
            std::fill(q.end + size, q.end + padded, kNever);
            uint32_t ends_before[kMaxBins + kGroup] = {};
            uint32_t begins_before[kMaxBins + kGroup] = {};
            for (int j = 1; j < bins; j += kGroup) {
                count_below<kGroup>(q.begin, padded, j, begins_before + j);
                count_below<kGroup>(q.end, padded, j, ends_before + j);
            }
            for (int j = 1; j < bins; ++j) {
                counts.left[axis][j] += begins_before[j];
                counts.right[axis][j] += size - ends_before[j];
            }
        }
    }
}

/// Expected blocks of a node that is split further: whole blocks where it will soon be a leaf.
HWY_INLINE float expected_blocks(uint32_t count) {
    return count <= kSmallNode ? static_cast<float>(block_count(count)) : static_cast<float>(count) * (1.0F / kBlockSize);
}

/// A node's shape in units of its longest side, so that areas neither overflow nor vanish.
struct CellShape {
    float scale;        ///< 1 / longest side
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
    /// Area of the part with this extent along the axis, relative to the whole.
    float relative_area(int axis, float extent) const {
        const float b = side[(axis + 1) % 3];
        const float c = side[(axis + 2) % 3];
        return (b * c + extent * scale * (b + c)) * inverse_area;
    }
};

inline Split choose_split(const OpenNode& node, const BinCounts& counts, const BuildParameters& parameters) {
    const CellShape shape(node.cell);
    Split best;
    if (node.depth >= parameters.sah.max_depth || !shape.is_splittable()) {
        return best;
    }
    const auto traversal = static_cast<float>(parameters.sah.traversal);
    const auto block = static_cast<float>(parameters.sah.block);
    const auto bonus = static_cast<float>(parameters.sah.empty_bonus);
    float best_cost = block * expected_blocks(node.count);
    for (int axis = 0; axis < 3; ++axis) {
        const float lower = node.tight.lower[axis];
        const float upper = node.tight.upper[axis];
        if (Slices(lower, upper, parameters.bins).scale == 0) {
            continue;
        }
        for (int j = 0; j <= parameters.bins; ++j) {
            const float position = slice_position(lower, upper, j, parameters.bins);
            const uint32_t left = j == 0 ? 0 : j == parameters.bins ? node.count : counts.left[axis][j];
            const uint32_t right = j == 0 ? node.count : j == parameters.bins ? 0 : counts.right[axis][j];
            const bool inside = node.cell.lower[axis] < position && position < node.cell.upper[axis];
            const bool affordable = uint64_t{left} + right <= node.count + node.spare;
            const float left_area = shape.relative_area(axis, position - node.cell.lower[axis]);
            const float right_area = shape.relative_area(axis, node.cell.upper[axis] - position);
            float children = block * (left_area * expected_blocks(left) + right_area * expected_blocks(right));
            if (left == 0 || right == 0) {
                children *= bonus;
            }
            const float cost = traversal + children;
            if (inside && affordable && cost < best_cost) {
                best_cost = cost;
                best = {axis, position};
            }
        }
    }
    return best;
}

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
