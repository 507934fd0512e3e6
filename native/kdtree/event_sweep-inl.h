// SPDX-License-Identifier: GPL-3.0-or-later
// Planes through the begins and ends of references' boxes, among which the cheapest of all planes lies (Wald and Havran
// 2006, section 4.2, with a sort per node). Compiled once per instruction set (see build_kernels.cpp).

#if defined(ESPALIER_KDTREE_EVENT_SWEEP_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_KDTREE_EVENT_SWEEP_INL_H_
#undef ESPALIER_KDTREE_EVENT_SWEEP_INL_H_
#else
#define ESPALIER_KDTREE_EVENT_SWEEP_INL_H_
#endif

#include <hwy/highway.h>

#include <algorithm>
#include <bit>
#include <limits>
#include <utility>

#include "kdtree/binning-inl.h"
#include "kdtree/build_kernels.h"
#include "kdtree/compress-inl.h"
#include "kdtree/sah-inl.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// Floats as numbers of the same order. Boxes hold no NaN and no -0.
inline int32_t sort_key(float x) {
    const auto bits = std::bit_cast<int32_t>(x);
    return bits ^ ((bits >> 31) & 0x7fffffff);
}
template <class DI>
HWY_INLINE hn::Vec<DI> sort_keys_of(DI di, hn::Vec<DI> bits) {
    return hn::Xor(bits, hn::And(hn::ShiftRight<31>(bits), hn::Set(di, 0x7fffffff)));
}
/// A zero has no sign, since planes are compared bit by bit in the end.
inline float from_sort_key(int32_t key) { return std::bit_cast<float>(key ^ ((key >> 31) & 0x7fffffff)) + 0.0F; }

/// Sorts the first `count` keys: by radix, if they are enough for that to pay.
inline void sort_keys(LargeBuffer<int32_t>& keys, uint32_t count, LargeBuffer<int32_t>& scratch) {
    constexpr uint32_t kWorthRadix = 256;
    constexpr uint32_t kBits = 8;
    constexpr uint32_t kBuckets = 1U << kBits;
    if (count < kWorthRadix) {
        std::sort(keys.data(), keys.data() + count);
        return;
    }
    const auto digit_of = [](int32_t key, uint32_t digit) {
        return ((static_cast<uint32_t>(key) ^ 0x80000000U) >> (kBits * digit)) % kBuckets;
    };
    uint32_t counts[32 / kBits][kBuckets] = {};
    for (uint32_t i = 0; i < count; ++i) {
        for (uint32_t digit = 0; digit < 32 / kBits; ++digit) {
            ++counts[digit][digit_of(keys[i], digit)];
        }
    }
    for (uint32_t digit = 0; digit < 32 / kBits; ++digit) {
        uint32_t place = 0;
        for (uint32_t& bucket : counts[digit]) {
            place += std::exchange(bucket, place);
        }
        for (uint32_t i = 0; i < count; ++i) {
            scratch[counts[digit][digit_of(keys[i], digit)]++] = keys[i];
        }
        std::swap(keys, scratch);
    }
}

/// Tries planes through the begins and ends of references' boxes.
class EventSweep {
    using D = hn::CappedTag<float, 16>;

 public:
    /// The cheapest of a split and all events of one axis in an interval.
    void operator()(const OpenNode& node, const References& references, const BuildParameters& parameters, int axis,
                    Interval range, Split& best) {
        find_events(references, axis, node.count, range);
        cheapest_event(node, parameters, axis, best);
    }

