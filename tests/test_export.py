# SPDX-License-Identifier: GPL-3.0-or-later
"""The exported arrays against what Blender itself says of the evaluated scene, read the slow and documented way."""

from __future__ import annotations

import ctypes
from collections import Counter
from math import inf, nan
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.stage import Stage, ordered, world_triangles


def api_triangles(bpy: ModuleType) -> np.ndarray:
    """Every triangle of every visible instance, one vertex at a time."""
    bpy.context.view_layer.update()
    found = []
    for instance in bpy.context.evaluated_depsgraph_get().object_instances:
        if instance.object.type != "MESH" or not instance.show_self:
            continue
        mesh = instance.object.data
        mesh.calc_loop_triangles()
        matrix = instance.matrix_world.copy()
        places = [tuple(matrix @ vertex.co) for vertex in mesh.vertices]
        found += [[places[index] for index in triangle.vertices] for triangle in mesh.loop_triangles]
    return ordered(np.array(found, float).reshape(-1, 3, 3))


def triangles_of(arrays: Any) -> Counter[str]:
    counts: Counter[str] = Counter()
    for placement in arrays.placements:
        counts[placement.object] += len(arrays.meshes[placement.mesh].triangles)
    return counts


def normals_of(mesh: Any) -> np.ndarray:
    """The normal at each corner of each triangle, in whichever form they are kept."""
    normals: np.ndarray = mesh.normals if mesh.normals.ndim == 3 else mesh.normals[mesh.triangles]
    return normals


def collection_of(stage: Stage, name: str, *members: Any) -> Any:
    """A collection that is in no view layer and shown through instances alone."""
    collection = stage.bpy.data.collections.new(name)
    for member in members:
        stage.scene.collection.objects.unlink(member)
        collection.objects.link(member)
    return collection


def make_every_kind(stage: Stage) -> None:
    bpy = stage.bpy
    cube = stage.cube("Subdivided", location=(1, 2, 3))
    cube.modifiers.new("Subdivision", "SUBSURF").levels = 2
    text = bpy.data.curves.new("Text", "FONT")
    text.body, text.extrude = "Ab", 0.1
    stage.add("Text", text)
    bpy.ops.curve.primitive_bezier_circle_add()
    bpy.context.object.data.bevel_depth = 0.2
    bpy.ops.surface.primitive_nurbs_surface_sphere_add()
    bpy.ops.object.metaball_add(location=(5, 0, 0))


def test_each_kind_of_object_is_there_with_the_triangles_blender_makes_of_it(stage: Stage) -> None:
    make_every_kind(stage)
    arrays = stage.export()
    counts = triangles_of(arrays)
    depsgraph = stage.bpy.context.evaluated_depsgraph_get()
    assert len(stage.scene.objects) == 5
    for item in stage.scene.objects:
        mesh = stage.bpy.data.meshes.new_from_object(item.evaluated_get(depsgraph))
        mesh.calc_loop_triangles()
        assert counts[item.name] == len(mesh.loop_triangles) > 0, item.name
    assert counts["Subdivided"] == 6 * 16 * 2
    np.testing.assert_allclose(world_triangles(arrays), api_triangles(stage.bpy), atol=1e-5)
    assert arrays.settings_used == "viewport"


def test_collection_instances_are_placed_and_stored_once(stage: Stage) -> None:
    inside = collection_of(stage, "Inside", stage.cube("One", location=(1, 0, 0)), stage.cube("Two", scale=(2, 1, 1)))
    for index, scale in enumerate([(1, 1, 1), (-1, 1, 1), (0.5, 2, 1)]):
        stage.add(
            f"Instance {index}",
            None,
            instance_type="COLLECTION",
            instance_collection=inside,
            scale=scale,
            location=(0, 9, index),
        )
    arrays = stage.export()
    assert triangles_of(arrays) == {"One": 36, "Two": 36}
    assert len(arrays.meshes) == 2
    assert arrays.triangle_count == 72
    assert sum(np.linalg.det(matrix) < 0 for matrix in arrays.matrices) == 2
    np.testing.assert_allclose(world_triangles(arrays), api_triangles(stage.bpy), atol=1e-5)


