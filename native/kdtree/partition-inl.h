// SPDX-License-Identifier: GPL-3.0-or-later
// Stable partition of a node's references by a split plane, with split clipping (Soupikov, Shevtsov and Kapustin 2008)
// of those that straddle it. Compiled once per instruction set (see build_kernels.cpp).

#if defined(ESPALIER_KDTREE_PARTITION_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_KDTREE_PARTITION_INL_H_
#undef ESPALIER_KDTREE_PARTITION_INL_H_
#else
#define ESPALIER_KDTREE_PARTITION_INL_H_
#endif

#include <hwy/highway.h>

#include <bit>

#include "kdtree/box_union-inl.h"
#include "kdtree/build_kernels.h"
#include "kdtree/compress-inl.h"
#include "kdtree/corners-inl.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// References on both sides of the plane, waiting to be clipped: where their two halves were written.
struct Straddlers {
    static constexpr uint32_t kCapacity = 256;
    static constexpr uint32_t kFlushAt = kCapacity - 32;
    uint32_t count = 0;
    alignas(64) uint32_t left[kCapacity];
    alignas(64) uint32_t right[kCapacity];
};

/// Halves that turned out to hold no part of their triangle, in ascending order of position.
struct DroppedHalves {
    std::vector<uint32_t> left;
    std::vector<uint32_t> right;
};

/// Where the edge p-q crosses the plane, on another axis: the true crossing lies in [low, high]. With u = 2^-24, t = (s
/// - p) / (q - p) is off by a factor within 1 +- 3.01 u, the product with the edge by two more roundings, and the sum
/// by one of the result: below 5.1 u |edge| + 1.01 u |crossing|, of which the margin takes more than the double; its
/// last term covers underflow.
template <class D, class V = hn::Vec<D>>
HWY_INLINE void cross_plane(D d, V t, V p, V q, V& low, V& high) {
    const V edge = hn::Sub(q, p);
    const V crossing = hn::Add(p, hn::Mul(t, edge));
    const V margin =
        hn::Add(hn::Add(hn::Mul(hn::Abs(edge), hn::Set(d, 0x1p-20F)), hn::Mul(hn::Abs(crossing), hn::Set(d, 0x1p-22F))),
                hn::Set(d, 0x1p-120F));
    low = hn::Sub(crossing, margin);
    high = hn::Add(crossing, margin);
}

