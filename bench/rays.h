// SPDX-License-Identifier: GPL-3.0-or-later
// The rays that are measured, from a mesh and the way it is looked at.
#pragma once

#include <cmath>
#include <limits>
#include <numbers>
#include <random>

#include "bench.h"
#include "kdtree/plain_traversal.h"
#include "kdtree/traversal.h"

namespace espalier::bench {

constexpr int kPicture = 1024;  ///< pixels on a side
constexpr int kSquare = 4;      ///< pixels are visited in squares of this side
/// Rays that a thread takes at a time: one strip of squares, and a whole number of packets and streams.
constexpr size_t kChunk = size_t{kPicture} * kSquare;

/// A pinhole camera for a square picture.
class Pinhole {
 public:
    explicit Pinhole(const View& view)
        : eye_(view.eye),
          forward_(normalize(view.target - view.eye)),
          right_(normalize(cross(forward_, view.up)) * view.slope),
          down_(cross(forward_, right_)) {}

    Ray ray(int x, int y) const {
        const float across = 2 * (static_cast<float>(x) + 0.5F) / kPicture - 1;
        const float along = 2 * (static_cast<float>(y) + 0.5F) / kPicture - 1;
        return {eye_, 0, forward_ + down_ * along + right_ * across, std::numeric_limits<float>::infinity()};
    }

 private:
    Vec3f eye_, forward_, right_, down_;
};

/// Where a ray has hit, moved off the surface towards the ray's origin, with the normal on that side.
struct SurfacePoint {
    SurfacePoint(const TriangleSoup& soup, uint32_t triangle, const Ray& ray, float t, float offset) {
        const Vec3f corner = soup.vertex(triangle, 0);
        normal = normalize(cross(soup.vertex(triangle, 1) - corner, soup.vertex(triangle, 2) - corner));
        if (dot(normal, ray.direction) > 0) {
            normal = -normal;
        }
        position = ray.origin + ray.direction * t + normal * offset;
    }
    Vec3f position, normal;
};

inline float surface_offset(const Box3f& bounds) { return 1e-4F * length(bounds.size()); }

/// From a point to the light, which t = 1 stands for.
inline Ray shadow_ray(Vec3f from, Vec3f light) { return {from, 0, light - from, 1}; }

struct RaySet {
    const char* name;
    bool any_hit;
    bool coherent;
    std::vector<Ray> rays;  ///< a whole number of chunks
};

/// About the normal, with a density of cosine over pi (Malley's method).
inline Vec3f cosine_direction(Vec3f normal, double u, double v) {
    const Vec3f side = std::abs(normal.x) > 0.5F ? Vec3f{0, 1, 0} : Vec3f{1, 0, 0};
    const Vec3f tangent = normalize(cross(side, normal));
    const Vec3f bitangent = cross(normal, tangent);
    const double radius = std::sqrt(u);
    const double angle = 2 * std::numbers::pi * v;
    return tangent * static_cast<float>(radius * std::cos(angle)) +
           bitangent * static_cast<float>(radius * std::sin(angle)) + normal * static_cast<float>(std::sqrt(1 - u));
}

/// Primary rays through all pixels, square by square; from each of their hits one to the light and one that bounces;
/// and as many random ones, from the bounding sphere through uniform points of the box.
inline std::vector<RaySet> make_rays(const Mesh& mesh, const Tree& tree) {
    constexpr float kInfinity = std::numeric_limits<float>::infinity();
    constexpr int kSquares = kPicture / kSquare;
    RaySet primary{"primary", false, true, {}};
    const Pinhole camera(mesh.view);
    for (int i = 0; i < kPicture * kPicture; ++i) {
        const int square = i / (kSquare * kSquare);
        const int pixel = i % (kSquare * kSquare);
        primary.rays.push_back(
            camera.ray(square % kSquares * kSquare + pixel % kSquare, square / kSquares * kSquare + pixel / kSquare));
    }
    std::vector<Hit> hits(primary.rays.size());
    intersect(tree, primary.rays, hits);

    RaySet shadow{"shadow", true, true, {}};
    RaySet bounce{"bounce", false, false, {}};
    RaySet random{"random", false, false, {}};
    std::mt19937_64 generator(1);
    std::uniform_real_distribution<double> uniform;
    const float offset = surface_offset(tree.bounds);
    for (size_t i = 0; i < hits.size(); ++i) {
        if (hits[i].triangle < 0) {
            continue;
        }
        const SurfacePoint point(mesh.soup(), static_cast<uint32_t>(hits[i].triangle), primary.rays[i], hits[i].t,
                                 offset);
        shadow.rays.push_back(shadow_ray(point.position, mesh.view.light));
        const double u = uniform(generator);
        bounce.rays.push_back({point.position, 0, cosine_direction(point.normal, u, uniform(generator)), kInfinity});
    }
    const Vec3f size = tree.bounds.size();
    const Vec3f centre = tree.bounds.lower + size * 0.5F;
    for (size_t i = 0; i < primary.rays.size(); ++i) {
        Vec3f target = tree.bounds.lower;
        Vec3f outward;
        for (int axis = 0; axis < 3; ++axis) {
            target[axis] += size[axis] * static_cast<float>(uniform(generator));
            outward[axis] = static_cast<float>(std::normal_distribution<double>()(generator));
        }
        const Vec3f origin = centre + normalize(outward) * (0.5F * length(size));
        random.rays.push_back({origin, 0, target - origin, kInfinity});
    }
    std::vector<RaySet> sets{std::move(primary), std::move(shadow), std::move(bounce), std::move(random)};
    for (RaySet& set : sets) {
        set.rays.resize(set.rays.size() / kChunk * kChunk);
    }
    return sets;
}

/// Traces a set chunk by chunk on so many threads, with `trace_chunk(first, count)`; returns milliseconds.
template <class TraceChunk>
double trace_chunks(const RaySet& set, int threads, const TraceChunk& trace_chunk) {
    const Stopwatch watch;
    parallel_for(threads, set.rays.size() / kChunk, [&](size_t i) { trace_chunk(i * kChunk, kChunk); });
    return watch.ms();
}

/// What our tracer finds of a set.
struct Found {
    std::vector<Hit> hits;
    std::vector<uint8_t> blocked;

    explicit Found(const RaySet& set)
        : hits(set.any_hit ? 0 : set.rays.size()), blocked(set.any_hit ? set.rays.size() : 0) {}
};

/// Our tracer on a set, or what it would be without that which makes hits exact.
inline double trace_ours(const Tree& tree, const RaySet& set, int threads, Found& found, bool is_exact = true) {
    return trace_chunks(set, threads, [&](size_t first, size_t count) {
        const auto rays = std::span(set.rays).subspan(first, count);
        if (set.any_hit) {
            (is_exact ? occluded : plain_occluded)(tree, rays, std::span(found.blocked).subspan(first, count));
        } else {
            (is_exact ? intersect : plain_intersect)(tree, rays, std::span(found.hits).subspan(first, count));
        }
    });
}

}  // namespace espalier::bench
