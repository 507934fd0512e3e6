// SPDX-License-Identifier: GPL-3.0-or-later
#include <cmath>
#include <limits>
#include <memory>
#include <span>
#include <string>
#include <vector>

#include "module/arrays.h"
#include "module/bindings.h"
#include "module/docs.h"
#include "module/fields.h"
#include "module/reports.h"
#include "render/scene.h"

namespace py = pybind11;
using namespace py::literals;

namespace espalier {
namespace {

/// A mesh's arrays, held while the scene is made from them.
struct HeldMesh {
    Array<float> positions, normals;
    Array<uint32_t> triangles;
    Array<int32_t> slots;
    MeshInput input;
};

HeldMesh mesh_from(const Fields& fields) {
    HeldMesh mesh;
    mesh.input.name = fields.required<std::string>("name");
    const std::string where = "mesh '" + mesh.input.name + "': ";
    mesh.positions = float_array(fields.at("positions"), where + "positions", {kAny, 3});
    mesh.triangles = triangle_array(fields.at("triangles"), where + "triangles", mesh.positions.rows());
    mesh.input.positions = mesh.positions.span();
    mesh.input.triangles = mesh.triangles.span();
    const auto vertices = static_cast<py::ssize_t>(mesh.positions.rows());
    const auto triangles = static_cast<py::ssize_t>(mesh.triangles.rows());
    if (const py::object normals = fields.find("normals"); !normals.is_none()) {
        const bool per_corner =
            py::isinstance<py::array>(normals) && py::reinterpret_borrow<py::array>(normals).ndim() == 3;
        mesh.normals = per_corner ? float_array(normals, where + "normals", {triangles, 3, 3})
                                  : float_array(normals, where + "normals", {vertices, 3});
        mesh.input.normals = mesh.normals.span();
        mesh.input.normal_kind = per_corner ? NormalKind::kPerCorner : NormalKind::kPerVertex;
    }
    if (const py::object slots = fields.find("material_slots"); !slots.is_none()) {
        mesh.slots = int_array(slots, where + "material_slots", {triangles});
        mesh.input.material_slots = mesh.slots.span();
    }
    return mesh;
}

Placement placement_from(const Fields& fields) {
    Placement placement;
    placement.object = fields.required<std::string>("object");
    const std::string where = "object '" + placement.object + "': ";
    const auto mesh = fields.required<int64_t>("mesh");
    if (mesh < 0 || mesh > std::numeric_limits<uint32_t>::max()) {
        throw py::index_error(where + "mesh index " + std::to_string(mesh) + " is out of range");
    }
    placement.mesh = static_cast<uint32_t>(mesh);
    placement.matrix = matrix_from(fields.at("matrix"), where + "matrix");
    const Array<int32_t> materials = int_array(fields.at("materials"), where + "materials", {kAny});
    placement.materials.assign(materials.span().begin(), materials.span().end());
    return placement;
}

std::shared_ptr<Scene> make_scene(const py::sequence& meshes, const py::sequence& placements, py::handle materials) {
    std::vector<HeldMesh> held;
    for (size_t i = 0; i < meshes.size(); ++i)
        held.push_back(mesh_from(Fields(meshes[i], "meshes", i)));
    std::vector<Placement> placed;
    for (size_t i = 0; i < placements.size(); ++i)
        placed.push_back(placement_from(Fields(placements[i], "placements", i)));
    const Array<float> colors = float_array(materials, "materials", {kAny, 3});
    for (const float value : colors.span()) {
        if (!std::isfinite(value))
            throw py::value_error("materials must be finite");
    }
    std::vector<MeshInput> inputs;
    for (const HeldMesh& mesh : held)
        inputs.push_back(mesh.input);
    const py::gil_scoped_release release;
    return std::make_shared<Scene>(inputs, placed, colors.span());
}

/// A copy with `width` values to the row.
template <class T>
py::array_t<T> rows_array(std::span<const T> values, size_t width) {
    return py::array_t<T>({values.size() / width, width}, values.data());
}

py::dict scene_arrays(const Scene& scene) {
    const std::span<const uint32_t> first = scene.first_triangles();
    return py::dict("vertices"_a = rows_array(scene.soup().positions, 3),
                    "triangles"_a = rows_array(scene.soup().triangles, 3),
                    "first_triangles"_a = py::array_t<uint32_t>(first.size(), first.data()));
}

/// The points of hits, as Tree.intersect() returned them for these directions.
py::dict scene_surface(const Scene& scene, py::handle triangle, py::handle u, py::handle v, py::handle directions) {
    const Array<int32_t> triangles = int_array(triangle, "triangle", {kAny});
    const auto count = static_cast<py::ssize_t>(triangles.rows());
    const Array<float> us = float_array(u, "u", {count}), vs = float_array(v, "v", {count});
    const Array<float> along = float_array(directions, "directions", {count, 3});
    py::array_t<int32_t> placement(count);
    py::array_t<double> position({count, py::ssize_t{3}}), geometric({count, py::ssize_t{3}}),
        shading({count, py::ssize_t{3}});
    for (py::ssize_t i = 0; i < count; ++i) {
        const int32_t hit = triangles.owner.at(i);
        if (hit >= 0 && static_cast<uint64_t>(hit) >= scene.triangle_count())
            throw py::index_error("triangle " + std::to_string(hit) + " is not in the scene");
        SurfacePoint point{};
        if (hit >= 0) {
            const Vec3d direction{along.owner.at(i, 0), along.owner.at(i, 1), along.owner.at(i, 2)};
            point = scene.surface(static_cast<uint32_t>(hit), us.owner.at(i), vs.owner.at(i), direction);
        }
        placement.mutable_at(i) = hit < 0 ? -1 : static_cast<int32_t>(scene.placement_of(static_cast<uint32_t>(hit)));
        for (int axis = 0; axis < 3; ++axis) {
            position.mutable_at(i, axis) = point.position[axis];
            geometric.mutable_at(i, axis) = point.geometric_normal[axis];
            shading.mutable_at(i, axis) = point.shading_normal[axis];
        }
    }
    return py::dict("placement"_a = placement, "position"_a = position, "geometric_normal"_a = geometric,
                    "shading_normal"_a = shading);
}

}  // namespace

void bind_scene(py::module_& module) {
    const auto centre = [](const Scene& scene) {
        py::array_t<double> array(3);
        for (int axis = 0; axis < 3; ++axis) {
            array.mutable_at(axis) = scene.centre()[axis];
        }
        return array;
    };
    py::class_<Scene, std::shared_ptr<Scene>>(module, "Scene", docs::kScene)
        .def(py::init(&make_scene), "meshes"_a, "placements"_a, "materials"_a, docs::kSceneInit)
        .def_property_readonly("triangle_count", &Scene::triangle_count, docs::kTriangleCount)
        .def_property_readonly("centre", centre, docs::kCentre)
        .def_property_readonly("objects", &objects_list, docs::kObjects)
        .def_property_readonly(
            "precision", [](const Scene& scene) { return precision_dict(scene.precision()); }, docs::kPrecision)
        .def("arrays", &scene_arrays, docs::kSceneArrays)
        .def("surface", &scene_surface, "triangle"_a, "u"_a, "v"_a, "directions"_a, docs::kSurface);
}

}  // namespace espalier
