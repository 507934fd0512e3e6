// SPDX-License-Identifier: GPL-3.0-or-later
// Many rays in flight on one thread, each on its own way: while the memory that one needs is fetched, others step.
// Those that look for any hit and set out together go the first part of it as a group. Compiled once per instruction
// set (see traversal.cpp).

#if defined(ESPALIER_KDTREE_STREAM_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef ESPALIER_KDTREE_STREAM_INL_H_
#undef ESPALIER_KDTREE_STREAM_INL_H_
#else
#define ESPALIER_KDTREE_STREAM_INL_H_
#endif

#include <hwy/highway.h>

#include <algorithm>
#include <bit>
#include <cstdint>
#include <iterator>
#include <span>
#include <utility>

#include "kdtree/l2_cache.h"
#include "kdtree/ray_batch-inl.h"
#include "kdtree/ray_group-inl.h"
#include "kdtree/root_leaves-inl.h"
#include "kdtree/traced_ray-inl.h"
#include "kdtree/triangle_test-inl.h"

HWY_BEFORE_NAMESPACE();
namespace espalier::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// With no more than these waiting, a StreamRay has room for another node's children.
constexpr size_t kFullStack = 40;

/// What few rays have so much of that it does not fit into StreamRay: the lower part of what they still have to visit.
/// A ray that comes from a group may go down the deepest tree with a full stack to begin with.
struct Overflow {
    static constexpr size_t kCapacity = WideNode::kMostLevels * (WideNode::kWidth - 1) + kFullStack;
    uint32_t children[kCapacity];
    float depths[kCapacity];
};

/// A ray under way with what it still has to visit, what comes first on top, and at the bottom the mark that nothing is
/// left. Small, since all rays in flight are in use at once: together they are to lie on few pages.
struct StreamRay : TracedRay {
    static constexpr uint32_t kNothing = 0;                                 ///< the root, which is nobody's child
    static constexpr size_t kCapacity = kFullStack + 2 * WideNode::kWidth;  ///< vectors may run over the end

    uint32_t number;    ///< among the rays
    uint32_t next;      ///< where it goes: a child's code
    uint32_t overflow;  ///< how many wait in its Overflow
    uint32_t* top;
    uint32_t children[kCapacity];
    float depths[kCapacity];  ///< where the ray enters the child, if the nearest hit is looked for

    HWY_INLINE float* top_depth() { return depths + (top - children); }

    HWY_INLINE void clear_stack() {
        children[0] = kNothing;
        depths[0] = -kInfinity;
        top = children + 1;
        overflow = 0;
    }

    HWY_INLINE bool is_full() const { return top > children + kFullStack; }

    /// Moves all but the mark there.
    template <bool kDepths>
    HWY_NOINLINE void spill(Overflow& below) {
        const auto count = static_cast<size_t>(top - children) - 1;
        std::copy_n(children + 1, count, below.children + overflow);
        if constexpr (kDepths) {
            std::copy_n(depths + 1, count, below.depths + overflow);
        }
        overflow += static_cast<uint32_t>(count);
        top = children + 1;
    }

    /// Takes what comes first from there, where there is something, onto an empty stack whose mark was taken off.
    template <bool kDepths>
    HWY_NOINLINE void refill(const Overflow& below) {
        const uint32_t count = std::min<uint32_t>(overflow, kFullStack / 2);
        overflow -= count;
        std::copy_n(below.children + overflow, count, children + 1);
        top = children + 1 + count;
        if constexpr (kDepths) {
            std::copy_n(below.depths + overflow, count, depths + 1);
            prune();
        }
    }

    /// Drops what lies beyond the ray's reach.
    HWY_INLINE void prune() {
        const hn::CappedTag<float, WideNode::kWidth> d;
        const hn::RebindToUnsigned<decltype(d)> du;
        constexpr size_t kLanes = hn::MaxLanes(hn::CappedTag<float, WideNode::kWidth>());
        const auto count = static_cast<size_t>(top - children);
        const auto limit = hn::Set(d, reach);
        size_t kept = 0;
        for (size_t i = 0; i < count; i += kLanes) {
            const auto entry = hn::LoadU(d, depths + i);
            const auto child = hn::LoadU(du, children + i);
            // The last vector runs over the end: what lies there counts for nothing.
            const auto keep = hn::And(hn::Le(entry, limit), hn::FirstN(d, count - i));
            kept += compress_pair(d, keep, child, children + kept, entry, depths + kept);
        }
        top = children + kept;
    }
};

