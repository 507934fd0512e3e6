// SPDX-License-Identifier: GPL-3.0-or-later
// Several levels of a large node at once: planes chosen by a sample of its references, all of which are then sorted by
// the leaves below, chunk by chunk. They go through memory once, not once a level. Compiled once per instruction set
// (see build_kernels.cpp).

#if defined(ESPALIER_KDTREE_MULTIWAY_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_KDTREE_MULTIWAY_INL_H_
#undef ESPALIER_KDTREE_MULTIWAY_INL_H_
#else
#define ESPALIER_KDTREE_MULTIWAY_INL_H_
#endif

#include <hwy/cache_control.h>
#include <hwy/highway.h>

#include <algorithm>
#include <bit>

#include "kdtree/binning-inl.h"
#include "kdtree/bounds-inl.h"
#include "kdtree/build_kernels.h"
#include "kdtree/compress-inl.h"
#include "kdtree/partition-inl.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// Neighbours that are sampled together: a line of the cache, and a vector.
constexpr uint32_t kGroup = 16;

/// Calls take(first) for the groups of a chunk that are its sample: one out of each 2^shift, scattered, since meshes
/// are regular.
template <class F>
HWY_INLINE void for_each_sampled_group(uint32_t count, uint32_t number, uint32_t shift, const F& take) {
    const uint32_t windows = count / kGroup >> shift;
    for (uint32_t window = 0; window < windows; ++window) {
        const uint32_t scattered = (number * (kChunk / kGroup >> shift) + window) * 0x9e3779b1U;
        take(((window << shift) + (scattered >> (32 - shift))) * kGroup);
    }
}

/// Copies the sample of a chunk of a node's references; returns how many those are.
inline uint32_t take_sample(const References& chunk, uint32_t count, uint32_t number, uint32_t shift,
                            const References& to) {
    uint32_t taken = 0;
    for_each_sampled_group(count, number, shift, [&](uint32_t first) {
        copy_references(chunk.at(first), kGroup, to.at(taken));
        taken += kGroup;
    });
    return taken;
}

inline uint32_t sample_faces(const TriangleSoup& soup, uint32_t number, uint32_t shift, const References& to) {
    const uint32_t begin = number * kChunk;
    const uint32_t count = std::min(kChunk, soup.size() - begin);
    uint32_t taken = 0;
    Box3f bounds;
    RejectedFaces rejected;
    for_each_sampled_group(count, number, shift, [&](uint32_t first) {
        taken += make_references(soup, begin + first, begin + first + kGroup, to.at(taken), bounds, rejected);
    });
    return taken;
}

/// The plane of a node of which only a sample is known.
inline Split find_split_by_sample(const OpenNode& node, const References& sample, const BuildParameters& parameters) {
    BinCounts counts{};
    count_bins(node, sample, node.count, counts);
    leave_no_side_empty(counts, node);
    const Split split = choose_split(node, counts, parameters);
    Interval range;
    if (!finer_range(node, split, range)) {
        return split;
    }
    BinCounts finer{};
    count_bins_along(split.axis, range, sample, node.count, finer);
    leave_no_side_empty(finer, node);
    return choose_finer_split(node, split, range, finer, parameters);
}

/// Makes room in a sample's tight box for what is not in the sample, as far as the parent's box and the cell allow.
inline void widen(const OpenNode& parent, OpenNode& child) {
    const Vec3f size = child.tight.size();
    for (int axis = 0; axis < 3; ++axis) {
        const float margin = size[axis] * (1.0F / 64);
        const float least = std::max(parent.tight.lower[axis], child.cell.lower[axis]);
        const float most = std::min(parent.tight.upper[axis], child.cell.upper[axis]);
        child.tight.lower[axis] = std::max(child.tight.lower[axis] - margin, least);
        child.tight.upper[axis] = std::min(child.tight.upper[axis] + margin, most);
    }
}

