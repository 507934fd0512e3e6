# SPDX-License-Identifier: GPL-3.0-or-later
"""What the tests of the Blender side share: scenes in few words, and exported triangles made comparable."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np


class Stage:
    """A scene under construction: what each test would otherwise write again."""

    def __init__(self, bpy: ModuleType) -> None:
        self.bpy = bpy
        self.scene = bpy.context.scene

    def add(self, name: str, data: Any, **properties: Any) -> Any:
        made = self.bpy.data.objects.new(name, data)
        for key, value in properties.items():
            setattr(made, key, value)
        self.scene.collection.objects.link(made)
        return made

    def mesh(self, name: str, vertices: Any, faces: Any, smooth: bool = False) -> Any:
        data = self.bpy.data.meshes.new(name)
        data.from_pydata(vertices, [], faces)
        data.polygons.foreach_set("use_smooth", [smooth] * len(data.polygons))
        return data

    def cube(self, name: str = "Cube", **properties: Any) -> Any:
        corners = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
        faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        return self.add(name, self.mesh(name, corners, faces), **properties)

    def camera(self, location: Any = (0.0, 0.0, 10.0), **settings: Any) -> Any:
        """The active camera; it looks down from above, +X to the right and +Y up, unless it is turned."""
        data = self.bpy.data.cameras.new("Camera")
        for key, value in settings.items():
            setattr(data, key, value)
        made = self.add("Camera", data, location=location)
        self.scene.camera = made
        return made

    def material(self, name: str, color: Any) -> Any:
        made = self.bpy.data.materials.new(name)
        if made.node_tree is None:
            made.use_nodes = True
        shader = next(node for node in made.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
        shader.inputs["Base Color"].default_value = (*color, 1.0)
        return made

    def export(self, **options: Any) -> Any:
        from addon import export, pipeline

        depsgraph, _ = pipeline.evaluate(self.bpy.context)
        return export.export_scene(depsgraph, **{"camera": False, **options})


def world_triangles(arrays: Any) -> np.ndarray:
    """Every exported triangle where it is placed, float64 [n,3,3], sorted so that order does not matter."""
    placed = [
        arrays.meshes[p.mesh].positions[arrays.meshes[p.mesh].triangles].astype(float) @ m[:3, :3].T + m[:3, 3]
        for p, m in zip(arrays.placements, arrays.matrices, strict=True)
    ]
    return ordered(np.concatenate(placed) if placed else np.empty((0, 3, 3)))


def ordered(triangles: np.ndarray) -> np.ndarray:
    """The same triangles, sorted by their coordinates."""
    keys = np.round(triangles.reshape(len(triangles), 9), 4) + 0.0
    found: np.ndarray = triangles[np.lexsort(keys.T[::-1])]
    return found
