// SPDX-License-Identifier: GPL-3.0-or-later
#include <gtest/gtest.h>

#include <algorithm>
#include <functional>
#include <iterator>
#include <limits>
#include <random>
#include <span>
#include <vector>

#include "kdtree/child_order.h"
#include "kdtree/collapse.h"

namespace espalier {
namespace {

/// A kd-tree of any shape whose boxes are of any size: a collapse asks for nothing else.
class RandomTree {
 public:
    RandomTree(unsigned seed, uint32_t leaves, uint32_t most_blocks, float size = 1)
        : generator_(seed), most_blocks_(most_blocks), size_(size) {
        add(leaves, 1);
        part_boxes_.resize(blocks_);
        for (Box3f& box : part_boxes_) {
            box = random_box();
        }
        piece_ = {0, 0, boxes_, part_boxes_, {}};
        plans_.resize(nodes_.size());
    }

    std::vector<KdNode> nodes_;
    TreePiece piece_;
    std::vector<SpreadPlan> plans_;

    Collapse collapse() { return {nodes_, {&piece_, 1}, plans_}; }

    /// Subtrees of at most so many nodes, but for leaves, in order.
    std::vector<KdRun> runs(uint32_t longest) const {
        std::vector<KdRun> found;
        find_runs(0, static_cast<uint32_t>(nodes_.size()), longest, found);
        return found;
    }

 private:
    /// Right children may be empty leaves.
    void add(uint32_t leaves, uint32_t least_blocks) {
        const size_t index = nodes_.size();
        nodes_.push_back(KdNode::leaf(0, 0));
        boxes_.push_back(random_box());
        if (leaves == 1) {
            const uint32_t blocks = std::max(least_blocks, static_cast<uint32_t>(generator_() % (most_blocks_ + 1)));
            nodes_[index] = KdNode::leaf(blocks_, blocks * kBlockSize);
            blocks_ += blocks;
            if (blocks == 0) {
                boxes_[index] = {};
            }
            return;
        }
        const uint32_t left = 1 + generator_() % (leaves - 1);
        const int axis = static_cast<int>(generator_() % 3);
        add(left, 1);
        nodes_[index] = KdNode::inner(axis, 0, static_cast<uint32_t>(nodes_.size()));
        const size_t right = nodes_.size();
        add(leaves - left, 0);
        if (boxes_[right].is_empty()) {
            boxes_[index] = boxes_[index + 1];
        }
    }

    void find_runs(uint32_t begin, uint32_t end, uint32_t longest, std::vector<KdRun>& found) const {
        if (nodes_[begin].is_leaf()) {
            return;
        }
        if (end - begin <= longest) {
            found.push_back({begin, end, {}});
            return;
        }
        find_runs(begin + 1, nodes_[begin].right_child(), longest, found);
        find_runs(nodes_[begin].right_child(), end, longest, found);
    }

    Box3f random_box() {
        std::uniform_real_distribution<float> at(0, size_);
        Box3f box;
        box.extend(Vec3f{at(generator_), at(generator_), at(generator_)});
        box.extend(Vec3f{at(generator_), at(generator_), at(generator_)});
        return box;
    }

    std::mt19937 generator_;
    uint32_t most_blocks_;
    float size_;
    uint32_t blocks_ = 0;
    std::vector<Box3f> boxes_;
    std::vector<Box3f> part_boxes_;
};

bool same_bytes(std::span<const WideNode> a, std::span<const WideNode> b) {
    const auto bytes = std::as_bytes(a);
    return std::ranges::equal(bytes, std::as_bytes(b));
}

std::vector<WideNode> written_at_once(RandomTree& tree) {
    const Collapse collapse = tree.collapse();
    KdRun whole{0, static_cast<uint32_t>(tree.nodes_.size()), {}};
    collapse.plan(whole);
    std::vector<WideNode> wide(collapse.wide_nodes(0) + 1);
    const WideNode untouched = wide.back();
    collapse.write({0, 0}, 0, wide.data());
    EXPECT_TRUE(same_bytes(std::span(&wide.back(), 1), std::span(&untouched, 1)));
    wide.pop_back();
    return wide;
}

std::vector<WideNode> written_in_runs(RandomTree& tree, uint32_t longest) {
    const Collapse collapse = tree.collapse();
    std::vector<KdRun> runs = tree.runs(longest);
    for (KdRun& run : runs) {
        collapse.plan(run);
    }
    collapse.plan_above(runs);
    std::vector<WideNode> wide(collapse.wide_nodes(0));
    for (const WideSubtree& subtree : collapse.write_above(runs, wide.data())) {
        collapse.write(subtree, 0, wide.data());
    }
    return wide;
}

std::vector<uint32_t> children_of(const std::vector<WideNode>& wide) {
    std::vector<uint32_t> found;
    for (const WideNode& node : wide) {
        found.insert(found.end(), std::begin(node.child), std::end(node.child));
    }
    return found;
}

float leaf_cost(const Box3f& box, uint32_t blocks) {
    const uint32_t steps = (blocks + 1) / 2;
    return half_area(box) * (kLeafCost + kStepCost * static_cast<float>(steps));
}

/// What the rays pay for the children of a wide node and all below them.
float cost_below(const std::vector<WideNode>& wide, uint32_t index) {
    const WideNode& node = wide.at(index);
    float cost = 0;
    for (int i = 0; i < WideNode::kWidth; ++i) {
        const Box3f box{{node.lower[0][i], node.lower[1][i], node.lower[2][i]},
                        {node.upper[0][i], node.upper[1][i], node.upper[2][i]}};
        if (box.is_empty()) {
            continue;
        }
        if ((node.child[i] & WideNode::kLeafFlag) == 0) {
            cost += half_area(box) * kWideNodeCost + cost_below(wide, node.child[i]);
        } else {
            cost += leaf_cost(box, WideNode::blocks(node.child[i]));
        }
    }
    return cost;
}

/// The same at its least, found by trying all sets of up to eight nodes that could be children.
class AllWays {
 public:
    explicit AllWays(const RandomTree& tree) : tree_(tree) {}