inline MultiwaySplit choose_multiway_split(const TriangleSoup& soup, const OpenNode& node, const References& sample,
                                           uint32_t count, const BuildParameters& parameters) {
    constexpr uint32_t kMargin = 16;
    struct Leaf {
        OpenNode node;
        size_t begin;
        size_t capacity;
        uint32_t* child;  ///< where its parent has it
        bool is_final;    ///< no plane pays
    };
    MultiwaySplit plan;
    std::array<Leaf, MultiwaySplit::kMostLeaves> leaves;
    const size_t room = size_t{count} + count / 4;
    leaves[0] = {node, 0, room, &plan.root, false};
    leaves[0].node.count = count;
    leaves[0].node.spare = count;
    const References scratch = sample.at(room + kMargin);
    const uint64_t least = uint64_t{kMultiwayLeaf} * count / node.count;
    while (plan.leaves < MultiwaySplit::kMostLeaves) {
        uint32_t largest = 0;
        const auto size = [&](uint32_t leaf) { return leaves[leaf].is_final ? 0 : leaves[leaf].node.count; };
        for (uint32_t leaf = 1; leaf < plan.leaves; ++leaf) {
            largest = size(leaf) > size(largest) ? leaf : largest;
        }
        if (size(largest) <= least) {
            break;
        }
        Leaf& left = leaves[largest];
        Leaf& right = leaves[plan.leaves];
        const References references = sample.at(left.begin);
        const Split split = find_split_by_sample(left.node, references, parameters);
        if (split.axis < 0) {
            left.is_final = true;
            continue;
        }
        const Partition parts =
            partition(soup, references, left.node.count, split, parameters.clip, references, scratch);
        const size_t both = size_t{parts.left_count} + parts.right_count;
        if (both + 2 * kMargin > left.capacity) {
            break;  // where much straddles, references are better split a level at a time
        }
        const size_t free = left.capacity - both - 2 * kMargin;
        const size_t left_capacity = parts.left_count + kMargin + free * parts.left_count / std::max<size_t>(both, 1);
        copy_references(scratch, parts.right_count, references.at(left_capacity));

        const uint32_t number = plan.leaves - 1;
        MultiwaySplit::Branch& branch = plan.branches[number];
        branch = {split, largest, {largest, plan.leaves}};
        *left.child = MultiwaySplit::kMostLeaves + number;
        const OpenNode parent = left.node;
        open_children(parent, split, parts, left.node, right.node);
        widen(parent, left.node);
        widen(parent, right.node);
        right.begin = left.begin + left_capacity;
        right.capacity = left.capacity - left_capacity;
        right.child = &branch.child[1];
        right.is_final = false;
        left.capacity = left_capacity;
        left.child = &branch.child[0];
        ++plan.leaves;
    }
    return plan;
}

/// The union of references' boxes.
inline Box3f bounds(const References& references, uint32_t count) {
    const hn::ScalableTag<float> d;
    const auto lanes = static_cast<uint32_t>(hn::Lanes(d));
    BoxUnion box(d);
    for (uint32_t i = 0; i < count; i += lanes) {
        const auto valid = hn::FirstN(d, count - i);
        for (int axis = 0; axis < 3; ++axis) {
            const auto a = static_cast<size_t>(axis);
            box.extend(axis, valid, hn::LoadU(d, references.lower[a] + i), hn::LoadU(d, references.upper[a] + i));
        }
    }
    return box.box();
}

/// Instead of a leaf's number.
constexpr uint8_t kStraddles = 255;

/// For each reference of a chunk, the leaf it lies in, or kStraddles; those are copied, too. Returns how many they are.
/// The bytes are padded to 64. Memory that will be written next is fetched meanwhile.
inline uint32_t find_leaves(const MultiwaySplit& plan, const References& from, uint32_t count, uint8_t* leaves,
                            const References& to, const References& next) {
    // Copies, so that the compiler knows that no store changes the pointers.
    const References in = from;
    const References straddlers = to;
    const hn::ScalableTag<float> d;
    const hn::RebindToUnsigned<decltype(d)> du;
    const hn::RebindToSigned<decltype(d)> di;
    const hn::Rebind<uint8_t, decltype(d)> d8;
    const auto lanes = static_cast<uint32_t>(hn::Lanes(d));
    uint32_t straddling = 0;
    for (uint32_t i = 0; i < count; i += lanes) {
        for (size_t axis = 0; axis < 3; ++axis) {
            hwy::Prefetch(next.lower[axis] + i);
            hwy::Prefetch(next.upper[axis] + i);
        }
        hwy::Prefetch(next.triangle + i);
        auto leaf = hn::Zero(du);
        auto straddles = hn::Lt(hn::Zero(d), hn::Zero(d));
        for (uint32_t b = 0; b + 1 < plan.leaves; ++b) {
            const MultiwaySplit::Branch& branch = plan.branches[b];
            const auto plane = hn::Set(d, branch.split.position);
            const auto axis = static_cast<size_t>(branch.split.axis);
            const auto is_here = hn::RebindMask(d, hn::Eq(leaf, hn::Set(du, branch.leaf)));
            const auto begins_before = hn::Lt(hn::LoadU(d, in.lower[axis] + i), plane);
            const auto ends_behind = hn::Gt(hn::LoadU(d, in.upper[axis] + i), plane);
            straddles = hn::Or(straddles, hn::And(is_here, hn::And(begins_before, ends_behind)));
            const auto goes_right = hn::RebindMask(du, hn::AndNot(begins_before, is_here));
            leaf = hn::IfThenElse(goes_right, hn::Set(du, b + 1), leaf);
        }
        straddles = hn::And(straddles, hn::FirstN(d, count - i));
        leaf = hn::IfThenElse(hn::RebindMask(du, straddles), hn::Set(du, uint32_t{kStraddles}), leaf);
        hn::StoreU(hn::DemoteTo(d8, hn::BitCast(di, leaf)), d8, leaves + i);
        if (hn::AllFalse(d, straddles)) {
            continue;
        }
        const Compression compression(d, straddles);
        for (size_t axis = 0; axis < 3; ++axis) {
            compression.store(d, hn::LoadU(d, in.lower[axis] + i), straddlers.lower[axis] + straddling);
            compression.store(d, hn::LoadU(d, in.upper[axis] + i), straddlers.upper[axis] + straddling);
        }
        compression.store(du, hn::LoadU(du, in.triangle + i), straddlers.triangle + straddling);
        straddling += static_cast<uint32_t>(std::popcount(compression.bits()));
    }
    std::fill(leaves + count, leaves + (count + 63) / 64 * 64 + 64, kStraddles);
    return straddling;
}

