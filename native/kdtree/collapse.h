// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "kdtree/node.h"
#include "kdtree/tree_piece.h"

namespace espalier {

// What it costs a ray to visit a wide node, to get to a leaf, and to test one or two blocks of it there.
constexpr float kWideNodeCost = 1;
constexpr float kLeafCost = 1;
constexpr float kStepCost = 2;

/// What a subtree costs the rays that meet it if it takes up to so many places among the children of a wide node, and
/// how many wide nodes it then becomes. One place is entry kPlaces; entries below stand for none, and cost infinitely
/// much.
struct Spread {
    static constexpr size_t kPlaces = WideNode::kWidth;
    alignas(32) float cost[2 * kPlaces];
    alignas(32) uint32_t wide_nodes[2 * kPlaces];
};

/// How a kd node is best spread.
struct SpreadPlan {
    /// By the number of places less 1: those of them that its left part gets, the right one taking the rest; 0 where it
    /// takes one place itself. The first is for all places, where it becomes a wide node, as inner nodes and very long
    /// leaves do.
    uint8_t left_places[Spread::kPlaces];
    uint32_t wide_nodes;  ///< where it becomes one: that and those below; 0 if nothing is in it
};

/// Kd nodes from `begin` to `end` that form one subtree.
struct KdRun {
    uint32_t begin;
    uint32_t end;
    Spread spread;  ///< once it is planned
};

/// The wide node that a kd node becomes and those below it, one after another.
struct WideSubtree {
    uint32_t node;
    uint32_t place;  ///< of the first
};

/// Chooses which nodes of a finished kd-tree, and which parts of its leaves, become children of wide nodes: of all ways
/// that which costs the rays least, found from the leaves up (Ylitie, Karras and Laine 2017 collapse binary trees so).
/// First all subtrees are planned, then what lies above them; then wide nodes are written, depth first.
class Collapse {
 public:
    /// plans: one for each node.
    Collapse(std::span<const KdNode> nodes, std::span<const TreePiece> pieces, std::span<SpreadPlan> plans);

    void plan(KdRun& run) const;
    /// Plans the nodes above all these, which are planned.
    void plan_above(std::span<const KdRun> runs) const;

    /// How many wide nodes a kd node that becomes one and those below it come to.
    uint32_t wide_nodes(uint32_t node) const { return std::max(1U, plans_[node].wide_nodes); }

    /// first_block: added to the numbers of blocks.
    void write(const WideSubtree& subtree, uint32_t first_block, WideNode* wide) const;
    /// Writes the whole tree but for subtrees that lie in runs, which are returned.
    std::vector<WideSubtree> write_above(std::span<const KdRun> runs, WideNode* wide) const;

 private:
    class Planner;
    class Writer;

    /// Whether nothing is in a node, once it is planned: both halves of a split may lose all they had to rounding.
    bool is_empty(uint32_t node) const { return plans_[node].wide_nodes == 0; }
    /// near: the one that most likely holds the node.
    const TreePiece* piece_with(uint32_t node, const TreePiece* near) const {
        return near->holds(node) ? near : &piece_of(pieces_, node);
    }

    std::span<const KdNode> nodes_;
    std::span<const TreePiece> pieces_;
    std::span<SpreadPlan> plans_;
    /// What lengths are multiplied by, so that in scenes of any size areas neither vanish nor add up to infinity: the
    /// tree's longest side becomes 2^45, and the longest leaf 2^26 blocks of 3 * 2^90.
    float unit_;
};

}  // namespace espalier
