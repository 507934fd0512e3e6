// SPDX-License-Identifier: GPL-3.0-or-later
#include "kdtree/multiway_split.h"

#include <algorithm>
#include <span>

namespace espalier {

bool SortedNode::add_up() {
    for (const SortedChunk& chunk : chunks) {
        for (size_t leaf = 0; leaf < count.size(); ++leaf) {
            count[leaf] += chunk.count[leaf];
            tight[leaf].extend(chunk.tight[leaf]);
            total_ += chunk.count[leaf];
        }
    }
    return total_ <= node.count + node.spare;
}

OpenNode SortedNode::leaf(uint32_t leaf, const Box3f& cell, int depth) const {
    const uint64_t rest = node.count + node.spare - std::max<uint64_t>(total_, node.count);
    return {cell, tight[leaf], count[leaf], count[leaf] == 0 ? 0 : rest * count[leaf] / total_, depth};
}

bool SortedNode::has_plane_in_upper_end() const {
    const auto branches = std::span(split.branches).first(split.leaves - 1);
    return std::any_of(branches.begin(), branches.end(), [&](const MultiwaySplit::Branch& branch) {
        return branch.split.position == node.cell.upper[branch.split.axis];
    });
}

uint32_t SortedNode::skip_planes_beside(const Box3f& cell, uint32_t child) const {
    while (!MultiwaySplit::is_leaf(child)) {
        const auto& [plane, leaf, children] = split.branch(child);
        if (plane.position <= cell.lower[plane.axis]) {
            child = children[1];
        } else if (plane.position >= cell.upper[plane.axis]) {
            child = children[0];
        } else {
            break;
        }
    }
    return child;
}

void SortedNode::gather(uint32_t leaf, const References& to) const {
    size_t place = 0;
    for (const SortedChunk& chunk : chunks) {
        copy_references(chunk.places.at(chunk.begin[leaf]), chunk.count[leaf], to.at(place));
        place += chunk.count[leaf];
    }
}

}  // namespace espalier
