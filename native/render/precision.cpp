// SPDX-License-Identifier: GPL-3.0-or-later
#include "render/precision.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "geometry/triangle.h"
#include "geometry/vec.h"

namespace espalier {
namespace {

Vec3d load(std::span<const float> xyz, size_t index) {
    return {xyz[3 * index], xyz[3 * index + 1], xyz[3 * index + 2]};
}

/// Not a number where a ray can never meet the point.
double largest_component(Vec3d p) {
    const double largest = is_finite(p) ? largest_of(p) : HUGE_VAL;
    return largest <= kMaxCoordinate ? largest : std::numeric_limits<double>::quiet_NaN();
}

double median(std::vector<double>& values) {
    if (values.empty())
        return 0.0;
    const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
    std::nth_element(values.begin(), middle, values.end());
    return *middle;
}

size_t stride(size_t count, size_t most) { return std::max<size_t>(1, count / most); }

}  // namespace

Precision precision_at(double distance, double edge) {
    const auto there = static_cast<float>(distance);
    const float next = std::nextafter(there, std::numeric_limits<float>::infinity());
    return {distance, static_cast<double>(next) - static_cast<double>(there), edge};
}

double typical_distance(std::span<const float> positions, size_t most) {
    const size_t count = positions.size() / 3;
    std::vector<double> distances;
    for (size_t i = 0; i < count; i += stride(count, most)) {
        if (const double distance = largest_component(load(positions, i)); !std::isnan(distance))
            distances.push_back(distance);
    }
    return median(distances);
}

double typical_edge(std::span<const float> positions, std::span<const uint32_t> triangles, size_t most) {
    const size_t count = triangles.size() / 3;
    std::vector<double> lengths;
    for (size_t i = 0; i < count; i += stride(count, most)) {
        for (size_t k = 0; k < 3; ++k) {
            const Vec3d a = load(positions, triangles[3 * i + k]), b = load(positions, triangles[3 * i + (k + 1) % 3]);
            const double edge = length(b - a);
            if (edge > 0.0 && !std::isnan(largest_component(a) + largest_component(b)))
                lengths.push_back(edge);
        }
    }
    return median(lengths);
}

}  // namespace espalier