def test_particles_and_vertex_instances_are_there(stage: Stage) -> None:
    stage.cube("Grain", location=(0, 0, 50))
    plane = stage.add("Field", stage.mesh("Field", [(0, 0, 0), (4, 0, 0), (4, 4, 0), (0, 4, 0)], [(0, 1, 2, 3)]))
    plane.modifiers.new("Particles", "PARTICLE_SYSTEM")
    settings = plane.particle_systems[0].settings
    settings.type, settings.count, settings.render_type = "HAIR", 7, "OBJECT"
    settings.instance_object = stage.scene.objects["Grain"]
    corners = stage.add("Corners", plane.data.copy(), instance_type="VERTS", show_instancer_for_viewport=False)
    stage.cube("Post", parent=corners)
    arrays = stage.export()
    assert triangles_of(arrays) == {
        "Grain": 12 * 8,
        "Field": 2,
        "Post": 12 * 5,
    }  # 4 corners, and the viewport shows the original
    np.testing.assert_allclose(world_triangles(arrays), api_triangles(stage.bpy), atol=1e-5)


def test_geometry_nodes_instances_have_their_own_materials_and_one_mesh(stage: Stage) -> None:
    green = stage.material("Green", (0, 1, 0))
    group = stage.bpy.data.node_groups.new("Instances", "GeometryNodeTree")
    group.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    names = ("MeshCube", "SetMaterial", "MeshGrid", "InstanceOnPoints")
    cube, paint, grid, spread = (group.nodes.new(f"GeometryNode{name}") for name in names)
    paint.inputs["Material"].default_value = green
    output = group.nodes.new("NodeGroupOutput")
    for source, target in (
        (cube.outputs[0], paint.inputs["Geometry"]),
        (paint.outputs[0], spread.inputs["Instance"]),
        (grid.outputs[0], spread.inputs["Points"]),
        (spread.outputs[0], output.inputs[0]),
    ):
        group.links.new(source, target)
    host = stage.cube("Host")
    host.modifiers.new("Nodes", "NODES").node_group = group
    arrays = stage.export()
    assert triangles_of(arrays) == {"Host": 9 * 12}
    assert len(arrays.meshes) == 1
    mesh = arrays.meshes[0]
    slots = np.zeros(12, int) if mesh.material_slots is None else mesh.material_slots
    for placement in arrays.placements:
        assert {arrays.materials[placement.materials[slot]] for slot in slots} == {(0.0, 1.0, 0.0)}


def test_hidden_things_are_left_out(stage: Stage) -> None:
    bpy = stage.bpy
    stage.cube("Seen")
    stage.cube("Disabled", hide_viewport=True)
    stage.cube("Not rendered", hide_render=True)
    stage.cube("Eye closed")
    closed = bpy.data.collections.new("Closed")
    excluded = bpy.data.collections.new("Excluded")
    for collection in (closed, excluded):
        stage.scene.collection.children.link(collection)
        collection.objects.link(bpy.data.objects.new(f"In {collection.name}", stage.scene.objects["Seen"].data))
    inside = collection_of(stage, "Inside", stage.cube("Instanced"), stage.cube("Hidden inside", hide_viewport=True))
    stage.add("Instancer", None, instance_type="COLLECTION", instance_collection=inside)
    closed.objects.link(bpy.data.objects.new("Instancer in Closed", None))
    closed.objects["Instancer in Closed"].instance_type = "COLLECTION"
    closed.objects["Instancer in Closed"].instance_collection = inside
    bpy.context.view_layer.update()
    stage.scene.objects["Eye closed"].hide_set(True)
    bpy.context.view_layer.layer_collection.children["Closed"].hide_viewport = True
    bpy.context.view_layer.layer_collection.children["Excluded"].exclude = True
    assert triangles_of(stage.export()) == {"Seen": 12, "Not rendered": 12, "Instanced": 12}


def test_a_background_set_is_drawn(stage: Stage) -> None:
    stage.cube("Actor")
    backdrop = stage.bpy.data.scenes.new("Backdrop")
    backdrop.collection.objects.link(stage.bpy.data.objects.new("Wall", stage.scene.objects["Actor"].data))
    stage.scene.background_set = backdrop
    assert triangles_of(stage.export()) == {"Actor": 12, "Wall": 12}