/// Cuts the boxes of both halves of each straddler to what the triangle has on that side of the plane. Every box stays
/// a bound of triangle, node and half-space together, so a half whose box is empty can go.
template <class D>
HWY_INLINE void clip_straddlers(D d, const TriangleSoup& soup, Split split, const References& left,
                                const References& right, Straddlers& straddlers, BoxUnion<D>& left_tight,
                                BoxUnion<D>& right_tight, DroppedHalves& dropped) {
    using V = hn::Vec<D>;
    const hn::RebindToSigned<D> di;
    const auto lanes = static_cast<uint32_t>(hn::Lanes(d));
    const auto plane = hn::Set(d, split.position);
    const auto zero = hn::Zero(d);
    const int a = split.axis;

    // Lanes past the end repeat the last straddler and are not stored.
    for (uint32_t i = straddlers.count; i % lanes != 0; ++i) {
        straddlers.left[i] = straddlers.left[straddlers.count - 1];
        straddlers.right[i] = straddlers.right[straddlers.count - 1];
    }
    for (uint32_t begin = 0; begin < straddlers.count; begin += lanes) {
        const uint32_t active = std::min(lanes, straddlers.count - begin);
        for (uint32_t i = begin + lanes; i < std::min(begin + 2 * lanes, straddlers.count); ++i) {
            prefetch_corner(soup, left.triangle[straddlers.left[i]]);
        }
        const auto at_left = hn::Load(di, reinterpret_cast<const int32_t*>(straddlers.left + begin));
        const auto at_right = hn::Load(di, reinterpret_cast<const int32_t*>(straddlers.right + begin));
        alignas(64) uint32_t triangles[hn::MaxLanes(D())];
        for (uint32_t i = 0; i < lanes; ++i) {
            triangles[i] = left.triangle[straddlers.left[begin + i]];
        }
        V v[3][3];
        load_corners(d, soup, triangles, v);
        hn::Mask<D> on_left[3];
        hn::Mask<D> on_right[3];
        hn::Mask<D> crosses[3];
        V t[3];
        for (int k = 0; k < 3; ++k) {
            on_left[k] = hn::Le(v[k][a], plane);
            on_right[k] = hn::Ge(v[k][a], plane);
        }
        for (int k = 0; k < 3; ++k) {
            const int next = (k + 1) % 3;
            crosses[k] = hn::Or(hn::AndNot(on_right[k], hn::Not(on_left[next])),
                                hn::AndNot(on_left[k], hn::Not(on_right[next])));
            t[k] = hn::Div(hn::Sub(plane, v[k][a]), hn::Sub(v[next][a], v[k][a]));
        }
        const auto stored = hn::FirstN(d, active);
        auto left_empty = hn::Lt(zero, zero);
        auto right_empty = left_empty;
        V cut[2][2][2];  // [axis b or c][left, right][lower, upper]
        for (int other = 0; other < 2; ++other) {
            const int b = (a + 1 + other) % 3;
            const auto bi = static_cast<size_t>(b);
            V left_low = hn::Inf(d);
            V right_low = hn::Inf(d);
            V left_high = hn::Neg(hn::Inf(d));
            V right_high = left_high;
            for (int k = 0; k < 3; ++k) {
                V low;
                V high;
                cross_plane(d, t[k], v[k][b], v[(k + 1) % 3][b], low, high);
                low = hn::IfThenElse(crosses[k], low, hn::Inf(d));
                high = hn::IfThenElse(crosses[k], high, hn::Neg(hn::Inf(d)));
                left_low = hn::Min(left_low, hn::Min(low, hn::IfThenElse(on_left[k], v[k][b], hn::Inf(d))));
                right_low = hn::Min(right_low, hn::Min(low, hn::IfThenElse(on_right[k], v[k][b], hn::Inf(d))));
                left_high = hn::Max(left_high, hn::Max(high, hn::IfThenElse(on_left[k], v[k][b], hn::Neg(hn::Inf(d)))));
                right_high =
                    hn::Max(right_high, hn::Max(high, hn::IfThenElse(on_right[k], v[k][b], hn::Neg(hn::Inf(d)))));
            }
            const V lower = hn::GatherIndex(d, left.lower[bi], at_left);
            const V upper = hn::GatherIndex(d, left.upper[bi], at_left);
            cut[other][0][0] = hn::Add(hn::Max(lower, left_low), zero);
            cut[other][0][1] = hn::Add(hn::Min(upper, left_high), zero);
            cut[other][1][0] = hn::Add(hn::Max(lower, right_low), zero);
            cut[other][1][1] = hn::Add(hn::Min(upper, right_high), zero);
            left_empty = hn::Or(left_empty, hn::Gt(cut[other][0][0], cut[other][0][1]));
            right_empty = hn::Or(right_empty, hn::Gt(cut[other][1][0], cut[other][1][1]));
        }
        const auto keep_left = hn::AndNot(left_empty, stored);
        const auto keep_right = hn::AndNot(right_empty, stored);
        const auto ai = static_cast<size_t>(a);
        left_tight.extend(a, keep_left, hn::GatherIndex(d, left.lower[ai], at_left), plane);
        right_tight.extend(a, keep_right, plane, hn::GatherIndex(d, right.upper[ai], at_right));
        for (int other = 0; other < 2; ++other) {
            const int b = (a + 1 + other) % 3;
            const auto bi = static_cast<size_t>(b);
            left_tight.extend(b, keep_left, cut[other][0][0], cut[other][0][1]);
            right_tight.extend(b, keep_right, cut[other][1][0], cut[other][1][1]);
            alignas(64) float values[2][2][hn::MaxLanes(D())];
            for (int side = 0; side < 2; ++side) {
                for (int end = 0; end < 2; ++end) {
                    hn::Store(cut[other][side][end], d, values[side][end]);
                }
            }
            for (uint32_t i = 0; i < active; ++i) {
                left.lower[bi][straddlers.left[begin + i]] = values[0][0][i];
                left.upper[bi][straddlers.left[begin + i]] = values[0][1][i];
                right.lower[bi][straddlers.right[begin + i]] = values[1][0][i];
                right.upper[bi][straddlers.right[begin + i]] = values[1][1][i];
            }
        }
        if (!hn::AllFalse(d, hn::And(stored, hn::Or(left_empty, right_empty)))) {
            const auto emptied = hn::VecFromMask(d, left_empty);
            const auto emptied_right = hn::VecFromMask(d, right_empty);
            alignas(64) int32_t flags[2][hn::MaxLanes(D())];
            hn::Store(hn::BitCast(di, emptied), di, flags[0]);
            hn::Store(hn::BitCast(di, emptied_right), di, flags[1]);
            for (uint32_t i = 0; i < active; ++i) {
                if (flags[0][i] != 0) {
                    dropped.left.push_back(straddlers.left[begin + i]);
                }
                if (flags[1][i] != 0) {
                    dropped.right.push_back(straddlers.right[begin + i]);
                }
            }
        }
    }
    straddlers.count = 0;
}

