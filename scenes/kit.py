# SPDX-License-Identifier: GPL-3.0-or-later
"""What the scene scripts share: meshes from arrays, plain materials, lights, a camera, and saving the file.

Everything here is written to work alike in Blender 4.2 to 5.2: data is made directly, without operators.
Lengths are metres, angles degrees, colours sRGB hex strings ("#rrggbb"); Z is up.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from itertools import pairwise
from math import radians
from pathlib import Path

import bpy
import numpy as np
from mathutils import Euler, Matrix, Vector

Point = Sequence[float] | np.ndarray


def linear(colour: str) -> tuple[float, float, float]:
    """The linear RGB values of an sRGB hex string such as "#c8a27a"."""
    srgb = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    r, g, b = (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in srgb)
    return r, g, b


def material(colour: str) -> bpy.types.Material:
    """A matt material of that colour, made once per colour and named after it."""
    found = bpy.data.materials.get(colour)
    if found is not None:
        return found
    made = bpy.data.materials.new(colour)
    if made.node_tree is None:  # before Blender 5.0 a new material has no nodes
        made.use_nodes = True
    shader = next(node for node in made.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
    shader.inputs["Base Color"].default_value = (*linear(colour), 1.0)
    # Without gloss, so that Cycles limited to direct light draws the very picture that Espalier draws.
    shader.inputs["Roughness"].default_value = 1.0
    shader.inputs["Specular IOR Level"].default_value = 0.0
    made.diffuse_color = (*linear(colour), 1.0)
    return made


def mesh(
    name: str,
    vertices: np.ndarray,
    faces: np.ndarray | Sequence[Sequence[int]],
    smooth: bool = False,
    crease: float | None = None,
) -> bpy.types.Mesh:
    """A mesh datablock from vertices [N,3] and faces: an int array [M,corners], or a list of faces of any size.

    smooth: shade smooth, except at edges sharper than crease (degrees) where that is given.
    """
    data = bpy.data.meshes.new(name)
    if isinstance(faces, np.ndarray):
        data.vertices.add(len(vertices))
        data.vertices.foreach_set("co", np.ascontiguousarray(vertices, np.float32).ravel())
        data.loops.add(faces.size)
        data.loops.foreach_set("vertex_index", np.ascontiguousarray(faces, np.int32).ravel())
        data.polygons.add(len(faces))
        data.polygons.foreach_set("loop_start", np.arange(0, faces.size, faces.shape[1], dtype=np.int32))
        data.update(calc_edges=True)
    else:
        data.from_pydata(np.asarray(vertices, float).tolist(), [], faces)
    if smooth:
        data.shade_smooth()
        if crease is not None:
            data.set_sharp_from_angle(angle=radians(crease))
    else:
        data.shade_flat()
    return data


def box(name: str, size: Point) -> bpy.types.Mesh:
    """A box of that size, centred in x and y, standing on z = 0."""
    x, y, z = size[0] / 2, size[1] / 2, size[2]
    corners = np.array([(i, j, k) for k in (0, z) for j in (-y, y) for i in (-x, x)])
    return mesh(name, corners, [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (1, 3, 7, 5), (3, 2, 6, 7), (2, 0, 4, 6)])


def sheet(
    name: str, points: np.ndarray, *, closed_rows: bool = False, closed_columns: bool = False, smooth: bool = True
) -> bpy.types.Mesh:
    """A surface of quads over a grid of points [rows, columns, 3], closed in either way on demand."""
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    if closed_rows:
        index = np.concatenate([index, index[:1]], axis=0)
    if closed_columns:
        index = np.concatenate([index, index[:, :1]], axis=1)
    quads = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], axis=-1)
    return mesh(name, points.reshape(-1, 3), quads.reshape(-1, 4), smooth)


def lathe(
    name: str, profile: Sequence[tuple[float, float]], segments: int = 48, crease: float = 35.0
) -> bpy.types.Mesh:
    """A profile of (radius, height), bottom first, turned about z; a radius of 0 at an end closes it with a fan."""
    angle = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    vertices: list[Point] = []
    rings: list[list[int]] = []
    for radius, height in profile:
        start = len(vertices)
        turned = (
            [(0.0, 0.0, height)]
            if radius == 0
            else [(radius * c, radius * s, height) for c, s in zip(np.cos(angle), np.sin(angle), strict=True)]
        )
        vertices += turned
        rings.append(list(range(start, len(vertices))))
    faces: list[tuple[int, ...]] = []
    for low, high in pairwise(rings):
        for i in range(segments):
            j = (i + 1) % segments
            corners = (low[i % len(low)], low[j % len(low)], high[j % len(high)], high[i % len(high)])
            faces.append(tuple(dict.fromkeys(corners)))
    return mesh(name, np.array(vertices), faces, smooth=True, crease=crease)


def ball(name: str, radius: float, segments: int = 24) -> bpy.types.Mesh:
    """A sphere about the origin."""
    angle = np.linspace(0, np.pi, segments // 2 + 1)
    return lathe(
        name,
        [
            (radius * float(np.sin(a)) if 0 < i < segments // 2 else 0.0, -radius * float(np.cos(a)))
            for i, a in enumerate(angle)
        ],
        segments,
    )


def tube(
    name: str,
    points: Sequence[Point],
    radius: float,
    *,
    closed: bool = False,
    resolution: int = 3,
    radii: Sequence[float] | None = None,
) -> bpy.types.Curve:
    """A round bar through the points: a Bézier curve with a bevel; radii scale it point by point."""
    curve = bpy.data.curves.new(name, "CURVE")
    curve.dimensions = "3D"
    curve.bevel_depth = radius
    curve.bevel_resolution = resolution
    curve.use_fill_caps = True
    spline = curve.splines.new("BEZIER")
    spline.bezier_points.add(len(points) - 1)
    spline.use_cyclic_u = closed
    for i, (knot, place) in enumerate(zip(spline.bezier_points, points, strict=True)):
        knot.co = place
        knot.handle_left_type = knot.handle_right_type = "AUTO"
        knot.radius = 1.0 if radii is None else radii[i]
    return curve


def place(
    data: bpy.types.ID,
    colour: str | Sequence[str],
    at: Point = (0, 0, 0),
    turn: Point = (0, 0, 0),
    scale: float | Point = 1.0,
    into: bpy.types.Collection = None,
    name: str | None = None,
) -> bpy.types.Object:
    """An object with that data, in the scene or in `into`; the colours become its materials, if it has none."""
    thing = bpy.data.objects.new(name or data.name, data)
    (into or bpy.context.scene.collection).objects.link(thing)
    if not data.materials:
        for one in [colour] if isinstance(colour, str) else colour:
            data.materials.append(material(one))
    thing.location = at
    thing.rotation_euler = [radians(a) for a in turn]
    thing.scale = (scale, scale, scale) if isinstance(scale, int | float) else scale
    return thing


def collection(name: str) -> bpy.types.Collection:
    """A collection that is not in the scene, to be drawn through its instances only."""
    return bpy.data.collections.new(name)


def instance(
    of: bpy.types.Collection, at: Point = (0, 0, 0), turn: Point = (0, 0, 0), scale: float | Point = 1.0
) -> bpy.types.Object:
    """An empty that draws the collection."""
    empty = bpy.data.objects.new(of.name, None)
    empty.instance_type = "COLLECTION"
    empty.instance_collection = of
    empty.matrix_world = Matrix.LocRotScale(
        Vector(at),
        Euler([radians(a) for a in turn]),
        Vector((scale, scale, scale) if isinstance(scale, int | float) else scale),
    )
    bpy.context.scene.collection.objects.link(empty)
    return empty


def modify(thing: bpy.types.Object, kind: str, **settings: object) -> bpy.types.Object:
    """Adds a modifier of that kind with those settings; returns the object."""
    modifier = thing.modifiers.new(kind.title(), kind)
    for name, value in settings.items():
        setattr(modifier, name, value)
    return thing


def aim(thing: bpy.types.Object, at: Point, target: Point) -> bpy.types.Object:
    """Puts a camera or light at a point and turns it to the target."""
    thing.location = at
    thing.rotation_euler = (Vector(target) - Vector(at)).to_track_quat("-Z", "Y").to_euler()
    return thing


def light(
    kind: str, colour: str, power: float, at: Point, target: Point = (0, 0, 0), **settings: object
) -> bpy.types.Object:
    """A light of kind POINT, SUN, SPOT or AREA; power in W (sun: W/m²); further settings by Blender's names."""
    data = bpy.data.lights.new(kind.title(), kind)
    data.color = linear(colour)
    data.energy = power
    for name, value in settings.items():
        setattr(data, name, value)
    thing = bpy.data.objects.new(kind.title(), data)
    bpy.context.scene.collection.objects.link(thing)
    return aim(thing, at, target)


