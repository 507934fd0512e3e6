# SPDX-License-Identifier: GPL-3.0-or-later
"""The shipped scenes: each is what scenes/README.md says it is, twice over."""

from __future__ import annotations

import hashlib
import importlib
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from addon.export import SceneArrays
from tests.stage import Stage

SCENES = Path(__file__).resolve().parent.parent / "scenes"
NAMES = ["interior", "sculpture", "forest", "hall"]


@pytest.fixture(autouse=True)
def _scripts_import_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(SCENES))


def exported(bpy: ModuleType, name: str) -> SceneArrays:
    """The scene of that name, built into an empty one and exported."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    importlib.import_module(name).build()
    arrays: SceneArrays = Stage(bpy).export(camera=True)
    return arrays


def digest(arrays: SceneArrays) -> str:
    """A hash of all geometry, in the order of the objects' names, which the depsgraph's order is not bound to."""
    found = hashlib.sha256()
    rows = []
    for placement, matrix in zip(arrays.placements, arrays.matrices, strict=True):
        mesh = arrays.meshes[placement.mesh]
        rows.append(placement.object.encode() + matrix.tobytes() + mesh.positions.tobytes() + mesh.triangles.tobytes())
    for row in sorted(hashlib.sha256(row).digest() for row in rows):
        found.update(row)
    return found.hexdigest()


def in_picture(arrays: SceneArrays, points: np.ndarray) -> bool:
    """Whether the camera sees all of these world points [N,4]."""
    assert arrays.camera is not None
    clip = points @ (arrays.camera.projection @ np.linalg.inv(arrays.camera.matrix_world)).T
    return bool((np.abs(clip[:, :2]) < clip[:, 3:]).all())


def stated_triangles(name: str) -> int:
    """The triangles that the table in scenes/README.md gives the scene."""
    row = re.search(rf"^\| `{name}\.py` \|.*?\| ([\d ]+) \|", (SCENES / "README.md").read_text(), re.MULTILINE)
    assert row is not None, f"scenes/README.md has no row for {name}.py"
    return int(row[1].replace(" ", ""))


@pytest.mark.parametrize("name", NAMES)
def test_a_scene_is_the_same_each_time_and_of_the_size_that_is_stated(bpy: ModuleType, name: str) -> None:
    first = exported(bpy, name)
    again = exported(bpy, name)
    assert digest(first) == digest(again)
    assert first.materials == again.materials
    assert first.triangle_count == stated_triangles(name)
    assert not first.not_finite
    assert not first.left_out


@pytest.mark.parametrize(
    ("name", "subject"), [("interior", "lettering"), ("sculpture", "knot"), ("forest", "roof"), ("hall", "body")]
)
def test_the_camera_has_the_subject_in_the_picture(bpy: ModuleType, name: str, subject: str) -> None:
    arrays = exported(bpy, name)
    assert (arrays.width, arrays.height) == (960, 540)
    index, points = next(
        (i, arrays.meshes[placement.mesh].positions)
        for i, placement in enumerate(arrays.placements)
        if placement.object == subject
    )
    assert in_picture(arrays, np.column_stack([points, np.ones(len(points))]) @ arrays.matrices[index].T)


def test_the_interior_has_every_kind_of_light_and_many_kinds_of_object(bpy: ModuleType) -> None:
    arrays = exported(bpy, "interior")
    assert {light["type"] for light in arrays.lights} == {"SUN", "AREA", "POINT", "SPOT"}
    assert {thing.type for thing in bpy.data.objects} >= {"MESH", "CURVE", "SURFACE", "META", "FONT", "EMPTY"}
    modifiers = {modifier.type for thing in bpy.data.objects for modifier in thing.modifiers}
    assert modifiers >= {"ARRAY", "BEVEL", "SUBSURF", "SOLIDIFY", "SCREW", "WIREFRAME", "NODES", "PARTICLE_SYSTEM"}
    counts = Counter(placement.object for placement in arrays.placements)
    meshes = Counter(arrays.meshes[placement.mesh].name for placement in arrays.placements)
    assert meshes["leaf"] == 600
    assert counts["pear"] == 26
    assert sum(counts[thing.name] for thing in bpy.data.collections["books"].objects) == 10 * 15
    assert (np.linalg.det(arrays.matrices[:, :3, :3]) < 0).sum() >= 5 * 15, "no mirrored copies"
    assert {mesh.normals is None for mesh in arrays.meshes} == {True, False}, "not both flat and smooth"
    rug = next(mesh for mesh in arrays.meshes if mesh.name == "rug")
    assert rug.slot_count == 7


def test_the_sculpture_is_one_dense_mesh_with_subdivision(bpy: ModuleType) -> None:
    arrays = exported(bpy, "sculpture")
    counts = {arrays.meshes[p.mesh].name: len(arrays.meshes[p.mesh].triangles) for p in arrays.placements}
    assert max(counts.values()) > 0.99 * arrays.triangle_count > 900_000
    assert [modifier.type for modifier in bpy.data.objects["knot"].modifiers] == ["SUBSURF"]


def test_the_forest_is_thousands_of_copies_of_few_meshes(bpy: ModuleType) -> None:
    arrays = exported(bpy, "forest")
    counts = Counter(placement.object for placement in arrays.placements)
    trees = [name for name in counts if name.startswith(("spruce", "broadleaf"))]
    assert len(trees) == 8
    assert sum(counts[name] for name in trees) > 3000
    assert counts["tuft"] == 7000
    assert len(arrays.meshes) < 60
    assert 1_000_000 < arrays.triangle_count < 2_000_000


def test_the_hall_has_its_detail_in_a_small_place_and_no_lamp(bpy: ModuleType) -> None:
    arrays = exported(bpy, "hall")
    assert not arrays.lights
    inside, triangles = 0, 0
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for placement, matrix in zip(arrays.placements, arrays.matrices, strict=True):
        mesh = arrays.meshes[placement.mesh]
        points = mesh.positions @ matrix[:3, :3].T + matrix[:3, 3]
        low, high = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
        triangles += len(mesh.triangles)
        if np.ptp(points, axis=0).max() < 1:
            inside += len(mesh.triangles)
    assert inside > 0.5 * triangles
    assert (high - low).max() > 200


def test_arrays_are_loaded_as_they_are_with_a_camera_that_sees_them(bpy: ModuleType, tmp_path: Path) -> None:
    vertices = np.array([(0, 0, 0), (2, 0, 0), (0, 3, 0), (0, 0, 1)], np.float32)
    triangles = np.array([(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)], np.uint32)
    np.savez(tmp_path / "corner.npz", vertices=vertices, triangles=triangles)
    importlib.import_module("load_npz").load(tmp_path / "corner.npz")
    arrays = Stage(bpy).export(camera=True)
    (mesh,) = arrays.meshes
    assert (mesh.positions == vertices).all()
    assert (mesh.triangles == triangles).all()
    world = np.column_stack([vertices, np.ones(4)]) @ arrays.matrices[0].T
    np.testing.assert_allclose(world[2, :3], (0, 0, 3), atol=1e-6)  # the mesh's Y is up
    assert in_picture(arrays, world)


def test_arrays_of_another_shape_are_refused(bpy: ModuleType, tmp_path: Path) -> None:
    np.savez(tmp_path / "quads.npz", vertices=np.zeros((4, 3), np.float32), triangles=np.zeros((1, 4), np.int32))
    with pytest.raises(ValueError, match=r"triangles has the shape \(1, 4\)"):
        importlib.import_module("load_npz").load(tmp_path / "quads.npz")


def test_a_script_writes_a_file_that_opens_with_the_scene_in_it(bpy: ModuleType, tmp_path: Path) -> None:
    out = tmp_path / "new folder" / "hall.blend"
    subprocess.run([sys.executable, SCENES / "hall.py", out], check=True, timeout=120, capture_output=True)
    bpy.ops.wm.open_mainfile(filepath=str(out))
    assert Stage(bpy).export(camera=True).triangle_count == stated_triangles("hall")
    usage = subprocess.run(
        [sys.executable, SCENES / "hall.py"], timeout=60, capture_output=True, text=True, check=False
    )
    assert usage.returncode == 1
    assert "usage" in usage.stderr