/// Closes the gaps at the given positions; returns how many references are left.
inline uint32_t remove_references(const References& references, uint32_t count,
                                  const std::vector<uint32_t>& positions) {
    const auto close_gaps = [&](auto* values) {
        uint32_t to = positions.front();
        for (size_t i = 0; i < positions.size(); ++i) {
            const uint32_t from = positions[i] + 1;
            const uint32_t end = i + 1 < positions.size() ? positions[i + 1] : count;
            std::copy(values + from, values + end, values + to);
            to += end - from;
        }
    };
    for (size_t axis = 0; axis < 3; ++axis) {
        close_gaps(references.lower[axis]);
        close_gaps(references.upper[axis]);
    }
    close_gaps(references.triangle);
    return count - static_cast<uint32_t>(positions.size());
}

/// Appends a whole vector of references to a side that has `count` of them; what is there already is left alone.
template <class D>
HWY_INLINE void append_all(D d, const References& from, const References& to, uint32_t& count, BoxUnion<D>& tight) {
    const hn::RebindToUnsigned<D> du;
    const bool moves = to.triangle + count != from.triangle;
    for (int axis = 0; axis < 3; ++axis) {
        const auto b = static_cast<size_t>(axis);
        const auto lower = hn::LoadU(d, from.lower[b]);
        const auto upper = hn::LoadU(d, from.upper[b]);
        tight.extend(axis, lower, upper);
        if (moves) {
            hn::StoreU(lower, d, to.lower[b] + count);
            hn::StoreU(upper, d, to.upper[b] + count);
        }
    }
    if (moves) {
        hn::StoreU(hn::LoadU(du, from.triangle), du, to.triangle + count);
    }
    count += static_cast<uint32_t>(hn::Lanes(d));
}

