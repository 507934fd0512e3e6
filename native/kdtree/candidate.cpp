// SPDX-License-Identifier: GPL-3.0-or-later
#include "kdtree/candidate.h"

#include <cmath>

#include "geometry/exact_hit.h"

namespace espalier {
namespace {

struct Corners {
    Vec3f corner[3];

    Corners(const TriangleBlock* blocks, uint32_t place) {
        const float* from = corners_at(blocks, place);
        for (Vec3f& to : corner) {
            to = {from[0], from[kBlockSize], from[2 * kBlockSize]};
            from += 3 * kBlockSize;
        }
    }
};

bool hit_place(const Ray& ray, const TriangleBlock* blocks, uint32_t place, ExactHit& hit) {
    hit.triangle = static_cast<int32_t>(triangle_at(blocks, place));
    return hit_exactly(ray.origin, ray.direction, Corners(blocks, place).corner, hit);
}

Distance distance_of(const Ray& ray, const TriangleBlock* blocks, uint32_t place) {
    return distance_to_plane(ray.origin, ray.direction, Corners(blocks, place).corner);
}

/// Infinite beyond the largest float, where the language leaves a cast open.
float round_to_float(double t) {
    constexpr double kLargest = std::numeric_limits<float>::max();
    return t > kLargest    ? std::numeric_limits<float>::infinity()
           : t < -kLargest ? -std::numeric_limits<float>::infinity()
                           : static_cast<float>(t);
}

}  // namespace

bool take_exactly(const Ray& ray, const TriangleBlock* blocks, uint32_t place, Nearest& nearest) {
    // What a ray starts on, and what lies just behind its end or its nearest hit, is ruled out by its plane alone.
    const Distance distance = distance_of(ray, blocks, place);
    if (distance.is_nearer_than({ray.t_min, 0}) || Distance{ray.t_max, 0}.is_nearer_than(distance) ||
        (nearest.place != kNoPlace && distance_of(ray, blocks, nearest.place).is_nearer_than(distance))) {
        return false;
    }
    ExactHit candidate;
    if (!hit_place(ray, blocks, place, candidate) ||
        compare_distance(ray.origin, ray.direction, candidate, ray.t_min) < 0 ||
        compare_distance(ray.origin, ray.direction, candidate, ray.t_max) > 0) {
        return false;
    }
    if (nearest.place != kNoPlace) {
        const int order = compare_distance(ray.origin, ray.direction, candidate, Corners(blocks, nearest.place).corner);
        if (order > 0 ||
            (order == 0 && candidate.triangle >= static_cast<int32_t>(triangle_at(blocks, nearest.place)))) {
            return false;
        }
    }
    const double scale = largest_of(ray.direction);
    const double lower = (candidate.distance.t - candidate.distance.error) * scale;
    const double upper = (candidate.distance.t + candidate.distance.error) * scale;
    nearest.place = place;
    nearest.lower = round_to_float(lower - std::abs(lower) * 0x1p-22 - 0x1p-120);
    nearest.upper = round_to_float(upper + std::abs(upper) * 0x1p-22 + 0x1p-120);
    return true;
}

Hit finish_exactly(const Ray& ray, const TriangleBlock* blocks, uint32_t place) {
    ExactHit hit;
    if (!hit_place(ray, blocks, place, hit)) {
        return missed(ray);
    }
    finish_hit(ray.origin, ray.direction, hit);
    return {round_to_float(hit.distance.t), static_cast<float>(hit.u), static_cast<float>(hit.v), hit.triangle};
}

}  // namespace espalier
