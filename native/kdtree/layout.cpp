// SPDX-License-Identifier: GPL-3.0-or-later
#include "kdtree/layout.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <utility>
#include <vector>

#include "kdtree/build_kernels.h"
#include "kdtree/parallel.h"
#include "kdtree/wide_nodes.h"

namespace espalier {
namespace {

/// A run of kd nodes that forms one subtree, laid out by one thread. Where the tree is cut into such runs depends on
/// the tree alone, so that the layout is the same for any number of threads.
struct Run {
    uint32_t begin;
    uint32_t end;
    int worker = 0;  ///< who has made its wide nodes
    uint32_t count = 0;
    uint32_t made_at = 0;  ///< of the first, among the worker's
    uint32_t place = 0;    ///< of the first, among all
};

uint32_t run_length(size_t nodes) { return static_cast<uint32_t>(std::max<size_t>(512, nodes / 256)); }

/// Something that may become a child of a wide node: a kd node, or part of a kd leaf.
struct Item {
    uint32_t node;
    uint32_t first_block;  ///< of a leaf
    uint32_t blocks;       ///< of a leaf; 0 for an inner node
    uint32_t part;         ///< of a leaf: where the boxes of its parts begin
    float area;
    const TreePiece* piece;  ///< which holds the node
    Box3f box;

    void set_box(const Box3f& new_box) {
        box = new_box;
        area = half_area(new_box);
    }
};

class Collapse {
 public:
    Collapse(std::span<const KdNode> nodes, std::span<const TreePiece> pieces) : nodes_(nodes), pieces_(pieces) {}

    /// Appends the wide node for a kd node and all below it; returns its index. A kd node listed in `runs` is not
    /// entered: its child code is the place of its run.
    uint32_t collapse(uint32_t kd_node, WideNodes& out, const std::vector<Run>* runs) const {
        return collapse(item(kd_node, pieces_.front()), out, runs);
    }

 private:
    /// near: the piece that most likely holds the node.
    Item item(uint32_t node, const TreePiece& near) const {
        const KdNode kd = nodes_[node];
        Item made{node, 0, 0, 0, 0, near.holds(node) ? &near : &piece_of(pieces_, node), {}};
        made.set_box(made.piece->box(node));
        if (kd.is_leaf()) {
            made.first_block = made.part = kd.first_block();
            made.blocks = block_count(kd.references());
        }
        return made;
    }

    bool is_empty(uint32_t node) const { return nodes_[node].is_leaf() && nodes_[node].references() == 0; }

    static const Run* find_run(const std::vector<Run>* runs, uint32_t node) {
        if (runs == nullptr) {
            return nullptr;
        }
        const auto found = std::lower_bound(runs->begin(), runs->end(), node,
                                            [](const Run& run, uint32_t n) { return run.begin < n; });
        return found != runs->end() && found->begin == node ? &*found : nullptr;
    }

    uint32_t collapse(const Item& root, WideNodes& out, const std::vector<Run>* runs) const {
        std::array<Item, WideNode::kWidth> items;
        ChildOrder order;
        int count = 1;
        items[0] = root;
        for (;;) {
            const int slot = next_to_open(items, count, root.node, runs);
            if (slot < 0) {
                break;
            }
            open(items, count, slot, order);
        }
        cut_leaves(items, count, order);

        const uint32_t index = out.add();
        std::array<Box3f, WideNode::kWidth> boxes;
        std::transform(items.begin(), items.begin() + count, boxes.begin(), [](const Item& item) { return item.box; });
        order.write(std::span(boxes).first(static_cast<size_t>(count)), out[index]);
        for (int i = 0; i < count; ++i) {
            const Item& child = items[static_cast<size_t>(i)];
            if (child.blocks == 0 && is_empty(child.node)) {
                continue;  // both halves of a split may have lost all they had; no ray meets the box of nothing
            }
            uint32_t code = 0;
            if (child.blocks != 0 && child.blocks <= WideNode::kMaxLeafBlocks) {
                code = WideNode::leaf(child.first_block, child.blocks);
            } else if (const Run* run = child.blocks == 0 ? find_run(runs, child.node) : nullptr; run != nullptr) {
                code = run->place;
            } else {
                code = collapse(child, out, runs);
            }
            out[index].child[i] = code;
        }
        return index;
    }

