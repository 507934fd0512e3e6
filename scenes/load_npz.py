# SPDX-License-Identifier: GPL-3.0-or-later
"""Brings a mesh kept as arrays into Blender: python scenes/load_npz.py IN.npz OUT.blend [--up Z] [--inside]

The file holds `vertices`, float32 [N,3], and `triangles`, integers [M,3]. The mesh keeps its size; a camera frames it
from outside, or, for a building, looks along its longer side from within. Lights are sized to the mesh.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import bpy
import numpy as np
from kit import camera, light, mesh, picture, place, save
from mathutils import Vector

LENS = 50  # millimetres, for a sensor 36 mm wide


def framing(centre: np.ndarray, size: np.ndarray, towards: Vector, slope: float) -> np.ndarray:
    """Where a camera stands, in the direction `towards` from a box, to have all of it in a 16:9 picture.

    slope is half the picture's width over its distance.
    """
    right, up, back = np.array(towards.to_track_quat("Z", "Y").to_matrix()).T
    corners = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * size
    across, high = np.abs(corners @ right) / slope, np.abs(corners @ up) / (slope * 9 / 16)
    eye: np.ndarray = centre + 1.06 * float((np.maximum(across, high) + corners @ back).max()) * back
    return eye


def load(source: Path, up: str = "Y", inside: bool = False) -> None:
    """Adds the mesh of an .npz file to the current scene, which should be empty, with lights and a camera.

    up is the mesh's own upward axis: "Y", as most scans have it, or "Z". inside puts the camera within the mesh.
    Raises KeyError where the file lacks an array and ValueError where an array has the wrong shape.
    """
    with np.load(source) as arrays:
        vertices, triangles = arrays["vertices"], arrays["triangles"]
    for name, array in [("vertices", vertices), ("triangles", triangles)]:
        if array.ndim != 2 or array.shape[1] != 3:
            raise ValueError(f"{source}: {name} has the shape {array.shape}, not [N, 3]")
    place(mesh(source.stem, vertices, triangles.astype(np.int32)), "#cfc6b8", turn=(90 if up == "Y" else 0, 0, 0))

    points = vertices.astype(np.float64)
    if up == "Y":
        points = np.stack([points[:, 0], -points[:, 2], points[:, 1]], axis=1)
    low, high = points.min(axis=0), points.max(axis=0)
    centre, size = (low + high) / 2, float(np.linalg.norm(high - low))
    picture("#68717c")
    if inside:
        x, y, z = high - low
        eye = np.array([low[0] + 0.08 * x, centre[1], low[2] + 0.12 * z])
        camera(eye, (high[0], centre[1], low[2] + 0.2 * z), 20, far=10 * size)
        light("SUN", "#fff2df", 4.0, (-0.12, -0.25, 1.0), (0, 0, 0), angle=0.02)
        light(
            "AREA", "#b8cdf0", 0.5 * size**2, (*centre[:2], high[2]), centre, shape="RECTANGLE", size=x, size_y=0.2 * y
        )
        light("AREA", "#ffd9b0", 0.3 * size**2, eye, centre, shape="DISK", size=0.1 * z)
    else:
        eye = framing(centre, high - low, Vector((0.35, -1.0, 0.3)), 36 / 2 / LENS)
        camera(eye, centre, LENS, far=10 * size)
        light("SUN", "#fff2df", 3.0, (-0.6, -0.7, 1.0), (0, 0, 0), angle=0.02)
        # A lamp's light falls off with the square of the distance, so its power grows with that of the mesh.
        light(
            "AREA", "#b8cdf0", 6 * size**2, centre + size * np.array([1.2, -0.8, 0.4]), centre, shape="DISK", size=size
        )
    bpy.context.scene.camera.data.clip_start = size / 1000


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Bring a mesh kept as arrays into Blender.")
    parser.add_argument("source", type=Path, metavar="IN.npz")
    parser.add_argument("out", metavar="OUT.blend")
    parser.add_argument("--up", choices=["Y", "Z"], default="Y", help="the mesh's own upward axis")
    parser.add_argument("--inside", action="store_true", help="put the camera within the mesh")
    options = parser.parse_args()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    load(options.source, options.up, options.inside)
    save(options.out)