/// In which order a ray looks at a node's children.
enum class Order { kNearest, kSoonest };

/// Stacks the children that the ray enters, and those to be looked at first last. With how far away they are, where
/// the nearest counts: only there does a ray's reach become shorter.
template <bool kDepths>
HWY_INLINE void stack_children(StreamRay& ray, const WideNode& node, const ChildEntries& entries, Order order) {
#if HWY_TARGET != HWY_SSE4 && HWY_TARGET != HWY_NEON
    // Permuted into that order and compressed onto the stack, without a branch on their number.
    const hn::CappedTag<float, WideNode::kWidth> d;
    const hn::RebindToUnsigned<decltype(d)> du;
    auto ranks = hn::Zero(du);
    if (order == Order::kSoonest) {
        ranks = hn::ShiftRight<WideNode::kSoonestShift>(hn::Load(du, node.order));
    } else {
        const auto all = hn::Set(du, node.order[ray.octant]);
        ranks = hn::And(hn::Shr(all, hn::Mul(hn::Iota(du, 0), hn::Set(du, 3))), hn::Set(du, 7));
    }
    const auto slots = hn::IndicesFromVec(d, ranks);
    const auto child = hn::BitCast(du, hn::TableLookupLanes(hn::BitCast(d, hn::Load(du, node.child)), slots));
    const auto depth = hn::TableLookupLanes(entries.depth, slots);
    const auto is_met = hn::Lt(depth, hn::Inf(d));
    if constexpr (kDepths) {
        ray.top += compress_pair(d, is_met, child, ray.top, depth, ray.top_depth());
    } else {
        const Compression compression(d, is_met);
        compression.store(du, child, ray.top);
        ray.top += std::popcount(compression.bits());
    }
#else
    uint32_t near = node.order[ray.octant];
    for (int i = 0; i < WideNode::kWidth; ++i, near >>= 3) {
        const uint32_t slot = order == Order::kSoonest ? node.order[i] >> WideNode::kSoonestShift : near & 7U;
        *ray.top = node.child[slot];
        if constexpr (kDepths) {
            *ray.top_depth() = entries.depth[slot];
        }
        ray.top += entries.met >> slot & 1U;
    }
#endif
}

template <bool kDepths>
HWY_INLINE void visit_node(StreamRay& ray, const WideNode& node, Order order) {
    const hn::CappedTag<float, WideNode::kWidth> d;
    constexpr size_t kLanes = hn::MaxLanes(hn::CappedTag<float, WideNode::kWidth>());
    const float* planes = node.lower[0];
    static_assert(sizeof(node.lower) == 3 * WideNode::kWidth * sizeof(float));
    ChildEntries entries;
    for (size_t first = 0; first < WideNode::kWidth; first += kLanes) {
        BoxSpan<hn::Vec<decltype(d)>> span{hn::Set(d, ray.start), hn::Set(d, ray.reach)};
        for (int axis = 0; axis < 3; ++axis) {
            span.cut(hn::Load(d, planes + ray.near_planes[axis] + first),
                     hn::Load(d, planes + ray.far_planes[axis] + first), hn::Set(d, ray.inverse[axis]),
                     hn::Set(d, ray.near_shift[axis]), hn::Set(d, ray.far_shift[axis]));
        }
#if HWY_TARGET != HWY_SSE4 && HWY_TARGET != HWY_NEON
        static_assert(kLanes == WideNode::kWidth);
        entries.depth = span.entry_or_infinity();
#else
        hn::Store(span.entry, d, entries.depth + first);
        entries.met |= mask_bits(d, span.meets()) << first;
#endif
    }
    stack_children<kDepths>(ray, node, entries, order);
}

/// Traces rays through a tree. For any hit a ray ends at the first.
template <bool kAnyHit, bool kExact>
class Stream {
 public:
    Stream(const Tree& tree, std::span<const Ray> rays)
        : nodes_(tree.wide_nodes.data()),
          blocks_(tree.blocks.data()),
          on_demand_(tree.on_demand.get()),
          fetches_(tree.wide_nodes.bytes() + tree.blocks.bytes() > near_bytes()),
          rays_(rays),
          batch_(tree.bounds),
          root_leaves_(nodes_[0], blocks_) {}