/// How many of the bytes, padded to 64, are equal to `value`.
inline uint32_t count_equal(const uint8_t* bytes, uint32_t count, uint8_t value) {
    const hn::ScalableTag<uint8_t> d;
    uint32_t equal = 0;
    for (uint32_t i = 0; i < count; i += static_cast<uint32_t>(hn::Lanes(d))) {
        equal += static_cast<uint32_t>(hn::CountTrue(d, hn::Eq(hn::LoadU(d, bytes + i), hn::Set(d, value))));
    }
    return equal;
}

/// Copies the references of a chunk that straddle no plane to where the leaves they lie in have got to.
inline void copy_to_leaves(const References& from, uint32_t count, const uint8_t* leaves, const References& to,
                           uint32_t* places) {
    const References in = from;
    const References out = to;
    const hn::ScalableTag<float> d;
    const hn::RebindToUnsigned<decltype(d)> du;
    const hn::Rebind<uint8_t, decltype(d)> d8;
    const auto lanes = static_cast<uint32_t>(hn::Lanes(d));
    for (uint32_t i = 0; i < count; i += lanes) {
        const auto leaf = hn::PromoteTo(du, hn::LoadU(d8, leaves + i));
        uint64_t open = mask_bits(d, hn::RebindMask(d, hn::Ne(leaf, hn::Set(du, uint32_t{kStraddles}))));
        while (open != 0) {
            const uint32_t next = leaves[i + static_cast<uint32_t>(std::countr_zero(open))];
            const Compression compression(d, hn::RebindMask(d, hn::Eq(leaf, hn::Set(du, next))));
            const uint32_t place = places[next];
            for (size_t axis = 0; axis < 3; ++axis) {
                compression.store(d, hn::LoadU(d, in.lower[axis] + i), out.lower[axis] + place);
                compression.store(d, hn::LoadU(d, in.upper[axis] + i), out.upper[axis] + place);
            }
            compression.store(du, hn::LoadU(du, in.triangle + i), out.triangle + place);
            places[next] = place + static_cast<uint32_t>(std::popcount(compression.bits()));
            open &= ~compression.bits();
        }
    }
}

inline size_t sort_by_leaves(const TriangleSoup& soup, const MultiwaySplit& plan, const References& chunk,
                             uint32_t count, bool clip, const References& scratch, size_t capacity,
                             SortedChunk& sorted) {
    constexpr uint32_t kMargin = SortedChunk::kMargin;
    alignas(64) uint8_t leaves[kChunk + 128];
    struct Straddling {
        References references;
        uint32_t count = 0;
    };
    std::array<Straddling, MultiwaySplit::kMostLeaves> straddling;  // by the leaf in which they are so far
    straddling[0] = {scratch, find_leaves(plan, chunk, count, leaves, scratch, sorted.places)};
    uint32_t used = straddling[0].count + kMargin;
    for (uint32_t b = 0; b + 1 < plan.leaves; ++b) {
        const MultiwaySplit::Branch& branch = plan.branches[b];
        if (Straddling& left = straddling[branch.leaf]; left.count != 0) {
            Straddling& right = straddling[b + 1];
            right.references = scratch.at(used);
            const Partition parts =
                partition(soup, left.references, left.count, branch.split, clip, left.references, right.references);
            left.count = parts.left_count;
            right.count = parts.right_count;
            used += right.count + kMargin;
        }
    }
    uint32_t places[MultiwaySplit::kMostLeaves];
    uint32_t next = 0;
    for (uint32_t leaf = 0; leaf < plan.leaves; ++leaf) {
        const uint32_t whole = count_equal(leaves, count, static_cast<uint8_t>(leaf));
        sorted.begin[leaf] = places[leaf] = next;
        sorted.count[leaf] = whole + straddling[leaf].count;
        next += sorted.count[leaf] + kMargin;
    }
    if (next > capacity) {
        return next;
    }
    const References& out = sorted.places;
    copy_to_leaves(chunk, count, leaves, out, places);
    for (uint32_t leaf = 0; leaf < plan.leaves; ++leaf) {
        copy_references(straddling[leaf].references, straddling[leaf].count, out.at(places[leaf]));
        sorted.tight[leaf] = bounds(out.at(sorted.begin[leaf]), sorted.count[leaf]);
    }
    return next;
}

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