    float least_below(uint32_t node) const {
        float least = std::numeric_limits<float>::infinity();
        std::vector<Item> open;
        if (tree_.nodes_[node].is_leaf()) {
            open.push_back(item(node));
        } else {
            open = parts(item(node));
        }
        try_all(open, 0, 0, least);
        return least;
    }

 private:
    struct Item {
        uint32_t node;
        uint32_t blocks;  ///< of a leaf or a part of one
        uint32_t part;
        Box3f box;
    };

    Item item(uint32_t node) const {
        const KdNode kd = tree_.nodes_[node];
        return {node, kd.is_leaf() ? block_count(kd.references()) : 0, kd.is_leaf() ? kd.first_block() : 0,
                tree_.piece_.box(node)};
    }
    bool is_inner(const Item& item) const { return !tree_.nodes_[item.node].is_leaf(); }
    bool is_nothing(const Item& item) const { return !is_inner(item) && item.blocks == 0; }

    std::vector<Item> parts(const Item& whole) const {
        std::vector<Item> found;
        if (is_inner(whole)) {
            found = {item(whole.node + 1), item(tree_.nodes_[whole.node].right_child())};
            std::erase_if(found, [&](const Item& part) { return is_nothing(part); });
            return found;
        }
        const uint32_t first = first_blocks(whole.blocks);
        const uint32_t second = whole.part + 1 + part_count(first);
        return {{whole.node, first, whole.part + 1, tree_.piece_.part_box(whole.part)},
                {whole.node, whole.blocks - first, second + 1, tree_.piece_.part_box(second)}};
    }

    /// Settles the last of those that are open, one way and the other.
    void try_all(std::vector<Item> open, int settled, float cost, float& least) const {
        if (settled + static_cast<int>(open.size()) > WideNode::kWidth || cost >= least) {
            return;
        }
        if (open.empty()) {
            least = cost;
            return;
        }
        const Item last = open.back();
        open.pop_back();
        if (is_nothing(last)) {
            try_all(open, settled, cost, least);
            return;
        }
        if (is_inner(last) || last.blocks > 2) {
            std::vector<Item> opened = open;
            const std::vector<Item> those = parts(last);
            opened.insert(opened.end(), those.begin(), those.end());
            try_all(opened, settled, cost, least);
        }
        const float own = is_inner(last) ? half_area(last.box) * kWideNodeCost + least_below(last.node)
                                         : leaf_cost(last.box, last.blocks);
        try_all(open, settled + 1, cost + own, least);
    }

