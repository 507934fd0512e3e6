// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <atomic>
#include <cstdint>
#include <memory>
#include <span>
#include <stdexcept>

#include "geometry/triangle.h"
#include "geometry/vec.h"
#include "kdtree/large_buffer.h"
#include "kdtree/node.h"

namespace espalier {

/// How the splits are searched, never what a ray may hit. Exact is what the others are held against.
enum class Quality { kDraft, kBalanced, kBest, kExact };

struct BuildOptions {
    Quality quality = Quality::kBalanced;
    int threads = 0;                            ///< 0: all the machine has
    const std::atomic<bool>* cancel = nullptr;  ///< set from another thread, makes build() throw BuildCancelled
    /// In scenes of at least so many triangles, subtrees wait for the first ray that enters them. The triangles then
    /// have to outlive the tree, which has no `nodes` and reports neither size nor cost; what rays hit is the same.
    uint32_t on_demand_from = UINT32_MAX;
};

class BuildCancelled : public std::runtime_error {
 public:
    BuildCancelled() : std::runtime_error("the build was cancelled") {}
};

/// The model by which splits are chosen and trees are compared: a step through an inner node against one block of
/// eight triangle tests (Wald and Havran 2006, with leaves that know they are tested eight at a time).
struct SahConstants {
    double traversal = 15.0;
    double block = 6.0;
    double empty_bonus = 0.9;  ///< factor on splits that cut off empty space; not part of a reported cost
    int max_depth = 48;
};

/// Faces set aside before the build, by reason.
struct RejectedFaces {
    uint64_t not_finite = 0;
    uint64_t too_large = 0;
    uint64_t no_area = 0;

    void count(FaceFault fault) {
        not_finite += fault == FaceFault::kNotFinite ? 1 : 0;
        too_large += fault == FaceFault::kTooLarge ? 1 : 0;
        no_area += fault == FaceFault::kNoArea ? 1 : 0;
    }
    RejectedFaces& operator+=(const RejectedFaces& other) {
        not_finite += other.not_finite;
        too_large += other.too_large;
        no_area += other.no_area;
        return *this;
    }
};

/// Wall-clock milliseconds of each phase of a build, in the order in which they run.
struct PhaseTimes {
    double bounds = 0;
    double top_levels = 0;
    double subtrees = 0;
    double compaction = 0;
    double layout = 0;
};

struct BuildReport {
    double build_ms = 0;  ///< from triangles to a tree that can be traced
    PhaseTimes phases_ms;
    int threads = 0;
    uint64_t triangles = 0;  ///< as given, rejected ones included
    uint64_t nodes = 0;
    uint64_t leaves = 0;  ///< empty ones included
    uint64_t empty_leaves = 0;
    uint64_t references = 0;
    uint64_t wide_nodes = 0;
    uint64_t subtrees = 0;  ///< on demand: how many waited, and how many of those were opened
    uint64_t opened = 0;
    uint64_t bytes = 0;          ///< what the tree keeps: nodes, wide nodes and triangle blocks
    double sah_cost = 0;         ///< block model, in the units of the constants, per ray that meets the scene's box
    SahConstants sah_constants;  ///< of that cost: the same for every quality, even where its splits follow others
    uint64_t checksum = 0;  ///< of nodes, leaves and wide nodes: the same for every thread count and instruction set
    RejectedFaces rejected_faces;
};

class OnDemand;

/// A kd-tree over triangles and the layout in which rays walk through it. It keeps its own copy of the triangles.
struct Tree {
    Box3f bounds;
    LargeBuffer<KdNode> nodes;         ///< depth first; leaves point into blocks
    LargeBuffer<WideNode> wide_nodes;  ///< root first; empty for a tree without triangles
    LargeBuffer<TriangleBlock> blocks;
    std::shared_ptr<OnDemand> on_demand;  ///< opens subtrees, where that was asked for
    BuildReport report;
};

/// Triangles as three indices into xyz positions each. Indices must be in range; positions may be anything.
struct TriangleSoup {
    std::span<const float> positions;
    std::span<const uint32_t> triangles;

    uint32_t size() const { return static_cast<uint32_t>(triangles.size() / 3); }
    Vec3f vertex(uint32_t triangle, int corner) const {
        const float* p = &positions[size_t{3} * triangles[size_t{3} * triangle + static_cast<size_t>(corner)]];
        return {p[0], p[1], p[2]};
    }
};

/// Builds the tree. The same triangles and quality give the same tree bit for bit on any number of threads.
/// Throws BuildCancelled, std::bad_alloc, or std::length_error beyond 2^28 triangles.
Tree build(const TriangleSoup& soup, const BuildOptions& options);

/// Of the faces [begin, end), those that build() sets aside.
RejectedFaces rejected_faces(const TriangleSoup& soup, uint32_t begin, uint32_t end);

}  // namespace espalier