    /// Traces rays, batches of them from these numbers on, and calls done(number, place) at least for each that hits
    /// something, when its way has ended.
    template <class Done>
    HWY_INLINE void run(std::span<const uint32_t> batches, const Done& done) {
        batches_ = batches;
        batch_.reset();
        Lists lists;
        for (uint32_t slot = 0; slot < kInFlight; ++slot) {
            begin(ray_[slot], lists, done);
        }
        while ((lists.at_node | lists.at_leaf | lists.at_end) != 0) {
            // Each list is read from its front while rays are put behind; as each ray is put back once at most, a list
            // may be refilled while it is read.
            const uint32_t nodes = std::exchange(lists.at_node, 0);
            for (uint32_t i = 0; i < nodes; ++i) {
                StreamRay& ray = *node_list_[i];
                if (ray.is_full()) [[unlikely]] {
                    ray.spill<!kAnyHit>(overflow_[&ray - ray_]);
                }
                visit_node<!kAnyHit>(ray, nodes_[ray.next], order());
            }
            // In a loop of its own: what a node has put on a stack is long in coming, and while one ray waited for it,
            // a processor could look ahead to no more than a few others.
            for (uint32_t i = 0; i < nodes; ++i) {
                StreamRay& ray = *node_list_[i];
                list(ray, *--ray.top, lists);
                fetch(ray.next);
            }
            // Whether a ray meets something in a leaf cannot be foreseen: those that may are listed, and looked at
            // together.
            const uint32_t leaves = ask_first(std::exchange(lists.at_leaf, 0), lists);
            uint32_t meeting = 0;
            for (uint32_t i = 0; i < leaves; ++i) {
                StreamRay& ray = kAsksFirst ? *asked_list_[i] : *leaf_list_[i];
                const uint32_t leaf = ray.next;
                if (WideNode::is_unopened(leaf)) [[unlikely]] {
                    list(ray, on_demand_->open(leaf), lists);
                    fetch(ray.next);
                    continue;
                }
                const uint32_t further = leaf % WideNode::kMaxLeafBlocks;  // blocks behind the first
                Meeting& met = meetings_[meeting];
                const uint32_t possible =
                    test_blocks<kExact>(ray, blocks_ + WideNode::first_block(leaf), at_most_one(further), met.verdict);
                met.ray = &ray;
                met.leaf = leaf;
                met.possible = possible;
                const uint32_t meets = at_most_one(possible);
                meeting += meets;
                leave(ray, leaf, lists, 1 - meets);
                fetch(ray.next);
            }
            for (uint32_t i = 0; i < meeting; ++i) {
                const Meeting& met = meetings_[i];
                StreamRay& ray = *met.ray;
                if (take(ray, met)) {
                    if constexpr (kAnyHit) {
                        ray.overflow = 0;
                        end_list_[lists.at_end++] = &ray;
                        continue;
                    } else {
                        ray.prune();
                    }
                }
                // What it goes on to was fetched behind the test, unless that lay beyond the hit.
                leave(ray, met.leaf, lists);
            }
            const uint32_t ended = std::exchange(lists.at_end, 0);
            for (uint32_t i = 0; i < ended; ++i) {
                StreamRay& ray = *end_list_[i];
                if (ray.overflow != 0) [[unlikely]] {
                    ray.refill<!kAnyHit>(overflow_[&ray - ray_]);
                    list(ray, *--ray.top, lists);
                    continue;
                }
                done(ray.number, ray.place);
                begin(ray, lists, done);
            }
        }
    }

 private:
    /// So many that, with what is noted of them and fetched for them, they fit into a processor's first cache of 32
    /// KiB.
    static constexpr uint32_t kInFlight = 24;
    /// Nodes and blocks that take no more bytes are so near that fetching ahead costs more than it gains: a few times
    /// the L2 cache where the L3 cache is near, and little more than it where it is not, in processors whose L2 cache
    /// makes up for that. 10 MiB were measured with an L2 cache of 1 MiB (OPTIMIZATION.md).
    static size_t near_bytes() {
        constexpr size_t kMiB = size_t{1} << 20;
        const size_t l2 = l2_cache_bytes();
        if (l2 >= 2 * kMiB) {
            return l2 + l2 / 2;
        }
        return kBlocksPerStep == 2 ? 10 * kMiB : 4 * l2;
    }
    /// Lines of 64 bytes that are fetched of a node, and of a leaf from where a ray goes on, of whose blocks each has
    /// five.
    static constexpr size_t kLinesOfNode = sizeof(WideNode) / 64;
    static constexpr size_t kLinesOfLeaf = kBlocksPerStep == 2 ? 8 : 5;

