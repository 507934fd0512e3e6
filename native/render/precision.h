// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>

namespace espalier {

/// How fine float is where geometry lies, against how fine the geometry is. All in one unit of length.
struct Precision {
    double distance = 0.0;  // the coordinate that is looked at, as a magnitude
    double ulp = 0.0;       // how far apart neighbouring floats are there
    double edge = 0.0;      // the median edge; zero where there is none

    double ulp_per_edge() const { return edge > 0.0 ? ulp / edge : 0.0; }

    friend Precision operator*(const Precision& a, double scale) {
        return {a.distance * scale, a.ulp * scale, a.edge * scale};
    }
};

/// An ulp of this much of an edge turns faces by up to a degree, which shading begins to show.
constexpr double kLostShape = 1.0 / 64.0;
/// An ulp of this much of an edge opens gaps between objects that are seen as soon as their faces are.
constexpr double kLostPlace = 1.0 / 8.0;

/// The precision that float has at `distance` for edges of the length `edge`.
Precision precision_at(double distance, double edge);

/// Medians over up to about 2 * `most` vertices, or triangles, spread evenly, so that a stray one has no say: of the
/// largest component, and of the length of edges that have any. What no ray can meet does not count.
double typical_distance(std::span<const float> positions, size_t most);
double typical_edge(std::span<const float> positions, std::span<const uint32_t> triangles, size_t most);

}  // namespace espalier
