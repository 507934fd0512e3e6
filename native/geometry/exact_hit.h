// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <cstdint>

#include "geometry/vec.h"

namespace espalier {

/// Six times the signed volume of direction, p and q: on which side of the edge p-q a line from the origin passes.
struct Side {
    double value;
    double error;  ///< more than what the value is off by
};
Side measure_side(Vec3d direction, Vec3d p, Vec3d q);

/// The weights of a triangle's corners where a line meets it: each the edge function of the edge opposite.
struct Weights {
    Side side[3];
    double det = 0;
    double error = 0;  ///< of det

    void add_up() {
        det = side[0].value + side[1].value + side[2].value;
        error = side[0].error + side[1].error + side[2].error;
    }
};

/// How far along a ray, as double has it.
struct Distance {
    double t;
    double error;  ///< more than what t is off by

    /// For certain, with room for the roundings of this comparison itself.
    bool is_nearer_than(Distance other) const { return other.t - t > (error + other.error) * (1 + 0x1p-50); }
};
/// Along the line origin + t direction to the plane of a triangle with an area. The error is infinite where the two are
/// all but parallel.
Distance distance_to_plane(Vec3f origin, Vec3f direction, const Vec3f (&corner)[3]);

/// A triangle that a ray hits, how far along, and where on it.
struct ExactHit {
    Distance distance;
    Weights weights;
    double u, v;  ///< P = (1 - u - v) corner[0] + u corner[1] + v corner[2]
    Vec3f corner[3];
    int32_t triangle;
};

/// Decides as infinite precision would whether the line origin + t direction meets the closed triangle in one point; a
/// line in the triangle's plane does not. On a hit fills in everything but `triangle`, u and v.
///
/// All coordinates are floats of at most 2^60 (kMaxCoordinate), the direction's largest component lies in [2^-100,
/// 2^100], and the triangle has an area.
bool hit_exactly(Vec3f origin, Vec3f direction, const Vec3f (&corner)[3], ExactHit& hit);

/// Fills in u and v, with errors below 2^-22.9, and narrows t down to 2^-27 of itself, which one hit of many needs.
void finish_hit(Vec3f origin, Vec3f direction, ExactHit& hit);

/// The sign of the hit's true distance less that of another triangle, which the ray is known to hit.
int compare_distance(Vec3f origin, Vec3f direction, const ExactHit& hit, const Vec3f (&other)[3]);

/// The sign of the hit's true distance less t.
int compare_distance(Vec3f origin, Vec3f direction, const ExactHit& hit, float t);

}  // namespace espalier
