// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <cmath>
#include <numbers>
#include <random>
#include <vector>

#include "kdtree/tree.h"

namespace espalier {

/// A mesh for tests, and the ways to make one.
struct Mesh {
    std::vector<float> positions;
    std::vector<uint32_t> triangles;

    TriangleSoup soup() const { return {positions, triangles}; }
    uint32_t add_vertex(Vec3f p) {
        for (int axis = 0; axis < 3; ++axis) {
            positions.push_back(p[axis]);
        }
        return static_cast<uint32_t>(positions.size() / 3 - 1);
    }
    void add_triangle(Vec3f a, Vec3f b, Vec3f c) {
        for (const Vec3f& corner : {a, b, c}) {
            triangles.push_back(add_vertex(corner));
        }
    }
};

/// A closed sphere whose neighbouring faces share their vertices.
inline Mesh make_sphere(uint32_t rings, uint32_t segments, Vec3f centre = {}, float radius = 1) {
    Mesh mesh;
    const auto point = [&](uint32_t ring, uint32_t segment) {
        const double polar = std::numbers::pi * ring / rings;
        const double azimuth = 2 * std::numbers::pi * segment / segments;
        const Vec3d unit{std::sin(polar) * std::cos(azimuth), std::sin(polar) * std::sin(azimuth), std::cos(polar)};
        return mesh.add_vertex(centre + to_float(unit) * radius);
    };
    const uint32_t north = point(0, 0);
    for (uint32_t ring = 1; ring < rings; ++ring) {
        for (uint32_t segment = 0; segment < segments; ++segment) {
            point(ring, segment);
        }
    }
    const uint32_t south = point(rings, 0);
    const auto at = [&](uint32_t ring, uint32_t segment) { return 1 + (ring - 1) * segments + segment % segments; };
    for (uint32_t segment = 0; segment < segments; ++segment) {
        mesh.triangles.insert(mesh.triangles.end(), {north, at(1, segment), at(1, segment + 1)});
        for (uint32_t ring = 1; ring + 1 < rings; ++ring) {
            const uint32_t a = at(ring, segment);
            const uint32_t b = at(ring, segment + 1);
            const uint32_t c = at(ring + 1, segment);
            const uint32_t d = at(ring + 1, segment + 1);
            mesh.triangles.insert(mesh.triangles.end(), {a, c, b, b, c, d});
        }
        mesh.triangles.insert(mesh.triangles.end(), {south, at(rings - 1, segment + 1), at(rings - 1, segment)});
    }
    return mesh;
}

/// Triangles of all sizes, anywhere in the unit cube; the same for the same seed.
inline Mesh make_soup(uint32_t count, uint32_t seed, float largest = 0.2F) {
    Mesh mesh;
    std::mt19937 random(seed);
    const auto uniform = [&] { return static_cast<float>(random() >> 8) * 0x1p-24F; };
    for (uint32_t i = 0; i < count; ++i) {
        const float size = largest * uniform() * uniform();
        const Vec3f base{uniform(), uniform(), uniform()};
        const auto corner = [&] { return base + Vec3f{uniform(), uniform(), uniform()} * size; };
        const Vec3f a = corner();
        const Vec3f b = corner();
        mesh.add_triangle(a, b, corner());
    }
    return mesh;
}

/// Long thin triangles through the whole unit cube: every plane cuts nearly all of them.
inline Mesh make_furball(uint32_t count) {
    Mesh mesh;
    std::mt19937 random(7);
    const auto uniform = [&] { return static_cast<float>(random() >> 8) * 0x1p-24F; };
    for (uint32_t i = 0; i < count; ++i) {
        const Vec3f a{uniform(), uniform(), uniform()};
        const Vec3f b{uniform(), uniform(), uniform()};
        mesh.add_triangle(a, b, b + Vec3f{1e-4F, 1e-4F, -1e-4F});
    }
    return mesh;
}

/// A flat grid of squares in the plane z = 0, two triangles each.
inline Mesh make_grid(uint32_t squares) {
    Mesh mesh;
    for (uint32_t y = 0; y <= squares; ++y) {
        for (uint32_t x = 0; x <= squares; ++x) {
            mesh.add_vertex({static_cast<float>(x), static_cast<float>(y), 0});
        }
    }
    for (uint32_t y = 0; y < squares; ++y) {
        for (uint32_t x = 0; x < squares; ++x) {
            const uint32_t a = y * (squares + 1) + x;
            const uint32_t c = a + squares + 1;
            mesh.triangles.insert(mesh.triangles.end(), {a, a + 1, c, a + 1, c + 1, c});
        }
    }
    return mesh;
}

/// A sphere on a floor, before a wall with two sides, and with a step in the corner: large triangles, which lie in
/// leaves right below the root, behind and before small ones. On the floor and in its plane lie fine sheets, one that
/// comes before it and one behind.
inline Mesh make_room() {
    Mesh mesh = make_sphere(24, 32);
    const auto square = [&](Vec3f corner, Vec3f along, Vec3f across, uint32_t times) {
        for (uint32_t i = 0; i < times; ++i) {
            const Vec3f a = corner + along * static_cast<float>(i);
            mesh.add_triangle(a, a + along, a + across);
            mesh.add_triangle(a + along, a + along + across, a + across);
        }
    };
    const auto sheet = [&](Vec3f corner) {
        for (uint32_t row = 0; row < 16; ++row) {
            square(corner + Vec3f{0, 0.0625F * static_cast<float>(row), 0}, {0.0625F, 0, 0}, {0, 0.0625F, 0}, 16);
        }
    };
    sheet({-3, -3, -1});
    square({-4, -4, -1}, {2, 0, 0}, {0, 8, 0}, 4);
    square({-4, 4, -1}, {4, 0, 0}, {0, 0, 6}, 2);
    square({-4, 4.001F, -1}, {4, 0, 0}, {0, 0, 6}, 2);
    square({3, -4, -0.9F}, {1, 0, 0}, {0, 8, 0}, 1);
    sheet({1, -3, -1});
    return mesh;
}

}  // namespace espalier
