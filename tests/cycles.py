# SPDX-License-Identifier: GPL-3.0-or-later
"""What Cycles sees at the centre of each pixel, and what Espalier sees there: depth, normal and object.

Cycles has its own reading of the scene, its own triangles, camera and ray caster (Embree), so that it agrees is
evidence for all of the path from the scene to the hit. Two things may set them apart, and are told from errors by
asking again. Cycles cannot be asked for the very centre: its thinnest pixel filter spreads samples over a hundredth of
a pixel, so rays of ours are sent over that hundredth. And where faces of two objects coincide, both see one of them:
the object that Cycles names is then looked for at the same depth, alone. What is left are rays of Cycles that pass an
edge within the rounding of its own test, and get the wrong one of the two faces there: up to a few pixels in a million.
"""

from __future__ import annotations

import itertools
import struct
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import espalier_native
import numpy as np
from numpy.typing import NDArray

from addon.export import SceneArrays, export_scene

FILTER_PIXELS = 0.01  # the least that Cycles takes
PROBES = 33  # by as many rays across the filter
DEPTH = 1e-4  # relative; float32 coordinates in another order of operations give up to about 1e-5
NORMAL = 0.01  # radians
TIE = 2e-6  # relative: faces this close together coincide, a few units in the last place of float32

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Ints = NDArray[np.int32]


@dataclass(frozen=True)
class View:
    """What is seen at each pixel, bottom row first; depth is along the camera's axis and infinite at a miss."""

    depth: Doubles  # [P]
    normal: Doubles  # [P,3]
    object: Ints  # [P], the object's pass index, 0 at a miss


def number_objects(bpy: ModuleType) -> dict[str, int]:
    """Give every object a pass index of its own; which name has which."""
    numbers = {}
    for number, thing in enumerate(bpy.data.objects, 1):
        thing.pass_index = number
        numbers[thing.name] = number
    return numbers


def exported_for_render(bpy: ModuleType) -> SceneArrays:
    """The scene with the render settings of modifiers and visibility, which only a render engine is given."""
    found = []

    class Exporter(bpy.types.RenderEngine):  # type: ignore[name-defined]
        bl_idname = "ESPALIER_EXPORTER"
        bl_label = "Exporter"

        def __init__(self, *args: object, **kwargs: object) -> None:
            super().__init__(*args, **kwargs)

        def render(self, depsgraph: Any) -> None:
            found.append(export_scene(depsgraph))

    bpy.utils.register_class(Exporter)
    try:
        bpy.context.scene.render.engine = Exporter.bl_idname
        bpy.ops.render.render()
    finally:
        bpy.utils.unregister_class(Exporter)
    (arrays,) = found
    return arrays