    /// How many rays are on each list. Not beside the lists: what is written to those and to rays might be these, for
    /// all a compiler knows, and they would be read back at every step.
    struct Lists {
        uint32_t at_node = 0;
        uint32_t at_leaf = 0;
        uint32_t at_end = 0;
    };

    /// A ray and what its step at a leaf has found.
    struct Meeting {
        Verdict verdict;
        StreamRay* ray;
        uint32_t leaf;
        uint32_t possible;
    };

    /// On demand the nearest come first, where others have been: what costs most there is to open what none has seen.
    HWY_INLINE Order order() const { return kAnyHit && on_demand_ == nullptr ? Order::kSoonest : Order::kNearest; }

    /// Puts the next ray, if there is one, in place of one that has ended.
    template <class Done>
    HWY_INLINE void begin(StreamRay& ray, Lists& lists, const Done& done) {
        if (waiting_ == 0 && !set_up_next_batch(done)) {
            return;
        }
        const auto lane = static_cast<uint32_t>(std::countr_zero(waiting_));
        waiting_ &= waiting_ - 1;
        set_out(lane, ray);
        if constexpr (kAnyHit) {
            if (has_walked_) {
                // In the order in which the group came by: what comes first on top.
                const StreamRay& member = members_[lane];
                ray.top = std::reverse_copy(member.children + 1, static_cast<const uint32_t*>(member.top), ray.top);
                list(ray, *--ray.top, lists);
                fetch(ray.next);
                return;
            }
        }
        stack_children<!kAnyHit>(ray, nodes_[0], batch_.root_entries(lane), order());
        // Not fetched: with as many rays going there, it is at hand.
        list(ray, *--ray.top, lists);
    }

    /// Fills a ray of the batch in, with nothing to visit.
    HWY_INLINE void set_out(uint32_t lane, StreamRay& ray) const {
        batch_.copy(lane, ray);
        ray.number = first_ + lane;
        ray.clear_stack();
    }

    /// Of which some rays have to be followed: the others have missed, or ended together or in a leaf below the root.
    template <class Done>
    HWY_NOINLINE bool set_up_next_batch(const Done& done) {
        do {
            if (batches_.empty()) {
                return false;
            }
            first_ = batches_.front();
            batches_ = batches_.subspan(1);
            const std::span<const Ray> rays = rays_.subspan(first_, std::min(RayBatch::kSize, rays_.size() - first_));
            const Ray* batch = rays.data();
            Ray filled_up[RayBatch::kSize];
            if (rays.size() < RayBatch::kSize) {
                std::fill(std::copy(rays.begin(), rays.end(), filled_up), std::end(filled_up), rays.front());
                batch = filled_up;
            }
            waiting_ = batch_.set_up(batch, nodes_[0]) & ((1U << rays.size()) - 1);
            if constexpr (kAnyHit) {
                has_walked_ = on_demand_ == nullptr && group_.gather(batch_, waiting_);
                if (has_walked_) {
                    waiting_ = walk_together(done);
                    continue;
                }
            }
            waiting_ = root_leaves_.visit(batch_, waiting_,
                                          [&](uint32_t lane, uint32_t place) { done(first_ + lane, place); });
        } while (waiting_ == 0);
        return true;
    }

    /// Leads those that wait through the tree as a group. Returns those that have neither ended nor been everywhere.
    template <class Done>
    HWY_INLINE uint32_t walk_together(const Done& done) {
        for (uint32_t rest = waiting_; rest != 0; rest &= rest - 1) {
            const auto lane = static_cast<uint32_t>(std::countr_zero(rest));
            set_out(lane, members_[lane]);
        }
        const auto test = [&](uint32_t leaf, uint32_t rays) { return test_together(leaf, rays, done); };
        uint32_t parted = 0;
        const auto part = [&](uint32_t child, uint32_t rays) {
            for (uint32_t rest = rays; rest != 0; rest &= rest - 1) {
                if (members_[std::countr_zero(rest)].is_full()) {
                    return false;
                }
            }
            for (uint32_t rest = rays; rest != 0; rest &= rest - 1) {
                *members_[std::countr_zero(rest)].top++ = child;
            }
            parted |= rays;
            return true;
        };
        return group_.walk(nodes_, waiting_, test, part) & parted;
    }

