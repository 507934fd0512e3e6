// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <span>

#include "kdtree/tree.h"
#include "kdtree/tree_piece.h"

namespace espalier {

/// Phase 5: derives from the finished kd-tree what rays walk through: triangle blocks, and eight-wide nodes collapsed
/// from the tree's nodes, each child with its tight box, in the order that the split planes give for each ray octant.
/// pieces: of all nodes, in order; tree.blocks has room for their triangles. memory: for plans, and for the wide nodes
/// where they fit behind the blocks.
void build_layout(const TriangleSoup& soup, std::span<const TreePiece> pieces, int threads, BuildMemory& memory,
                  Tree& tree);

}  // namespace espalier
