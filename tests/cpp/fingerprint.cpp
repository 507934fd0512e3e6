// SPDX-License-Identifier: GPL-3.0-or-later
// Prints checksums of trees, of hits and of light samples, to be compared between machines and instruction sets: all
// must be the same. With the argument "sets" prints the instruction sets that this machine runs instead.

#include <cstdio>
#include <cstring>
#include <string>

#include "kdtree/simd_target.h"
#include "meshes.h"
#include "rays.h"
#include "render/light_rays.h"

namespace espalier {
namespace {

/// FNV-1a.
class Checksum {
 public:
    template <class T>
    Checksum& add(const T* items, size_t count) {
        const auto* bytes = reinterpret_cast<const unsigned char*>(items);
        for (size_t i = 0; i < count * sizeof(T); ++i) {
            value_ = (value_ ^ bytes[i]) * 0x100000001b3;
        }
        return *this;
    }
    unsigned long long value() const { return value_; }

 private:
    uint64_t value_ = 0xcbf29ce484222325;
};

Mesh moved(Mesh mesh, float offset, float scale) {
    for (float& x : mesh.positions) {
        x = x * scale + offset;
    }
    return mesh;
}

/// Every fault a face can have, and copies of faces, among sound ones.
Mesh make_faulty() {
    Mesh mesh = make_sphere(20, 30);
    mesh.triangles.insert(mesh.triangles.end(), mesh.triangles.begin(), mesh.triangles.begin() + 600);
    mesh.add_triangle({0, 0, NAN}, {1, 0, 0}, {0, 1, 0});
    mesh.add_triangle({0, 0, 0}, {1e30F, 0, 0}, {0, 1, 0});
    mesh.add_triangle({0, 0, 0}, {1, 1, 1}, {3, 3, 3});
    mesh.add_triangle({-0.0F, 0, 0}, {0x1p-60F, 0x1p-60F, 0}, {0x1p-59F, 0x1p-60F, -0.0F});
    return mesh;
}

void print_fingerprint(const char* name, const Mesh& mesh) {
    std::printf("%-14s mesh %016llx", name,
                Checksum()
                    .add(mesh.positions.data(), mesh.positions.size())
                    .add(mesh.triangles.data(), mesh.triangles.size())
                    .value());
    const std::vector<Ray> rays = make_rays(mesh, 800, 21);
    constexpr size_t kMostForExact = 10000;  // it is slow, and slower under an emulator
    for (const Quality quality : {Quality::kDraft, Quality::kBalanced, Quality::kBest, Quality::kExact}) {
        if (quality == Quality::kExact && mesh.triangles.size() / 3 > kMostForExact) {
            continue;
        }
        Checksum trees;
        Tree tree;
        for (const int threads : {1, 3}) {
            tree = build(mesh.soup(), {quality, threads});
            trees.add(tree.nodes.data(), tree.nodes.size())
                .add(tree.wide_nodes.data(), tree.wide_nodes.size())
                .add(tree.blocks.data(), tree.blocks.size());
        }
        std::vector<Hit> hits(rays.size());
        std::vector<uint8_t> blocked(rays.size());
        intersect(tree, rays, hits);
        occluded(tree, rays, blocked);
        const Checksum answers = Checksum().add(hits.data(), hits.size()).add(blocked.data(), blocked.size());
        std::printf(" | tree %016llx hits %016llx", trees.value(), answers.value());
    }
    std::printf("\n");
}

/// A light that all points lie around. Its angles have cosines that are given: the system's are not the same
/// everywhere.
Light make_light(LightKind kind, AreaShape shape) {
    LightInput input;
    input.kind = kind;
    input.shape = shape;
    input.energy = 3.0;
    input.radius = 0.25;
    input.size = 1.5;
    input.size_y = 0.5;
    input.matrix.rows = {
        {{0.6, 0.0, 0.8, 0.125}, {0.0, 1.0, 0.0, -0.25}, {-0.8, 0.0, 0.6, 0.375}, {0.0, 0.0, 0.0, 1.0}}};
    Light light(input, {0.0, 0.0, 0.0});
    light.cos_half = 0.375;
    light.spot_fade = 0.25;
    return light;
}

void print_light_rays() {
    const Mesh sphere = make_sphere(30, 45);
    LitPoints points;
    for (uint32_t i = 0; 3 * size_t{i} + 2 < sphere.positions.size(); ++i) {
        SurfacePoint surface{};
        surface.position = {sphere.positions[3 * i], sphere.positions[3 * i + 1], sphere.positions[3 * i + 2]};
        surface.geometric_normal = surface.shading_normal = normalize(surface.position) * -1.0;
        surface.base_color = {0.5F, 0.25F, 1.0F};
        points.add(surface, i, sequence_point(i % 4), i);
    }
    const Light lights[] = {make_light(LightKind::kPoint, {}),
                            make_light(LightKind::kSpot, {}),
                            make_light(LightKind::kSun, {}),
                            make_light(LightKind::kArea, AreaShape::kRectangle),
                            make_light(LightKind::kArea, AreaShape::kEllipse),
                            Light::sky({1.0, 2.0, 3.0}, {0.5, 0.25, 0.0})};
    std::vector<Ray> rays(points.size);
    std::vector<Arrival> arrivals(points.size);
    std::printf("light rays");
    for (const Light& light : lights) {
        const size_t count = light_rays(light, points, 3, rays, arrivals);
        Checksum samples;
        samples.add(rays.data(), count);
        for (size_t i = 0; i < count; ++i) {
            samples.add(&arrivals[i].target, 1).add(&arrivals[i].radiance, 1);
        }
        std::printf(" | %zu %016llx", count, samples.value());
    }
    std::printf("\n");
}

void print_all() {
    print_fingerprint("sphere", make_sphere(60, 90));
    print_fingerprint("far sphere", moved(make_sphere(30, 40), 1e5F, 1));
    print_fingerprint("soup", make_soup(4000, 1));
    print_fingerprint("tiny soup", moved(make_soup(200, 2), 0, 1e-30F));
    print_fingerprint("subnormal soup", moved(make_soup(200, 2), 0, 1e-42F));
    print_fingerprint("huge soup", moved(make_soup(2000, 3), -3, 1e15F));
    print_fingerprint("furball", make_furball(700));
    print_fingerprint("grid", make_grid(25));
    print_fingerprint("large grid", make_grid(256));
    print_fingerprint("faulty", make_faulty());
    print_light_rays();
}

}  // namespace
}  // namespace espalier

int main(int count, char** arguments) {
    if (count == 2 && std::strcmp(arguments[1], "sets") == 0) {
        for (const std::string& name : espalier::simd_target_names()) {
            std::printf("%s\n", name.c_str());
        }
    } else {
        espalier::print_all();
    }
    return 0;
}
