// SPDX-License-Identifier: GPL-3.0-or-later
// Rays: our tracer on the tree of every mode beside Embree's calls, and a whole picture on both sides.
#include <malloc.h>

#include <memory>

#include "compare.h"
#include "embree_rays.h"
#include "kdtree/on_demand.h"

namespace espalier::bench {
namespace {

struct Steps {
    uint64_t nodes = 0;
    uint64_t blocks = 0;
};

/// Distance to a triangle of a block, or infinity, in plain double arithmetic (Moeller and Trumbore 1997): good enough
/// to count by.
double distance_to(const TriangleBlock& block, int lane, const Ray& ray) {
    const auto corner = [&](int i) {
        return Vec3d{block.vertex[i][0][lane], block.vertex[i][1][lane], block.vertex[i][2][lane]};
    };
    const Vec3d edge1 = corner(1) - corner(0);
    const Vec3d edge2 = corner(2) - corner(0);
    const Vec3d p = cross(to_double(ray.direction), edge2);
    const Vec3d s = to_double(ray.origin) - corner(0);
    const Vec3d q = cross(s, edge1);
    const double scale = 1 / dot(edge1, p);
    const double u = dot(s, p) * scale;
    const double v = dot(to_double(ray.direction), q) * scale;
    const double t = dot(edge2, q) * scale;
    const bool hit = u >= 0 && v >= 0 && u + v <= 1 && t >= ray.t_min && t <= ray.t_max;
    return hit ? t : std::numeric_limits<double>::infinity();
}

/// Walks a ray through the tree in the tracer's order, child by child, and counts what it visits.
void count_steps(const Tree& tree, Ray ray, bool any_hit, Steps& steps) {
    struct Visit {
        uint32_t child;
        float entry;
    };
    std::vector<Visit> stack{{0, ray.t_min}};
    uint32_t octant = 0;
    for (int axis = 0; axis < 3; ++axis) {
        octant |= ray.direction[axis] < 0 ? 1U << axis : 0U;
    }
    while (!stack.empty()) {
        const Visit visit = stack.back();
        stack.pop_back();
        if (visit.entry > ray.t_max) {
            continue;
        }
        if ((visit.child & WideNode::kLeafFlag) != 0) {
            const TriangleBlock* block = &tree.blocks[WideNode::first_block(visit.child)];
            for (uint32_t b = 0; b < WideNode::blocks(visit.child); ++b) {
                ++steps.blocks;
                for (int lane = 0; lane < static_cast<int>(kBlockSize); ++lane) {
                    ray.t_max = std::min(ray.t_max, static_cast<float>(distance_to(block[b], lane, ray)));
                    if (any_hit && ray.t_max < 1) {
                        return;
                    }
                }
            }
            continue;
        }
        ++steps.nodes;
        const WideNode& node = tree.wide_nodes[visit.child];
        for (int rank = 0; rank < WideNode::kWidth; ++rank) {  // the nearest child comes last, and is taken first
            const uint32_t slot = node.order[octant] >> (3 * rank) & 7U;
            float entry = ray.t_min;
            float exit = ray.t_max;
            for (int axis = 0; axis < 3; ++axis) {
                const float a = (node.lower[axis][slot] - ray.origin[axis]) / ray.direction[axis];
                const float b = (node.upper[axis][slot] - ray.origin[axis]) / ray.direction[axis];
                const bool negative = ray.direction[axis] < 0;
                entry = std::max(entry, negative ? b : a);
                exit = std::min(exit, negative ? a : b);
            }
            if (entry <= exit) {
                stack.push_back({node.child[slot], entry});
            }
        }
    }
}

/// Wide nodes and triangle blocks per ray, of every eighth ray.
Json steps_per_ray(const Tree& tree, const RaySet& set, int threads) {
    constexpr size_t kStride = 8;
    std::vector<Steps> of_thread(static_cast<size_t>(threads));
    parallel_for(threads, set.rays.size() / kChunk, [&](size_t chunk, int worker) {
        Steps steps;
        for (size_t i = chunk * kChunk; i < (chunk + 1) * kChunk; i += kStride) {
            count_steps(tree, set.rays[i], set.any_hit, steps);
        }
        of_thread[static_cast<size_t>(worker)].nodes += steps.nodes;
        of_thread[static_cast<size_t>(worker)].blocks += steps.blocks;
    });
    Steps all;
    for (const Steps& steps : of_thread) {
        all.nodes += steps.nodes;
        all.blocks += steps.blocks;
    }
    const double rays = static_cast<double>(set.rays.size()) / kStride;
    return {{"nodes", static_cast<double>(all.nodes) / rays}, {"blocks", static_cast<double>(all.blocks) / rays}};
}

/// What our tracer found, in one number per ray: the face or kNoFace, or 1 for any hit.
uint32_t face_of(const RaySet& set, size_t ray, const Found& found) {
    return set.any_hit ? found.blocked[ray] : static_cast<uint32_t>(found.hits[ray].triangle);
}

Json compare_set(const RaySet& set, const std::vector<Tree>& trees, RTCScene scene, RTCDevice device, int threads,
                 double seconds) {
    Found found(set);
    Found inexact(set);
    const Tree& tree = trees[kDefaultMode];
    std::vector<Contestant> contestants;
    for (size_t i = 0; i < kModes.size(); ++i) {
        contestants.emplace_back(kModes[i].name, threads, [&, i] { return trace_ours(trees[i], set, threads, found); });
    }
    contestants.emplace_back("not exact", threads, [&] { return trace_ours(tree, set, threads, inexact, false); });
    if (threads > 1) {
        contestants.emplace_back(kModes[kDefaultMode].name, 1, [&] { return trace_ours(tree, set, 1, found); });
    }
    EmbreeSingle single(scene, set);
    contestants.emplace_back("Embree single", threads, [&] { return single.run(threads); });
    const std::unique_ptr<EmbreeStream> stream(set.any_hit || set.coherent ? nullptr : new EmbreeStream(scene, set));
    if (stream) {
        contestants.emplace_back("Embree stream", threads, [&] { return stream->run(threads); });
    }
    with_native_width(device, [&](auto width) {
        EmbreePackets<width> packets(scene, set);
        contestants.emplace_back("Embree packets of " + std::to_string(width), threads,
                                 [&] { return packets.run(threads); });
        take_turns(contestants, seconds);
    });

    uint64_t differ = 0;
    for (size_t i = 0; i < set.rays.size(); ++i) {
        differ += face_of(set, i, found) != single.hits.face[i] ? 1 : 0;
    }
    Json rows = rows_of(contestants);
    for (size_t i = 0; i < kModes.size(); ++i) {
        rows[i]["steps"] = steps_per_ray(trees[i], set, threads);
    }
    return {{"set", set.name}, {"rays", set.rays.size()}, {"threads", threads}, {"differ", differ}, {"rows", rows}};
}

constexpr int kTile = 32;  ///< pixels on a side
constexpr size_t kTilePixels = size_t{kTile} * kTile;

/// Rays of a tile for our tracer.
class OurBatch {
 public:
    explicit OurBatch(const Tree& tree) : tree_(tree) {}
    /// Member by member: copied as a whole, a ray that was just put together would be waited for.
    void set(size_t i, const Ray& ray) {
        rays_[i].origin = ray.origin;
        rays_[i].t_min = ray.t_min;
        rays_[i].direction = ray.direction;
        rays_[i].t_max = ray.t_max;
    }
    void find_closest(size_t count) { intersect(tree_, std::span(rays_).first(count), std::span(hits_).first(count)); }
    void find_any(size_t count) { occluded(tree_, std::span(rays_).first(count), std::span(blocked_).first(count)); }
    uint32_t face(size_t i) const { return static_cast<uint32_t>(hits_[i].triangle); }
    float t(size_t i) const { return hits_[i].t; }
    bool blocked(size_t i) const { return blocked_[i] != 0; }

