// SPDX-License-Identifier: GPL-3.0-or-later
#include "kdtree/collapse.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <utility>

#include "kdtree/child_order.h"
#include "kdtree/simd_config.h"

// clang-format off: behind its configuration
#include <hwy/highway.h>
// clang-format on

HWY_BEFORE_NAMESPACE();
namespace espalier {
namespace {

namespace hn = hwy::HWY_NAMESPACE;

constexpr uint32_t kPlaces = Spread::kPlaces;

float area_of(const Box3f& box, float unit) { return half_area(box.size() * unit); }

/// A leaf or part of one.
struct LeafPart {
    const TreePiece* piece;
    float unit;  ///< see area_of
    uint32_t first_block;
    uint32_t blocks;
    uint32_t part;  ///< where the boxes of its own parts begin
    Box3f box;

    bool is_divisible() const { return blocks > 2; }
    /// Too long for a child of a wide node. Its parts have no boxes of their own.
    bool is_long() const { return blocks > WideNode::kMaxLeafBlocks; }
    uint32_t blocks_of_left() const { return is_long() ? blocks / 2 : first_blocks(blocks); }
    LeafPart left() const {
        LeafPart left = *this;
        left.blocks = blocks_of_left();
        if (!is_long()) {
            left.part = part + 1;
            left.box = piece->part_box(part);
        }
        return left;
    }
    LeafPart right() const {
        LeafPart right = *this;
        const uint32_t before = blocks_of_left();
        right.blocks -= before;
        right.first_block += before;
        if (is_long()) {
            right.part = right.first_block;
        } else {
            const uint32_t slot = part + 1 + part_count(before);
            right.part = slot + 1;
            right.box = piece->part_box(slot);
        }
        return right;
    }
    float area() const { return area_of(box, unit); }
    float cost() const {
        const uint32_t steps = (blocks + 1) / 2;
        return area() * (kLeafCost + kStepCost * static_cast<float>(steps));
    }
};

LeafPart whole_leaf(const KdNode& node, uint32_t index, const TreePiece& piece, float unit) {
    return {&piece, unit, node.first_block(), block_count(node.references()), node.first_block(), piece.box(index)};
}

/// What takes one place however many there are.
void take_one_place(float cost, Spread& spread, SpreadPlan& plan) {
    std::fill_n(spread.cost + kPlaces, kPlaces, cost);
    std::fill_n(spread.wide_nodes + kPlaces, kPlaces, 0U);
    plan = {{}, 1};
}

/// The best ways to share places between two parts, and where one place costs no more than several, to take but that.
class Shares {
 public:
    Shares(const Spread& left, const Spread& right) : best_{in_places<0>(left, right), in_places<1>(left, right)} {}

    /// As a wide node of its own; own_cost: of that without what lies below.
    void take_node(float own_cost, Spread& spread, SpreadPlan& plan) const {
        take(own_cost + hn::ExtractLane(best_[1].cost, 3), 1 + nodes_below(), spread, plan);
    }
    /// As a leaf.
    void take_leaf(float cost, Spread& spread, SpreadPlan& plan) const { take(cost, 0, spread, plan); }

 private:
    using D = hn::FixedTag<float, 4>;
    using DU = hn::FixedTag<uint32_t, 4>;
    struct Best {
        hn::Vec<D> cost;
        hn::Vec<DU> left_places;
        hn::Vec<DU> wide_nodes;
    };

    /// In four places and fewer, or in five to eight.
    template <uint32_t kHalf>
    static HWY_INLINE Best in_places(const Spread& left, const Spread& right) {
        const D d;
        const DU du;
        Best best{hn::Set(d, std::numeric_limits<float>::infinity()), hn::Zero(du), hn::Zero(du)};
        constexpr uint32_t kFirst = kPlaces + 4 * kHalf;
        for (uint32_t share = 1; share < 4 * (kHalf + 1); ++share) {
            const auto cost =
                hn::Add(hn::Set(d, left.cost[kPlaces + share - 1]), hn::LoadU(d, right.cost + kFirst - share));
            const auto nodes = hn::Add(hn::Set(du, left.wide_nodes[kPlaces + share - 1]),
                                       hn::LoadU(du, right.wide_nodes + kFirst - share));
            const auto is_better = hn::Lt(cost, best.cost);
            const auto is_better_u = hn::RebindMask(du, is_better);
            best.cost = hn::IfThenElse(is_better, cost, best.cost);
            best.left_places = hn::IfThenElse(is_better_u, hn::Set(du, share), best.left_places);
            best.wide_nodes = hn::IfThenElse(is_better_u, nodes, best.wide_nodes);
        }
        return best;
    }

