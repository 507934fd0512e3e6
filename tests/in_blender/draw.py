# SPDX-License-Identifier: GPL-3.0-or-later
"""Run inside a Blender: draw.py ZIP FOLDER. Installs the zip as a user would and draws a small scene in all ways.

FOLDER gets scene.blend, preview.npy and render.npy (float32 [H,W,4], linear) and cli.png, cli.json.
"""

import os
import sys
from pathlib import Path
from typing import Any

import bpy
import numpy as np

NAME = "bl_ext.user_default.espalier"


def add_mesh(name: str, vertices: Any, faces: Any, color: tuple[float, float, float]) -> Any:
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(vertices, [], faces)
    material = bpy.data.materials.new(name)
    if material.node_tree is None:
        material.use_nodes = True
    material.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (*color, 1.0)
    mesh.materials.append(material)
    added = bpy.data.objects.new(name, mesh)
    bpy.context.collection.objects.link(added)
    return added


def build_scene() -> None:
    """A box, its mirrored and stretched twin, a tetrahedron with an Array modifier, a floor; a lamp and a sun"""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    scene = bpy.context.scene
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 96, 64, 100
    scene.espalier.samples = 4
    box = [(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    one = add_mesh("Box", box, sides, (0.8, 0.2, 0.1))
    one.location, one.rotation_euler = (-1.0, 0.0, 0.8), (0.3, 0.2, 0.5)
    twin = bpy.data.objects.new("Twin", one.data)
    twin.location, twin.rotation_euler, twin.scale = (0.5, 1.0, 0.7), (0.1, 0.6, 0.2), (-1.0, 0.7, 1.2)
    scene.collection.objects.link(twin)
    corners = [(0, 0, 0), (0.6, 0, 0), (0, 0.6, 0), (0.1, 0.1, 0.7)]
    row = add_mesh("Row", corners, [(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)], (0.1, 0.3, 0.8))
    row.location = (-0.4, -1.4, 0.05)
    row.modifiers.new("Array", "ARRAY").count = 4
    add_mesh("Floor", [(-4, -4, 0), (4, -4, 0), (4, 4, 0), (-4, 4, 0)], [(0, 1, 2, 3)], (0.6, 0.6, 0.55))
    for name, kind, energy, place in (("Lamp", "POINT", 150.0, (-2, -2, 3)), ("Sun", "SUN", 1.5, (0, 0, 5))):
        light = bpy.data.objects.new(name, bpy.data.lights.new(name, kind))
        light.data.energy, light.location, light.rotation_euler = energy, place, (0.5, 0.3, 0.0)
        scene.collection.objects.link(light)
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.location, camera.rotation_euler = (3.2, -4.4, 2.9), (1.15, 0.0, 0.62)
    scene.collection.objects.link(camera)
    scene.camera = camera


def pixels_of(image: Any) -> np.ndarray:
    width, height = image.size
    pixels = np.empty(width * height * image.channels, np.float32)
    image.pixels.foreach_get(pixels)
    return pixels.reshape(height, width, image.channels)[..., :3]


def main() -> None:
    zip_file, folder = sys.argv[-2], Path(sys.argv[-1])
    done = bpy.ops.extensions.package_install_files(
        filepath=zip_file, repo="user_default", enable_on_install=True, overwrite=True
    )
    assert done == {"FINISHED"}, done
    assert NAME in bpy.context.preferences.addons

    import espalier_native

    resources = Path(bpy.utils.resource_path("USER")).resolve()
    assert Path(espalier_native.__file__).resolve().is_relative_to(resources), espalier_native.__file__

    build_scene()
    assert bpy.ops.espalier.preview() == {"FINISHED"}
    np.save(folder / "preview.npy", pixels_of(bpy.data.images["Espalier Preview"]))
    assert bpy.ops.espalier.compare() == {"FINISHED"}

    scene = bpy.context.scene
    scene.render.engine = "ESPALIER"
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_depth = "32"
    scene.render.filepath = str(folder / "render.exr")
    assert bpy.ops.render.render(write_still=True) == {"FINISHED"}
    np.save(folder / "render.npy", pixels_of(bpy.data.images.load(scene.render.filepath)))

    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "scene.blend"))
    command = sys.modules[NAME + ".cli"].main
    files = ["--output", str(folder / "cli.png"), "--json", str(folder / "cli.json")]
    assert command(["preview", *files, "--threads", "1,2"]) == 0
    assert command(["preview", *files, "--threads", "none"]) == 2
    assert command(["preview", str(folder / "absent.blend"), *files]) == 2
    assert command(["preview", "--output", "/dev/null/out.png"]) == 1

    assert bpy.ops.preferences.addon_disable(module=NAME) == {"FINISHED"}
    assert not hasattr(bpy.types.Scene, "espalier")
    print("espalier: came to the end", flush=True)
    if bpy.app.version < (4, 3, 0):
        # As a Python module, 4.2 crashes while the interpreter shuts down once any add-on, even an empty panel, was on.
        os._exit(0)


main()
