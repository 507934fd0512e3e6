// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <span>

#include "kdtree/tree.h"
#include "kdtree/tree_piece.h"
#include "kdtree/wide_nodes.h"

namespace espalier {

/// Phase 5: derives from the finished kd-tree what rays walk through: triangle blocks, and eight-wide nodes collapsed
/// from the tree's nodes, each child with its tight box, in the order that the split planes give for each ray octant.
/// pieces: of all nodes, in order; tree.blocks has room for their triangles.
void build_layout(const TriangleSoup& soup, std::span<const TreePiece> pieces, int threads, TransientMemory& memory,
                  Tree& tree);

/// The wide nodes alone, of a subtree by itself: root first, with indices that count from there.
void collapse_whole(std::span<const KdNode> nodes, const TreePiece& piece, WideNodes& out);

}  // namespace espalier
