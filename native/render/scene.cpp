// SPDX-License-Identifier: GPL-3.0-or-later
#include "render/scene.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <unordered_map>

#include "geometry/float_environment.h"
#include "geometry/triangle.h"
#include "kdtree/parallel.h"

namespace espalier {
namespace {

constexpr size_t kChunk = 16384;
constexpr uint64_t kMaxVertices = std::numeric_limits<uint32_t>::max();

/// How many vertices or triangles make a median: of a mesh or the scene at most, of a placement at least.
constexpr size_t kMostLookedAt = 4096;
constexpr size_t kLeastLookedAt = 16;

/// A run of consecutive vertices or triangles of one placement: the unit of parallel work.
struct Chunk {
    size_t placement, begin, end;
};

template <class Count>
std::vector<Chunk> make_chunks(size_t placements, const Count& count) {
    std::vector<Chunk> chunks;
    for (size_t placement = 0; placement < placements; ++placement) {
        const size_t total = count(placement);
        for (size_t begin = 0; begin < total; begin += kChunk)
            chunks.push_back({placement, begin, std::min(begin + kChunk, total)});
    }
    return chunks;
}

Vec3d load(std::span<const float> xyz, size_t index) {
    return {xyz[3 * index], xyz[3 * index + 1], xyz[3 * index + 2]};
}

/// How much longer edges of all directions become, in the mean of the squares.
double mean_scale(const Matrix4& matrix) {
    double sum = 0.0;
    for (int axis = 0; axis < 3; ++axis)
        sum += dot(matrix.column(axis), matrix.column(axis));
    return std::sqrt(sum / 3.0);
}

/// Whether a vertex may have a say in where the scene's centre is: one stray coordinate must not spoil all others.
bool in_reach(Vec3d p) {
    return std::abs(p.x) <= kMaxCoordinate && std::abs(p.y) <= kMaxCoordinate && std::abs(p.z) <= kMaxCoordinate;
}

struct Bounds {
    Vec3d lower{HUGE_VAL, HUGE_VAL, HUGE_VAL};
    Vec3d upper{-HUGE_VAL, -HUGE_VAL, -HUGE_VAL};

