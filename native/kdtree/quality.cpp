// SPDX-License-Identifier: GPL-3.0-or-later
#include "kdtree/quality.h"

#include <algorithm>
#include <cstring>
#include <vector>

#include "kdtree/parallel.h"

namespace espalier {
namespace {

double half_area(const Box3f& box) {
    const Vec3d size = to_double(box.upper) - to_double(box.lower);
    return size.x * size.y + size.y * size.z + size.z * size.x;
}

/// Adds up the tree below a node: counts, and areas weighted by cost.
double add_cost(const Tree& tree, uint32_t index, const Box3f& cell, BuildReport& report) {
    const KdNode node = tree.nodes[index];
    if (node.is_leaf()) {
        ++report.leaves;
        report.empty_leaves += node.references() == 0 ? 1 : 0;
        report.references += node.references();
        return report.sah_constants.block * block_count(node.references()) * half_area(cell);
    }
    Box3f left = cell;
    Box3f right = cell;
    left.upper[node.axis()] = node.split();
    right.lower[node.axis()] = node.split();
    const double below = add_cost(tree, index + 1, left, report) + add_cost(tree, node.right_child(), right, report);
    return report.sah_constants.traversal * half_area(cell) + below;
}

/// FNV-1a over 64-bit words, mixed as in splitmix64.
class Checksum {
 public:
    void add_word(uint64_t word) {
        state_ = (state_ ^ word) * 0x9e3779b97f4a7c15U;
        state_ ^= state_ >> 32;
    }
    void add(const KdNode& node) { add_bytes(node); }
    void add(const WideNode& node) { add_bytes(node); }
    void add(const TriangleBlock& block) { add_bytes(block.triangle); }
    uint64_t value() const { return state_; }

 private:
    template <class T>
    void add_bytes(const T& item) {
        constexpr size_t kBytes = sizeof(T);
        static_assert(kBytes % sizeof(uint64_t) == 0);
        uint64_t words[kBytes / sizeof(uint64_t)];
        std::memcpy(words, &item, kBytes);
        for (const uint64_t word : words) {
            add_word(word);
        }
    }

    uint64_t state_ = 0xcbf29ce484222325U;
};

/// Of nodes, wide nodes and the triangles of blocks: chunks of fixed length, on all threads, and then of their
/// checksums.
uint64_t tree_checksum(const Tree& tree, int threads) {
    constexpr size_t kChunk = 8192;
    const auto chunks_of = [](const auto& buffer) { return (buffer.size() + kChunk - 1) / kChunk; };
    const size_t wide_from = chunks_of(tree.nodes);
    const size_t blocks_from = wide_from + chunks_of(tree.wide_nodes);
    std::vector<uint64_t> parts(blocks_from + chunks_of(tree.blocks));
    parallel_for(threads, parts.size(), [&](size_t i) {
        Checksum checksum;
        const auto add_chunk = [&](const auto& buffer, size_t chunk) {
            const size_t begin = chunk * kChunk;
            const size_t end = std::min(begin + kChunk, buffer.size());
            for (size_t k = begin; k < end; ++k) {
                checksum.add(buffer[k]);
            }
        };
        if (i < wide_from) {
            add_chunk(tree.nodes, i);
        } else if (i < blocks_from) {
            add_chunk(tree.wide_nodes, i - wide_from);
        } else {
            add_chunk(tree.blocks, i - blocks_from);
        }
        parts[i] = checksum.value();
    });
    Checksum whole;
    for (const uint64_t part : parts) {
        whole.add_word(part);
    }
    return whole.value();
}

}  // namespace

void measure_quality(Tree& tree, int threads) {
    BuildReport& report = tree.report;
    report.nodes = tree.nodes.size();
    report.wide_nodes = tree.wide_nodes.size();
    report.bytes = tree.nodes.bytes() + tree.wide_nodes.bytes() + tree.blocks.bytes();
    const double area = tree.bounds.is_empty() ? 0 : half_area(tree.bounds);
    const double cost = add_cost(tree, 0, tree.bounds, report);
    report.sah_cost = area > 0 ? cost / area : 0;

    report.checksum = tree_checksum(tree, threads);
}

}  // namespace espalier
