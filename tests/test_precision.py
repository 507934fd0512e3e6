# SPDX-License-Identifier: GPL-3.0-or-later
"""What float32 takes away far from the origin: not more than it must, and said to the artist where it shows."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from tests.native_kit import mesh, moved, placed, rotation, scene, sphere
from tests.stage import Stage
from tests.test_panel import drawn
from tests.test_pipeline import finished, run_of
from tests.test_scenes import NAMES, SCENES


def grid(side: int, edge: float, origin: float = 0.0) -> tuple[np.ndarray, list[tuple[int, ...]]]:
    """Vertices and quads of a square net, its corner at (origin, origin, 0)."""
    x, y = np.meshgrid(np.arange(side + 1.0), np.arange(side + 1.0), indexing="ij")
    vertices = np.stack([x * edge + origin, y * edge + origin, np.zeros_like(x)], -1).reshape(-1, 3)
    index = np.arange((side + 1) ** 2).reshape(side + 1, side + 1)
    corners = (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:])
    return vertices, [tuple(face) for face in np.stack(corners, -1).reshape(-1, 4).tolist()]


def test_world_triangles_are_rounded_once() -> None:
    vertices, triangles = sphere()
    places = [moved(1e6, -2e6, 3e5) @ rotation(1), moved(1e6 + 5, -2e6, 3e5) @ np.diag([1e-3, 2.0, -1.0, 1.0])]
    what = scene([mesh(vertices, triangles)], [placed(place) for place in places])
    arrays = what.arrays()
    assert arrays["first_triangles"].tolist() == [0, len(triangles), 2 * len(triangles)]
    np.testing.assert_array_equal(arrays["triangles"] % len(vertices), np.tile(triangles, (2, 1)))
    exact = np.concatenate([vertices.astype(np.longdouble) @ p[:3, :3].T + p[:3, 3] for p in places]) - what.centre
    # Half an ulp for the one rounding to float, and what double loses at 2e6.
    allowed = 0.5 * np.spacing(np.abs(exact).astype(np.float32)).astype(float) + 4 * np.spacing(2e6)
    assert (np.abs(arrays["vertices"] - exact) <= allowed).all()
    # The world's own coordinates in float would be off by hundreds of these ulps.
    assert allowed.max() < 1e-3 * np.spacing(np.float32(2e6))


def test_the_margin_is_that_of_the_rim_and_the_median_edge() -> None:
    vertices, faces = grid(40, 0.01)
    far = mesh(vertices, np.array(faces)[:, :3])
    what = scene([far], [placed(moved(1e7, 0, 0)), placed(moved(1e7 + 1000, 0, 0))])
    margin = what.precision
    assert margin["distance_m"] == pytest.approx(500.2)
    assert margin["ulp_m"] == np.spacing(np.float32(500.2))
    assert margin["median_edge_m"] == pytest.approx(0.01, rel=0.01)
    assert margin["ulp_per_median_edge"] == margin["ulp_m"] / margin["median_edge_m"]


def test_a_stray_vertex_has_no_say_in_what_its_mesh_has_lost() -> None:
    vertices, faces = grid(40, 0.01)
    stray = np.vstack([vertices, [[1e30, 0, 0], [np.nan, 0, 0], [1e6, 0, 0]]])
    n = len(vertices)
    odd = [(0, 1, n), (0, 1, n + 1), (0, 1, n + 2)]
    what = scene([mesh(stray, np.vstack([np.array(faces)[:, :3], odd]))])
    (entry,) = what.objects
    assert entry["lost_precision"].keys() == {"scene"}  # whose middle is half a stray away


def test_an_empty_scene_has_no_margin() -> None:
    assert set(scene([]).precision.values()) == {0.0}


def lost(stage: Stage) -> dict[str, dict[str, Any]]:
    report = finished(run_of(stage, preview=False, counts=[1])).report
    return {entry["object"]: entry["lost_precision"] for entry in report["objects"]}


def net(stage: Stage, name: str, edge: float, origin: float = 0.0, **properties: Any) -> None:
    vertices, faces = grid(100, edge, origin)
    stage.add(name, stage.mesh(name, vertices.tolist(), faces), **properties)


def test_detail_that_the_scene_has_lost_is_found_in_its_place(stage: Stage) -> None:
    net(stage, "Good", 1e-3)
    net(stage, "Far mesh", 1e-3, origin=1e6, location=(-1e6, -1e6, 0.0))
    net(stage, "Scaled", 10.0, origin=1e6, scale=(1e-6,) * 3)
    found = lost(stage)
    assert found["Good"] == found["Scaled"] == {}
    assert "mesh" in found["Far mesh"]
    cause = found["Far mesh"]["mesh"]
    assert cause["distance_m"] == pytest.approx(1e6)
    assert cause["ulp_m"] == 0.0625
    assert cause["ulp_per_median_edge"] >= 0.5  # of the edges that are left


def test_a_scene_far_away_as_a_whole_keeps_its_shapes(stage: Stage) -> None:
    net(stage, "Far", 1e-3, location=(1e6, 0.0, 0.0))
    net(stage, "Beside", 1e-3, location=(1e6 + 1, 0.0, 0.0))
    found = lost(stage)
    assert found["Far"].keys() == found["Beside"].keys() == {"placement"}
    assert found["Far"]["placement"]["ulp_m"] == 0.0625
    assert found["Far"]["placement"]["ulp_per_median_edge"] == pytest.approx(62.5, rel=0.01)


def test_detail_at_both_ends_of_a_wide_scene_is_missed_in_the_picture(stage: Stage) -> None:
    net(stage, "Here", 1e-3)
    net(stage, "There", 1e-3, location=(4e3, 0.0, 0.0))
    net(stage, "Middle", 1e-3, location=(2e3, 0.0, 0.0))
    found = lost(stage)
    assert found["Here"].keys() == {"scene"}
    assert found["There"].keys() == {"scene", "placement"}
    assert found["Middle"].keys() == set()
    assert found["Here"]["scene"]["distance_m"] == pytest.approx(2e3)


@pytest.mark.parametrize("name", NAMES)
def test_no_shipped_scene_has_lost_anything(bpy: ModuleType, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(SCENES))
    importlib.import_module(name).build()
    found = lost(Stage(bpy))
    assert not any(found.values())


@pytest.fixture
def troubled(stage: Stage) -> Stage:
    """One object for each thing that can be wrong with faces."""
    stage.camera()
    stage.cube()
    net(stage, "Terrain", 1e-3, origin=1e6, location=(-1e6, -1e6, 0.0))
    net(stage, "Town", 1e-3, location=(1e6, 0.0, 0.0))
    points = {"Line": (2.0, 0.0, 0.0), "Broken": (np.nan, 0.0, 0.0), "Galaxy": (1e30, 0.0, 0.0)}
    for name, point in points.items():
        corners = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (1.0, 1.0, 0.0)]
        data = stage.mesh(name, corners, [(0, 1, 2), (0, 1, 3)])
        data.attributes["position"].data.foreach_set("vector", np.array([*corners[:3], point], np.float32).ravel())
        stage.add(name, data)
    stage.scene.render.resolution_x = stage.scene.render.resolution_y = 8
    return stage


WARNINGS = {
    "Line: 1 face has no area",
    "Broken: 1 face is not finite",
    "Galaxy: 1 face is too large",
    "Terrain: detail finer than 6.2 cm was lost before it came here, at 1,000,000 m from the object's origin",
    "Town and 1 more: placed only to within 6.2 cm, at 1,000,000 m from the world's origin",
}


def test_every_fault_reaches_the_panel(addon: ModuleType, troubled: Stage) -> None:
    assert troubled.bpy.ops.espalier.preview() == {"FINISHED"}
    assert troubled.bpy.ops.espalier.compare() == {"FINISHED"}
    for panel in (addon.panels.ESPALIER_PT_preview_result, addon.panels.ESPALIER_PT_compare_result):
        seen = drawn(troubled.bpy, panel)
        assert max(map(len, seen)) <= 44, "a sidebar is narrow"
        said = " ".join(seen)
        for warning in WARNINGS:
            assert warning in said


def test_every_fault_reaches_the_terminal_and_the_json(
    troubled: Stage, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    from addon.cli import main

    timings = tmp_path / "timings.json"
    words = ["preview", "--output", str(tmp_path / "out.png"), "--json", str(timings), "--threads", "1"]
    assert main([*words, "--samples", "1"]) == 0
    printed = capfd.readouterr()
    assert {line.removeprefix("espalier: ") for line in printed.err.splitlines()} >= WARNINGS
    report = json.loads(timings.read_text())
    margin = report["precision"]
    assert margin["ulp_per_median_edge"] == pytest.approx(margin["ulp_m"] / margin["median_edge_m"])
    assert "Precision: steps of 3.1 cm at 500,001 m from the middle, 0 to a median edge of 1 mm" in printed.out
    objects = {entry["object"]: entry for entry in report["objects"]}
    assert objects["Line"]["rejected_faces"] == {"no_area": 1, "not_finite": 0, "too_large": 0}
    assert objects["Broken"]["rejected_faces"] == {"no_area": 0, "not_finite": 1, "too_large": 0}
    assert objects["Galaxy"]["rejected_faces"] == {"no_area": 0, "not_finite": 0, "too_large": 1}
    assert "mesh" in objects["Terrain"]["lost_precision"]
    assert objects["Cube"]["lost_precision"] == {}