    void add(const Bounds& other) {
        lower = {std::min(lower.x, other.lower.x), std::min(lower.y, other.lower.y), std::min(lower.z, other.lower.z)};
        upper = {std::max(upper.x, other.upper.x), std::max(upper.y, other.upper.y), std::max(upper.z, other.upper.z)};
    }
};

/// All threads together: two that first wrote to one page would both clear it.
template <class T>
void take_huge_pages(LargeBuffer<T>& buffer, int threads) {
    parallel_for(threads, LargeBuffer<T>::huge_pages(buffer.bytes()), [&](size_t i) { buffer.take_huge_page(i); });
}

void check_mesh(const MeshInput& mesh) {
    const size_t vertices = mesh.positions.size() / 3;
    const size_t triangles = mesh.triangles.size() / 3;
    uint32_t largest = 0;
    for (const uint32_t index : mesh.triangles)
        largest = std::max(largest, index);
    if (!mesh.triangles.empty() && largest >= vertices) {
        const auto at = std::ranges::find_if(mesh.triangles, [&](uint32_t index) { return index >= vertices; });
        throw std::out_of_range("mesh '" + mesh.name + "': triangle " +
                                std::to_string((at - mesh.triangles.begin()) / 3) + " has vertex index " +
                                std::to_string(static_cast<int32_t>(*at)) + ", outside the mesh's " +
                                std::to_string(vertices) + " vertices");
    }
    int32_t least = 0;
    for (const int32_t slot : mesh.material_slots)
        least = std::min(least, slot);
    if (least < 0) {
        const auto at = std::ranges::find_if(mesh.material_slots, [](int32_t slot) { return slot < 0; });
        throw std::out_of_range("mesh '" + mesh.name + "': material_slots of triangle " +
                                std::to_string(at - mesh.material_slots.begin()) + " is negative");
    }
    const size_t normals = mesh.normals.size() / 3;
    const size_t expected = mesh.normal_kind == NormalKind::kFlat        ? 0
                            : mesh.normal_kind == NormalKind::kPerVertex ? vertices
                                                                         : 3 * triangles;
    if (normals != expected)
        throw std::invalid_argument("mesh '" + mesh.name + "': normals has the wrong length");
    if (!mesh.material_slots.empty() && mesh.material_slots.size() != triangles) {
        throw std::invalid_argument("mesh '" + mesh.name + "': material_slots must have one entry per triangle");
    }
}

void check_placement(const Placement& placement, size_t meshes, size_t materials) {
    const std::string where = "object '" + placement.object + "': ";
    if (placement.mesh >= meshes) {
        throw std::out_of_range(where + "mesh index " + std::to_string(placement.mesh) + " is outside the scene's " +
                                std::to_string(meshes) + " meshes");
    }
    if (!placement.matrix.finite())
        throw std::invalid_argument(where + "matrix is not finite");
    if (placement.materials.empty())
        throw std::invalid_argument(where + "materials must have at least one entry");
    for (const int32_t material : placement.materials) {
        if (material < 0 || static_cast<size_t>(material) >= materials) {
            throw std::out_of_range(where + "material index " + std::to_string(material) + " is outside the scene's " +
                                    std::to_string(materials) + " materials");
        }
    }
}

}  // namespace

Scene::Scene(std::span<const MeshInput> meshes, std::span<const Placement> placements, std::span<const float> materials,
             int threads) {
    const FloatEnvironment environment;
    const auto start = std::chrono::steady_clock::now();
    if (threads <= 0)
        threads = hardware_threads();
    meshes_.resize(meshes.size());
    parallel_for(threads, meshes.size(), [&](size_t i) {
        const MeshInput& mesh = meshes[i];
        check_mesh(mesh);
        meshes_[i] = {mesh.normal_kind,
                      {mesh.normals.begin(), mesh.normals.end()},
                      {mesh.material_slots.begin(), mesh.material_slots.end()}};
    });
    for (const Placement& placement : placements)
        check_placement(placement, meshes.size(), materials.size() / 3);

    for (size_t i = 0; i < materials.size() / 3; ++i)
        materials_.push_back({materials[3 * i], materials[3 * i + 1], materials[3 * i + 2]});
    place(meshes, placements, threads);
    const std::vector<size_t> object_of = name_objects(placements);
    count_rejected(object_of, threads);
    measure_precision(meshes, placements, object_of, threads);
    placing_ms_ = std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now() - start).count();
}

