// SPDX-License-Identifier: GPL-3.0-or-later
// Our tracer without what makes its hits exact, for Python: what the report shows the price and the worth of that by.
#include <algorithm>
#include <vector>

#include "kdtree/plain_traversal.h"

using espalier::Hit;
using espalier::Ray;
using espalier::Tree;

#define ESPALIER_EXPORT extern "C" __attribute__((visibility("default")))

/// A tree of the default quality, to be given to espalier_plain_free.
ESPALIER_EXPORT Tree* espalier_plain_build(const float* vertices, size_t vertex_count, const uint32_t* triangles,
                                           size_t triangle_count) {
    return new Tree(espalier::build({{vertices, 3 * vertex_count}, {triangles, 3 * triangle_count}}, {}));
}

ESPALIER_EXPORT void espalier_plain_free(Tree* tree) { delete tree; }

/// Closest hits on one thread; a miss is triangle -1.
ESPALIER_EXPORT void espalier_plain_intersect(const Tree* tree, const float* origins, const float* directions,
                                              size_t count, int32_t* triangle, float* t) {
    constexpr size_t kRun = 4096;  // as many as the module hands over at once
    std::vector<Ray> rays(std::min(count, kRun));
    std::vector<Hit> hits(rays.size());
    for (size_t first = 0; first < count; first += kRun) {
        const size_t some = std::min(kRun, count - first);
        for (size_t i = 0; i < some; ++i) {
            const float* o = origins + 3 * (first + i);
            const float* d = directions + 3 * (first + i);
            rays[i] = {{o[0], o[1], o[2]}, 0.0F, {d[0], d[1], d[2]}, std::numeric_limits<float>::infinity()};
        }
        espalier::plain_intersect(*tree, std::span(rays).first(some), std::span(hits).first(some));
        for (size_t i = 0; i < some; ++i) {
            triangle[first + i] = hits[i].triangle;
            t[first + i] = hits[i].t;
        }
    }
}
