// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <atomic>
#include <memory>
#include <mutex>
#include <vector>

#include "kdtree/collapse.h"
#include "kdtree/subtree_output.h"
#include "kdtree/top_levels.h"

namespace espalier {

/// Triangles from which on a picture is there sooner if subtrees wait: in smaller scenes most are opened by some ray,
/// and opening costs more than building all at once.
constexpr uint32_t kOnDemandPays = 2'000'000;

/// A tree of which only the top is built; every subtree below waits for the first ray that enters it (Wald, Friedrich,
/// Marmitt, Slusallek and Seidel 2005 build so too, within a frame; Hunt, Mark and Fussell 2007 lazily). A large one is
/// then split into a wide node's children, which wait in turn; a small one is built whole. What is made is appended to
/// the tree's wide nodes and blocks, for which address space is reserved, so nothing that rays walk through moves.
class OnDemand {
 public:
    OnDemand(const TriangleSoup& soup, const BuildParameters& parameters, const std::atomic<bool>* cancel, int threads);

    /// Phase 1, and phase 2 down to nodes enough to keep all threads busy.
    void make_references(Tree& tree);
    void split_top(Tree& tree);

    /// What became of an unopened child: the code of a wide node or a leaf. Any thread may ask; one builds, and others
    /// that want the same wait for it.
    uint32_t open(uint32_t child);

    /// How many wait or waited for rays, and how many of those were opened.
    uint32_t subtrees() const { return part_count_.load(std::memory_order_relaxed) - opened_before_; }
    uint32_t opened() const { return opened_.load(std::memory_order_relaxed) - opened_before_; }

 private:
    /// A subtree that waits to be opened.
    struct Part {
        std::atomic<uint32_t> code{0};  ///< once it is open; 0 is the root, which is nobody's child
        std::mutex mutex;
        OpenNode node;
        const TopNode* top;  ///< whose segments hold the references; null if they lie here:
        References references;
    };
    /// Made when the first of them is needed: most scenes have far fewer than they might.
    struct PartChunk {
        static constexpr uint32_t kSize = 512;
        std::once_flag is_made;
        std::unique_ptr<Part[]> parts;
    };
    /// What building a subtree takes, used again and again.
    struct Scratch {
        ReferenceBuffer room;
        SubtreeOutput output{kWholeOutput};
        std::vector<SpreadPlan> plans;
    };
    static constexpr size_t kWholeOutput = 16384;

    Part& part(uint32_t number) { return parts_[number / PartChunk::kSize].parts[number % PartChunk::kSize]; }
    uint32_t lay_out(uint32_t top_node);
    uint32_t new_part(const OpenNode& node, const TopNode* top, const References& references);
    uint32_t build(Part& part);
    std::unique_ptr<Scratch> take_scratch();
    uint32_t divide(const Part& part, Scratch& scratch);
    uint32_t build_whole(const OpenNode& node, Scratch& scratch);
    uint32_t add_nodes(uint32_t count);

    const TriangleSoup soup_;
    const BuildParameters parameters_;
    const BuildKernels& kernels_;
    TopLevels top_;
    const int threads_;
    const uint32_t whole_;  ///< a subtree of at most so many references is built in one go

    SegmentMemory memory_;  ///< of the references of subtrees that wait, but for the top's
    const uint32_t most_parts_;
    std::vector<PartChunk> parts_;
    std::atomic<uint32_t> part_count_{0};
    std::atomic<uint32_t> opened_{0};
    uint32_t opened_before_ = 0;  ///< rays started

    SizeClasses classes_;
    WideNode* nodes_ = nullptr;  ///< the tree's
    TriangleBlock* blocks_ = nullptr;
    size_t most_blocks_;
    std::atomic<size_t> node_count_{0};
    std::atomic<size_t> block_count_{0};

    std::mutex scratch_mutex_;
    std::vector<std::unique_ptr<Scratch>> scratch_;  ///< that nobody uses now
    size_t scratch_count_ = 0;                       ///< of all, those in use among them
};

}  // namespace espalier