def test_what_has_no_triangles_is_named(stage: Stage) -> None:
    stage.add("Fur", stage.bpy.data.hair_curves.new("Fur"))
    stage.add("Smoke", stage.bpy.data.volumes.new("Smoke"))
    stage.add("Smoke nobody sees", stage.bpy.data.volumes.new("Smoke"), hide_viewport=True)
    assert stage.export().left_out == {"Fur": "hair curves", "Smoke": "volumes"}


def test_what_the_viewport_shows_as_wire_or_bounds_is_named_and_left_to_the_render(stage: Stage) -> None:
    cutter = stage.cube("Cutter", display_type="WIRE")
    stage.cube("Box", display_type="BOUNDS")
    hollow = stage.cube("Hollow", display_type="SOLID")
    hole = hollow.modifiers.new("Hole", "BOOLEAN")
    hole.object, cutter.location = cutter, (1.0, 0.0, 0.0)
    inside = collection_of(stage, "Inside", stage.cube("Instanced"))
    stage.add("Ghosts", None, instance_type="COLLECTION", instance_collection=inside, display_type="WIRE")
    label = stage.bpy.data.curves.new("Label", "FONT")
    label.body = "A"
    stage.add("Label", label, display_type="WIRE")
    arrays = stage.export()
    assert set(triangles_of(arrays)) == {"Hollow"}
    assert set(arrays.left_out) == {"Cutter", "Box", "Instanced", "Label"}
    assert arrays.left_out["Cutter"] == "faces of an object displayed as wire"
    assert arrays.left_out["Box"] == "faces of an object displayed as bounds"


def test_a_light_at_no_finite_place_is_named(stage: Stage) -> None:
    for name, x in (("Lamp", 1.0), ("Lost", nan)):
        stage.add(name, stage.bpy.data.lights.new(name, "POINT"), location=(x, 0.0, 0.0))
    arrays = stage.export()
    assert len(arrays.lights) == 1
    assert arrays.left_out == {"Lost": "lights at no finite place"}


def test_a_concave_face_is_cut_along_blenders_own_diagonals(stage: Stage) -> None:
    arrow = [(0, 0, 0), (4, 0, 0), (4, 4, 0), (2, 1, 0), (0, 4, 1)]
    stage.add("Arrow", stage.mesh("Arrow", arrow, [(0, 1, 2, 3, 4)]))
    arrays = stage.export()
    mesh = stage.scene.objects["Arrow"].data
    mesh.calc_loop_triangles()
    assert arrays.meshes[0].triangles.tolist() == [list(triangle.vertices) for triangle in mesh.loop_triangles]


def test_a_mesh_of_triangles_keeps_their_order(stage: Stage) -> None:
    vertices = np.random.default_rng(1).normal(size=(9, 3))
    faces = [(0, 1, 2), (8, 3, 5), (4, 6, 7), (2, 1, 8)]
    stage.add("Loose", stage.mesh("Loose", vertices.tolist(), faces))
    mesh = stage.export().meshes[0]
    assert mesh.triangles.tolist() == [list(face) for face in faces]
    np.testing.assert_array_equal(mesh.positions, vertices.astype(np.float32))
    assert mesh.triangles.dtype == np.int32
    assert mesh.positions.dtype == np.float32


def test_meshes_without_faces_are_no_trouble(stage: Stage) -> None:
    stage.add("Nothing", stage.mesh("Nothing", [], []))
    stage.add("Points", stage.mesh("Points", [(0, 0, 0), (1, 0, 0)], []))
    edges = stage.bpy.data.meshes.new("Edges")
    edges.from_pydata([(0, 0, 0), (1, 0, 0)], [(0, 1)], [])
    stage.add("Edges", edges)
    arrays = stage.export()
    assert (arrays.meshes, arrays.placements, arrays.triangle_count) == ([], [], 0)
    assert arrays.matrices.shape == (0, 4, 4)
    assert arrays.to_native()[2].shape == (1, 3)