    const RandomTree& tree_;
};

TEST(Collapse, CostsNoMoreThanAnyOtherWay) {
    for (unsigned seed = 0; seed < 60; ++seed) {
        RandomTree tree(seed, 1 + seed % 13, 5);
        const std::vector<WideNode> wide = written_at_once(tree);
        const float least = AllWays(tree).least_below(0);
        EXPECT_NEAR(cost_below(wide, 0), least, 1e-4F * least) << "seed " << seed;
    }
}

TEST(Collapse, IsTheSameHoweverTheTreeIsCutIntoRuns) {
    for (unsigned seed = 0; seed < 20; ++seed) {
        RandomTree tree(seed, 300, 6);
        const std::vector<WideNode> whole = written_at_once(tree);
        for (const uint32_t longest : {1U, 5U, 40U, 150U, 1000U}) {
            const std::vector<WideNode> cut = written_in_runs(tree, longest);
            ASSERT_EQ(cut.size(), whole.size());
            EXPECT_TRUE(same_bytes(cut, whole)) << "seed " << seed << ", runs of " << longest;
        }
    }
}

TEST(Collapse, IsTheSameInScenesOfAnySize) {
    const auto children = [](float size) {
        RandomTree tree(7, 300, 6, size);
        return children_of(written_at_once(tree));
    };
    const std::vector<uint32_t> usual = children(1);
    for (const float size : {0x1p61F, 0x1p30F, 0x1p-30F, 0x1p-90F}) {  // exact, and so are areas in units of the tree
        EXPECT_EQ(children(size), usual) << "size " << size;
    }
}

TEST(Collapse, IsTheSameWhereTheTreeIsFarLargerThanAllBelow) {
    const auto children = [](float root_size) {
        RandomTree tree(7, 300, 6);
        tree.piece_.box(0) = {{0, 0, 0}, {root_size, root_size, root_size}};
        return children_of(written_at_once(tree));
    };
    EXPECT_EQ(children(0x1p75F), children(1));
}

/// What it takes to look through a child of a wide node: of leaves their blocks, of nodes how many there are.
uint32_t cost_of_child(const std::vector<WideNode>& wide, const WideNode& node, uint32_t slot) {
    if (node.lower[0][slot] > node.upper[0][slot]) {
        return UINT32_MAX;  // there is none
    }
    const std::function<uint32_t(uint32_t)> count = [&](uint32_t index) {
        uint32_t nodes = 1;
        for (const uint32_t child : wide.at(index).child) {
            nodes += (child & WideNode::kLeafFlag) == 0 ? count(child) : 0;
        }
        return nodes;
    };
    const uint32_t child = node.child[slot];
    return (child & WideNode::kLeafFlag) != 0 ? WideNode::blocks(child) : WideNode::kMaxLeafBlocks + count(child);
}

TEST(Collapse, OrdersChildrenByHowSoonTheyAreLookedThrough) {
    for (unsigned seed = 0; seed < 20; ++seed) {
        RandomTree tree(seed, 1 + 15 * seed, seed % 2 == 0 ? 6 : 300);
        const std::vector<WideNode> wide = written_at_once(tree);
        for (const WideNode& node : wide) {
            uint32_t before = UINT32_MAX;
            uint32_t slots = 0;
            for (const uint32_t word : node.order) {
                const uint32_t slot = word >> WideNode::kSoonestShift;
                if (slot >= static_cast<uint32_t>(WideNode::kWidth)) {
                    FAIL() << "no slot: " << slot;
                }
                slots |= 1U << slot;
                const uint32_t cost = cost_of_child(wide, node, slot);
                EXPECT_LE(cost, before) << "seed " << seed;
                before = cost;
            }
            EXPECT_EQ(slots, 0xffU) << "each child has its place in the order";
        }
    }
}

TEST(Collapse, GivesNoPlaceToWhatHasLostAllItHad) {
    std::vector<KdNode> nodes{KdNode::inner(0, 0, 2), KdNode::leaf(0, kBlockSize)};
    const std::function<void(int)> add_nothing = [&](int levels) {
        const size_t index = nodes.size();
        nodes.push_back(KdNode::leaf(1, 0));
        if (levels > 0) {
            add_nothing(levels - 1);
            nodes[index] = KdNode::inner(0, 0, static_cast<uint32_t>(nodes.size()));
            add_nothing(levels - 1);
        }
    };
    add_nothing(5);
    std::vector<Box3f> boxes(nodes.size());
    boxes[0] = boxes[1] = {{0, 0, 0}, {1, 1, 1}};
    const std::vector<Box3f> part_boxes(1);
    const TreePiece piece{0, 0, boxes, part_boxes, {}};
    std::vector<SpreadPlan> plans(nodes.size());
    const Collapse collapse(nodes, {&piece, 1}, plans);
    KdRun whole{0, static_cast<uint32_t>(nodes.size()), {}};
    collapse.plan(whole);
    ASSERT_EQ(collapse.wide_nodes(0), 1U);
    WideNode wide;
    collapse.write({0, 0}, 0, &wide);
    EXPECT_EQ(wide.child[0], WideNode::leaf(0, 1));
    EXPECT_EQ(wide.upper[0][0], 1);
    EXPECT_LT(wide.upper[0][1], wide.lower[0][1]);
}

TEST(Collapse, CutsLeavesThatAreTooLongForAChild) {
    for (const uint32_t blocks : {1U, 32U, 33U, 64U, 100U, 1000U}) {
        const std::vector<KdNode> nodes{KdNode::leaf(7, blocks * kBlockSize)};
        std::vector<Box3f> box{{{0, 0, 0}, {1, 1, 1}}};
        const std::vector<Box3f> part_boxes(blocks, box[0]);
        const TreePiece piece{0, 7, box, part_boxes, {}};
        std::vector<SpreadPlan> plans(1);
        const Collapse collapse(nodes, {&piece, 1}, plans);
        KdRun whole{0, 1, {}};
        collapse.plan(whole);
        std::vector<WideNode> wide(collapse.wide_nodes(0));
        collapse.write({0, 0}, 100, wide.data());
        std::vector<bool> found(blocks);
        for (const WideNode& node : wide) {
            for (int i = 0; i < WideNode::kWidth; ++i) {
                if (node.lower[0][i] <= node.upper[0][i] && (node.child[i] & WideNode::kLeafFlag) != 0) {
                    for (uint32_t b = 0; b < WideNode::blocks(node.child[i]); ++b) {
                        found.at(WideNode::first_block(node.child[i]) - 107 + b) = true;
                    }
                }
            }
        }
        EXPECT_EQ(std::count(found.begin(), found.end(), true), blocks) << blocks << " blocks";
    }
}

}  // namespace
}  // namespace espalier