 private:
    /// The events in the interval in order, and how many lie before it. A box without extent lies behind planes through
    /// it, and ends at the next number.
    void find_events(const References& references, int axis, uint32_t count, Interval range) {
        const D d;
        const hn::RebindToSigned<D> di;
        const auto lanes = static_cast<uint32_t>(hn::Lanes(d));
        const auto a = static_cast<size_t>(axis);
        if (begins_.size() < count + lanes) {
            for (LargeBuffer<int32_t>* keys : {&begins_, &ends_, &scratch_}) {
                *keys = LargeBuffer<int32_t>(count + lanes);
            }
        }
        const auto first = hn::Set(di, sort_key(range.lower));
        const auto last = hn::Set(di, sort_key(range.upper));
        begin_count_ = end_count_ = begun_ = ended_ = 0;
        for (uint32_t i = 0; i < count; i += lanes) {
            const auto exists = hn::FirstN(di, count - i);
            const auto begin = sort_keys_of(di, hn::BitCast(di, hn::LoadU(d, references.lower[a] + i)));
            const auto end = hn::Max(sort_keys_of(di, hn::BitCast(di, hn::LoadU(d, references.upper[a] + i))),
                                     hn::Add(begin, hn::Set(di, 1)));
            const auto collect = [&](hn::Vec<decltype(di)> keys, int32_t* to, uint32_t& inside, uint32_t& before) {
                const auto is_before = hn::Lt(keys, first);
                const auto is_behind = hn::Gt(keys, last);
                const Compression chosen(d, hn::RebindMask(d, hn::AndNot(hn::Or(is_before, is_behind), exists)));
                chosen.store(di, keys, to + inside);
                inside += static_cast<uint32_t>(std::popcount(chosen.bits()));
                before += static_cast<uint32_t>(std::popcount(mask_bits(di, hn::And(exists, is_before))));
            };
            collect(begin, begins_.data(), begin_count_, begun_);
            collect(end, ends_.data(), end_count_, ended_);
        }
        sort_keys(begins_, begin_count_, scratch_);
        sort_keys(ends_, end_count_, scratch_);
    }

    /// Goes through the events in order. Of several at one place, the last end and the first begin see the right
    /// counts, and the others higher ones.
    void cheapest_event(const OpenNode& node, const BuildParameters& parameters, int axis, Split& best) {
        const D d;
        const hn::RebindToUnsigned<D> du;
        constexpr uint32_t kChunk = 512;
        alignas(64) float position[kChunk];
        alignas(64) uint32_t left[kChunk];
        alignas(64) uint32_t right[kChunk];
        const CellShape shape(node.cell);
        const SplitCosts<D> costs(d, node, shape, parameters.sah);
        begins_[begin_count_] = ends_[end_count_] = std::numeric_limits<int32_t>::max();
        const int32_t* begin = begins_.data();
        const int32_t* end = ends_.data();
        const uint32_t count = node.count;
        for (uint32_t rest = begin_count_ + end_count_; rest != 0;) {
            const uint32_t size = std::min(kChunk, rest);
            rest -= size;
            uint32_t k = 0;
            for (; k < size; ++k) {
                const bool is_end = *end <= *begin;
                position[k] = from_sort_key(is_end ? *end : *begin);
                ended_ += is_end ? 1 : 0;
                left[k] = begun_;
                right[k] = count - ended_;
                begun_ += is_end ? 0 : 1;
                begin += is_end ? 0 : 1;
                end += is_end ? 1 : 0;
            }
            for (; k % 16 != 0; ++k) {
                position[k] = std::numeric_limits<float>::infinity();
                left[k] = right[k] = 0;
            }
            CheapestPlane cheapest(d);
            for (uint32_t i = 0; i < k; i += static_cast<uint32_t>(hn::Lanes(d))) {
                const auto lefts = hn::Load(du, left + i);
                const auto rights = hn::Load(du, right + i);
                const auto cost =
                    costs(axis, hn::Load(d, position + i), expected_blocks(d, lefts), expected_blocks(d, rights));
                cheapest.offer(static_cast<int>(i),
                               hn::IfThenElse(is_affordable(d, node, lefts, rights), cost, hn::Inf(d)));
            }
            if (cheapest.cost() < best.cost) {
                best = {axis, position[cheapest.index()], cheapest.cost()};
            }
        }
    }

    LargeBuffer<int32_t> begins_;
    LargeBuffer<int32_t> ends_;
    LargeBuffer<int32_t> scratch_;
    uint32_t begin_count_ = 0;
    uint32_t end_count_ = 0;
    uint32_t begun_ = 0;
    uint32_t ended_ = 0;
};

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