 private:
    const Tree& tree_;
    std::array<Ray, kTilePixels> rays_;
    std::array<Hit, kTilePixels> hits_;
    std::array<uint8_t, kTilePixels> blocked_;
};

/// The same for Embree's packets, into which rays are written directly.
template <int kWidth>
class EmbreeBatch {
 public:
    explicit EmbreeBatch(RTCScene scene) : scene_(scene) {}
    void set(size_t i, const Ray& ray) { put(packets_[i / kWidth].ray, i % kWidth, ray); }
    void find_closest(size_t count) {
        each_packet(count, [&](RTCIntersectContext& context, const int* valid, auto& packet) {
            std::fill_n(packet.hit.primID, kWidth, kNoFace);
            std::fill_n(packet.hit.geomID, kWidth, kNoFace);
            Packet<kWidth>::kIntersect(valid, scene_, &context, &packet);
        });
    }
    void find_any(size_t count) {
        each_packet(count, [&](RTCIntersectContext& context, const int* valid, auto& packet) {
            Packet<kWidth>::kOccluded(valid, scene_, &context, &packet.ray);
        });
    }
    uint32_t face(size_t i) const { return packets_[i / kWidth].hit.primID[i % kWidth]; }
    float t(size_t i) const { return packets_[i / kWidth].ray.tfar[i % kWidth]; }
    bool blocked(size_t i) const { return packets_[i / kWidth].ray.tfar[i % kWidth] < 0; }

 private:
    template <class F>
    void each_packet(size_t count, const F& f) {
        const FlushToZero flush;
        RTCIntersectContext context = new_context(true);
        for (size_t first = 0; first < count; first += kWidth) {
            alignas(64) int valid[kWidth];
            for (size_t lane = 0; lane < kWidth; ++lane) {
                valid[lane] = first + lane < count ? -1 : 0;
            }
            f(context, valid, packets_[first / kWidth]);
        }
    }

