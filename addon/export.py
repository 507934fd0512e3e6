# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's evaluated scene as NumPy arrays: meshes once each, where they are placed, colours, lights and the camera.

Everything is in Blender's world frame, in metres, colours linear. Only bulk reads are used, and what comes back owns
its memory, so the next evaluation cannot pull it away.
"""

from __future__ import annotations

import ctypes
import itertools
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

DEFAULT_COLOR = (0.8, 0.8, 0.8)
BLACK = (0.0, 0.0, 0.0)

# What Blender would draw and triangles cannot say; left out by name, never silently.
TYPES_WITHOUT_TRIANGLES = {
    "CURVES": "hair curves",
    "POINTCLOUD": "point clouds",
    "VOLUME": "volumes",
    "GREASEPENCIL": "Grease Pencil strokes",
    "GPENCIL": "Grease Pencil strokes",
}

# Objects whose faces the viewport does not draw, in solid and in rendered shading; a final render draws them.
DISPLAYED_WITHOUT_FACES = {
    "WIRE": "faces of an object displayed as wire",
    "BOUNDS": "faces of an object displayed as bounds",
}

Color = tuple[float, float, float]


class ExportError(RuntimeError):
    """The scene cannot be drawn; the message is one sentence for the artist."""


@dataclass(frozen=True)
class Mesh:
    """One evaluated mesh in its own frame."""

    name: str
    positions: NDArray[np.float32]  # [N,3]
    triangles: NDArray[np.int32]  # [M,3]
    normals: NDArray[np.float32] | None  # None: flat; [N,3]: per vertex; [M,3,3]: per corner
    material_slots: NDArray[np.int32] | None  # [M]; None: all in slot 0
    slot_count: int
    not_finite: int  # faces left out because a vertex of theirs is not finite

    def to_native(self) -> dict[str, Any]:
        """Give this mesh as the native scene takes it."""
        return {
            "name": self.name,
            "positions": self.positions,
            "triangles": self.triangles,
            "normals": self.normals,
            "material_slots": self.material_slots,
        }


@dataclass(frozen=True)
class Placement:
    """A mesh put into the world by an object."""

    object: str
    mesh: int
    materials: tuple[int, ...]  # for each slot of the mesh, an index into SceneArrays.materials


@dataclass(frozen=True)
class Camera:
    """The active camera; projection is Blender's own (OpenGL convention), for the render size asked for."""

    type: str  # "PERSP" or "ORTHO"
    matrix_world: NDArray[np.float64]  # [4,4], without scale
    projection: NDArray[np.float64]  # [4,4]


@dataclass
class SceneArrays:
    """All that a picture needs, free of Blender."""

    settings_used: str  # "viewport" or "render"
    width: int
    height: int
    camera: Camera | None
    meshes: list[Mesh] = field(default_factory=list)
    placements: list[Placement] = field(default_factory=list)
    matrices: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 4, 4)))  # [placements,4,4]
    materials: list[Color] = field(default_factory=lambda: [DEFAULT_COLOR])  # linear base colours
    lights: list[dict[str, Any]] = field(default_factory=list)
    world_color: Color = BLACK
    not_finite: dict[str, int] = field(default_factory=dict)  # faces left out, by object
    left_out: dict[str, str] = field(default_factory=dict)  # object: what of it is not drawn
    evaluation_ms: float = 0.0
    export_ms: float = 0.0

    @property
    def triangle_count(self) -> int:
        """Triangles in the world, instances counted each time they are placed."""
        return sum(len(self.meshes[placement.mesh].triangles) for placement in self.placements)

    def to_native(self) -> tuple[list[dict[str, Any]], list[dict[str, Any]], NDArray[np.float32]]:
        """The arguments of espalier_native.Scene: meshes, placements, materials."""
        placements = [
            {
                "object": placement.object,
                "mesh": placement.mesh,
                "matrix": matrix,
                "materials": np.array(placement.materials, np.int32),
            }
            for placement, matrix in zip(self.placements, self.matrices, strict=True)
        ]
        return [mesh.to_native() for mesh in self.meshes], placements, np.array(self.materials, np.float32)