    /// Where rays are asked first, returns those of a group's that may meet something in a block; else all.
    HWY_INLINE uint32_t asked_together(uint32_t block, uint32_t rays) const {
        if constexpr (!kAsksFirst) {
            return rays;
        }
        uint32_t meeting = 0;
        for (uint32_t rest = rays; rest != 0; rest &= rest - 1) {
            const auto lane = static_cast<uint32_t>(std::countr_zero(rest));
            meeting |= may_meet(members_[lane], blocks_[block]) << lane;
        }
        return meeting;
    }

    /// 1 where a ray of the stream may meet something in a block, else 0.
    HWY_INLINE uint32_t may_meet(const StreamRay& ray, const TriangleBlock& block) const {
        const float least_inside = batch_.least_inside()[block.triangle[0] / kMaxTriangles];
        return at_most_one(lanes_in_question<kExact>(ray, block, least_inside));
    }

    /// Returns those of a group's rays that hit something in a leaf.
    template <class Done>
    HWY_INLINE uint32_t test_together(uint32_t leaf, uint32_t rays, const Done& done) {
        const uint32_t blocks = WideNode::blocks(leaf);
        uint32_t ended = 0;
        for (uint32_t b = 0; b < blocks; b += kBlocksPerStep) {
            const uint32_t first = WideNode::first_block(leaf) + b;
            uint32_t meeting = 0;
            for (uint32_t rest = asked_together(first, rays & ~ended); rest != 0; rest &= rest - 1) {
                StreamRay& ray = members_[std::countr_zero(rest)];
                Meeting& met = meetings_of_group_[meeting];
                met.possible = test_blocks<kExact>(ray, blocks_ + first, at_most_one(blocks - 1 - b), met.verdict);
                met.ray = &ray;
                met.leaf = WideNode::leaf(first, 1);
                meeting += at_most_one(met.possible);
            }
            for (uint32_t i = 0; i < meeting; ++i) {
                StreamRay& ray = *meetings_of_group_[i].ray;
                if (take(ray, meetings_of_group_[i])) {
                    done(ray.number, ray.place);
                    ended |= 1U << (ray.number - first_);
                }
            }
        }
        return ended;
    }

    /// Where rays are asked first, lets so many from the list of those at a leaf go on that meet nothing there, and
    /// lists the others anew. Returns the number of rays whose step at a leaf is still to be made.
    HWY_INLINE uint32_t ask_first(uint32_t leaves, Lists& lists) {
        if constexpr (!kAsksFirst) {
            return leaves;
        }
        uint32_t left = 0;
        uint32_t passing = 0;
        for (uint32_t i = 0; i < leaves; ++i) {
            StreamRay& ray = *leaf_list_[i];
            const uint32_t leaf = ray.next;
            uint32_t meets = 1;
            if (!WideNode::is_unopened(leaf)) [[likely]] {
                meets = may_meet(ray, blocks_[WideNode::first_block(leaf)]);
            }
            asked_list_[left] = &ray;
            passing_list_[passing] = &ray;
            left += meets;
            passing += 1 - meets;
        }
        for (uint32_t i = 0; i < passing; ++i) {
            StreamRay& ray = *passing_list_[i];
            leave(ray, ray.next, lists);
            fetch(ray.next);
        }
        return left;
    }

    /// Goes on after a step at a leaf, if `counts` is 1.
    HWY_INLINE void leave(StreamRay& ray, uint32_t leaf, Lists& lists, uint32_t counts = 1) {
        // The rest of the leaf is some blocks further, and as many less. Where there is none, what lies on top is next,
        // chosen without a branch: how long leaves are cannot be foreseen.
        const uint32_t further = leaf % WideNode::kMaxLeafBlocks;
        const uint32_t is_last = (further - kBlocksPerStep) >> 31;
        const uint32_t rest = leaf + (WideNode::kMaxLeafBlocks - 1) * kBlocksPerStep;
        const uint32_t top = ray.top[-1];
        ray.top -= is_last & counts;
        list(ray, rest ^ ((rest ^ top) & (0U - is_last)), lists, counts);
    }

    /// Puts a ray on the list of what it does next, if `counts` is 1, without a branch on which.
    HWY_INLINE void list(StreamRay& ray, uint32_t child, Lists& lists, uint32_t counts = 1) {
        ray.next = child;
        static_assert(StreamRay::kNothing == 0);
        const uint32_t is_leaf = child >> 31;
        const uint32_t is_end = (~child & (child - 1)) >> 31;  // child == 0, for which compilers would branch
        leaf_list_[lists.at_leaf] = &ray;
        node_list_[lists.at_node] = &ray;
        end_list_[lists.at_end] = &ray;
        lists.at_leaf += is_leaf & counts;
        lists.at_node += (1 - is_leaf - is_end) & counts;
        lists.at_end += is_end & counts;
    }