    RTCScene scene_;
    std::array<typename Packet<kWidth>::RayHits, kTilePixels / kWidth> packets_;
};

/// Calls f(number, x, y) for the pixels of a tile, square by square.
template <class F>
void each_pixel(int x0, int y0, const F& f) {
    size_t i = 0;
    for (int square_y = y0; square_y < y0 + kTile; square_y += kSquare) {
        for (int square_x = x0; square_x < x0 + kTile; square_x += kSquare) {
            for (int y = square_y; y < square_y + kSquare; ++y) {
                for (int x = square_x; x < square_x + kSquare; ++x) {
                    f(i++, x, y);
                }
            }
        }
    }
}

/// One tile: closest hits, a shadow ray from each of them, and light by Lambert's law.
template <class Batch>
void draw_tile(const Mesh& mesh, const Pinhole& camera, float offset, int x0, int y0, Batch& eye, Batch& light,
               std::vector<float>& picture) {
    std::array<float, kTilePixels> shade;
    std::array<size_t, kTilePixels> lit;
    each_pixel(x0, y0, [&](size_t i, int x, int y) { eye.set(i, camera.ray(x, y)); });
    eye.find_closest(kTilePixels);
    size_t count = 0;
    each_pixel(x0, y0, [&](size_t i, int x, int y) {
        const size_t place = static_cast<size_t>(y) * kPicture + static_cast<size_t>(x);
        picture[place] = 0;
        if (eye.face(i) == kNoFace) {
            return;
        }
        const SurfacePoint point(mesh.soup(), eye.face(i), camera.ray(x, y), eye.t(i), offset);
        const Ray ray = shadow_ray(point.position, mesh.view.light);
        shade[count] = std::max(0.0F, dot(point.normal, ray.direction) / length(ray.direction));
        lit[count] = place;
        light.set(count++, ray);
    });
    light.find_any(count);
    for (size_t i = 0; i < count; ++i) {
        picture[lit[i]] = light.blocked(i) ? 0 : shade[i];
    }
}

/// Every thread has two copies of a batch of its own.
template <class Batch>
void draw(const Mesh& mesh, float offset, int threads, const Batch& batch, std::vector<float>& picture) {
    constexpr int kAcross = kPicture / kTile;
    constexpr size_t kFar = 16;
    const Pinhole camera(mesh.view);
    std::vector<std::array<Batch, 2>> of_thread(static_cast<size_t>(threads), {batch, batch});
    parallel_for(threads, size_t{kAcross} * kAcross, [&](size_t i, int worker) {
        auto& [eye, light] = of_thread[static_cast<size_t>(worker)];
        // Tiles far apart, so that threads that open subtrees do not wait for one another.
        const auto tile = static_cast<int>(i % kFar * (size_t{kAcross} * kAcross / kFar) + i / kFar);
        draw_tile(mesh, camera, offset, tile % kAcross * kTile, tile / kAcross * kTile, eye, light, picture);
    });
}

}  // namespace

Json compare_rays(const Mesh& mesh, int threads, double seconds) {
    std::vector<Tree> trees;
    for (const Mode& mode : kModes) {
        trees.push_back(build(mesh.soup(), {.quality = mode.quality}));
    }
    const Device device = new_device(threads);
    const EmbreeScene scene = build_embree(device, mesh.soup(), kMedium);
    Json sets;
    for (const RaySet& set : make_rays(mesh, trees[kDefaultMode])) {
        if (!set.rays.empty()) {
            sets.push_back(compare_set(set, trees, scene.get(), device.get(), threads, seconds));
        }
    }
    return sets;
}

Json compare_previews(const Mesh& mesh, int threads, double seconds) {
    const Device device = new_device(threads);
    const Mesh sample = sample_of(mesh);
    build_embree(device, sample.soup(), kMedium);
    const float offset = surface_offset(build(sample.soup(), {}).bounds);
    std::vector<float> ours(size_t{kPicture} * kPicture);
    std::vector<float> theirs = ours;

    std::vector<Contestant> contestants;
    for (const bool on_demand : {false, true}) {
        for (const Mode& mode : kModes) {
            contestants.emplace_back(
                on_demand ? mode.name + std::string(", on demand") : mode.name, threads, [&, on_demand] {
                    malloc_trim(0);
                    const Stopwatch watch;
                    const Tree tree = build(mesh.soup(), {.quality = mode.quality,
                                                          .threads = threads,
                                                          .on_demand_from = on_demand ? kOnDemandPays : UINT32_MAX});
                    draw(mesh, offset, threads, OurBatch(tree), ours);
                    return watch.ms();
                });
        }
    }
    contestants.emplace_back(kMedium.name, threads, [&] {
        malloc_trim(0);
        const Stopwatch watch;
        const EmbreeScene scene = build_embree(device, mesh.soup(), kMedium);
        with_native_width(device.get(),
                          [&](auto width) { draw(mesh, offset, threads, EmbreeBatch<width>(scene.get()), theirs); });
        return watch.ms();
    });
    take_turns(contestants, seconds);

    uint64_t differ = 0;
    for (size_t i = 0; i < ours.size(); ++i) {
        differ += std::abs(ours[i] - theirs[i]) > 1.0F / 256 ? 1 : 0;
    }
    return {{"threads", threads}, {"differ", differ}, {"rows", rows_of(contestants)}};
}

}  // namespace espalier::bench