    uint32_t nodes_below() const { return hn::ExtractLane(best_[1].wide_nodes, 3); }

    HWY_INLINE void take(float cost_of_one, uint32_t nodes_of_one, Spread& spread, SpreadPlan& plan) const {
        const D d;
        const DU du;
        const hn::FixedTag<int32_t, 4> di;
        const hn::FixedTag<uint8_t, 4> d8;
        plan.wide_nodes = 1 + nodes_below();
        const auto one = hn::Set(d, cost_of_one);
        for (size_t half = 0; half < 2; ++half) {
            const auto is_one = hn::Le(one, best_[half].cost);
            const auto is_one_u = hn::RebindMask(du, is_one);
            hn::Store(hn::IfThenElse(is_one, one, best_[half].cost), d, spread.cost + kPlaces + 4 * half);
            hn::Store(hn::IfThenElse(is_one_u, hn::Set(du, nodes_of_one), best_[half].wide_nodes), du,
                      spread.wide_nodes + kPlaces + 4 * half);
            const auto left_places = hn::IfThenZeroElse(is_one_u, best_[half].left_places);
            hn::StoreU(hn::DemoteTo(d8, hn::BitCast(di, left_places)), d8, plan.left_places + 4 * half);
        }
        plan.left_places[0] = static_cast<uint8_t>(hn::ExtractLane(best_[1].left_places, 3));
    }

    Best best_[2];
};

/// A spread of what is not yet known.
Spread new_spread() {
    Spread spread{};
    std::fill_n(spread.cost, kPlaces, std::numeric_limits<float>::infinity());
    return spread;
}

void plan_leaf(const LeafPart& leaf, Spread& spread, SpreadPlan& plan) {
    if (leaf.blocks == 0) {
        take_one_place(0, spread, plan);
        plan.wide_nodes = 0;
        return;
    }
    if (!leaf.is_divisible()) {
        take_one_place(leaf.cost(), spread, plan);
        return;
    }
    const LeafPart left = leaf.left();
    const LeafPart right = leaf.right();
    if (!left.is_divisible() && !right.is_divisible()) {  // most are so short
        const float whole = leaf.cost();
        const float parts = left.cost() + right.cost();
        take_one_place(std::min(whole, parts), spread, plan);
        spread.cost[kPlaces] = whole;
        std::fill_n(plan.left_places, kPlaces, static_cast<uint8_t>(parts < whole ? 1 : 0));
        return;
    }
    Spread spreads[2] = {new_spread(), new_spread()};
    SpreadPlan unused;
    plan_leaf(left, spreads[0], unused);
    plan_leaf(right, spreads[1], unused);
    const Shares shares(spreads[0], spreads[1]);
    if (leaf.is_long()) {
        shares.take_node(leaf.area() * kWideNodeCost, spread, plan);
    } else {
        shares.take_leaf(leaf.cost(), spread, plan);
    }
}

SpreadPlan plan_of(const LeafPart& leaf) {
    Spread unused;
    SpreadPlan plan;
    plan_leaf(leaf, unused, plan);
    return plan;
}

}  // namespace

/// Plans nodes from the last to the first, and so a node when both its parts are planned. Their spreads lie on a stack.
class Collapse::Planner {
 public:
    explicit Planner(const Collapse& collapse)
        : collapse_(collapse), piece_(&collapse.pieces_.front()), stack_(64, new_spread()) {}

    void plan(uint32_t node) {
        const KdNode kd = collapse_.nodes_[node];
        piece_ = collapse_.piece_with(node, piece_);
        SpreadPlan& plan = collapse_.plans_[node];
        if (kd.is_leaf()) {
            plan_leaf(whole_leaf(kd, node, *piece_, collapse_.unit_), push(), plan);
            return;
        }
        const uint32_t left = node + 1;
        const uint32_t right = kd.right_child();
        const Spread& of_left = stack_[--size_];
        Spread& of_right = stack_[size_ - 1];
        if (collapse_.is_empty(left)) {  // which takes no place
            plan = collapse_.plans_[right];
        } else if (collapse_.is_empty(right)) {
            plan = collapse_.plans_[left];
            of_right = of_left;
        } else {
            Shares(of_left, of_right)
                .take_node(area_of(piece_->box(node), collapse_.unit_) * kWideNodeCost, of_right, plan);
        }
    }

