// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <cmath>
#include <random>
#include <vector>

#include "kdtree/traversal.h"
#include "meshes.h"

namespace espalier {

/// Rays from around a mesh: into the open, at vertices, along an axis through vertices, at the middle between two; the
/// same for the same seed.
inline std::vector<Ray> make_rays(const Mesh& mesh, uint32_t count, uint32_t seed) {
    std::mt19937 random(seed);
    const auto uniform = [&] { return static_cast<float>(random() >> 8) * 0x1p-24F; };
    const Box3f box = build(mesh.soup(), {Quality::kDraft, 1}).bounds;
    const auto point = [&] {
        return box.lower + box.size() * Vec3f{uniform() * 2 - 0.5F, uniform() * 2 - 0.5F, uniform() * 2 - 0.5F};
    };
    const auto vertex = [&] {
        const float* p = &mesh.positions[size_t{3} * (random() % (mesh.positions.size() / 3))];
        return Vec3f{p[0], p[1], p[2]};
    };
    // Scaled by a power of two, so that it stays a valid direction in the smallest mesh.
    const auto direction = [](Vec3f from, Vec3f to) {
        const Vec3f d = to - from;
        const int exponent = std::ilogb(std::max({std::abs(d.x), std::abs(d.y), std::abs(d.z)}));
        return Vec3f{std::ldexp(d.x, -exponent), std::ldexp(d.y, -exponent), std::ldexp(d.z, -exponent)};
    };
    std::vector<Ray> rays;
    for (uint32_t i = 0; i < count; ++i) {
        const Vec3f from = point();
        const Vec3f axis = (i & 4U) != 0 ? Vec3f{1, 0, 0} : (i & 8U) != 0 ? Vec3f{0, -1, 0} : Vec3f{-0.0F, 0, 1};
        switch (i % 4) {
            case 0:
                rays.push_back({from, 0, direction(from, point()), INFINITY});
                break;
            case 1:
                rays.push_back({from, 0, direction(from, vertex()), INFINITY});
                break;  // at a vertex
            case 2:
                rays.push_back({vertex() - axis * (2 * box.size().x), 0, axis, INFINITY});
                break;  // along an axis through a vertex
            default:
                rays.push_back({from, 0, direction(from, (vertex() + vertex()) * 0.5F), INFINITY});
                break;
        }
    }
    return rays;
}

}  // namespace espalier
