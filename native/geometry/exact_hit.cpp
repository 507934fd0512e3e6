// SPDX-License-Identifier: GPL-3.0-or-later
#include "geometry/exact_hit.h"

#include <algorithm>
#include <iterator>
#include <limits>

#include "geometry/expansion.h"

namespace espalier {
namespace {

using ExactVec = Vec3<Expansion>;

ExactVec exact_difference(Vec3f a, Vec3f b) {
    return {Expansion::difference(a.x, b.x), Expansion::difference(a.y, b.y), Expansion::difference(a.z, b.z)};
}

ExactVec exact(Vec3f a) { return {Expansion(a.x), Expansion(a.y), Expansion(a.z)}; }

Expansion exact_dot(const ExactVec& a, const ExactVec& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

ExactVec exact_cross(const ExactVec& a, const ExactVec& b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

/// A distance as a quotient: t = above / below, below > 0.
struct Quotient {
    Expansion above;
    Expansion below;
};

Quotient exact_distance(Vec3f origin, Vec3f direction, const Vec3f (&corner)[3]) {
    const ExactVec normal = exact_cross(exact_difference(corner[1], corner[0]), exact_difference(corner[2], corner[0]));
    const Expansion above = exact_dot(exact_difference(corner[0], origin), normal);
    const Expansion below = exact_dot(exact(direction), normal);
    return below.sign() < 0 ? Quotient{Expansion() - above, Expansion() - below} : Quotient{above, below};
}

/// -1 or 1 where one distance is the smaller for certain, else 0.
int order_of(Distance a, Distance b) { return (b.is_nearer_than(a) ? 1 : 0) - (a.is_nearer_than(b) ? 1 : 0); }

/// Whether all corners have one coordinate in common: what lies in one plane is equally far for a ray that hits both.
bool lie_across_an_axis(const Vec3f (&a)[3], const Vec3f (&b)[3]) {
    for (int axis = 0; axis < 3; ++axis) {
        const float place = a[0][axis];
        if (a[1][axis] == place && a[2][axis] == place && b[0][axis] == place && b[1][axis] == place &&
            b[2][axis] == place) {
            return true;
        }
    }
    return false;
}

Side measure_side_exactly(Vec3f origin, Vec3f direction, Vec3f p, Vec3f q) {
    const Expansion side =
        exact_dot(exact(direction), exact_cross(exact_difference(p, origin), exact_difference(q, origin)));
    const double value = side.estimate();
    return {value, std::abs(value) * 0x1p-51};
}

bool are_open(const Weights& weights) {
    const auto is_open = [](const Side& s) { return std::abs(s.value) <= s.error; };
    return is_open(weights.side[0]) || is_open(weights.side[1]) || is_open(weights.side[2]) ||
           std::abs(weights.det) < 4 * weights.error;
}

Weights weigh_exactly(Vec3f origin, Vec3f direction, const Vec3f (&corner)[3]) {
    Weights weights;
    for (int k = 0; k < 3; ++k) {
        weights.side[k] = measure_side_exactly(origin, direction, corner[(k + 1) % 3], corner[(k + 2) % 3]);
    }
    weights.add_up();
    return weights;
}

int largest_component(Vec3f d) {
    const Vec3f a{std::abs(d.x), std::abs(d.y), std::abs(d.z)};
    return a.x > a.y ? (a.x > a.z ? 0 : 2) : (a.y > a.z ? 1 : 2);
}

}  // namespace

/// Each difference from the origin carries a relative error e = 2^-53, each product one more, each sum one more: below
/// 8 e times the sum of the terms' absolute values, of which 16 e is taken (EXACTNESS.md, 9).
Side measure_side(Vec3d d, Vec3d p, Vec3d q) {
    const Vec3d c{p.y * q.z - p.z * q.y, p.z * q.x - p.x * q.z, p.x * q.y - p.y * q.x};
    const double size = std::abs(d.x) * (std::abs(p.y * q.z) + std::abs(p.z * q.y)) +
                        std::abs(d.y) * (std::abs(p.z * q.x) + std::abs(p.x * q.z)) +
                        std::abs(d.z) * (std::abs(p.x * q.y) + std::abs(p.y * q.x));
    return {d.x * c.x + d.y * c.y + d.z * c.z, size * 0x1p-49};
}

/// With e = 2^-53 and D, S, A and B the largest components of the direction, of the first corner as seen from the
/// origin and of the two edges from there, 128 e (S A B + |t| D A B) / |below| covers the errors of both products and
/// the roundings of t, where |below| is no less than 128 e D A B (EXACTNESS.md, 9).
Distance distance_to_plane(Vec3f origin, Vec3f direction, const Vec3f (&corner)[3]) {
    const Vec3d d = to_double(direction);
    const Vec3d seen = to_double(corner[0]) - to_double(origin);
    const Vec3d edge[2] = {to_double(corner[1]) - to_double(corner[0]), to_double(corner[2]) - to_double(corner[0])};
    const Vec3d normal = cross(edge[0], edge[1]);
    const double below = dot(d, normal);
    const double area = largest_of(edge[0]) * largest_of(edge[1]);
    const double size = area * largest_of(d);
    if (!(std::abs(below) >= size * 0x1p-46)) {
        return {0, std::numeric_limits<double>::infinity()};
    }
    const double scale = 1 / below;
    const double t = dot(seen, normal) * scale;
    return {t, 0x1p-46 * (area * largest_of(seen) + std::abs(t) * size) * std::abs(scale)};
}

bool hit_exactly(Vec3f origin, Vec3f direction, const Vec3f (&corner)[3], ExactHit& hit) {
    const Vec3d d = to_double(direction);
    Vec3d p[3];
    for (int k = 0; k < 3; ++k) {
        p[k] = to_double(corner[k]) - to_double(origin);
    }
    Weights& weights = hit.weights;
    const auto& side = weights.side;
    for (int k = 0; k < 3; ++k) {
        const Vec3d edge = to_double(corner[(k + 2) % 3]) - to_double(corner[(k + 1) % 3]);
        weights.side[k] = measure_side(d, p[(k + 1) % 3], edge);
    }
    weights.add_up();
    if (are_open(weights)) {
        weights = weigh_exactly(origin, direction, corner);
    }
    const bool any_positive = side[0].value > 0 || side[1].value > 0 || side[2].value > 0;
    const bool any_negative = side[0].value < 0 || side[1].value < 0 || side[2].value < 0;
    if (any_positive == any_negative) {  // on both sides, or in the plane
        return false;
    }
    for (int k = 0; k < 3; ++k) {
        hit.corner[k] = corner[k];
    }
    // The weighted mean of the corners along the direction's largest axis. The weights' errors count by the corners'
    // spread.
    const int axis = largest_component(direction);
    const double z[3] = {p[0][axis], p[1][axis], p[2][axis]};
    const double spread = std::max({z[0], z[1], z[2]}) - std::min({z[0], z[1], z[2]});
    const double size = std::max({std::abs(z[0]), std::abs(z[1]), std::abs(z[2])});
    const double scale = 1 / (weights.det * d[axis]);
    const double t = (side[0].value * z[0] + side[1].value * z[1] + side[2].value * z[2]) * scale;
    hit.distance = {t, (weights.error * spread * 1.34 + 0x1p-49 * size * std::abs(weights.det)) * std::abs(scale)};
    return true;
}

void finish_hit(Vec3f origin, Vec3f direction, ExactHit& hit) {
    if (std::abs(hit.weights.det) < hit.weights.error * 0x1p24) {
        hit.weights = weigh_exactly(origin, direction, hit.corner);
    }
    hit.u = hit.weights.side[1].value / hit.weights.det;
    hit.v = hit.weights.side[2].value / hit.weights.det;
    if (!(hit.distance.error <= std::abs(hit.distance.t) * 0x1p-28)) {
        const Quotient distance = exact_distance(origin, direction, hit.corner);
        const double t = distance.above.estimate() / distance.below.estimate();
        hit.distance = {t, std::abs(t) * 0x1p-50};
    }
}

int compare_distance(Vec3f origin, Vec3f direction, const ExactHit& hit, const Vec3f (&other)[3]) {
    if (const int order = order_of(hit.distance, distance_to_plane(origin, direction, other)); order != 0) {
        return order;
    }
    if (lie_across_an_axis(hit.corner, other) ||
        std::is_permutation(std::begin(hit.corner), std::end(hit.corner), std::begin(other))) {
        return 0;
    }
    const Quotient a = exact_distance(origin, direction, hit.corner);
    const Quotient b = exact_distance(origin, direction, other);
    return (a.above * b.below - b.above * a.below).sign();
}

int compare_distance(Vec3f origin, Vec3f direction, const ExactHit& hit, float t) {
    if (const int order = order_of(hit.distance, {t, 0}); order != 0) {
        return order;
    }
    const Quotient x = exact_distance(origin, direction, hit.corner);
    return (x.above - Expansion(t) * x.below).sign();
}

}  // namespace espalier
