// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <cstdint>
#include <limits>

#include "kdtree/node.h"
#include "kdtree/traversal.h"

namespace espalier {

/// A triangle by its place in the blocks: block * kBlockSize + lane.
constexpr uint32_t kNoPlace = 0xffffffffU;

/// A ray's nearest hit so far. Its depth, t times the direction's largest component, lies between the two bounds.
struct Nearest {
    uint32_t place;
    float lower;
    float upper;
};

/// Of the triangle at `place`; other coordinates follow kBlockSize floats behind, corner by corner.
inline const float* corners_at(const TriangleBlock* blocks, uint32_t place) {
    return blocks[place / kBlockSize].vertex[0][0] + place % kBlockSize;
}

/// The triangle at `place` takes the nearest's if exact arithmetic says that the ray hits it within its interval, and
/// nearer than the other, which the ray truly hits, or as near with a lower index. Returns whether it did.
bool take_exactly(const Ray& ray, const TriangleBlock* blocks, uint32_t place, Nearest& nearest);

/// The hit of a ray with the triangle at `place`, which it is known to hit.
Hit finish_exactly(const Ray& ray, const TriangleBlock* blocks, uint32_t place);

inline Hit missed(const Ray& ray) { return {ray.t_max, 0, 0, -1}; }

inline uint32_t triangle_at(const TriangleBlock* blocks, uint32_t place) {
    return blocks[place / kBlockSize].triangle[place % kBlockSize] % kMaxTriangles;
}

}  // namespace espalier