    /// The child of largest area that can be opened, or -1.
    int next_to_open(const std::array<Item, WideNode::kWidth>& items, int count, uint32_t root,
                     const std::vector<Run>* runs) const {
        if (count == WideNode::kWidth) {
            return -1;
        }
        int best = -1;
        for (int i = 0; i < count; ++i) {
            const Item& candidate = items[static_cast<size_t>(i)];
            const bool is_inner = candidate.blocks == 0 && !is_empty(candidate.node) &&
                                  (candidate.node == root || find_run(runs, candidate.node) == nullptr);
            const bool is_long_leaf = candidate.blocks > WideNode::kMaxLeafBlocks;
            if ((is_inner || is_long_leaf) && (best < 0 || candidate.area > items[static_cast<size_t>(best)].area)) {
                best = i;
            }
        }
        return best;
    }

    /// Replaces an item by its two parts, the near one first in each octant's order.
    void open(std::array<Item, WideNode::kWidth>& items, int& count, int slot, ChildOrder& order) const {
        const Item opened = items[static_cast<size_t>(slot)];
        int axis = 0;
        if (opened.blocks != 0) {
            Item first = opened;
            first.blocks = opened.blocks / 2;
            Item second = opened;
            second.first_block += first.blocks;
            second.blocks -= first.blocks;
            second.part = second.first_block;
            items[static_cast<size_t>(slot)] = first;
            items[static_cast<size_t>(count)] = second;
        } else {
            const KdNode kd = nodes_[opened.node];
            const uint32_t left = opened.node + 1;
            const uint32_t right = kd.right_child();
            axis = kd.axis();
            if (is_empty(left) || is_empty(right)) {  // an empty leaf takes no place
                items[static_cast<size_t>(slot)] = item(is_empty(left) ? right : left, *opened.piece);
                return;
            }
            items[static_cast<size_t>(slot)] = item(left, *opened.piece);
            items[static_cast<size_t>(count)] = item(right, *opened.piece);
        }
        order.split(axis, slot, count);
        ++count;
    }

    /// The two parts of a leaf of three to kMaxLeafBlocks blocks.
    std::pair<Item, Item> parts(const Item& leaf) const {
        Item first = leaf;
        first.blocks = first_blocks(leaf.blocks);
        first.part = leaf.part + 1;
        first.set_box(leaf.piece->part_box(leaf.part));
        Item second = leaf;
        second.first_block += first.blocks;
        second.blocks -= first.blocks;
        const uint32_t slot = first.part + part_count(first.blocks);
        second.part = slot + 1;
        second.set_box(leaf.piece->part_box(slot));
        return {first, second};
    }

    /// What a leaf costs the rays that meet the node, where two blocks are tested at a time, and to get there takes
    /// half as long as that.
    static float cost(const Item& leaf) {
        const uint32_t steps = (leaf.blocks + 1) / 2;
        return leaf.area * (1 + 2 * static_cast<float>(steps));
    }

    float gain_by_cutting(const Item& item) const {
        if (item.blocks < 3) {
            return 0;
        }
        const auto [first, second] = parts(item);
        return cost(item) - (cost(first) + cost(second));
    }

    /// Gives places that are left over to parts of the leaves that gain most by it.
    void cut_leaves(std::array<Item, WideNode::kWidth>& items, int& count, ChildOrder& order) const {
        std::array<float, WideNode::kWidth> gains{};
        std::transform(items.begin(), items.begin() + count, gains.begin(),
                       [&](const Item& item) { return gain_by_cutting(item); });
        while (count < WideNode::kWidth) {
            const auto slot = static_cast<size_t>(std::max_element(gains.begin(), gains.end()) - gains.begin());
            if (gains[slot] <= 0) {
                return;
            }
            auto [low, high] = parts(items[slot]);
            const Vec3f apart = (high.box.lower + high.box.upper) - (low.box.lower + low.box.upper);
            int axis = 0;
            for (int other = 1; other < 3; ++other) {
                axis = std::abs(apart[other]) > std::abs(apart[axis]) ? other : axis;
            }
            if (apart[axis] < 0) {
                std::swap(low, high);
            }
            const auto added = static_cast<size_t>(count);
            items[slot] = low;
            items[added] = high;
            gains[slot] = gain_by_cutting(low);
            gains[added] = gain_by_cutting(high);
            order.split(axis, static_cast<int>(slot), count);
            ++count;
        }
    }

