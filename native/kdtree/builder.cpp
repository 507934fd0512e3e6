// SPDX-License-Identifier: GPL-3.0-or-later
#include <algorithm>
#include <chrono>
#include <numeric>
#include <optional>

#include "geometry/float_environment.h"
#include "kdtree/build_kernels.h"
#include "kdtree/layout.h"
#include "kdtree/parallel.h"
#include "kdtree/quality.h"
#include "kdtree/top_levels.h"

namespace espalier {
namespace {

constexpr uint32_t kMaxTriangles = 1U << 28;

class Stopwatch {
 public:
    /// Milliseconds since the last lap.
    double lap() {
        const auto now = std::chrono::steady_clock::now();
        const double ms = std::chrono::duration<double, std::milli>(now - last_).count();
        last_ = now;
        return ms;
    }

 private:
    std::chrono::steady_clock::time_point last_ = std::chrono::steady_clock::now();
};

BuildParameters parameters_of(Quality quality) {
    BuildParameters parameters{{}, true};
    switch (quality) {
        case Quality::kDraft:
            parameters.clip = false;
            parameters.sah.block = 8.0;
            break;
        case Quality::kBalanced:
            break;
        case Quality::kBest:
            break;
    }
    return parameters;
}

/// A finished subtree: where its thread put it, and where it goes.
struct Subtree {
    const OpenNode* root;
    const TopNode* top;  ///< whose segments hold the references; null if they are in place already
    int worker = 0;
    size_t first_node = 0;
    size_t node_count = 0;
    size_t first_triangle = 0;
    size_t triangle_count = 0;
    uint32_t place = 0;  ///< in the final node array
    uint32_t block_place = 0;
};

/// The phases of a build, in order.
class Builder {
 public:
    Builder(const TriangleSoup& soup, const BuildOptions& options)
        : soup_(soup),
          cancel_(options.cancel),
          threads_(options.threads > 0 ? options.threads : hardware_threads()),
          parameters_(parameters_of(options.quality)),
          outputs_(static_cast<size_t>(threads_)),
          rooms_(static_cast<size_t>(threads_)) {}

    Tree build() {
        Stopwatch total;
        Stopwatch watch;
        PhaseTimes& phases = tree_.report.phases_ms;
        if (threads_ == 1) {
            make_references_alone();
            phases.bounds = watch.lap();
        } else {
            TopLevels& top = top_.emplace(soup_, parameters_, cancel_, threads_);
            top.make_references();
            phases.bounds = watch.lap();
            tree_.report.rejected_faces = top.rejected();
            tree_.bounds = top.nodes()[0].node.cell;
            // Six subtrees a thread even out their different costs.
            top.split_above(soup_.size() / (6 * static_cast<uint32_t>(threads_)));
            list_subtrees();
            phases.top_levels = watch.lap();
        }
        build_subtrees();
        phases.subtrees = watch.lap();
        compact();
        phases.compaction = watch.lap();
        build_layout(soup_, boxes_, triangles_, threads_, tree_);
        release_working_memory();
        phases.layout = watch.lap();
        tree_.report.build_ms = total.lap();
        return std::move(tree_);
    }

    int threads() const { return threads_; }
    const BuildParameters& parameters() const { return parameters_; }

 private:
    /// One thread needs no top levels: all references in one piece, and one subtree.
    void make_references_alone() {
        const uint32_t triangles = soup_.size();
        rooms_[0] = ReferenceBuffer(subtree_room(triangles), expected_block_bytes(triangles));
        const uint32_t count = build_kernels().make_references(soup_, 0, triangles, rooms_[0].references(),
                                                               tree_.bounds, tree_.report.rejected_faces);
        whole_ = {tree_.bounds, tree_.bounds, count, spare_references(triangles), 0};
        subtrees_.push_back({&whole_, nullptr});
    }

    void list_subtrees() {
        for (const TopNode& node : top_->nodes()) {
            if (!node.is_split()) {
                subtrees_.push_back({&node.node, &node});
            }
        }
    }

    /// Phase 3: the largest first, so that the last to end are small.
    void build_subtrees() {
        std::vector<uint32_t> by_size(subtrees_.size());
        std::iota(by_size.begin(), by_size.end(), 0U);
        std::stable_sort(by_size.begin(), by_size.end(),
                         [&](uint32_t a, uint32_t b) { return subtrees_[a].root->count > subtrees_[b].root->count; });
        size_t room = 0;
        for (const Subtree& subtree : subtrees_) {
            room = std::max(room, subtree_room(subtree.root->count));
        }
        parallel_for(threads_, subtrees_.size(), [&](size_t i, int worker) {
            const auto w = static_cast<size_t>(worker);
            Subtree& subtree = subtrees_[by_size[i]];
            if (subtree.top != nullptr) {
                if (rooms_[w].references().triangle == nullptr) {
                    rooms_[w] = ReferenceBuffer(room);
                }
                top_->gather(*subtree.top, rooms_[w].references());
            }
            SubtreeOutput& output = outputs_[w];
            if (output.nodes().data() == nullptr) {
                output = SubtreeOutput(soup_.size() / static_cast<uint32_t>(threads_));
            }
            subtree.worker = worker;
            subtree.first_node = output.node_count();
            subtree.first_triangle = output.triangle_count();
            build_kernels().build_subtree({&soup_, &parameters_, cancel_, &rooms_[w]}, *subtree.root, output);
            subtree.node_count = output.node_count() - subtree.first_node;
            subtree.triangle_count = output.triangle_count() - subtree.first_triangle;
        });
    }

