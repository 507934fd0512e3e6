// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <deque>
#include <mutex>
#include <span>
#include <vector>

#include "kdtree/build_kernels.h"
#include "kdtree/top_levels.h"

namespace espalier {

/// Phases 3 and 4: the subtrees below the top levels, and all nodes in their depth-first places. Threads take whole
/// subtrees, the largest first; one that finds none left is given part of one that is still being built. Which thread
/// builds what decides where its nodes lie until phase 4, and the rest until phase 5, never what the tree is.
class Subtrees : public SubtreeSharing {
 public:
    /// memory: for what this needs itself; the references lie at its front, where the tree's blocks then stay.
    Subtrees(const TriangleSoup& soup, const BuildParameters& parameters, const std::atomic<bool>* cancel, int threads,
             BuildMemory& memory)
        : memory_(memory),
          soup_(soup),
          parameters_(parameters),
          cancel_(cancel),
          threads_(threads),
          outputs_(static_cast<size_t>(threads)) {}

    /// One subtree that is the whole tree, built where its references lie.
    void add_whole(const OpenNode& root, ReferenceBuffer references);
    /// One subtree that is the whole tree, of references sorted by the leaves of a multiway split.
    void add_sorted(TopLevels& top);
    /// A subtree for each node that the top levels left unsplit.
    void add_below(TopLevels& top);

    /// Phase 3.
    void build();
    /// Phase 4: fills in tree.nodes, and makes room for tree.blocks in memory that is no longer needed. `top` is null
    /// for a whole tree.
    void compact(TopLevels* top, Tree& tree);

    /// After compaction: of the whole tree.
    std::span<const TreePiece> pieces() const { return pieces_; }

    uint32_t give(const OpenNode& node, const References& references) override;

 private:
    /// Places among the references where a thread may build.
    struct Room {
        size_t begin;
        size_t end;
    };

    struct Subtree {
        OpenNode root;
        const TopNode* top = nullptr;  ///< null for the whole tree and for what was given by a thread
        bool is_gathered = false;      ///< whether its references are in one piece
        size_t begin = 0;              ///< of them
        size_t space = 0;              ///< for right children, to the end of the room
        Room room{};                   ///< none before a thread takes the subtree, but for given ones
        // Where the thread that built it put it:
        int worker = 0;
        size_t first_node = 0;
        size_t node_end = 0;
        size_t first_triangle = 0;
        size_t triangle_end = 0;
        size_t first_gap = 0;
        size_t gap_end = 0;
        // Where it goes:
        size_t place = 0;
        size_t place_end = 0;
        size_t triangle_place = 0;
        size_t triangle_place_end = 0;
    };

    void gather_all(TopLevels& top);
    Subtree* take();
    void finish(const Subtree& subtree);
    void build_one(Subtree& subtree, int worker);
    std::span<const Gap> gaps(const Subtree& subtree) const;
    void place(Subtree& subtree, size_t& nodes, size_t& triangles);
    void place(const TopLevels& top, uint32_t index, size_t& nodes, size_t& triangles);
    void copy(const Subtree& subtree, Tree& tree) const;
    void write_top(const TopLevels& top, uint32_t index, Tree& tree);
    void close_gaps(const Subtree& subtree, Tree& tree);
    void extend_boxes(const Tree& tree, size_t index, size_t last);
    Box3f& box(size_t place);
    size_t place_of(const Subtree& subtree, size_t node) const;

    BuildMemory& memory_;
    const TriangleSoup& soup_;
    const BuildParameters& parameters_;
    const std::atomic<bool>* cancel_;
    const int threads_;

    std::mutex mutex_;
    std::deque<Subtree> subtrees_;
    std::deque<Subtree*> waiting_;
    size_t unfinished_ = 0;
    bool is_abandoned_ = false;
    std::vector<Room> rooms_;           ///< in which nothing is built
    std::atomic<uint32_t> changes_{0};  ///< of the five above

    const SortedNode* sorted_ = nullptr;  ///< if that is the one subtree
    References references_;
    ReferenceBuffer own_references_;      ///< where they do not lie in the memory of the top levels
    std::vector<SubtreeOutput> outputs_;  ///< per thread

    std::vector<Subtree*> of_top_;    ///< per top node; null where the node is split
    std::vector<size_t> top_places_;  ///< per top node
    std::vector<Box3f> top_boxes_;    ///< likewise
    std::vector<TreePiece> pieces_;
};

}  // namespace espalier
