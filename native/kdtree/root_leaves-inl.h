// SPDX-License-Identifier: GPL-3.0-or-later
// Leaves right below the root, where floors and walls lie, tested as rays are set up: most rays that come to one first
// end there, and need not be put under way. Compiled once per instruction set (see traversal.cpp).

#if defined(ESPALIER_KDTREE_ROOT_LEAVES_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_KDTREE_ROOT_LEAVES_INL_H_
#undef ESPALIER_KDTREE_ROOT_LEAVES_INL_H_
#else
#define ESPALIER_KDTREE_ROOT_LEAVES_INL_H_
#endif

#include <hwy/highway.h>

#include <algorithm>
#include <bit>
#include <cstdint>
#include <iterator>
#include <limits>

#include "kdtree/node.h"
#include "kdtree/ray_batch-inl.h"
#include "kdtree/triangle_test-inl.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

template <bool kAnyHit, bool kExact>
class RootLeaves {
 public:
    RootLeaves(const WideNode& root, const TriangleBlock* blocks) : root_(root), blocks_(blocks) {
        for (size_t child = 0; child < WideNode::kWidth; ++child) {
            const uint32_t code = root.child[child];
            const bool is_leaf = (code & WideNode::kLeafFlag) != 0 && !WideNode::is_unopened(code);
            const bool is_used = root.lower[0][child] <= root.upper[0][child];
            leaves_ |= is_leaf && is_used && WideNode::blocks(code) <= kMostBlocks ? 1U << child : 0U;
        }
    }

    /// Tests those of the rays, a bit for each, that come to a leaf first. Calls done(lane, place) for each whose way
    /// ends with a hit there, and returns those that have to go on. What float cannot decide is left to those, as if
    /// nothing had been tested.
    template <class Done>
    HWY_INLINE uint32_t visit(RayBatch& batch, uint32_t rays, const Done& done) {
        const uint32_t at_leaf = leaves_ != 0 ? batch.first_in(leaves_) & rays : 0;
        if (kAtOnce && at_leaf != 0 && !is_laid_out_) [[unlikely]] {
            lay_out();
        }
        // Two loops: whether a ray ends is known late, and a wrong guess would hold up the tests of others.
        for (uint32_t rest = at_leaf; rest != 0; rest &= rest - 1) {
            test(batch, static_cast<uint32_t>(std::countr_zero(rest)));
        }
        for (uint32_t rest = at_leaf; rest != 0; rest &= rest - 1) {
            const auto lane = static_cast<uint32_t>(std::countr_zero(rest));
            rays &= ~(ends(batch, lane, done) << lane);
        }
        return rays;
    }

 private:
    static constexpr uint32_t kMostBlocks = 2;
    static constexpr bool kAtOnce = kBlocksPerStep == kMostBlocks;  ///< a step tests all that a leaf has
    static constexpr size_t kRows = 9;                              ///< three coordinates of three corners

    /// What a ray's test has found.
    struct Meeting {
        Verdict verdict;
        uint32_t block;
        uint32_t possible;
        uint32_t has_more;  ///< 1 where there is another block with triangles to be tested
    };

    /// Copies the corners of each leaf's blocks side by side, NaN for a second that it does not have. Not before a ray
    /// gets to one: many calls are of few rays, or of packets.
    HWY_NOINLINE void lay_out() {
        is_laid_out_ = true;
        for (uint32_t rest = leaves_; rest != 0; rest &= rest - 1) {
            const auto child = static_cast<size_t>(std::countr_zero(rest));
            const uint32_t leaf = root_.child[child];
            const TriangleBlock* block = blocks_ + WideNode::first_block(leaf);
            std::fill(std::begin(corners_[child]), std::end(corners_[child]), std::numeric_limits<float>::quiet_NaN());
            for (size_t b = 0; b < WideNode::blocks(leaf); ++b) {
                for (size_t row = 0; row < kRows; ++row) {
                    std::copy_n(block[b].vertex[0][0] + row * kBlockSize, kBlockSize,
                                corners_[child] + (row * kMostBlocks + b) * kBlockSize);
                }
            }
        }
    }

    HWY_INLINE void test(const RayBatch& batch, uint32_t lane) {
        const RayBatch::AtLeaf ray = batch.at_leaf(lane);
        const uint32_t leaf = root_.child[batch.first_child(lane)];
        const uint32_t further = leaf % WideNode::kMaxLeafBlocks;  // blocks behind the first
        Meeting& met = meetings_[lane];
        met.block = WideNode::first_block(leaf);
        met.has_more = 0;
        const auto limits = [&]<class V>(const Sheared<V>&) {
            const hn::DFromV<V> d;
            return EdgeLimits<V>{hn::Set(d, ray.minus_edge_error), hn::Set(d, ray.mz)};
        };
        if constexpr (kAtOnce) {
            const float* corners = corners_[batch.first_child(lane)];
            const auto load = [&](size_t from) {
                return hn::Load(hn::CappedTag<float, kBlocksPerStep * kBlockSize>(), corners + kBlocksPerStep * from);
            };
            met.possible = test_lanes<kExact>(ray, load, limits, met.verdict);
        } else {
            static_assert(kMostBlocks == 2);
            const auto is_asked = [&](uint32_t block) {
                return at_most_one(lanes_in_question<kExact>(ray, blocks_[block], ray.minus_edge_error));
            };
            const uint32_t first = is_asked(met.block);
            const uint32_t second = is_asked(met.block + further) & further;
            met.has_more = first & second;
            met.block += (1 - first) & second;
            met.possible = test_lanes<kExact>(ray, BlockLoader(blocks_ + met.block, 0), limits, met.verdict);
        }
    }

    /// Returns 1 where a ray has ended, else 0.
    template <class Done>
    HWY_INLINE uint32_t ends(RayBatch& batch, uint32_t lane, const Done& done) const {
        const Meeting& met = meetings_[lane];
        if (met.has_more != 0) {
            return 0;
        }
        const uint32_t child = batch.first_child(lane);
        const auto others = [&](float reach) { return batch.entered(lane, reach) & ~(1U << child); };
        if (met.possible == 0) {
            const uint32_t goes_on = at_most_one(others(kInfinity));
            batch.pass_by(lane, child);  // not before: what is read behind a part of it that was written has to wait
            return 1 - goes_on;
        }
        const auto hit = static_cast<uint32_t>(std::countr_zero(met.possible));
        const float lower = met.verdict.lower[hit];
        const float upper = met.verdict.upper[hit];
        const bool is_sure = (met.possible & (met.possible - 1)) == 0 && (met.verdict.certain >> hit & 1U) != 0 &&
                             batch.is_within(lane, lower, upper);
        if (!is_sure) {
            return 0;
        }
        const uint32_t place = met.block * kBlockSize + hit;
        if (!kAnyHit && others(reach_behind(upper)) != 0) {
            batch.shorten(lane, place, lower, upper);
            batch.pass_by(lane, child);
            return 0;
        }
        done(lane, place);
        return 1;
    }

    const WideNode& root_;
    const TriangleBlock* blocks_;
    uint32_t leaves_ = 0;  ///< those children of the root that are leaves of few blocks, a bit for each
    bool is_laid_out_ = false;
    alignas(64) float corners_[kAtOnce ? WideNode::kWidth : 1][kRows * kMostBlocks * kBlockSize];
    Meeting meetings_[RayBatch::kSize];
};

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