    /// Plans a node and all below it but for runs, which are taken off the end of these.
    void plan_above(uint32_t node, std::span<const KdRun>& runs) {
        if (!runs.empty() && runs.back().begin == node) {
            push() = runs.back().spread;
            runs = runs.first(runs.size() - 1);
            return;
        }
        if (!collapse_.nodes_[node].is_leaf()) {
            plan_above(collapse_.nodes_[node].right_child(), runs);
            plan_above(node + 1, runs);
        }
        plan(node);
    }

    const Spread& last() const { return stack_[size_ - 1]; }

 private:
    Spread& push() {
        if (size_ == stack_.size()) {
            stack_.resize(2 * size_, new_spread());
        }
        return stack_[size_++];
    }

    const Collapse& collapse_;
    const TreePiece* piece_;  ///< that of the last node
    std::vector<Spread> stack_;
    size_t size_ = 0;
};

/// Writes wide nodes one after another.
class Collapse::Writer {
 public:
    Writer(const Collapse& collapse, uint32_t first_block, uint32_t place, WideNode* wide)
        : collapse_(collapse),
          piece_(&collapse.pieces_.front()),
          first_block_(first_block),
          next_(place),
          wide_(wide) {}

    /// Leaves out subtrees in these.
    void skip(std::span<const KdRun> runs) { runs_ = runs; }
    const std::vector<WideSubtree>& skipped() const { return skipped_; }

    /// Writes the wide node that a kd node becomes, and those below it.
    uint32_t write(uint32_t node) {
        node = with_all(node);
        const KdNode kd = collapse_.nodes_[node];
        piece_ = collapse_.piece_with(node, piece_);
        if (kd.is_leaf()) {
            return write(whole_leaf(kd, node, *piece_, collapse_.unit_));
        }
        Row row(wide_[next_]);
        open(row, kd, node, 0, kPlaces, collapse_.plans_[node].left_places[0]);
        return finish(row);
    }

 private:
    /// The children of a wide node, and which of them become wide nodes themselves.
    struct Row {
        WideNode& wide;
        ChildOrder order;
        ChildCosts costs;
        size_t count = 1;
        struct Below {
            size_t slot;
            uint32_t node;
            LeafPart leaf;  ///< if that is long
        };
        std::array<Below, kPlaces> below;
        size_t below_count = 0;

        explicit Row(WideNode& node) : wide(node) {}
    };

    uint32_t write(const LeafPart& leaf) {
        Row row(wide_[next_]);
        if (leaf.is_long()) {
            open(row, leaf, 0, kPlaces, plan_of(leaf).left_places[0]);
        } else {  // the whole tree
            place(row, leaf, 0, kPlaces);
        }
        return finish(row);
    }

    uint32_t finish(Row& row) {
        row.order.write(row.count, row.wide);
        row.costs.write(row.wide);
        const uint32_t place = next_++;
        for (const Row::Below& below : std::span(row.below).first(row.below_count)) {
            uint32_t& child = row.wide.child[below.slot];
            if (below.leaf.blocks != 0) {
                child = write(below.leaf);
            } else if (is_skipped(below.node)) {
                child = next_;
                skipped_.push_back({below.node, next_});
                next_ += collapse_.wide_nodes(below.node);
            } else {
                child = write(below.node);
            }
        }
        return place;
    }

    /// Gives a node that has a place up to so many.
    void place(Row& row, uint32_t node, size_t slot, uint32_t places) {
        node = with_all(node);
        const KdNode kd = collapse_.nodes_[node];
        piece_ = collapse_.piece_with(node, piece_);
        const uint32_t left_places = places == 1 ? 0 : collapse_.plans_[node].left_places[places - 1];
        if (kd.is_leaf()) {
            const LeafPart leaf = whole_leaf(kd, node, *piece_, collapse_.unit_);
            left_places == 0 ? take(row, leaf, slot) : open(row, leaf, slot, places, left_places);
        } else if (left_places == 0) {
            set_box(row.wide, slot, piece_->box(node));
            row.costs.set_nodes(slot, collapse_.wide_nodes(node));
            row.below[row.below_count++] = {slot, node, {}};
        } else {
            open(row, kd, node, slot, places, left_places);
        }
    }
    void open(Row& row, const KdNode& kd, uint32_t node, size_t slot, uint32_t places, uint32_t left_places) {
        const size_t added = row.count++;
        row.order.split(kd.axis(), slot, added);
        place(row, node + 1, slot, left_places);
        place(row, kd.right_child(), added, places - left_places);
    }