void Scene::place(std::span<const MeshInput> meshes, std::span<const Placement> placements, int threads) {
    uint64_t vertices = 0, triangles = 0;
    for (const Placement& placement : placements) {
        const MeshInput& mesh = meshes[placement.mesh];
        placed_.push_back(
            {placement.mesh, static_cast<uint32_t>(vertices), normal_columns(placement.matrix), placement.materials});
        first_triangle_.push_back(static_cast<uint32_t>(triangles));
        vertices += mesh.positions.size() / 3;
        triangles += mesh.triangles.size() / 3;
        if (triangles > kMaxTriangles || vertices > kMaxVertices) {
            throw std::invalid_argument("the placed scene has more than " + std::to_string(kMaxTriangles) +
                                        " triangles or 2^32 vertices, more than an index can name");
        }
    }
    first_triangle_.push_back(static_cast<uint32_t>(triangles));
    positions_ = LargeBuffer<float>(3 * vertices);
    triangles_ = LargeBuffer<uint32_t>(3 * triangles);
    take_huge_pages(positions_, threads);
    take_huge_pages(triangles_, threads);

    const auto vertex_chunks =
        make_chunks(placements.size(), [&](size_t p) { return meshes[placements[p].mesh].positions.size() / 3; });
    std::vector<Bounds> chunk_bounds(vertex_chunks.size());
    parallel_for(threads, vertex_chunks.size(), [&](size_t c) {
        const Chunk& chunk = vertex_chunks[c];
        const Placement& placement = placements[chunk.placement];
        Bounds bounds;
        for (size_t i = chunk.begin; i < chunk.end; ++i) {
            const Vec3d p = placement.matrix.point(load(meshes[placement.mesh].positions, i));
            if (in_reach(p))
                bounds.add({p, p});
        }
        chunk_bounds[c] = bounds;
    });
    Bounds bounds;
    for (const Bounds& part : chunk_bounds)
        bounds.add(part);
    if (bounds.lower.x <= bounds.upper.x) {
        centre_ = bounds.lower * 0.5 + bounds.upper * 0.5;
        precision_.distance = 0.5 * largest_of(bounds.upper - bounds.lower);
    }

    parallel_for(threads, vertex_chunks.size(), [&](size_t c) {
        const Chunk& chunk = vertex_chunks[c];
        const Placement& placement = placements[chunk.placement];
        for (size_t i = chunk.begin; i < chunk.end; ++i) {
            const Vec3f p = to_float(placement.matrix.point(load(meshes[placement.mesh].positions, i)) - centre_);
            float* out = &positions_[3 * (placed_[chunk.placement].first_vertex + i)];
            out[0] = p.x, out[1] = p.y, out[2] = p.z;
        }
    });
    const auto index_chunks =
        make_chunks(placements.size(), [&](size_t p) { return meshes[placements[p].mesh].triangles.size(); });
    parallel_for(threads, index_chunks.size(), [&](size_t c) {
        const Chunk& chunk = index_chunks[c];
        const MeshInput& mesh = meshes[placements[chunk.placement].mesh];
        const size_t out = 3 * size_t{first_triangle_[chunk.placement]};
        for (size_t i = chunk.begin; i < chunk.end; ++i)
            triangles_[out + i] = mesh.triangles[i] + placed_[chunk.placement].first_vertex;
    });
}

/// One summary per name; returns which of them each placement belongs to.
std::vector<size_t> Scene::name_objects(std::span<const Placement> placements) {
    std::unordered_map<std::string, size_t> by_name;
    std::vector<size_t> object_of(placements.size());
    for (size_t p = 0; p < placements.size(); ++p) {
        const auto [entry, added] = by_name.try_emplace(placements[p].object, objects_.size());
        if (added)
            objects_.emplace_back().object = placements[p].object;
        object_of[p] = entry->second;
        objects_[entry->second].triangles += first_triangle_[p + 1] - first_triangle_[p];
    }
    return object_of;
}

void Scene::count_rejected(const std::vector<size_t>& object_of, int threads) {
    const auto chunks =
        make_chunks(object_of.size(), [&](size_t p) { return size_t{first_triangle_[p + 1]} - first_triangle_[p]; });
    std::vector<RejectedFaces> counts(chunks.size());
    parallel_for(threads, chunks.size(), [&](size_t c) {
        const size_t first = first_triangle_[chunks[c].placement];
        counts[c] = rejected_faces(soup(), static_cast<uint32_t>(first + chunks[c].begin),
                                   static_cast<uint32_t>(first + chunks[c].end));
    });
    for (size_t c = 0; c < chunks.size(); ++c)
        objects_[object_of[chunks[c].placement]].rejected += counts[c];
}

void Scene::measure_precision(std::span<const MeshInput> meshes, std::span<const Placement> placements,
                              const std::vector<size_t>& object_of, int threads) {
    if (triangles_.size() != 0)
        precision_ =
            precision_at(precision_.distance, typical_edge(positions_.span(), triangles_.span(), kMostLookedAt));
    std::vector<Precision> in_mesh(meshes.size());
    parallel_for(threads, meshes.size(), [&](size_t m) {
        in_mesh[m] = precision_at(typical_distance(meshes[m].positions, kMostLookedAt),
                                  typical_edge(meshes[m].positions, meshes[m].triangles, kMostLookedAt));
    });
    const size_t most = std::max(kLeastLookedAt, kMostLookedAt / std::max<size_t>(1, placements.size()));
    std::vector<double> distances(placements.size());
    parallel_for(threads, placements.size(), [&](size_t p) {
        distances[p] = typical_distance(
            positions_.span().subspan(3 * size_t{placed_[p].first_vertex}, meshes[placements[p].mesh].positions.size()),
            most);
    });

    const auto keep_worse = [](Precision& worst, const Precision& other) {
        if (other.ulp_per_edge() > worst.ulp_per_edge())
            worst = other;
    };
    for (size_t p = 0; p < placements.size(); ++p) {
        ObjectSummary& object = objects_[object_of[p]];
        const Precision own = in_mesh[placements[p].mesh] * mean_scale(placements[p].matrix);
        keep_worse(object.in_mesh, own);
        keep_worse(object.in_scene, precision_at(distances[p], own.edge));
        const Vec3d at = placements[p].matrix.translation();
        if (to_double(to_float(at)) == at)
            keep_worse(object.in_placement, precision_at(largest_of(at), own.edge));
    }
}

