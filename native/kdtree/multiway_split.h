// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <algorithm>
#include <array>
#include <bit>
#include <cstdint>
#include <numeric>
#include <vector>

#include "geometry/vec.h"
#include "kdtree/open_node.h"
#include "kdtree/references.h"

namespace espalier {

/// Nodes of so many references, more than a processor's own cache holds, are split several levels at once.
constexpr uint32_t kMultiwayFrom = 1U << 17;
/// Until there are so many expected in each leaf, or too many leaves.
constexpr uint32_t kMultiwayLeaf = 1U << 15;
/// References of a node, or faces of the scene, that are sorted by leaves in one go.
constexpr uint32_t kChunk = 4096;

/// The planes of several levels of a node.
struct MultiwaySplit {
    static constexpr uint32_t kMostLeaves = 16;

    struct Branch {
        Split split;
        uint32_t leaf;                  ///< which it splits, of those there were before: what lies left keeps the
                                        ///< number, what lies right becomes the next leaf
        std::array<uint32_t, 2> child;  ///< numbers of leaves, or kMostLeaves + those of branches further down
    };
    static bool is_leaf(uint32_t child) { return child < kMostLeaves; }
    const Branch& branch(uint32_t child) const { return branches[child - kMostLeaves]; }

    std::array<Branch, kMostLeaves - 1> branches;
    uint32_t leaves = 1;  ///< one more than branches
    uint32_t root = 0;    ///< as a child
};

/// Where a chunk's references went, by leaves.
struct SortedChunk {
    static constexpr uint32_t kMargin = 16;  ///< places between leaves that vector code may write
    /// Places for a chunk itself, and for the pieces of those that straddle planes.
    static constexpr size_t kScratch = kChunk + (MultiwaySplit::kMostLeaves + size_t{1}) * (kChunk + kMargin);

    References places;
    std::array<uint32_t, MultiwaySplit::kMostLeaves> begin{};  ///< among the places
    std::array<uint32_t, MultiwaySplit::kMostLeaves> count{};
    std::array<Box3f, MultiwaySplit::kMostLeaves> tight{};

    uint64_t total() const { return std::accumulate(count.begin(), count.end(), uint64_t{0}); }
};

/// A node whose references are sorted by the leaves of a multiway split, chunk by chunk.
struct SortedNode {
    OpenNode node;
    MultiwaySplit split;
    std::vector<SortedChunk> chunks;
    std::array<uint32_t, MultiwaySplit::kMostLeaves> count{};  ///< sums over the chunks
    std::array<Box3f, MultiwaySplit::kMostLeaves> tight{};

    /// Once the chunks are there; false if they hold more references than the node may have.
    bool add_up();
    /// What a leaf is, in a cell that the planes above it leave.
    OpenNode leaf(uint32_t leaf, const Box3f& cell, int depth) const;
    /// Whether a plane lies in the upper end of the node's cell. What is flat in both went right of it.
    bool has_plane_in_upper_end() const;
    /// The first below a child that cuts the cell: when the planes of the root were chosen, its box was not known but
    /// that of all vertices, and some planes may lie beside it. There must be none in its upper end.
    uint32_t skip_planes_beside(const Box3f& cell, uint32_t child) const;
    /// Copies a leaf's references into one piece.
    void gather(uint32_t leaf, const References& to) const;

 private:
    uint64_t total_ = 0;
};

/// A sample is a 2^-shift of a node's references: 2^14 to 2^15 of them, unless there are very many.
inline uint32_t sampling_shift(uint32_t count) {
    return std::min<uint32_t>(static_cast<uint32_t>(std::bit_width(count)) - 15, 8);
}
/// Places for so large a sample to be partitioned in.
constexpr size_t sample_room(size_t sample) { return 2 * sample + sample / 4 + 64; }

}  // namespace espalier