    std::span<const KdNode> nodes_;
    std::span<const TreePiece> pieces_;
};

/// Lists the runs below a node in depth-first order.
void find_runs(const Tree& tree, uint32_t begin, uint32_t end, uint32_t longest, std::vector<Run>& runs) {
    const KdNode node = tree.nodes[begin];
    if (node.is_leaf()) {
        return;  // the node above takes it as it is
    }
    if (end - begin <= longest) {
        runs.push_back({begin, end});
        return;
    }
    find_runs(tree, begin + 1, node.right_child(), longest, runs);
    find_runs(tree, node.right_child(), end, longest, runs);
}

/// Blocks that one thread writes in one go.
struct BlockTask {
    const uint32_t* triangles;
    size_t count;
    size_t place;
};

std::vector<BlockTask> cut_to_tasks(std::span<const TreePiece> pieces) {
    constexpr size_t kMost = 512;
    std::vector<BlockTask> tasks;
    for (const TreePiece& piece : pieces) {
        const size_t blocks = piece.triangles.size() / kBlockSize;
        for (size_t begin = 0; begin < blocks; begin += kMost) {
            tasks.push_back({piece.triangles.data() + begin * kBlockSize, std::min(kMost, blocks - begin),
                             piece.first_block + begin});
        }
    }
    return tasks;
}

}  // namespace

void collapse_whole(std::span<const KdNode> nodes, const TreePiece& piece, WideNodes& out) {
    out.clear();
    Collapse(nodes, {&piece, 1}).collapse(0, out, nullptr);
}

void build_layout(const TriangleSoup& soup, std::span<const TreePiece> pieces, int threads, TransientMemory& memory,
                  Tree& tree) {
    const size_t blocks = tree.blocks.size();
    const auto nodes = static_cast<uint32_t>(tree.nodes.size());
    if (blocks == 0) {
        return;
    }
    std::vector<Run> runs;
    find_runs(tree, 0, nodes, run_length(nodes), runs);

    const std::vector<BlockTask> block_tasks = cut_to_tasks(pieces);
    const Collapse collapse(tree.nodes.span(), pieces);
    const SizeClasses classes(tree.bounds);
    std::vector<WideNodes> made(static_cast<size_t>(threads));
    parallel_for(threads, runs.size() + block_tasks.size(), [&](size_t i, int worker) {
        if (i < runs.size()) {
            WideNodes& mine = made[static_cast<size_t>(worker)];
            Run& run = runs[i];
            run.worker = worker;
            run.made_at = mine.count();
            if (run.made_at == 0) {
                mine = WideNodes(nodes / 5 / static_cast<size_t>(threads) + 64, memory);
            }
            collapse.collapse(run.begin, mine, nullptr);
            run.count = mine.count() - run.made_at;
            return;
        }
        const BlockTask& task = block_tasks[i - runs.size()];
        tree.blocks.take_pages(task.place, task.place + task.count);
        build_kernels().write_blocks(soup, classes, task.triangles, task.count, tree.blocks.data() + task.place);
    });

    // The wide nodes above the runs, whose number is small. A tree that is one run has none.
    WideNodes top(runs.size() + 64, memory);
    const auto place_runs = [&](uint32_t first) {
        for (Run& run : runs) {
            run.place = first;
            first += run.count;
        }
        return first;
    };
    if (runs.size() != 1 || runs[0].begin != 0) {
        collapse.collapse(0, top, &runs);  // once to learn its size, which the runs' places depend on
        place_runs(top.count());
        top.clear();
        collapse.collapse(0, top, &runs);
    }
    tree.wide_nodes = LargeBuffer<WideNode>(place_runs(top.count()));
    std::copy_n(&top[0], top.count(), tree.wide_nodes.data());
    parallel_for(threads, runs.size(), [&](size_t i) {
        const Run& run = runs[i];
        tree.wide_nodes.take_pages(run.place, run.place + run.count);
        for (size_t n = 0; n < run.count; ++n) {
            WideNode& wide = tree.wide_nodes[run.place + n];
            wide = made[static_cast<size_t>(run.worker)][run.made_at + n];
            for (int child = 0; child < WideNode::kWidth; ++child) {
                if ((wide.child[child] & WideNode::kLeafFlag) == 0) {
                    wide.child[child] += run.place - run.made_at;
                }
            }
        }
    });
}

}  // namespace espalier
