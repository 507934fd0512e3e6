// SPDX-License-Identifier: GPL-3.0-or-later
#include "kdtree/quality.h"

#include <cstring>

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
    void add(uint64_t word) {
        state_ = (state_ ^ word) * 0x9e3779b97f4a7c15U;
        state_ ^= state_ >> 32;
    }
    template <class T>
    void add_all(const T* items, size_t count) {
        static_assert(sizeof(T) % sizeof(uint64_t) == 0);
        for (size_t i = 0; i < count; ++i) {
            uint64_t words[sizeof(T) / sizeof(uint64_t)];
            std::memcpy(words, items + i, sizeof(T));
            for (const uint64_t word : words) {
                add(word);
            }
        }
    }
    uint64_t value() const { return state_; }

 private:
    uint64_t state_ = 0xcbf29ce484222325U;
};

}  // namespace

void measure_quality(Tree& tree) {
    BuildReport& report = tree.report;
    report.nodes = tree.nodes.size();
    report.wide_nodes = tree.wide_nodes.size();
    report.bytes = tree.nodes.bytes() + tree.wide_nodes.bytes() + tree.blocks.bytes();
    const double area = tree.bounds.is_empty() ? 0 : half_area(tree.bounds);
    const double cost = add_cost(tree, 0, tree.bounds, report);
    report.sah_cost = area > 0 ? cost / area : 0;

    Checksum checksum;
    checksum.add_all(tree.nodes.data(), tree.nodes.size());
    checksum.add_all(tree.wide_nodes.data(), tree.wide_nodes.size());
    for (const TriangleBlock& block : tree.blocks.span()) {
        uint64_t words[kBlockSize / 2];
        std::memcpy(words, block.triangle, sizeof words);
        for (const uint64_t word : words) {
            checksum.add(word);
        }
    }
    report.checksum = checksum.value();
}

}  // namespace espalier
