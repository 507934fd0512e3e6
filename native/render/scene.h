// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "geometry/vec.h"
#include "kdtree/large_buffer.h"
#include "kdtree/tree.h"
#include "render/matrix.h"
#include "render/precision.h"

namespace espalier {

enum class NormalKind { kFlat, kPerVertex, kPerCorner };

/// A mesh in object space. The spans must live until the Scene has been made; it keeps no reference to them.
struct MeshInput {
    std::string name;
    std::span<const float> positions;     // xyz per vertex
    std::span<const uint32_t> triangles;  // three vertex indices each
    NormalKind normal_kind = NormalKind::kFlat;
    std::span<const float> normals;           // xyz per vertex or per corner, empty when flat
    std::span<const int32_t> material_slots;  // one per triangle, or empty: all in slot 0
};

/// One use of a mesh. `materials` says for each slot of the mesh which of the scene's base colours it has.
struct Placement {
    std::string object;
    uint32_t mesh = 0;
    Matrix4 matrix;  // object to world
    std::vector<int32_t> materials;
};

/// What became of one object's faces, its placements taken together. Precisions are those of the placement that has
/// least, in world units.
struct ObjectSummary {
    std::string object;
    uint64_t triangles = 0;
    RejectedFaces rejected{};
    Precision in_mesh;       // of the mesh's own coordinates, as they were given
    Precision in_placement;  // of the matrix's translation, if that was a float once, as all of Blender's are
    Precision in_scene;      // of the world triangles, relative to the scene's centre
};

/// A point on a triangle as seen by a ray, both normals of unit length and turned against the ray.
/// Frame: world axes, relative to Scene::centre().
struct SurfacePoint {
    Vec3d position;
    double error;  // the position is at most this far from the triangle's plane
    Vec3d geometric_normal;
    Vec3d shading_normal;              // interpolated where the mesh is smooth, else the geometric one
    Vec3d shadow_lift{0.0, 0.0, 0.0};  // from the triangle to the smooth surface its normals suggest; zero where flat
    Vec3f base_color;
};

/// Placed meshes, flattened to world triangles. Positions are formed in double relative to the centre of the world
/// bounds and rounded to float once, so a scene far from the origin loses nothing. Immutable, and free of references to
/// its input.
class Scene {
 public:
    /// Throws std::invalid_argument or std::out_of_range, naming the mesh or the object.
    Scene(std::span<const MeshInput> meshes, std::span<const Placement> placements, std::span<const float> materials,
          int threads = 0);

    TriangleSoup soup() const { return {positions_.span(), triangles_.span()}; }
    /// The first triangle of each placement, then the number of all.
    std::span<const uint32_t> first_triangles() const { return first_triangle_; }
    size_t placement_of(uint32_t triangle) const;
    uint64_t triangle_count() const { return triangles_.size() / 3; }
    Vec3d centre() const { return centre_; }
    double placing_ms() const { return placing_ms_; }
    const std::vector<ObjectSummary>& objects() const { return objects_; }
    /// Of the scene's largest coordinate, relative to the centre, against its median edge.
    const Precision& precision() const { return precision_; }

    /// The point (1-u-v) v0 + u v1 + v v2 of a triangle, hit by a ray along `direction`.
    SurfacePoint surface(uint32_t triangle, double u, double v, Vec3d direction) const;

 private:
    struct MeshShading {  // what is left of a mesh once it is placed: normals stay in object space, shared by its
                          // placements
        NormalKind kind;
        std::vector<float> normals;
        std::vector<int32_t> slots;
    };
    struct Placed {
        uint32_t mesh;
        uint32_t first_vertex;
        std::array<Vec3d, 3> normal_columns;
        std::vector<int32_t> materials;
    };

    void place(std::span<const MeshInput> meshes, std::span<const Placement> placements, int threads);
    std::vector<size_t> name_objects(std::span<const Placement> placements);
    void count_rejected(const std::vector<size_t>& object_of, int threads);
    void measure_precision(std::span<const MeshInput> meshes, std::span<const Placement> placements,
                           const std::vector<size_t>& object_of, int threads);
    Vec3d vertex(uint32_t index) const;

    LargeBuffer<float> positions_;
    LargeBuffer<uint32_t> triangles_;
    std::vector<uint32_t>
        first_triangle_;  // per placement, then the total: a triangle's placement is found by bisection
    std::vector<MeshShading> meshes_;
    std::vector<Placed> placed_;
    std::vector<Vec3f> materials_;
    std::vector<ObjectSummary> objects_;
    Vec3d centre_{0.0, 0.0, 0.0};
    Precision precision_;
    double placing_ms_ = 0.0;
};

}  // namespace espalier