    /// The same for parts of leaves.
    void place(Row& row, const LeafPart& leaf, size_t slot, uint32_t places) {
        const bool may_open = places > 1 && leaf.is_divisible();
        const uint32_t left_places = may_open ? plan_of(leaf).left_places[places - 1] : 0;
        left_places == 0 ? take(row, leaf, slot) : open(row, leaf, slot, places, left_places);
    }
    void open(Row& row, const LeafPart& leaf, size_t slot, uint32_t places, uint32_t left_places) {
        const LeafPart left = leaf.left();
        const LeafPart right = leaf.right();
        const Vec3f apart = (right.box.lower + right.box.upper) - (left.box.lower + left.box.upper);
        int axis = 0;
        for (int other = 1; other < 3; ++other) {
            axis = std::abs(apart[other]) > std::abs(apart[axis]) ? other : axis;
        }
        size_t left_slot = slot;
        size_t right_slot = row.count++;
        row.order.split(axis, left_slot, right_slot);
        if (apart[axis] < 0) {
            std::swap(left_slot, right_slot);
        }
        place(row, left, left_slot, left_places);
        place(row, right, right_slot, places - left_places);
    }
    void take(Row& row, const LeafPart& leaf, size_t slot) {
        set_box(row.wide, slot, leaf.box);
        if (leaf.is_long()) {
            row.costs.set_nodes(slot, plan_of(leaf).wide_nodes);
            row.below[row.below_count++] = {slot, 0, leaf};
        } else {
            row.costs.set_leaf(slot, leaf.blocks);
            // Only a subtree that has lost all it had is a leaf of nothing, and no ray meets its box.
            row.wide.child[slot] =
                leaf.blocks == 0 ? WideNode::leaf(0, 1) : WideNode::leaf(leaf.first_block + first_block_, leaf.blocks);
        }
    }

    /// A node, or the one below it that has all it has.
    uint32_t with_all(uint32_t node) const {
        for (;;) {
            const KdNode kd = collapse_.nodes_[node];
            if (kd.is_leaf()) {
                return node;
            }
            if (collapse_.is_empty(node + 1)) {
                node = kd.right_child();
            } else if (collapse_.is_empty(kd.right_child())) {
                ++node;
            } else {
                return node;
            }
        }
    }

    bool is_skipped(uint32_t node) const {
        const auto after = std::upper_bound(runs_.begin(), runs_.end(), node,
                                            [](uint32_t n, const KdRun& run) { return n < run.begin; });
        return after != runs_.begin() && node < (after - 1)->end;
    }

    const Collapse& collapse_;
    const TreePiece* piece_;  ///< that of the last node
    const uint32_t first_block_;
    uint32_t next_;
    WideNode* wide_;
    std::span<const KdRun> runs_;
    std::vector<WideSubtree> skipped_;
};

Collapse::Collapse(std::span<const KdNode> nodes, std::span<const TreePiece> pieces, std::span<SpreadPlan> plans)
    : nodes_(nodes), pieces_(pieces), plans_(plans) {
    const Vec3f size = pieces.front().box(0).size();
    unit_ = 0x1p45F / std::max({size.x, size.y, size.z, 0x1p-80F});
}

void Collapse::plan(KdRun& run) const {
    Planner planner(*this);
    for (uint32_t node = run.end; node-- > run.begin;) {
        planner.plan(node);
    }
    run.spread = planner.last();
}

void Collapse::plan_above(std::span<const KdRun> runs) const { Planner(*this).plan_above(0, runs); }

void Collapse::write(const WideSubtree& subtree, uint32_t first_block, WideNode* wide) const {
    Writer(*this, first_block, subtree.place, wide).write(subtree.node);
}

std::vector<WideSubtree> Collapse::write_above(std::span<const KdRun> runs, WideNode* wide) const {
    if (runs.size() == 1 && runs.front().begin == 0) {
        return {{0, 0}};
    }
    Writer writer(*this, 0, 0, wide);
    writer.skip(runs);
    writer.write(0);
    return writer.skipped();
}

}  // namespace espalier
HWY_AFTER_NAMESPACE();
