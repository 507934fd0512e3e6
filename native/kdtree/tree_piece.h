// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <algorithm>
#include <cstdint>
#include <span>

#include "geometry/vec.h"

namespace espalier {

/// What the finished tree's nodes do not hold of themselves, for a stretch of them that one thread made one after
/// another: it stays where that thread put it. Boxes of the parts of leaves (see node.h) are of the first part, of all
/// parts of that, and likewise of the second, from the place on that is the number of the leaf's first block.
struct TreePiece {
    uint32_t first_node;
    uint32_t first_block;
    std::span<Box3f> boxes;  ///< tight around what lies in each node
    std::span<const Box3f> part_boxes;
    std::span<const uint32_t> triangles;  ///< of the leaves, in whole blocks

    bool holds(uint32_t node) const { return node - first_node < boxes.size(); }
    Box3f& box(uint32_t node) const { return boxes[node - first_node]; }
    const Box3f& part_box(uint32_t place) const { return part_boxes[place - first_block]; }
};

/// The piece that holds a node, of pieces in the order of their nodes.
inline const TreePiece& piece_of(std::span<const TreePiece> pieces, uint32_t node) {
    return *(std::upper_bound(pieces.begin(), pieces.end(), node,
                              [](uint32_t n, const TreePiece& piece) { return n < piece.first_node; }) -
             1);
}

}  // namespace espalier