    /// Phase 4: every node to its depth-first place. The references are no longer needed; the triangle blocks get their
    /// memory.
    void compact() {
        size_t nodes = 0;
        size_t triangles = 0;
        std::vector<uint32_t> top_places;
        if (top_) {
            top_places.resize(top_->nodes().size());
            subtree_of_.assign(top_->nodes().size(), nullptr);
            for (Subtree& subtree : subtrees_) {
                subtree_of_[static_cast<size_t>(subtree.top - top_->nodes().data())] = &subtree;
            }
            place(0, nodes, triangles, top_places);
        } else {
            nodes = subtrees_[0].node_count;
            triangles = subtrees_[0].triangle_count;
        }
        if (nodes > (1U << 30) || triangles / kBlockSize > kMaxBlocks) {
            throw std::length_error("the tree needs more nodes or blocks than its indices can count");
        }
        LargeBuffer<uint32_t> references = top_ ? top_->take_memory() : rooms_[0].take_memory();
        rooms_.clear();
        tree_.blocks = std::move(references).reuse_for<TriangleBlock>(triangles / kBlockSize);
        tree_.nodes = LargeBuffer<KdNode>(nodes);
        if (!top_) {
            std::copy_n(outputs_[0].nodes().begin(), nodes, tree_.nodes.data());
            boxes_ = outputs_[0].boxes();
            triangles_ = outputs_[0].triangles();
            return;
        }
        joined_boxes_ = LargeBuffer<Box3f>(nodes);
        joined_triangles_ = LargeBuffer<uint32_t>(triangles);
        parallel_for(threads_, subtrees_.size(), [&](size_t i) { copy_subtree(subtrees_[i]); });
        write_top(0, top_places);
        boxes_ = joined_boxes_.span();
        triangles_ = joined_triangles_.span();
    }

    /// Gives every top node and subtree its place, in depth-first order.
    void place(uint32_t index, size_t& nodes, size_t& triangles, std::vector<uint32_t>& top_places) {
        top_places[index] = static_cast<uint32_t>(nodes);
        const TopNode& top = top_->nodes()[index];
        if (Subtree* subtree = subtree_of_[index]; subtree != nullptr) {
            subtree->place = static_cast<uint32_t>(nodes);
            subtree->block_place = static_cast<uint32_t>(triangles / kBlockSize);
            nodes += subtree->node_count;
            triangles += subtree->triangle_count;
            return;
        }
        ++nodes;
        place(top.left, nodes, triangles, top_places);
        place(top.right, nodes, triangles, top_places);
    }

    void copy_subtree(const Subtree& subtree) {
        const SubtreeOutput& output = outputs_[static_cast<size_t>(subtree.worker)];
        const auto node_shift = subtree.place - static_cast<uint32_t>(subtree.first_node);
        const auto block_shift = subtree.block_place - static_cast<uint32_t>(subtree.first_triangle / kBlockSize);
        for (size_t i = 0; i < subtree.node_count; ++i) {
            const KdNode node = output.nodes()[subtree.first_node + i];
            tree_.nodes[subtree.place + i] =
                node.is_leaf() ? KdNode::leaf(node.first_block() + block_shift, node.references())
                               : KdNode::inner(node.axis(), node.split(), node.right_child() + node_shift);
        }
        std::copy_n(output.boxes().begin() + static_cast<std::ptrdiff_t>(subtree.first_node), subtree.node_count,
                    joined_boxes_.data() + subtree.place);
        std::copy_n(output.triangles().begin() + static_cast<std::ptrdiff_t>(subtree.first_triangle),
                    subtree.triangle_count, joined_triangles_.data() + size_t{subtree.block_place} * kBlockSize);
    }

    void write_top(uint32_t index, const std::vector<uint32_t>& top_places) {
        const TopNode& top = top_->nodes()[index];
        if (!top.is_split()) {
            return;
        }
        write_top(top.left, top_places);
        write_top(top.right, top_places);
        const uint32_t right = top_places[top.right];
        tree_.nodes[top_places[index]] = KdNode::inner(top.split.axis, top.split.position, right);
        Box3f box = joined_boxes_[top_places[top.left]];
        box.extend(joined_boxes_[right]);
        joined_boxes_[top_places[index]] = box;
    }

    /// Given back while the clock runs: it is part of what a build costs.
    void release_working_memory() {
        top_.reset();
        outputs_.clear();
        joined_boxes_ = {};
        joined_triangles_ = {};
    }

    const TriangleSoup& soup_;
    const std::atomic<bool>* cancel_;
    const int threads_;
    const BuildParameters parameters_;
    std::optional<TopLevels> top_;
    OpenNode whole_{};
    std::vector<Subtree> subtrees_;
    std::vector<Subtree*> subtree_of_;    ///< per top node; null where the node is split
    std::vector<SubtreeOutput> outputs_;  ///< per thread
    std::vector<ReferenceBuffer> rooms_;  ///< per thread
    LargeBuffer<Box3f> joined_boxes_;         ///< of several subtrees
    LargeBuffer<uint32_t> joined_triangles_;
    std::span<const Box3f> boxes_;         ///< tight, per node
    std::span<const uint32_t> triangles_;  ///< per block
    Tree tree_;
};

}  // namespace

Tree build(const TriangleSoup& soup, const BuildOptions& options) {
    if (soup.triangles.size() / 3 > kMaxTriangles || soup.positions.size() > (size_t{1} << 31)) {
        throw std::length_error("a tree takes at most 2^28 triangles and 2^31 coordinates");
    }
    const FloatEnvironment environment;
    Builder builder(soup, options);
    Tree tree = builder.build();
    tree.report.threads = builder.threads();
    tree.report.triangles = soup.size();
    tree.report.sah_constants = builder.parameters().sah;
    measure_quality(tree);
    return tree;
}

}  // namespace espalier
