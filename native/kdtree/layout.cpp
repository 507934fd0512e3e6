// SPDX-License-Identifier: GPL-3.0-or-later
#include "kdtree/layout.h"

#include <algorithm>
#include <array>
#include <bit>
#include <vector>

#include "kdtree/build_kernels.h"
#include "kdtree/parallel.h"

namespace espalier {
namespace {

/// Wide nodes in the order in which they are made. Reserved for the worst case, taken page by page.
class WideNodes {
 public:
    WideNodes() = default;
    WideNodes(size_t capacity, size_t expected) : nodes_(capacity, expected * sizeof(WideNode)) {}
    uint32_t add() { return count_++; }
    uint32_t count() const { return count_; }
    WideNode* data() { return nodes_.data(); }
    void clear() { count_ = 0; }

 private:
    LargeBuffer<WideNode> nodes_;
    uint32_t count_ = 0;
};

/// A run of kd nodes that forms one subtree, laid out by one thread. Where the tree is cut into such runs depends on
/// the tree alone, so that the layout is the same for any number of threads.
struct Run {
    uint32_t begin;
    uint32_t end;
    const WideNode* wide = nullptr;
    uint32_t count = 0;
    uint32_t made_at = 0;  ///< what the indices in `wide` count the first as
    uint32_t place = 0;    ///< of the first, among all
};

uint32_t run_length(size_t nodes) { return static_cast<uint32_t>(std::max<size_t>(512, nodes / 256)); }

/// Something that may become a child of a wide node: a kd node, or part of a kd leaf too large for one child.
struct Item {
    uint32_t node;
    uint32_t first_block;  ///< of a leaf
    uint32_t blocks;       ///< of a leaf; 0 for an inner node
    float area;
    Box3f box;
};

class Collapse {
 public:
    Collapse(const Tree& tree, std::span<const Box3f> boxes) : tree_(tree), boxes_(boxes) {}

    /// Appends the wide node for a kd node and all below it; returns its index. A kd node listed in `runs` is not
    /// entered: its child code is the index of its run, marked for the caller to resolve.
    uint32_t collapse(uint32_t kd_node, WideNodes& out, const std::vector<Run>* runs) const {
        return collapse(item(kd_node), out, runs);
    }

 private:
    Item item(uint32_t node) const {
        const KdNode kd = tree_.nodes[node];
        const Box3f& box = boxes_[node];
        const Vec3f size = box.size();
        Item made{node, 0, 0, size.x * size.y + size.y * size.z + size.z * size.x, box};
        if (kd.is_leaf()) {
            made.first_block = kd.first_block();
            made.blocks = block_count(kd.references());
        }
        return made;
    }

    static bool is_empty(const Tree& tree, uint32_t node) {
        return tree.nodes[node].is_leaf() && tree.nodes[node].references() == 0;
    }

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
        // Per octant the slots of `items`, 4 bits each, the farthest lowest.
        std::array<uint32_t, 8> order{};
        int count = 1;
        items[0] = root;
        for (;;) {
            const int slot = next_to_open(items, count, root.node, runs);
            if (slot < 0) {
                break;
            }
            open(items, count, slot, order);
        }

        const uint32_t index = out.add();
        WideNode& made = out.data()[index];
        made = {};
        std::fill_n(made.child, WideNode::kWidth, WideNode::leaf(0, 1));  // where no child is, no ray gets
        for (int i = 0; i < WideNode::kWidth; ++i) {
            const Box3f box = i < count ? items[static_cast<size_t>(i)].box : Box3f{};
            for (int axis = 0; axis < 3; ++axis) {
                made.lower[axis][i] = box.lower[axis];
                made.upper[axis][i] = box.upper[axis];
            }
        }
        for (size_t octant = 0; octant < 8; ++octant) {
            // Unused slots come first, that is farthest: no ray meets them, but each slot has to appear once.
            uint32_t word = 0;
            int place = 0;
            for (int slot = count; slot < WideNode::kWidth; ++slot) {
                word |= static_cast<uint32_t>(slot) << (3 * place++);
            }
            for (int rank = 0; rank < count; ++rank) {
                word |= (order[octant] >> (4 * rank) & 7U) << (3 * place++);
            }
            made.order[octant] = word;
        }
        for (int i = 0; i < count; ++i) {
            const Item& child = items[static_cast<size_t>(i)];
            if (child.blocks == 0 && is_empty(tree_, child.node)) {
                continue;  // both halves of a split may have lost all they had; no ray meets the box of nothing
            }
            if (child.blocks != 0 && child.blocks <= WideNode::kMaxLeafBlocks) {
                made.child[i] = WideNode::leaf(child.first_block, child.blocks);
            } else if (const Run* run = child.blocks == 0 ? find_run(runs, child.node) : nullptr; run != nullptr) {
                made.child[i] = run->place;
            } else {
                made.child[i] = collapse(child, out, runs);
            }
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
            const bool is_inner = candidate.blocks == 0 && !is_empty(tree_, candidate.node) &&
                                  (candidate.node == root || find_run(runs, candidate.node) == nullptr);
            const bool is_long_leaf = candidate.blocks > WideNode::kMaxLeafBlocks;
            if ((is_inner || is_long_leaf) && (best < 0 || candidate.area > items[static_cast<size_t>(best)].area)) {
                best = i;
            }
        }
        return best;
    }