    /// Has the memory for a child fetched where the tree is large, without a branch on what it is.
    HWY_INLINE void fetch(uint32_t child) const {
        if (!fetches_) {
            return;
        }
        const uint32_t is_leaf = child >> 31;
        const auto node = reinterpret_cast<uintptr_t>(nodes_ + child);
        const auto block = reinterpret_cast<uintptr_t>(blocks_ + WideNode::first_block(child));
        // A choice that compilers would make with a branch.
        const auto* wanted = reinterpret_cast<const char*>(  // NOLINT(performance-no-int-to-ptr)
            node ^ ((node ^ block) & (uintptr_t{0} - is_leaf)));
        prefetch_lines<kLinesOfNode>(wanted);
        // More of a leaf; the same lines of a node, which costs next to nothing.
        prefetch_lines<kLinesOfLeaf - kLinesOfNode>(wanted + 64 * kLinesOfNode * is_leaf);
    }

    /// Takes in what a step at a leaf has found. Returns whether there is a new nearest hit.
    HWY_INLINE bool take(StreamRay& ray, const Meeting& met) {
        const Verdict& verdict = met.verdict;
        const uint32_t block = WideNode::first_block(met.leaf);
        bool taken = false;
        uint32_t open = 0;
        for (uint32_t lanes = met.possible; lanes != 0; lanes &= lanes - 1) {
            const auto lane = static_cast<uint32_t>(std::countr_zero(lanes));
            const float lower = verdict.lower[lane];
            const float upper = verdict.upper[lane];
            const bool is_sure =
                !kExact || ((verdict.certain >> lane & 1U) != 0 && lower >= ray.sure_start && upper <= ray.sure_end);
            if (is_sure && upper < ray.lower) {
                ray.place = block * kBlockSize + lane;
                ray.shorten(lower, upper);
                taken = true;
                if (kAnyHit) {
                    return true;
                }
            } else if (kExact) {
                // Mostly the triangle that the ray has hit, in another leaf.
                const bool is_known = ray.place != kNoPlace && triangle_at(blocks_, block * kBlockSize + lane) ==
                                                                   triangle_at(blocks_, ray.place);
                open |= is_known ? 0 : lanes & -lanes;
            }
        }
        if (kExact && open != 0) [[unlikely]] {
            taken |= take_open(ray, verdict, open, block);
        }
        return taken;
    }

    /// Takes in those lanes that need exact arithmetic.
    HWY_NOINLINE bool take_open(StreamRay& ray, const Verdict& verdict, uint32_t open, uint32_t block) {
        bool taken = false;
        for (; open != 0; open &= open - 1) {
            const auto lane = static_cast<uint32_t>(std::countr_zero(open));
            const uint32_t place = block * kBlockSize + lane;
            if (verdict.lower[lane] > ray.reach) {
                continue;
            }
            Nearest nearest{ray.place, ray.lower, ray.upper};
            if (take_exactly(rays_[ray.number], blocks_, place, nearest)) {
                ray.place = place;
                ray.shorten(nearest.lower, nearest.upper);
                taken = true;
            }
        }
        return taken;
    }

    const WideNode* nodes_;
    const TriangleBlock* blocks_;
    OnDemand* on_demand_;
    bool fetches_;
    std::span<const Ray> rays_;
    std::span<const uint32_t> batches_;  ///< those not yet set up, by the numbers of their first rays
    RayBatch batch_;
    RootLeaves<kAnyHit, kExact> root_leaves_;
    uint32_t first_ = 0;       ///< ray of the batch
    uint32_t waiting_ = 0;     ///< those of it that are still to begin, a bit for each
    bool has_walked_ = false;  ///< as a group, and the rays that wait go on from where it left them
    StreamRay* node_list_[kInFlight + 1];
    StreamRay* leaf_list_[kInFlight + 1];
    StreamRay* asked_list_[kInFlight + 1];    ///< and may meet something there
    StreamRay* passing_list_[kInFlight + 1];  ///< and do not
    StreamRay* end_list_[kInFlight + 1];
    Meeting meetings_[kInFlight];
    RayGroup group_;
    StreamRay members_[RayBatch::kSize];  ///< of the group
    Meeting meetings_of_group_[RayBatch::kSize];
    StreamRay ray_[kInFlight];
    Overflow overflow_[kInFlight];
};

}  // namespace espalier::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();
#endif