def export_scene(depsgraph: bpy.types.Depsgraph, *, percentage: int | None = None, camera: bool = True) -> SceneArrays:
    """Read everything that the evaluated depsgraph would draw.

    percentage replaces the scene's own resolution percentage; camera=False leaves the camera out (a build needs none).
    Modifiers that Blender evaluates only when their result is read, and normals, count as evaluation_ms.
    Raises ExportError where there is no picture to be had.
    """
    start = time.perf_counter()
    scene = depsgraph.scene
    width, height = render_size(scene, percentage)
    arrays = SceneArrays(
        settings_used="render" if depsgraph.mode == "RENDER" else "viewport",
        width=width,
        height=height,
        camera=export_camera(depsgraph, width, height) if camera else None,
        world_color=world_color(depsgraph.scene_eval.world),
    )
    evaluation_s = _InstanceReader(depsgraph, arrays).read()
    arrays.evaluation_ms = evaluation_s * 1e3
    arrays.export_ms = (time.perf_counter() - start - evaluation_s) * 1e3
    return arrays


def render_size(scene: bpy.types.Scene, percentage: int | None = None) -> tuple[int, int]:
    """Width and height of the picture in pixels, cut off as Blender cuts them off."""
    render = scene.render
    percentage = render.resolution_percentage if percentage is None else percentage
    return max(1, render.resolution_x * percentage // 100), max(1, render.resolution_y * percentage // 100)


def export_camera(depsgraph: bpy.types.Depsgraph, width: int, height: int) -> Camera:
    """The active camera with Blender's own projection (shift, sensor fit, pixel aspect). Raises ExportError."""
    scene = depsgraph.scene
    active = scene.camera
    if active is None:
        raise ExportError(
            f"The scene “{scene.name}” has no active camera: add one, or select a camera and press Ctrl+Numpad 0"
        )
    if active.type != "CAMERA":
        raise ExportError(
            f"The active camera “{active.name}” is not a camera object: choose one in the scene properties"
        )
    if active.data.type not in {"PERSP", "ORTHO"}:
        kind = {"PANO": "panoramic", "CUSTOM": "custom"}.get(active.data.type, active.data.type.lower())
        raise ExportError(
            f"The active camera “{active.name}” is {kind}: Espalier draws perspective and orthographic cameras"
        )
    evaluated = active.evaluated_get(depsgraph)
    render = scene.render
    projection = evaluated.calc_matrix_camera(
        depsgraph, x=width, y=height, scale_x=render.pixel_aspect_x, scale_y=render.pixel_aspect_y
    )
    camera = Camera(
        type=active.data.type,
        # A camera's scale does not change its picture.
        matrix_world=np.array(evaluated.matrix_world.normalized(), np.float64),
        projection=np.array(projection, np.float64),
    )
    if not (np.isfinite(camera.matrix_world).all() and np.isfinite(camera.projection).all()):
        raise ExportError(f"The active camera “{active.name}” is not at a finite place")
    return camera


def world_color(world: bpy.types.World | None) -> Color:
    """The colour of the background: that of the Background node times its strength, else the world's own colour."""
    if world is None:
        return BLACK
    node = _surface_node(world, {"BACKGROUND"})
    if node is None or node.inputs["Color"].is_linked:
        return _rgb(world.color)
    strength = node.inputs["Strength"]
    factor = 1.0 if strength.is_linked else strength.default_value
    red, green, blue = _rgb(node.inputs["Color"].default_value)
    return red * factor, green * factor, blue * factor


def base_color(material: bpy.types.Material | None) -> Color:
    """The linear colour of a surface: Principled base colour, else the first shader's colour, else the viewport's.

    A colour that comes from a texture is not looked up; the viewport's colour stands for it.
    """
    if material is None:
        return DEFAULT_COLOR
    node = _surface_node(material, {"BSDF_PRINCIPLED"}) or _surface_node(material, None)
    if node is not None:
        socket = _color_socket(node)
        if socket is not None and not socket.is_linked:
            return _rgb(socket.default_value)
    return _rgb(material.diffuse_color)


def export_light(light: bpy.types.Light, matrix: NDArray[np.float64]) -> dict[str, Any]:
    """A light's own settings and its place, as the native tracer takes them."""
    red, green, blue = _rgb(light.color)
    energy = float(light.energy)
    if getattr(light, "use_temperature", False):  # from Blender 4.5
        warm = light.temperature_color
        red, green, blue = red * warm[0], green * warm[1], blue * warm[2]
    energy *= 2.0 ** getattr(light, "exposure", 0.0)  # from Blender 4.5
    shape = getattr(light, "shape", "SQUARE")
    size = float(getattr(light, "size", 0.0))
    return {
        "type": light.type,
        "matrix": matrix,
        "color": (red, green, blue),
        "energy": energy,
        "radius": float(getattr(light, "shadow_soft_size", 0.0)),
        "angle": float(getattr(light, "angle", 0.0)),
        "spot_size": float(getattr(light, "spot_size", 0.0)),
        "spot_blend": float(getattr(light, "spot_blend", 0.0)),
        "shape": shape,
        "size": size,
        "size_y": float(light.size_y) if shape in {"RECTANGLE", "ELLIPSE"} else size,
        "shadow": bool(light.use_shadow),
    }


class _InstanceReader:
    """One walk over the depsgraph's instances."""

    def __init__(self, depsgraph: bpy.types.Depsgraph, arrays: SceneArrays) -> None:
        self.depsgraph = depsgraph
        self.arrays = arrays
        self.evaluation_s = 0.0
        self.mesh_of_pointer: dict[int, int | None] = {}
        self.material_of_pointer: dict[int, int] = {}
        self.slots_of_data: dict[tuple[int, str], tuple[int, ...]] = {}
        # Objects of a background set are in no view layer, and drawn.
        self.visible_of_pointer: dict[int, bool] = {}
        background = depsgraph.scene.background_set
        while background is not None:
            self.visible_of_pointer.update((item.as_pointer(), True) for item in background.objects)
            background = background.background_set
        self.matrices: list[Matrix] = []

    def read(self) -> float:
        """Fill the arrays; returns the seconds Blender spent on evaluating what was read."""
        arrays = self.arrays
        for instance in self.depsgraph.object_instances:
            if not instance.show_self or not self.is_visible(instance):
                continue
            kind = instance.object.type
            # Text, curves, surfaces and metaballs come a second time, as the mesh that is drawn.
            if kind == "MESH":
                # An instance has the lesser display type of its object and of what makes it.
                display = instance.object.display_type if arrays.settings_used == "viewport" else ""
                if display in DISPLAYED_WITHOUT_FACES:
                    arrays.left_out[instance.object.name] = DISPLAYED_WITHOUT_FACES[display]
                else:
                    self.place(instance)
            elif kind == "LIGHT":
                matrix = np.array(instance.matrix_world, np.float64)
                if np.isfinite(matrix).all():
                    arrays.lights.append(export_light(instance.object.data, matrix))
                else:
                    arrays.left_out[instance.object.name] = "lights at no finite place"
            elif kind in TYPES_WITHOUT_TRIANGLES:
                arrays.left_out[instance.object.name] = TYPES_WITHOUT_TRIANGLES[kind]
        flat = itertools.chain.from_iterable(itertools.chain.from_iterable(self.matrices))
        count = len(self.matrices)
        arrays.matrices = np.fromiter(flat, np.float64, count * 16).reshape(count, 4, 4)
        self.drop_lost_placements()
        return self.evaluation_s

    def is_visible(self, instance: bpy.types.DepsgraphObjectInstance) -> bool:
        """Whether the viewport would draw it: the depsgraph lists what is in a collection whose eye is closed, too."""
        if self.arrays.settings_used == "render":
            return True
        # An instance is hidden with the object that makes it.
        shown_by = (instance.parent if instance.is_instance else instance.object).original
        pointer = shown_by.as_pointer()
        if pointer not in self.visible_of_pointer:
            self.visible_of_pointer[pointer] = shown_by.visible_get(view_layer=self.depsgraph.view_layer)
        return self.visible_of_pointer[pointer]

    def place(self, instance: bpy.types.DepsgraphObjectInstance) -> None:
        arrays = self.arrays
        owner = instance.object
        start = time.perf_counter()
        data = owner.data  # a trailing Subdivision Surface is evaluated here
        self.evaluation_s += time.perf_counter() - start
        pointer = data.as_pointer()
        if pointer in self.mesh_of_pointer:
            index = self.mesh_of_pointer[pointer]
        else:
            mesh = self.read_mesh(owner, data)
            index = None
            if mesh is not None:
                index = len(arrays.meshes)
                arrays.meshes.append(mesh)
            self.mesh_of_pointer[pointer] = index
        if index is None:
            return
        mesh = arrays.meshes[index]
        name = owner.name
        if mesh.not_finite:
            arrays.not_finite[name] = arrays.not_finite.get(name, 0) + mesh.not_finite
        if len(mesh.triangles):
            arrays.placements.append(Placement(name, index, self.materials(owner, pointer, mesh.slot_count)))
            self.matrices.append(instance.matrix_world.copy())

    def materials(self, owner: bpy.types.Object, pointer: int, slot_count: int) -> tuple[int, ...]:
        # Slots may belong to the object as well as to the mesh, so the object has a say in the key.
        key = (pointer, owner.name_full)
        found = self.slots_of_data.get(key)
        if found is None:
            table = [self.material(slot.material) for slot in owner.material_slots] or [0]
            if len(table) < slot_count:
                table.extend([table[-1]] * (slot_count - len(table)))
            found = self.slots_of_data[key] = tuple(table)
        return found

    def material(self, material: bpy.types.Material | None) -> int:
        if material is None:
            return 0
        pointer = material.as_pointer()
        if pointer not in self.material_of_pointer:
            self.material_of_pointer[pointer] = len(self.arrays.materials)
            self.arrays.materials.append(base_color(material))
        return self.material_of_pointer[pointer]

    def read_mesh(self, owner: bpy.types.Object, data: bpy.types.Mesh) -> Mesh | None:
        # In Edit Mode the evaluated mesh may still be an edit mesh, which has no attributes to read.
        if not data.is_editmode:
            return self.read_arrays(data)
        start = time.perf_counter()
        data = owner.to_mesh()
        self.evaluation_s += time.perf_counter() - start
        try:
            return self.read_arrays(data)
        finally:
            owner.to_mesh_clear()

    def read_arrays(self, mesh: bpy.types.Mesh) -> Mesh | None:
        if not len(mesh.polygons):
            return None
        domain = mesh.normals_domain
        if domain != "FACE":
            start = time.perf_counter()
            # Normals are computed when they are first read.
            (mesh.vertex_normals if domain == "POINT" else mesh.corner_normals)[0].as_pointer()
            self.evaluation_s += time.perf_counter() - start

        positions = np.empty((len(mesh.vertices), 3), np.float32)
        mesh.attributes["position"].data.foreach_get("vector", positions.ravel())
        vertex_of_corner = np.empty(len(mesh.loops), np.int32)
        mesh.attributes[".corner_vert"].data.foreach_get("value", vertex_of_corner)
        corners = triangle_corners(mesh)
        slots = triangle_slots(mesh, corners is None)

        normals: NDArray[np.float32] | None = None
        if domain == "POINT":
            normals = np.empty((len(mesh.vertices), 3), np.float32)
            mesh.vertex_normals.foreach_get("vector", normals.ravel())
        elif domain == "CORNER":
            normals = np.empty((len(mesh.loops), 3), np.float32)
            mesh.corner_normals.foreach_get("vector", normals.ravel())

        finite = np.isfinite(positions).all(axis=1) if not np.isfinite(positions).all() else None
        if corners is None:
            triangles = vertex_of_corner.reshape(-1, 3)
            if domain == "CORNER" and normals is not None:
                normals = normals.reshape(-1, 3, 3)
        elif domain == "CORNER":
            # Every corner becomes a vertex of its own: half the copying of a normal for each corner of each triangle.
            # One opaque 12-byte item is copied twice as fast as a row of three numbers.
            positions = positions.view("V12").ravel().take(vertex_of_corner).view(np.float32).reshape(-1, 3)
            triangles = corners.reshape(-1, 3).copy()
            finite = None if finite is None else finite[vertex_of_corner]
        else:
            triangles = _gathered(vertex_of_corner, corners).reshape(-1, 3)

        not_finite = 0
        if finite is not None:
            kept = finite[triangles].all(axis=1)
            not_finite = len(kept) - int(np.count_nonzero(kept))
            triangles = triangles[kept]
            slots = None if slots is None else slots[kept]
            if normals is not None:
                normals = normals[kept] if normals.ndim == 3 else normals
                normals = np.nan_to_num(normals, nan=0.0, posinf=0.0, neginf=0.0)
        slot_count = 1 if slots is None or not len(slots) else int(slots.max()) + 1
        return Mesh(mesh.name, positions, triangles, normals, slots, slot_count, not_finite)

    def drop_lost_placements(self) -> None:
        """Take out what is placed at no finite place, and say of which object how many faces that were."""
        arrays = self.arrays
        finite = np.isfinite(arrays.matrices).all(axis=(1, 2))
        if finite.all():
            return
        for index in np.flatnonzero(~finite):
            lost = arrays.placements[index]
            count = len(arrays.meshes[lost.mesh].triangles)
            arrays.not_finite[lost.object] = arrays.not_finite.get(lost.object, 0) + count
        arrays.placements = list(itertools.compress(arrays.placements, finite))
        arrays.matrices = arrays.matrices[finite]


class _CornerPointer:
    """Whether loop_triangles can be read where they lie; it is thirty times faster than asking for them one by one."""

    trusted: bool | None = None  # None: not yet compared with the API


def triangle_corners(mesh: bpy.types.Mesh) -> NDArray[np.int32] | None:
    """Three corner indices per triangle, flat, Blender's own triangulation; None: corner i belongs to triangle i // 3.

    The array may lie in Blender's memory: use it before the next evaluation.
    """
    if len(mesh.loops) == 3 * len(mesh.polygons):
        return None
    mesh.calc_loop_triangles()
    triangles = mesh.loop_triangles
    count = len(triangles)
    if _CornerPointer.trusted is not False:
        first, last = triangles[0].as_pointer(), triangles[count - 1].as_pointer()
        if last - first == 12 * (count - 1):
            corners = np.ctypeslib.as_array((ctypes.c_int32 * (3 * count)).from_address(first))
            if _CornerPointer.trusted is None:
                samples = {*range(min(count, 64)), *range(0, count, max(1, count // 64)), count - 1}
                _CornerPointer.trusted = all(
                    tuple(corners[3 * i : 3 * i + 3]) == tuple(triangles[i].loops) for i in samples
                )
            if _CornerPointer.trusted:
                return corners
    corners = np.empty(3 * count, np.int32)
    triangles.foreach_get("loops", corners)
    return corners


def triangle_slots(mesh: bpy.types.Mesh, all_triangles: bool) -> NDArray[np.int32] | None:
    """Material slot of each triangle, int32 [M]; None where all are in slot 0."""
    attribute = mesh.attributes.get("material_index")
    if attribute is None or len(mesh.materials) <= 1:
        return None
    slot_of_face = np.empty(len(mesh.polygons), np.int32)
    attribute.data.foreach_get("value", slot_of_face)
    np.clip(slot_of_face, 0, len(mesh.materials) - 1, out=slot_of_face)
    if all_triangles:
        return slot_of_face
    face_of_triangle = np.empty(len(mesh.loop_triangles), np.int32)
    mesh.loop_triangle_polygons.foreach_get("value", face_of_triangle)
    return slot_of_face.take(face_of_triangle)


def _gathered(values: NDArray[np.int32], indices: NDArray[np.int32]) -> NDArray[np.int32]:
    """values[indices], in pieces: NumPy widens the indices first, and that copy should stay in the cache."""
    out = np.empty(len(indices), values.dtype)
    for begin in range(0, len(indices), 1 << 14):
        part = slice(begin, begin + (1 << 14))
        values.take(indices[part], out=out[part], mode="clip")
    return out


def _rgb(color: Sequence[float]) -> Color:
    return float(color[0]), float(color[1]), float(color[2])


def _color_socket(node: bpy.types.Node) -> bpy.types.NodeSocket | None:
    # A node group may call any kind of socket so.
    colors = [socket for socket in node.inputs if socket.type == "RGBA"]
    return next((socket for name in ("Base Color", "Color") for socket in colors if socket.name == name), None)


def _surface_node(owner: bpy.types.ID, types: set[str] | None) -> bpy.types.Node | None:
    """The first shader that the active output shows, nearest first: of these types, or any that has a colour."""
    for node in _shader_nodes(owner):
        if node.type in types if types else _color_socket(node) is not None:
            return node
    return None


def _shader_nodes(owner: bpy.types.ID) -> Iterator[bpy.types.Node]:
    """The nodes of a material or world that feed its active output through shader sockets, nearest first."""
    # Blender 5 always uses nodes and warns when it is asked.
    if owner.node_tree is None or (bpy.app.version < (5, 0) and not owner.use_nodes):
        return
    is_world = isinstance(owner, bpy.types.World)
    outputs = [
        node for node in owner.node_tree.nodes if node.type == ("OUTPUT_WORLD" if is_world else "OUTPUT_MATERIAL")
    ]
    waiting = [node for node in outputs if node.is_active_output][:1]
    seen = set()
    while waiting:
        node = waiting.pop(0)
        if node.as_pointer() in seen:
            continue
        seen.add(node.as_pointer())
        if node not in outputs:
            yield node
        sockets = [node.inputs["Surface"]] if node in outputs else [s for s in node.inputs if s.type == "SHADER"]
        waiting.extend(link.from_node for socket in sockets for link in socket.links)