def seen_by_cycles(bpy: ModuleType, folder: Path) -> View:
    """One sample per pixel from Cycles on the CPU, as near to the pixel's centre as it can be told."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.device, cycles.samples = "CPU", 1
    cycles.use_denoising = cycles.use_adaptive_sampling = False
    cycles.pixel_filter_type, cycles.filter_width = "BLACKMAN_HARRIS", FILTER_PIXELS
    layer = scene.view_layers[0]
    layer.use_pass_z = layer.use_pass_normal = layer.use_pass_object_index = True
    # Surfaces without a scattering of their own, so that the pass has the geometry's normal and nothing is lit.
    plain = bpy.data.materials.new("Plain")
    if plain.node_tree is None:
        plain.use_nodes = True
    nodes = plain.node_tree.nodes
    emission, output = nodes.new("ShaderNodeEmission"), next(n for n in nodes if n.type == "OUTPUT_MATERIAL")
    plain.node_tree.links.new(emission.outputs["Emission"], output.inputs["Surface"])
    layer.material_override = plain
    settings = scene.render.image_settings
    wanted = {"media_type": "MULTI_LAYER_IMAGE", "file_format": "OPEN_EXR_MULTILAYER", "color_depth": "32"}
    wanted |= {"exr_codec": "NONE"}
    for name, value in wanted.items():
        if hasattr(settings, name):
            setattr(settings, name, value)
    if hasattr(settings, "use_exr_interleave"):
        settings.use_exr_interleave = True
    path = folder / "cycles.exr"
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    channels = read_exr(path)
    flat = {name.split(".", 1)[1]: values[::-1].ravel() for name, values in channels.items()}
    number = np.rint(flat["Object Index.X"]).astype(np.int32)
    depth = np.where(number > 0, flat["Depth.Z"], np.inf).astype(np.float64)
    return View(depth, np.stack([flat[f"Normal.{axis}"] for axis in "XYZ"], -1).astype(np.float64), number)


def read_exr(path: Path) -> dict[str, Floats]:
    """The channels, float32 [H,W], top row first, of an OpenEXR file of one part, by scan lines, uncompressed."""
    data = path.read_bytes()
    magic, version = struct.unpack_from("<II", data)
    assert (magic, version & 0x1AFF) == (20000630, 2), "neither tiles nor parts are read"
    at, header = 8, {}
    while data[at]:
        name, at = _text(data, at)
        _, at = _text(data, at)
        (size,) = struct.unpack_from("<i", data, at)
        header[name], at = data[at + 4 : at + 4 + size], at + 4 + size
    assert header["compression"] == b"\0"
    left, top, right, bottom = struct.unpack("<4i", header["dataWindow"])
    width, height = right - left + 1, bottom - top + 1
    names, place = [], 0
    while header["channels"][place]:
        name, place = _text(header["channels"], place)
        assert struct.unpack_from("<i", header["channels"], place) == (2,), f"{name} is not float32"
        names.append(name)
        place += 16
    # A line is its number, its size in bytes, and each channel in turn.
    offsets = np.frombuffer(data, "<u8", height, at + 1)
    lines = [np.frombuffer(data, "<f4", len(names) * width, int(offset) + 8) for offset in offsets]
    pixels = np.stack(lines).reshape(height, len(names), width)
    return {name: pixels[:, channel] for channel, name in enumerate(names)}


def _text(data: bytes, at: int) -> tuple[str, int]:
    end = data.index(b"\0", at)
    return data[at:end].decode(), end + 1


class Eye:
    """Espalier's side: the exported scene and its tree, asked at any place of the picture."""

    def __init__(self, arrays: SceneArrays, numbers: dict[str, int]) -> None:
        assert arrays.camera is not None
        self.camera, self.width, self.height = arrays.camera, arrays.width, arrays.height
        self.scene = espalier_native.Scene(*arrays.to_native())
        world = self.scene.arrays()
        self.tree = espalier_native.build(world["vertices"], world["triangles"])
        counts = np.diff(world["first_triangles"].astype(np.int64))
        self.number_of_placement = np.array([numbers[p.object] for p in arrays.placements] + [0], np.int32)
        self.vertices, self.triangles = world["vertices"], world["triangles"]
        self.number_of_triangle = np.repeat(self.number_of_placement[:-1], counts)

    def sees(self, x: Doubles, y: Doubles) -> View:
        """What lies behind these places, in pixels from the lower left corner."""
        origins, directions, near, far = self.rays(x, y)
        hits = self.tree.intersect(origins, directions, near, far)
        surface = self.scene.surface(hits["triangle"], hits["u"], hits["v"], directions)
        number = self.number_of_placement[surface["placement"]]
        return View(hits["t"].astype(np.float64), surface["shading_normal"], number)

    def depth_of(self, number: int, x: Doubles, y: Doubles) -> Doubles:
        """How far off one object is behind these places, whatever is in front of it; infinite at a miss."""
        own = self.triangles[self.number_of_triangle == number]
        origins, directions, near, far = self.rays(x, y)
        hits = espalier_native.build(self.vertices, own).intersect(origins, directions, near, far)
        depth: Doubles = hits["t"].astype(np.float64)
        return depth

    def rays(self, x: Doubles, y: Doubles) -> tuple[Floats, Floats, float, float]:
        """Origins, directions and the clip range of rays through these places; t is the depth along the axis."""
        inverse = np.linalg.inv(self.camera.projection)

        def unprojected(x: Doubles, y: Doubles, z: float) -> Doubles:
            point = np.stack([x, y, np.full_like(x, z), np.ones_like(x)], -1) @ inverse.T
            found: Doubles = point[..., :3] / point[..., 3:]
            return found

        middle = np.zeros(1)
        near, far = (-float(unprojected(middle, middle, z)[0, 2]) for z in (-1.0, 1.0))
        clip_x, clip_y = 2 * x / self.width - 1, 2 * y / self.height - 1
        first, last = (unprojected(clip_x, clip_y, z) for z in (-1.0, 1.0))
        along = (last - first) / (far - near)
        turn, place = self.camera.matrix_world[:3, :3], self.camera.matrix_world[:3, 3] - self.scene.centre
        origins = (first - along * near) @ turn.T + place
        return origins.astype(np.float32), (along @ turn.T).astype(np.float32), near, far

    def centres(self) -> tuple[Doubles, Doubles]:
        """The centres of all pixels, bottom row first."""
        x, y = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        return x.ravel(), y.ravel()


