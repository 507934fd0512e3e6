// SPDX-License-Identifier: GPL-3.0-or-later
#include <algorithm>
#include <chrono>
#include <limits>
#include <optional>

#include "geometry/float_environment.h"
#include "kdtree/build_kernels.h"
#include "kdtree/layout.h"
#include "kdtree/on_demand.h"
#include "kdtree/parallel.h"
#include "kdtree/quality.h"
#include "kdtree/subtrees.h"
#include "kdtree/top_levels.h"

namespace espalier {
namespace {

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
    SahConstants sah;
    switch (quality) {
        case Quality::kDraft:
            sah.block = sah.traversal / 3;  // three blocks are a leaf without a search
            return {sah, Search::kFinerSlices, false, false, 256, 256};
        case Quality::kBalanced:
            return {sah, Search::kFinerSlices, true, true, 256, 256};
        case Quality::kBest:
            return {sah, Search::kEvents, true, true, 56, 1U << 14};
        case Quality::kExact:
            return {sah, Search::kAllEvents, true, true, 0, std::numeric_limits<uint32_t>::max()};
    }
    throw std::invalid_argument("no such quality");
}

/// What a triangle usually adds to subtrees until they are in their places, and to the plans of their nodes.
constexpr size_t kBytesBehind = 19;

/// Up to so many triangles the top's segments and what their partition takes are a good 1.4 references each.
constexpr uint32_t kRoomy = 1U << 17;

/// The phases of a build, in order.
class Builder {
 public:
    Builder(const TriangleSoup& soup, const BuildOptions& options)
        : soup_(soup),
          cancel_(options.cancel),
          threads_(options.threads > 0 ? options.threads : hardware_threads()),
          parameters_(parameters_of(options.quality)) {}

    Tree build() {
        Stopwatch total;
        Stopwatch watch;
        PhaseTimes& phases = tree_.report.phases_ms;
        const bool is_alone = threads_ == 1 && !is_large(soup_, parameters_);
        std::optional<BuildMemory> memory(std::in_place, front_size(is_alone), kBytesBehind * soup_.size());
        std::optional<TopLevels> top;
        std::optional<Subtrees> made(std::in_place, soup_, parameters_, cancel_, threads_, *memory);
        Subtrees& subtrees = *made;
        if (is_alone) {
            make_references_alone(*memory, subtrees);
            phases.bounds = watch.lap();
        } else {
            top.emplace(soup_, parameters_, cancel_, threads_, &*memory);
            top->make_references();
            phases.bounds = watch.lap();
            tree_.report.rejected_faces = top->rejected();
            tree_.bounds = top->nodes()[0].node.cell;
            if (threads_ == 1 && top->sorted_root() != nullptr) {
                subtrees.add_sorted(*top);
            } else {
                // From then on one node for each thread will do: what one thread splits depth first stays in its cache.
                // Somewhat more than its share does as well, since straddlers count on both sides: a quarter, or what
                // large scenes have room for behind the top's references.
                const uint32_t share = soup_.size() / static_cast<uint32_t>(threads_);
                top->split_above(share + share / (soup_.size() <= kRoomy ? 4 : 10));
                subtrees.add_below(*top);
            }
            phases.top_levels = watch.lap();
        }
        subtrees.build();
        phases.subtrees = watch.lap();
        subtrees.compact(top ? &*top : nullptr, tree_);
        phases.compaction = watch.lap();
        build_layout(soup_, subtrees.pieces(), threads_, *memory, tree_);
        made.reset();  // giving memory back is part of what a build costs
        top.reset();
        memory.reset();
        phases.layout = watch.lap();
        tree_.report.build_ms = total.lap();
        return std::move(tree_);
    }

    /// The top of the tree alone.
    Tree build_on_demand() {
        Stopwatch total;
        Stopwatch watch;
        tree_.on_demand = std::make_shared<OnDemand>(soup_, parameters_, cancel_, threads_);
        tree_.on_demand->make_references(tree_);
        tree_.report.phases_ms.bounds = watch.lap();
        tree_.on_demand->split_top(tree_);
        tree_.report.phases_ms.top_levels = watch.lap();
        tree_.report.build_ms = total.lap();
        return std::move(tree_);
    }

    int threads() const { return threads_; }

 private:
    /// Of the memory of the references, which becomes that of the blocks.
    BuildMemory::Size front_size(bool is_alone) const {
        const uint32_t triangles = soup_.size();
        const size_t references = is_alone ? ReferenceBuffer::bytes_for(subtree_room(triangles))
                                           : TopLevels::reference_bytes(triangles, threads_);
        return {std::max(references, most_block_bytes(triangles)), usual_block_bytes(triangles)};
    }

    /// One thread needs no top levels: all references in one piece, and one subtree.
    void make_references_alone(BuildMemory& memory, Subtrees& subtrees) {
        const uint32_t triangles = soup_.size();
        ReferenceBuffer room(subtree_room(triangles), memory.take_front<uint32_t>());
        room.memory().take_pages(0, usual_block_bytes(triangles) / sizeof(uint32_t));
        const uint32_t count = build_kernels().make_references(soup_, 0, triangles, room.references(), tree_.bounds,
                                                               tree_.report.rejected_faces);
        subtrees.add_whole({tree_.bounds, tree_.bounds, count, spare_references(triangles), 0}, std::move(room));
    }

    const TriangleSoup& soup_;
    const std::atomic<bool>* cancel_;
    const int threads_;
    const BuildParameters parameters_;
    Tree tree_;
};

}  // namespace

Tree build(const TriangleSoup& soup, const BuildOptions& options) {
    if (soup.triangles.size() / 3 > kMaxTriangles || soup.positions.size() > (size_t{1} << 31)) {
        throw std::length_error("a tree takes at most 2^28 triangles and 2^31 coordinates");
    }
    const FloatEnvironment environment;
    Builder builder(soup, options);
    const bool on_demand = soup.size() >= options.on_demand_from;
    Tree tree = on_demand ? builder.build_on_demand() : builder.build();
    tree.report.threads = builder.threads();
    tree.report.triangles = soup.size();
    if (!on_demand) {
        measure_quality(tree, builder.threads());
    }
    return tree;
}

RejectedFaces rejected_faces(const TriangleSoup& soup, uint32_t begin, uint32_t end) {
    const FloatEnvironment environment;
    return build_kernels().count_rejected(soup, begin, end);
}

}  // namespace espalier
