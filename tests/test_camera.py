# SPDX-License-Identifier: GPL-3.0-or-later
"""The exported camera against Blender's own projection, as matrices and as pixels of the picture."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from math import radians
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.stage import Stage

POINTS = [(0.0, 0.0, 0.0), (1.5, -0.7, 0.4), (-2.1, 1.3, -1.0), (0.3, 2.2, 1.1)]

CAMERAS: dict[str, dict[str, Any]] = {
    "plain": {},
    "long lens": {"lens": 200.0},
    "sensor horizontal": {"sensor_fit": "HORIZONTAL", "sensor_width": 30.0},
    "sensor vertical": {"sensor_fit": "VERTICAL", "sensor_height": 18.0},
    "shifted": {"shift_x": 0.31, "shift_y": -0.17},
    "shifted, vertical": {"shift_x": -0.2, "shift_y": 0.4, "sensor_fit": "VERTICAL"},
    "orthographic": {"type": "ORTHO", "ortho_scale": 7.0},
    "orthographic, shifted": {"type": "ORTHO", "ortho_scale": 9.0, "shift_x": 0.25, "shift_y": 0.1},
    "orthographic, vertical": {"type": "ORTHO", "ortho_scale": 6.0, "sensor_fit": "VERTICAL"},
}

# Width, height, percentage, pixel aspect x and y.
RENDERS = [(160, 90, 100, 1.0, 1.0), (90, 160, 100, 1.0, 1.0), (333, 201, 37, 1.0, 1.0), (160, 90, 100, 2.0, 1.0)]
RENDERS += [(120, 120, 100, 1.0, 1.5)]


def set_up(stage: Stage, camera: dict[str, Any], render: tuple[int, int, int, float, float]) -> Any:
    settings = stage.scene.render
    settings.resolution_x, settings.resolution_y, settings.resolution_percentage = render[:3]
    settings.pixel_aspect_x, settings.pixel_aspect_y = render[3:]
    made = stage.camera(location=(1.0, -9.0, 5.0), **camera)
    made.rotation_euler = (radians(62.0), radians(7.0), radians(5.0))
    made.scale = (2.0, 2.0, 2.0)  # a camera's scale does not change its picture
    stage.bpy.context.view_layer.update()
    return made


@contextmanager
def cut_off_size(stage: Stage) -> Iterator[tuple[int, int]]:
    """The size in whole pixels; Blender's Python functions take the aspect before it is cut off, a render after."""
    from addon.export import render_size

    render, size = stage.scene.render, render_size(stage.scene)
    before = render.resolution_x, render.resolution_y
    render.resolution_x, render.resolution_y = size
    yield size
    render.resolution_x, render.resolution_y = before


def seen_by_blender(stage: Stage, camera: Any, point: tuple[float, float, float]) -> np.ndarray:
    """Where Blender sees the point, in pixels from the lower left corner."""
    from bpy_extras.object_utils import world_to_camera_view
    from mathutils import Vector

    with cut_off_size(stage) as size:
        x, y, _ = world_to_camera_view(stage.scene, camera, Vector(point))
    return np.array((x, y)) * size


def in_the_frame(stage: Stage, camera: Any, x: float, y: float, depth: float) -> Any:
    """The world point at that part of the frame that Blender draws around the view, so deep in the scene."""
    with cut_off_size(stage):
        upper_right, lower_right, lower_left, _ = camera.data.view_frame(scene=stage.scene)
    point = lower_left + x * (lower_right - lower_left) + y * (upper_right - lower_right)
    if camera.data.type == "PERSP":
        point *= -depth / point.z
    point.z = -depth
    return camera.matrix_world.normalized() @ point


@pytest.mark.parametrize("render", RENDERS, ids=str)
@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_points_are_projected_where_blender_sees_them(stage: Stage, camera: Any, render: Any) -> None:
    made = set_up(stage, camera, render)
    arrays = stage.export(camera=True)
    assert arrays.camera.type == made.data.type
    view = np.linalg.inv(arrays.camera.matrix_world)
    for point in POINTS:
        clip = arrays.camera.projection @ view @ (*point, 1.0)
        pixel = (clip[:2] / clip[3] + 1.0) / 2.0 * (arrays.width, arrays.height)
        np.testing.assert_allclose(pixel, seen_by_blender(stage, made, point), atol=0.01)


@pytest.mark.parametrize("render", RENDERS, ids=str)
@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_a_small_cube_is_drawn_where_blender_sees_it(stage: Stage, camera: Any, render: Any) -> None:
    from addon import pipeline

    made = set_up(stage, camera, render)
    # The background is black, and a cube is lit from all sides by the soft sky.
    for part, depth in (((0.5, 0.5), 9.0), ((0.2, 0.7), 7.0), ((0.85, 0.15), 12.0)):
        place = in_the_frame(stage, made, *part, depth)
        reach = (in_the_frame(stage, made, part[0] + 0.02, part[1], depth) - place).length
        cube = stage.cube(location=place, scale=(reach,) * 3)
        depsgraph, _ = pipeline.evaluate(stage.bpy.context)
        run = pipeline.Run(depsgraph, pipeline.Options(quality="draft", threads=1, samples=16))
        assert run.wait(30.0)
        image = run.result().image
        stage.bpy.data.objects.remove(cube)
        assert image is not None
        rows, columns = np.nonzero(image[:, :, :3].sum(axis=2))
        assert len(rows)
        centre = (columns.min() + columns.max() + 1) / 2.0, (rows.min() + rows.max() + 1) / 2.0
        np.testing.assert_allclose(centre, np.array(part) * (image.shape[1], image.shape[0]), atol=1.0)


@pytest.mark.parametrize(("size", "percentage"), [((333, 201), 37), ((1920, 1080), 7), ((7, 5), 10), ((1921, 1081), 5)])
def test_the_render_size_is_cut_off_as_blender_does(
    stage: Stage, size: tuple[int, int], percentage: int, tmp_path: Path
) -> None:
    from addon.export import render_size

    render = stage.scene.render
    render.resolution_x, render.resolution_y = size
    render.resolution_percentage = percentage
    expected = max(1, int(size[0] * percentage / 100)), max(1, int(size[1] * percentage / 100))
    assert render_size(stage.scene) == expected
    assert render_size(stage.scene, 100) == size
    if min(expected) > 1:
        stage.camera()
        render.engine, render.filepath = "CYCLES", str(tmp_path / "size.png")
        stage.scene.cycles.samples = 1
        stage.bpy.ops.render.render(write_still=True)
        assert tuple(stage.bpy.data.images.load(render.filepath).size) == expected


def test_a_camera_in_a_hidden_collection_still_looks(stage: Stage) -> None:
    made = stage.camera(location=(1.0, 2.0, 3.0))
    made.hide_viewport = True
    arrays = stage.export(camera=True)
    np.testing.assert_allclose(arrays.camera.matrix_world[:3, 3], (1.0, 2.0, 3.0))


def test_without_an_active_camera_the_artist_is_told(stage: Stage) -> None:
    from addon.export import ExportError

    stage.scene.name = "Kitchen"
    with pytest.raises(ExportError, match=r"“Kitchen” has no active camera"):
        stage.export(camera=True)
    stage.scene.camera = stage.add("Marker", None)
    with pytest.raises(ExportError, match=r"“Marker” is not a camera"):
        stage.export(camera=True)


def test_a_panoramic_camera_is_refused_not_drawn_wrongly(stage: Stage) -> None:
    from addon.export import ExportError

    stage.camera(type="PANO")
    with pytest.raises(ExportError, match=r"“Camera” is panoramic"):
        stage.export(camera=True)
