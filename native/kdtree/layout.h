// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include "kdtree/subtree_output.h"
#include "kdtree/tree.h"
#include "kdtree/wide_nodes.h"

namespace espalier {

/// Phase 5: derives from the finished kd-tree what rays walk through: triangle blocks, and eight-wide nodes collapsed
/// from the tree's nodes, each child with its tight box, in the order that the split planes give for each ray octant.
/// triangles: kBlockSize face indices per block, padded with kNoTriangle; tree.blocks has room for them.
void build_layout(const TriangleSoup& soup, const TightBoxes& boxes, std::span<const uint32_t> triangles, int threads,
                  TransientMemory& memory, Tree& tree);

/// The wide nodes alone, of a subtree by itself: root first, with indices that count from there.
void collapse_whole(std::span<const KdNode> nodes, const TightBoxes& boxes, WideNodes& out);

}  // namespace espalier