def camera(at: Point, target: Point, lens: float, far: float = 1000.0) -> bpy.types.Object:
    """The scene's camera; lens in millimetres for a sensor 36 mm wide."""
    data = bpy.data.cameras.new("Camera")
    data.lens = lens
    data.clip_start = 0.01
    data.clip_end = far
    thing = bpy.data.objects.new("Camera", data)
    bpy.context.scene.collection.objects.link(thing)
    bpy.context.scene.camera = thing
    return aim(thing, at, target)


def picture(background: str, width: int = 960, height: int = 540) -> None:
    """The picture's size, its background colour, and colours shown as they are computed (no film curve)."""
    scene = bpy.context.scene
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = width, height, 100
    scene.view_settings.view_transform = "Standard"
    world = bpy.data.worlds.new("World")
    scene.world = world
    if world.node_tree is None:
        world.use_nodes = True
    world.color = linear(background)
    sky = next(node for node in world.node_tree.nodes if node.type == "BACKGROUND")
    sky.inputs["Color"].default_value = (*linear(background), 1.0)


def save(out: str) -> None:
    """Writes the current file, compressed, to the path `out`."""
    path = Path(out).resolve()
    path.parent.mkdir(parents=True, exist_ok=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(path), compress=True)


def main(build: Callable[[], None]) -> None:
    """The scripts' command line: `python scenes/NAME.py OUT.blend`."""
    if len(sys.argv) != 2:
        sys.exit(f"usage: python {sys.argv[0]} OUT.blend")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.name = Path(sys.argv[0]).stem
    build()
    save(sys.argv[1])