def test_in_edit_mode_the_edited_mesh_is_exported(stage: Stage) -> None:
    import bmesh

    cube = stage.cube()
    cube.modifiers.new("Subdivision", "SUBSURF").levels = 1
    stage.bpy.context.view_layer.objects.active = cube
    stage.bpy.ops.object.mode_set(mode="EDIT")
    edited = bmesh.from_edit_mesh(cube.data)
    bmesh.ops.translate(edited, verts=edited.verts, vec=(10, 0, 0))
    bmesh.update_edit_mesh(cube.data)
    arrays = stage.export()
    assert triangles_of(arrays) == {"Cube": 48}
    assert arrays.meshes[0].positions[:, 0].min() > 9.0


def test_flat_smooth_and_mixed_normals(stage: Stage) -> None:
    bpy = stage.bpy
    stage.cube("Flat")
    smooth = stage.cube("Smooth")
    smooth.data.polygons.foreach_set("use_smooth", [True] * 6)
    mixed = stage.cube("Mixed")
    mixed.data.polygons.foreach_set("use_smooth", [True, False, True, True, False, True])
    custom = stage.cube("Custom")
    custom.data.normals_split_custom_set([(0.6, 0.0, 0.8)] * 24)
    triangulated = stage.add("Triangulated", mixed.data.copy())
    triangulated.modifiers.new("Triangulate", "TRIANGULATE")
    arrays = stage.export()
    depsgraph = bpy.context.evaluated_depsgraph_get()
    meshes = {p.object: arrays.meshes[p.mesh] for p in arrays.placements}
    assert meshes["Flat"].normals is None
    assert meshes["Smooth"].normals.shape == (8, 3)
    expected = [vertex.vector for vertex in smooth.evaluated_get(depsgraph).data.vertex_normals]
    np.testing.assert_allclose(meshes["Smooth"].normals, expected, atol=1e-6)
    for item in (mixed, custom, triangulated):
        mesh = item.evaluated_get(depsgraph).data
        mesh.calc_loop_triangles()
        expected = [[mesh.corner_normals[corner].vector for corner in t.loops] for t in mesh.loop_triangles]
        np.testing.assert_allclose(normals_of(meshes[item.name]), expected, atol=1e-6, err_msg=item.name)
    np.testing.assert_allclose(normals_of(meshes["Custom"]), np.broadcast_to((0.6, 0.0, 0.8), (12, 3, 3)), atol=1e-3)
    np.testing.assert_allclose(world_triangles(arrays), api_triangles(bpy), atol=1e-6)


def test_the_arrays_outlive_the_next_evaluation(stage: Stage) -> None:
    cube = stage.cube()
    cube.modifiers.new("Subdivision", "SUBSURF").levels = 4
    arrays = stage.export()
    before = world_triangles(arrays).copy()
    cube.modifiers["Subdivision"].levels = 5
    cube.data.transform(stage.bpy.context.evaluated_depsgraph_get().objects[0].matrix_world * 3.0)
    assert len(world_triangles(stage.export())) == 4 * len(before)
    np.testing.assert_array_equal(world_triangles(arrays), before)

    cube.data.polygons[0].use_smooth = True
    for mesh in stage.export().meshes:
        for array in (mesh.positions, mesh.triangles, mesh.normals):
            while array.base is not None:
                array = array.base  # noqa: PLW2901
            assert isinstance(array, np.ndarray), "it lies in Blender's memory"