size_t Scene::placement_of(uint32_t triangle) const {
    // Placements without triangles share their start with the next one; the last that starts at or before the triangle
    // owns it.
    return static_cast<size_t>(std::upper_bound(first_triangle_.begin(), first_triangle_.end(), triangle) -
                               first_triangle_.begin()) -
           1;
}

Vec3d Scene::vertex(uint32_t index) const { return load(positions_.span(), index); }

SurfacePoint Scene::surface(uint32_t triangle, double u, double v, Vec3d direction) const {
    const size_t placement = placement_of(triangle);
    const Placed& placed = placed_[placement];
    const MeshShading& mesh = meshes_[placed.mesh];
    const size_t local = triangle - first_triangle_[placement];
    const uint32_t* corners = &triangles_[3 * size_t{triangle}];
    const std::array<Vec3d, 3> p{vertex(corners[0]), vertex(corners[1]), vertex(corners[2])};

    SurfacePoint point;
    double extent = 0.0;
    point.position = p[0] + (p[1] - p[0]) * u + (p[2] - p[0]) * v;
    for (const Vec3d corner : p)
        extent = std::max({extent, std::abs(corner.x), std::abs(corner.y), std::abs(corner.z)});
    point.error = extent * 0x1p-49;
    const Vec3d wound = normalize_or(cross(p[1] - p[0], p[2] - p[0]), {0.0, 0.0, 1.0});
    point.geometric_normal = dot(wound, direction) > 0.0 ? -wound : wound;
    point.shading_normal = point.geometric_normal;
    // A slot beyond the object's materials takes the last one, as Blender does.
    const size_t slot = mesh.slots.empty() ? 0 : static_cast<size_t>(mesh.slots[local]);
    point.base_color = materials_[static_cast<size_t>(placed.materials[std::min(slot, placed.materials.size() - 1)])];
    if (mesh.kind == NormalKind::kFlat)
        return point;

    const std::array<double, 3> weight{1.0 - u - v, u, v};
    std::array<Vec3d, 3> normal;
    Vec3d sum{0.0, 0.0, 0.0};
    for (size_t k = 0; k < 3; ++k) {
        const size_t index = mesh.kind == NormalKind::kPerVertex ? corners[k] - placed.first_vertex : 3 * local + k;
        const Vec3d n = load(mesh.normals, index);
        const auto& columns = placed.normal_columns;
        normal[k] = normalize_or(columns[0] * n.x + columns[1] * n.y + columns[2] * n.z, wound);
        sum += normal[k] * weight[k];
    }
    point.shading_normal = normalize_or(sum, wound);
    double side = 1.0;  // normals of a mirrored object come out of the map reversed, those of back faces look away
    if (dot(point.shading_normal, point.geometric_normal) < 0.0) {
        point.shading_normal = -point.shading_normal;
        side = -1.0;
    }
    // Shadow rays start on the surface that the normals suggest: the point is moved onto the tangent plane of each
    // corner it lies below, by that corner's weight (Hanika, Hacking the Shadow Terminator). Otherwise the faces of a
    // coarse mesh shade themselves.
    for (size_t k = 0; k < 3; ++k) {
        const Vec3d n = normal[k] * side;
        point.shadow_lift = point.shadow_lift - n * (weight[k] * std::min(0.0, dot(point.position - p[k], n)));
    }
    return point;
}

}  // namespace espalier
