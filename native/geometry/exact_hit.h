// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <cstdint>

#include "geometry/vec.h"

namespace espalier {

/// A triangle that a ray hits, how far along, and where on it.
struct ExactHit {
    double t;
    double error;        ///< more than what t is off by
    double u, v;         ///< P = (1 - u - v) corner[0] + u corner[1] + v corner[2]
    double place_error;  ///< more than what u and v are off by, but for a part in 2^20 of it
    Vec3f corner[3];
    int32_t triangle;
};

/// Six times the signed volume of direction, p and q: on which side of the edge p-q a line from the origin passes.
struct Side {
    double value;
    double error;  ///< more than what the value is off by
};
Side measure_side(Vec3d direction, Vec3d p, Vec3d q);

/// Decides as infinite precision would whether the line origin + t direction meets the closed triangle in one point; a
/// line in the triangle's plane does not. On a hit fills in everything but `triangle`.
///
/// All coordinates are floats of at most 2^60 (kMaxCoordinate), the direction's largest component lies in [2^-100,
/// 2^100], and the triangle has an area.
bool hit_exactly(Vec3f origin, Vec3f direction, const Vec3f (&corner)[3], ExactHit& hit);

/// Narrows t down to a relative error of 2^-27, u and v to 2^-22.9, which one hit of many needs.
void finish_hit(Vec3f origin, Vec3f direction, ExactHit& hit);

/// The sign of a's true distance less b's.
int compare_distance(Vec3f origin, Vec3f direction, const ExactHit& a, const ExactHit& b);

/// The sign of the hit's true distance less t.
int compare_distance(Vec3f origin, Vec3f direction, const ExactHit& hit, float t);

}  // namespace espalier