@dataclass(frozen=True)
class Comparison:
    """Shares of all pixels, and sizes over the pixels in which both see the same object."""

    pixels: int
    object_differs: float
    depth_differs: float  # by more than DEPTH
    normal_differs: float  # by more than NORMAL
    median_depth_error: float  # relative
    median_normal_error: float  # radians
    by_filter: float  # differ, and a ray within the filter sees what Cycles saw
    by_tie: float  # differ, and what Cycles saw lies at the same depth
    unexplained: float


def angle(a: Doubles, b: Doubles) -> Doubles:
    """Between unit vectors, exact for small ones too, in radians."""
    found: Doubles = 2.0 * np.arcsin(np.minimum(1.0, 0.5 * np.linalg.norm(a - b, axis=-1)))
    return found


def compare(eye: Eye, theirs: View) -> tuple[Comparison, NDArray[np.intp]]:
    """How far the two agree, and the pixels in which they do not for no reason that is known."""
    x, y = eye.centres()
    ours = eye.sees(x, y)
    same = ours.object == theirs.object
    hit = same & (ours.object > 0)
    depth_error, normal_error = np.zeros(len(x)), np.zeros(len(x))
    depth_error[hit] = np.abs(ours.depth[hit] / theirs.depth[hit] - 1.0)
    normal_error[hit] = angle(ours.normal[hit], theirs.normal[hit])
    differing = np.flatnonzero(~same | (depth_error > DEPTH) | (normal_error > NORMAL))
    after_filter = differing[~within_filter(eye, theirs, differing)]
    unexplained = after_filter[~tied(eye, ours, theirs, after_filter)]
    return (
        Comparison(
            pixels=len(x),
            object_differs=float(np.mean(~same)),
            depth_differs=float(np.mean(depth_error > DEPTH)),
            normal_differs=float(np.mean(normal_error > NORMAL)),
            median_depth_error=float(np.median(depth_error[hit])),
            median_normal_error=float(np.median(normal_error[hit])),
            by_filter=(len(differing) - len(after_filter)) / len(x),
            by_tie=(len(after_filter) - len(unexplained)) / len(x),
            unexplained=len(unexplained) / len(x),
        ),
        unexplained,
    )


def within_filter(eye: Eye, theirs: View, pixels: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Whether rays through a pixel's filter see the object that Cycles saw, at depths around its, with its normal."""
    x, y = (place[pixels] for place in eye.centres())
    number, depth, normal = theirs.object[pixels], theirs.depth[pixels], theirs.normal[pixels]
    low, high, turned = np.full(len(x), np.inf), np.full(len(x), -np.inf), np.full(len(x), np.inf)
    for dx, dy in itertools.product(np.linspace(-0.5, 0.5, PROBES) * FILTER_PIXELS, repeat=2):
        probe = eye.sees(x + dx, y + dy)
        alike = probe.object == number
        low[alike] = np.minimum(low, probe.depth)[alike]
        high[alike] = np.maximum(high, probe.depth)[alike]
        turned[alike] = np.minimum(turned, angle(probe.normal, normal))[alike]
    found: NDArray[np.bool_] = (low <= depth * (1 + DEPTH)) & (high >= depth * (1 - DEPTH)) & (turned <= NORMAL)
    return found


def tied(eye: Eye, ours: View, theirs: View, pixels: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Whether Cycles saw another object than we did, and that is there at the depth that we saw."""
    x, y = eye.centres()
    found = np.zeros(len(pixels), bool)
    other = np.where(theirs.object == ours.object, 0, theirs.object)[pixels]
    for number in np.unique(other[other > 0]):
        which = np.flatnonzero(other == number)
        at = pixels[which]
        alone = eye.depth_of(int(number), x[at], y[at])
        depth = ours.depth[at]
        found[which] = (
            np.isfinite(depth)
            & np.isclose(alone, depth, rtol=TIE, atol=0.0)
            & np.isclose(theirs.depth[at], depth, rtol=DEPTH, atol=0.0)
        )
    return found