    /// Replaces an item by its two parts, the near one first in each octant's order.
    void open(std::array<Item, WideNode::kWidth>& items, int& count, int slot, std::array<uint32_t, 8>& order) const {
        const Item opened = items[static_cast<size_t>(slot)];
        int axis = 0;
        if (opened.blocks != 0) {
            Item first = opened;
            first.blocks = opened.blocks / 2;
            Item second = opened;
            second.first_block += first.blocks;
            second.blocks -= first.blocks;
            items[static_cast<size_t>(slot)] = first;
            items[static_cast<size_t>(count)] = second;
        } else {
            const KdNode kd = tree_.nodes[opened.node];
            const uint32_t left = opened.node + 1;
            const uint32_t right = kd.right_child();
            axis = kd.axis();
            if (is_empty(tree_, left) || is_empty(tree_, right)) {  // an empty leaf takes no place
                items[static_cast<size_t>(slot)] = item(is_empty(tree_, left) ? right : left);
                return;
            }
            items[static_cast<size_t>(slot)] = item(left);
            items[static_cast<size_t>(count)] = item(right);
        }
        for (unsigned octant = 0; octant < 8; ++octant) {
            // The two take the place of the opened one, and everything nearer moves up by one.
            const bool left_is_nearer = (octant >> axis & 1U) == 0;
            const uint32_t near = left_is_nearer ? static_cast<uint32_t>(slot) : static_cast<uint32_t>(count);
            const uint32_t far = left_is_nearer ? static_cast<uint32_t>(count) : static_cast<uint32_t>(slot);
            // The lowest nibble that equals the slot.
            const uint32_t differing = order[octant] ^ (static_cast<uint32_t>(slot) * 0x11111111U);
            const int shift = std::countr_zero((differing - 0x11111111U) & ~differing & 0x88888888U) - 3;
            const uint32_t farther = order[octant] & ((1U << shift) - 1);
            const uint32_t nearer = static_cast<uint32_t>(uint64_t{order[octant]} >> (shift + 4) << (shift + 8));
            order[octant] = nearer | (near << (shift + 4)) | (far << shift) | farther;
        }
        ++count;
    }

    const Tree& tree_;
    std::span<const Box3f> boxes_;
};

/// Lists the runs below a node in depth-first order.
void find_runs(const Tree& tree, uint32_t begin, uint32_t end, uint32_t longest, std::vector<Run>& runs) {
    const KdNode node = tree.nodes[begin];
    if (node.is_leaf()) {
        return;  // the node above takes it as it is
    }
    if (end - begin <= longest) {
        runs.push_back({begin, end, {}});
        return;
    }
    find_runs(tree, begin + 1, node.right_child(), longest, runs);
    find_runs(tree, node.right_child(), end, longest, runs);
}

}  // namespace

void build_layout(const TriangleSoup& soup, std::span<const Box3f> boxes, std::span<const uint32_t> triangles,
                  int threads, Tree& tree) {
    constexpr size_t kBlocksPerTask = 512;
    const size_t blocks = triangles.size() / kBlockSize;
    const auto nodes = static_cast<uint32_t>(tree.nodes.size());
    if (blocks == 0) {
        return;
    }
    std::vector<Run> runs;
    find_runs(tree, 0, nodes, run_length(nodes), runs);

    const Collapse collapse(tree, boxes);
    const size_t most_wide_nodes = size_t{nodes} + blocks / (WideNode::kMaxLeafBlocks / 2) + 1;
    std::vector<WideNodes> made(static_cast<size_t>(threads));
    const size_t block_tasks = (blocks + kBlocksPerTask - 1) / kBlocksPerTask;
    parallel_for(threads, runs.size() + block_tasks, [&](size_t i, int worker) {
        if (i < runs.size()) {
            WideNodes& mine = made[static_cast<size_t>(worker)];
            if (mine.data() == nullptr) {
                mine = WideNodes(most_wide_nodes, nodes / 8 / static_cast<size_t>(threads));
            }
            const uint32_t first = mine.count();
            collapse.collapse(runs[i].begin, mine, nullptr);
            runs[i].wide = mine.data() + first;
            runs[i].count = mine.count() - first;
            runs[i].made_at = first;
            return;
        }
        const size_t begin = (i - runs.size()) * kBlocksPerTask;
        const size_t count = std::min(kBlocksPerTask, blocks - begin);
        build_kernels().write_blocks(soup, triangles.data() + begin * kBlockSize, count, tree.blocks.data() + begin);
    });

    // The wide nodes above the runs, whose number is small. A tree that is one run has none.
    WideNodes top(most_wide_nodes, runs.size());
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
    std::copy_n(top.data(), top.count(), tree.wide_nodes.data());
    parallel_for(threads, runs.size(), [&](size_t i) {
        const Run& run = runs[i];
        for (size_t n = 0; n < run.count; ++n) {
            WideNode& wide = tree.wide_nodes[run.place + n];
            wide = run.wide[n];
            for (int child = 0; child < WideNode::kWidth; ++child) {
                if ((wide.child[child] & WideNode::kLeafFlag) == 0) {
                    wide.child[child] += run.place - run.made_at;
                }
            }
        }
    });
}

}  // namespace espalier