inline Partition partition(const TriangleSoup& soup, const References& from, uint32_t count, Split split, bool clip,
                           const References& to_left_side, const References& to_right_side) {
    // Copies, so that the compiler knows that no store changes the pointers.
    const References in = from;
    const References left = to_left_side;
    const References right = to_right_side;
    const hn::ScalableTag<float> d;
    const hn::RebindToUnsigned<decltype(d)> du;
    const auto lanes = static_cast<uint32_t>(hn::Lanes(d));
    const auto plane = hn::Set(d, split.position);
    const auto a = static_cast<size_t>(split.axis);

    BoxUnion left_tight(d);
    BoxUnion right_tight(d);
    Straddlers straddlers;
    DroppedHalves dropped;
    uint32_t left_count = 0;
    uint32_t right_count = 0;
    const auto sort = [&](uint32_t i, uint32_t size, auto store_left) {
        const auto valid = hn::FirstN(d, size);
        const auto begins_before = hn::Lt(hn::LoadU(d, in.lower[a] + i), plane);
        // What lies in the plane goes right.
        const auto to_left = hn::And(valid, begins_before);
        const auto to_right =
            hn::And(valid, hn::Or(hn::Not(begins_before), hn::Gt(hn::LoadU(d, in.upper[a] + i), plane)));
        const auto to_both = hn::And(to_left, to_right);
        const auto tight_left = clip ? hn::AndNot(to_both, to_left) : to_left;
        const auto tight_right = clip ? hn::AndNot(to_both, to_right) : to_right;
        const Compression compress_left(d, to_left);
        const Compression compress_right(d, to_right);
        const uint64_t left_bits = compress_left.bits();
        const uint64_t right_bits = compress_right.bits();
        // References keep the order of the mesh, in which neighbours often lie side by side.
        if (size == lanes && right_bits == 0) {
            append_all(d, in.at(i), left, left_count, left_tight);
            return;
        }
        if (size == lanes && left_bits == 0) {
            append_all(d, in.at(i), right, right_count, right_tight);
            return;
        }
        for (int axis = 0; axis < 3; ++axis) {
            const auto b = static_cast<size_t>(axis);
            const auto lower = hn::LoadU(d, in.lower[b] + i);
            const auto upper = hn::LoadU(d, in.upper[b] + i);
            const auto left_upper = b == a ? hn::Min(upper, plane) : upper;
            const auto right_lower = b == a ? hn::Max(lower, plane) : lower;
            left_tight.extend(axis, tight_left, lower, left_upper);
            right_tight.extend(axis, tight_right, right_lower, upper);
            compress_right.store(d, right_lower, right.lower[b] + right_count);
            compress_right.store(d, upper, right.upper[b] + right_count);
            store_left(compress_left, d, lower, left.lower[b] + left_count);
            store_left(compress_left, d, left_upper, left.upper[b] + left_count);
        }
        const auto triangle = hn::LoadU(du, in.triangle + i);
        compress_right.store(du, triangle, right.triangle + right_count);
        store_left(compress_left, du, triangle, left.triangle + left_count);
        if (clip) {
            for (uint64_t both = left_bits & right_bits; both != 0; both &= both - 1) {
                const uint64_t earlier = (both & -both) - 1;
                straddlers.left[straddlers.count] =
                    left_count + static_cast<uint32_t>(std::popcount(left_bits & earlier));
                straddlers.right[straddlers.count] =
                    right_count + static_cast<uint32_t>(std::popcount(right_bits & earlier));
                prefetch_indices(soup, right.triangle[straddlers.right[straddlers.count]]);
                ++straddlers.count;
            }
        }
        left_count += static_cast<uint32_t>(std::popcount(left_bits));
        right_count += static_cast<uint32_t>(std::popcount(right_bits));
        if (straddlers.count >= Straddlers::kFlushAt) {
            clip_straddlers(d, soup, split, left, right, straddlers, left_tight, right_tight, dropped);
        }
    };
    // Whole vectors may be stored although the left side lies in place: what they write past its end was read before.
    // Only the last, partial one must leave alone what lies behind the node.
    uint32_t i = 0;
    for (; i + lanes <= count; i += lanes) {
        sort(i, lanes, [](const auto& compress, auto tag, auto v, auto* to) { compress.store(tag, v, to); });
    }
    if (i < count) {
        sort(i, count - i, [](const auto& compress, auto tag, auto v, auto* to) {
            const auto size = static_cast<size_t>(std::popcount(compress.bits()));
            hn::BlendedStore(compress(tag, v), hn::FirstN(tag, size), tag, to);
        });
    }
    if (straddlers.count != 0) {
        clip_straddlers(d, soup, split, left, right, straddlers, left_tight, right_tight, dropped);
    }
    if (!dropped.left.empty()) {
        left_count = remove_references(left, left_count, dropped.left);
    }
    if (!dropped.right.empty()) {
        right_count = remove_references(right, right_count, dropped.right);
    }
    return {left_count, right_count, left_tight.box(), right_tight.box()};
}

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