def test_the_documented_reading_gives_the_same_arrays(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    from addon.export import _CornerPointer

    make_every_kind(stage)
    monkeypatch.setattr(_CornerPointer, "trusted", None)
    fast = stage.export()
    assert _CornerPointer.trusted is True
    _CornerPointer.trusted = False
    slow = stage.export()
    assert len(fast.meshes) == len(slow.meshes) == 5
    for one, other in zip(fast.meshes, slow.meshes, strict=True):
        np.testing.assert_array_equal(one.triangles, other.triangles)


@pytest.mark.parametrize("fault", ["content", "stride"])
def test_a_memory_layout_that_is_not_the_expected_one_is_never_used(
    monkeypatch: pytest.MonkeyPatch, fault: str
) -> None:
    from addon import export

    true = np.arange(24, dtype=np.int32).reshape(8, 3)
    memory = (ctypes.c_int32 * 64)(*range(100, 164))
    step = 12 if fault == "content" else 16
    places = [ctypes.addressof(memory) + step * i for i in range(8)]

    class Triangles(list):
        def foreach_get(self, _name: str, out: np.ndarray) -> None:
            out[:] = true.ravel()

    triangles = Triangles(
        SimpleNamespace(loops=tuple(row), as_pointer=lambda place=place: place)
        for row, place in zip(true.tolist(), places, strict=True)
    )
    mesh = SimpleNamespace(loops=[0] * 16, polygons=[0] * 4, loop_triangles=triangles, calc_loop_triangles=lambda: None)
    monkeypatch.setattr(export._CornerPointer, "trusted", None)
    corners = export.triangle_corners(mesh)
    assert corners is not None
    np.testing.assert_array_equal(corners, true.ravel())
    assert export._CornerPointer.trusted is not True


def test_materials_by_slot_and_by_object(stage: Stage) -> None:
    red, blue = stage.material("Red", (1, 0, 0)), stage.material("Blue", (0, 0, 1))
    first = stage.cube("First")
    first.data.materials.append(red)
    first.data.materials.append(blue)
    first.data.polygons.foreach_set("material_index", [0, 1, 0, 1, 0, 9])
    second = stage.add("Second", first.data)
    second.material_slots[0].link = "OBJECT"
    second.material_slots[0].material = blue
    stage.cube("Bare")
    arrays = stage.export()
    table = {p.object: [arrays.materials[i] for i in p.materials] for p in arrays.placements}
    assert table == {
        "First": [(1, 0, 0), (0, 0, 1)],
        "Second": [(0, 0, 1), (0, 0, 1)],
        "Bare": [(pytest.approx(0.8), pytest.approx(0.8), pytest.approx(0.8))],
    }
    meshes = {p.object: arrays.meshes[p.mesh] for p in arrays.placements}
    assert meshes["First"].material_slots.tolist() == [0, 0, 1, 1, 0, 0, 1, 1, 0, 0, 1, 1]
    assert meshes["Bare"].material_slots is None


@pytest.mark.parametrize("kind", ["NodeSocketFloat", "NodeSocketVector", "NodeSocketShader"])
@pytest.mark.parametrize("name", ["Color", "Base Color"])
def test_a_group_socket_that_is_called_a_colour_is_none(stage: Stage, name: str, kind: str) -> None:
    from addon.export import base_color

    material = stage.material("Grouped", (0.1, 0.2, 0.3))
    material.diffuse_color = (0.5, 0.6, 0.7, 1.0)
    nodes = material.node_tree.nodes
    nodes.remove(next(node for node in nodes if node.type == "BSDF_PRINCIPLED"))
    inner = stage.bpy.data.node_groups.new("Inner", "ShaderNodeTree")
    inner.interface.new_socket("Shader", in_out="OUTPUT", socket_type="NodeSocketShader")
    inner.interface.new_socket(name, in_out="INPUT", socket_type=kind)
    group = nodes.new("ShaderNodeGroup")
    group.node_tree = inner
    output = next(node for node in nodes if node.type == "OUTPUT_MATERIAL")
    material.node_tree.links.new(group.outputs["Shader"], output.inputs["Surface"])
    assert base_color(material) == pytest.approx((0.5, 0.6, 0.7))

    inner.interface.new_socket(name, in_out="INPUT", socket_type="NodeSocketColor")
    group.inputs[1].default_value = (0.9, 0.8, 0.7, 1.0)
    assert base_color(material) == pytest.approx((0.9, 0.8, 0.7))


def test_base_colours(stage: Stage) -> None:
    from addon.export import base_color

    plain = stage.material("Plain", (0.1, 0.2, 0.3))
    assert base_color(plain) == pytest.approx((0.1, 0.2, 0.3))

    textured = stage.material("Textured", (0.1, 0.2, 0.3))
    textured.diffuse_color = (0.5, 0.6, 0.7, 1.0)
    tree = textured.node_tree
    shader = next(node for node in tree.nodes if node.type == "BSDF_PRINCIPLED")
    tree.links.new(tree.nodes.new("ShaderNodeTexNoise").outputs["Color"], shader.inputs["Base Color"])
    assert base_color(textured) == pytest.approx((0.5, 0.6, 0.7))

    mixed = stage.material("Mixed", (0.1, 0.2, 0.3))
    tree = mixed.node_tree
    shader = next(node for node in tree.nodes if node.type == "BSDF_PRINCIPLED")
    output = next(node for node in tree.nodes if node.type == "OUTPUT_MATERIAL")
    mix, glow, unused = (tree.nodes.new(f"ShaderNode{name}") for name in ("MixShader", "Emission", "BsdfDiffuse"))
    unused.inputs["Color"].default_value = (1, 1, 1, 1)
    glow.inputs["Color"].default_value = (0.9, 0.8, 0.7, 1)
    tree.links.new(glow.outputs[0], mix.inputs[1])
    tree.links.new(shader.outputs[0], mix.inputs[2])
    tree.links.new(mix.outputs[0], output.inputs["Surface"])
    assert base_color(mixed) == pytest.approx((0.1, 0.2, 0.3))
    tree.nodes.remove(shader)
    assert base_color(mixed) == pytest.approx((0.9, 0.8, 0.7))
    assert base_color(None) == (0.8, 0.8, 0.8)

    other = tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(unused.outputs[0], other.inputs["Surface"])
    other.is_active_output = True
    assert base_color(mixed) == pytest.approx((1.0, 1.0, 1.0))


def test_faces_with_a_vertex_that_is_not_finite_are_named_and_left_out(stage: Stage) -> None:
    grid = [(float(x), float(y), 0.0) for y in range(4) for x in range(4)]
    faces = [(4 * y + x, 4 * y + x + 1, 4 * y + x + 5, 4 * y + x + 4) for y in range(3) for x in range(3)]
    broken = stage.add("Terrain", stage.mesh("Terrain", grid, faces, smooth=True))
    grid[0], grid[15] = (nan, 0.0, 0.0), (3.0, 3.0, inf)
    broken.data.attributes["position"].data.foreach_set("vector", np.array(grid, np.float32).ravel())
    broken.data.polygons[4].use_smooth = False
    broken.data.update()
    stage.add("Terrain again", broken.data, location=(10, 0, 0))
    often = collection_of(stage, "Often", stage.add("Instanced", broken.data))
    for x in (20, 30):
        stage.add(f"Instancer {x}", None, instance_type="COLLECTION", instance_collection=often, location=(x, 0, 0))
    lost = stage.cube("Lost")
    lost.location.x = nan
    stage.cube("Sound")
    arrays = stage.export()
    broken.data.calc_loop_triangles()
    touched = sum(bool({0, 15} & set(triangle.vertices)) for triangle in broken.data.loop_triangles)
    assert touched
    assert arrays.not_finite == {"Terrain": touched, "Terrain again": touched, "Instanced": 2 * touched, "Lost": 12}
    assert triangles_of(arrays) == {
        "Terrain": 18 - touched,
        "Terrain again": 18 - touched,
        "Instanced": 2 * (18 - touched),
        "Sound": 12,
    }
    assert np.isfinite(world_triangles(arrays)).all()
    for mesh in arrays.meshes:
        assert mesh.normals is None or np.isfinite(mesh.normals).all()


def test_lights_with_their_own_settings(stage: Stage) -> None:
    wanted: dict[str, dict[str, Any]] = {
        "POINT": {"shadow_soft_size": 0.3},
        "SUN": {"angle": 0.1, "use_shadow": False},
        "SPOT": {"spot_size": 1.0, "spot_blend": 0.4, "shadow_soft_size": 0.2},
        "AREA": {"shape": "RECTANGLE", "size": 2.0, "size_y": 0.5},
    }
    for kind, settings in wanted.items():
        light = stage.bpy.data.lights.new(kind, kind)
        light.energy, light.color = 7.0, (1.0, 0.5, 0.25)
        for name, value in settings.items():
            setattr(light, name, value)
        stage.add(kind, light, location=(1, 2, 3))
    stage.add("Disk", stage.bpy.data.lights.new("Disk", "AREA")).data.shape = "DISK"
    stage.add("Off", stage.bpy.data.lights.new("Off", "POINT"), hide_viewport=True)
    lights = stage.export().lights
    assert [light["type"] for light in lights] == ["POINT", "SUN", "SPOT", "AREA", "AREA"]
    for light in lights[:4]:
        assert (light["energy"], light["color"]) == (7.0, (1.0, 0.5, 0.25))
        np.testing.assert_array_equal(light["matrix"][:3, 3], (1, 2, 3))
    point, sun, spot, area, disk = lights
    assert (point["radius"], point["shadow"]) == (pytest.approx(0.3), True)
    assert (sun["angle"], sun["shadow"]) == (pytest.approx(0.1), False)
    assert [spot[key] for key in ("spot_size", "spot_blend", "radius")] == pytest.approx([1.0, 0.4, 0.2])
    assert [area[key] for key in ("shape", "size", "size_y")] == ["RECTANGLE", 2.0, 0.5]
    assert disk["shape"] == "DISK"
    assert disk["size_y"] == disk["size"]


def test_lights_inside_instances_shine_from_every_one(stage: Stage) -> None:
    lamp = stage.add("Lamp", stage.bpy.data.lights.new("Lamp", "POINT"), location=(0, 0, 1))
    inside = collection_of(stage, "Inside", lamp)
    for x in (1, 2, 3):
        stage.add(f"Lamp {x}", None, instance_type="COLLECTION", instance_collection=inside, location=(x, 0, 0))
    assert [light["matrix"][:3, 3].tolist() for light in stage.export().lights] == [[1, 0, 1], [2, 0, 1], [3, 0, 1]]


def test_a_lights_exposure_and_temperature_count(stage: Stage) -> None:
    light = stage.bpy.data.lights.new("Lamp", "POINT")
    if not hasattr(light, "exposure"):
        pytest.skip("lights have an exposure from Blender 4.5")
    light.energy, light.exposure, light.use_temperature, light.temperature = 10.0, 2.0, True, 2500.0
    stage.add("Lamp", light)
    (exported,) = stage.export().lights
    assert exported["energy"] == 40.0
    assert exported["color"] == pytest.approx(tuple(light.temperature_color))
    assert exported["color"][0] > 2.0 * exported["color"][2]


def test_the_worlds_colour(stage: Stage) -> None:
    assert stage.export().world_color == (0.0, 0.0, 0.0)
    world = stage.scene.world = stage.bpy.data.worlds.new("World")
    if world.node_tree is None:
        world.color = (0.1, 0.2, 0.3)
        assert stage.export().world_color == pytest.approx((0.1, 0.2, 0.3))
        world.use_nodes = True
    background = next(node for node in world.node_tree.nodes if node.type == "BACKGROUND")
    background.inputs["Color"].default_value = (0.2, 0.3, 0.4, 1.0)
    background.inputs["Strength"].default_value = 2.0
    assert stage.export().world_color == pytest.approx((0.4, 0.6, 0.8))
    world.color = (0.5, 0.5, 0.1)
    sky = world.node_tree.nodes.new("ShaderNodeTexNoise")
    world.node_tree.links.new(sky.outputs["Color"], background.inputs["Color"])
    assert stage.export().world_color == pytest.approx((0.5, 0.5, 0.1))


def test_render_settings_are_used_and_said_when_the_render_engine_exports(stage: Stage) -> None:
    import bpy

    from addon.export import export_scene

    seen = []

    class Witness(bpy.types.RenderEngine):
        bl_idname = "WITNESS"
        bl_label = "Witness"

        def render(self, depsgraph: Any) -> None:
            seen.append(export_scene(depsgraph))

    cube = stage.cube("Detailed")
    modifier = cube.modifiers.new("Subdivision", "SUBSURF")
    modifier.levels, modifier.render_levels = 0, 2
    stage.cube("Viewport only", hide_render=True)
    stage.cube("Render only", hide_viewport=True)
    stage.cube("Wire", display_type="WIRE")
    stage.camera()
    bpy.utils.register_class(Witness)
    try:
        stage.scene.render.engine = "WITNESS"
        bpy.ops.render.render()
    finally:
        bpy.utils.unregister_class(Witness)
    (arrays,) = seen
    assert arrays.settings_used == "render"
    assert triangles_of(arrays) == {"Detailed": 192, "Render only": 12, "Wire": 12}
    assert not arrays.left_out
    assert triangles_of(stage.export()) == {"Detailed": 12, "Viewport only": 12}
