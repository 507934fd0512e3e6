// SPDX-License-Identifier: GPL-3.0-or-later
#include "kdtree/layout.h"

#include <algorithm>
#include <vector>

#include "kdtree/build_kernels.h"
#include "kdtree/collapse.h"
#include "kdtree/parallel.h"

namespace espalier {
namespace {

uint32_t run_length(size_t nodes) { return static_cast<uint32_t>(std::max<size_t>(512, nodes / 256)); }

/// Lists the runs below a node in depth-first order.
void find_runs(const Tree& tree, uint32_t begin, uint32_t end, uint32_t longest, std::vector<KdRun>& runs) {
    const KdNode node = tree.nodes[begin];
    if (node.is_leaf()) {
        return;  // planned with the nodes above
    }
    if (end - begin <= longest) {
        runs.push_back({begin, end, {}});
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

void build_layout(const TriangleSoup& soup, std::span<const TreePiece> pieces, int threads, BuildMemory& memory,
                  Tree& tree) {
    const size_t blocks = tree.blocks.size();
    const auto nodes = static_cast<uint32_t>(tree.nodes.size());
    if (blocks == 0) {
        return;
    }
    std::vector<KdRun> runs;
    find_runs(tree, 0, nodes, run_length(nodes), runs);

    const std::vector<BlockTask> block_tasks = cut_to_tasks(pieces);
    const SizeClasses classes(tree.bounds);
    LargeBuffer<SpreadPlan> plans = memory.take<SpreadPlan>(nodes);
    const Collapse collapse(tree.nodes.span(), pieces, {plans.data(), nodes});
    parallel_for(threads, runs.size(), [&](size_t i) { collapse.plan(runs[i]); });
    // What one thread alone can do, while the others write blocks.
    std::vector<WideSubtree> subtrees;
    const bool blocks_have_pages = memory.has_pages(tree.blocks);
    parallel_for(threads, 1 + block_tasks.size(), [&](size_t i) {
        if (i == 0) {
            collapse.plan_above(runs);
            tree.wide_nodes = memory.keep_more<WideNode>(collapse.wide_nodes(0));
            subtrees = collapse.write_above(runs, tree.wide_nodes.data());
            return;
        }
        const BlockTask& task = block_tasks[i - 1];
        if (!blocks_have_pages) {
            tree.blocks.take_pages(task.place, task.place + task.count);
        }
        build_kernels().write_blocks(soup, classes, task.triangles, task.count, tree.blocks.data() + task.place);
    });
    const bool nodes_have_pages = memory.has_pages(tree.wide_nodes);
    parallel_for(threads, subtrees.size(), [&](size_t i) {
        const WideSubtree& subtree = subtrees[i];
        if (!nodes_have_pages) {
            tree.wide_nodes.take_pages(subtree.place, subtree.place + collapse.wide_nodes(subtree.node));
        }
        collapse.write(subtree, 0, tree.wide_nodes.data());
    });
}

}  // namespace espalier
