# SPDX-License-Identifier: GPL-3.0-or-later
"""What surrounds the measuring: meshes as the C++ programs read them, and tables from a report. No time is judged."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from bench import from_python, run
from bench.tables import markdown
from tests.stage import Stage, ordered, world_triangles

TETRAHEDRON = np.array([[0, 0, 0], [2, 0, 0], [0, 4, 0], [0, 0, 6]], np.float32)
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.uint32)


def test_mesh_file_holds_counts_view_positions_and_indices(tmp_path: Path) -> None:
    view = run.view_of(TETRAHEDRON, inside=False)
    run.write_mesh(tmp_path / "t.mesh", TETRAHEDRON.astype(np.float64), FACES.astype(np.int64), view)
    data = (tmp_path / "t.mesh").read_bytes()
    assert np.frombuffer(data, np.uint64, 2).tolist() == [4, 4]
    assert np.array_equal(np.frombuffer(data, np.float32, 13, 16), view)
    assert np.array_equal(np.frombuffer(data, np.float32, 12, 68).reshape(4, 3), TETRAHEDRON)
    assert np.array_equal(np.frombuffer(data, np.uint32, 12, 116).reshape(4, 3), FACES)
    assert len(data) == 164


def test_view_from_outside_has_the_whole_mesh_in_its_picture() -> None:
    eye, target, up, _, slope = np.split(run.view_of(TETRAHEDRON, inside=False).astype(float), [3, 6, 9, 12])
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up) / np.linalg.norm(np.cross(forward, up))
    corners = TETRAHEDRON - eye
    depth = corners @ forward
    assert (depth > 0).all()
    assert (np.abs(corners @ right) <= slope * depth).all()
    assert (np.abs(corners @ np.cross(right, forward)) <= slope * depth).all()


def test_view_from_inside_stands_in_the_box_and_so_does_its_light() -> None:
    eye, target, _, light, _ = np.split(run.view_of(TETRAHEDRON, inside=True), [3, 6, 9, 12])
    for point in (eye, target, light):
        assert (point >= [0, 0, 0]).all()
        assert (point <= [2, 4, 6]).all()
    assert target[0] > eye[0]


def test_scene_becomes_triangles_in_the_world_seen_by_its_camera(stage: Stage) -> None:
    stage.cube("a", location=(3, 0, 0), scale=(1, 2, 1))
    stage.cube("b", location=(0, 5, 0), rotation_euler=(0.3, 0.2, 0.1))
    stage.camera((1, 2, 10), angle=np.pi / 2)
    arrays = stage.export(camera=True)
    vertices, triangles, view = run.world_mesh(arrays)
    assert triangles.shape == (24, 3)
    assert np.allclose(ordered(vertices[triangles].astype(float)), world_triangles(arrays), atol=1e-5)
    assert np.allclose(view[:9], [1, 2, 10, 1, 2, 9, 0, 1, 0])
    assert np.isclose(view[12], 1)


def test_mesh_without_a_source_is_skipped_by_name(tmp_path: Path, monkeypatch: Any, capsys: Any) -> None:
    monkeypatch.setattr(run, "SHARED", tmp_path)
    assert run.prepare("bunny") is None
    assert "bunny: skipped" in capsys.readouterr().err


def test_mesh_is_written_again_when_its_source_is_newer(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(run, "SHARED", tmp_path)
    monkeypatch.setattr(run, "BUILD", tmp_path)
    np.savez(tmp_path / "bunny.npz", vertices=TETRAHEDRON, triangles=FACES)
    path = run.prepare("bunny")
    assert path is not None
    before = path.stat().st_mtime_ns
    assert run.prepare("bunny") == path
    assert path.stat().st_mtime_ns == before
    np.savez(tmp_path / "bunny.npz", vertices=TETRAHEDRON, triangles=FACES[:3])
    newer = path.stat().st_mtime + 10
    os.utime(tmp_path / "bunny.npz", (newer, newer))
    run.prepare("bunny")
    assert np.fromfile(path, np.uint64, 2).tolist() == [4, 3]


def group_of(threads: int, **ms: list[float]) -> dict[str, Any]:
    rows: list[dict[str, Any]] = []
    for name, values in ms.items():
        builder, _, count = name.partition("_on_")
        rows.append({"name": builder.replace("_", " "), "threads": int(count or threads), "ms": values})
    return {"threads": threads, "rows": rows}


def cells(text: str, *begin: str) -> list[str]:
    """The one row of the tables that begins with these cells"""
    (row,) = [line for line in text.splitlines() if line.startswith("| " + " | ".join(begin) + " |")]
    return [cell.strip() for cell in row.strip("|").split("|")]


MACHINE = {
    "cpu": "A Processor",
    "cores": 2,
    "memory_gib": 16,
    "system": "Linux",
    "load": 0.0,
    "quiet": True,
    "date": "2026-01-01",
}


def report_of(**measured: Any) -> dict[str, Any]:
    one = {"triangles": 50_000, "compiler": "g++ 12", "embree": "3.13.5", **measured}
    return {"machine": MACHINE, "meshes": {"bunny": {"avx2": one}}}


def test_build_table_pairs_the_turns() -> None:
    """The machine is slow in the second turn: the times show it, ratio and efficiency do not"""
    group = group_of(
        2,
        balanced_on_1=[16, 48, 16],
        balanced=[10, 30, 10],
        Embree_MEDIUM=[25, 75, 25],
        Embree_HIGH=[100],
    )
    text = markdown(report_of(builds=[group]))
    assert "## Builds, avx2" in text
    row = cells(text, "bunny", "2", "balanced")
    assert row[3:] == ["10.00 (10.00 to 30.00)", "3", "5.00", "2.50", "0.80"]
    assert cells(text, "bunny", "2", "Embree HIGH")[4:] == ["1", "0.50", "0.25", ""]
    uneven = group_of(2, balanced=[10, 40], Embree_MEDIUM=[20, 80], balanced_on_1=[20, 80])
    assert cells(markdown(report_of(builds=[uneven])), "bunny", "2", "balanced")[6:] == ["2.00", "1.00"]


def test_phases_are_medians_per_mode() -> None:
    group = group_of(1, balanced=[10, 12, 11], Embree_MEDIUM=[25, 25, 25])
    group["rows"][0]["phases_ms"] = {"bounds": [1, 3, 2], "layout": [9, 9, 9]}
    text = markdown(report_of(builds=[group]))
    assert "| mesh | threads | mode | bounds | layout |" in text
    assert cells(text, "bunny", "1", "balanced", "2.00")[3:] == ["2.00", "9.00"]


def quality(sah: float) -> dict[str, Any]:
    return {
        "step": 15.0,
        "block": 8.0,
        "sah_block": sah,
        "sah_classic": 900.0,
        "nodes": 7,
        "wide_nodes": 1,
        "references_per_triangle": 1.5,
        "checksum": "00ff",
    }


def test_quality_is_stated_over_exact_where_that_was_built() -> None:
    both = {"draft": quality(550), "exact": quality(500)}
    text = markdown(report_of(quality=both))
    assert "| SAH cost, step 15 and block 8 | over exact |" in text
    assert cells(text, "bunny", "draft")[3] == "+10.0 %"
    assert cells(markdown(report_of(quality={"draft": quality(550)})), "bunny", "draft")[3] == ""


def test_memory_is_compared_with_medium() -> None:
    rows = [
        {"name": "balanced", "threads": 2, "peak_mb": 9.0, "kept_mb": 5.0},
        {"name": "Embree MEDIUM", "threads": 2, "peak_mb": 6.0, "kept_mb": 4.0},
    ]
    row = cells(markdown(report_of(memory=rows)), "bunny", "balanced")
    assert row[2:] == ["9.0", "5.0", "105", "1.50", "1.25"]


def test_busy_machine_is_said_so() -> None:
    report = report_of(quality={"draft": quality(550)})
    assert "busy" not in markdown(report)
    assert "busy" in markdown({**report, "machine": {**MACHINE, "quiet": False}})


def test_rays_are_compared_with_the_faster_of_embrees_calls() -> None:
    group = group_of(2, balanced=[10, 20], balanced_on_1=[19, 38], Embree_single=[30, 60], Embree_packets_of_8=[15, 15])
    group.update(set="primary", rays=20_000, differ=3)
    group["rows"][0]["steps"] = {"nodes": 2.25, "blocks": 1.125}
    text = markdown(report_of(rays=[group], threads=2))
    row = cells(text, "bunny", "primary")
    assert row[2:] == ["20000", "1.33 (2.2, 1.1)", "0.44", "1.33", "1.12 (0.75 to 1.50)", "", "0.95", "3"]
    assert "| number | balanced | Embree single | Embree packets of 8 |" in text


def test_price_is_the_share_of_speed_that_exactness_takes() -> None:
    """The machine is slow in the second turn"""
    group = group_of(2, balanced=[10, 20], not_exact=[9, 18], Embree_single=[30, 60])
    text = markdown(report_of(rays=[{**group, "set": "primary", "rays": 20_000, "differ": 0}], threads=2))
    assert cells(text, "bunny", "primary")[-3] == "10.0 %"


def test_call_that_a_set_was_not_traced_with_is_left_blank() -> None:
    sets = [
        {**group_of(1, balanced=[10], Embree_single=[20]), "set": "primary", "rays": 1000, "differ": 0},
        {**group_of(1, balanced=[10], Embree_stream=[20]), "set": "random", "rays": 1000, "differ": 0},
    ]
    text = markdown(report_of(rays=sets, threads=1))
    assert cells(text, "bunny", "primary")[4:6] == ["0.05", ""]
    assert cells(text, "bunny", "random")[4:6] == ["", "0.05"]


def test_rays_from_python_are_compared_per_thread() -> None:
    rows = [
        {"name": "Espalier", "call": "occluded", "threads": 2, "rays": 20_000, "ms": [10, 10, 20]},
        {"name": "embreex", "call": "occluded", "threads": 1, "rays": 20_000, "ms": [40, 50, 60]},
    ]
    row = cells(markdown(report_of(python=rows)), "bunny", "occluded")
    assert row[2:] == ["20000", "2", "2.00", "0.40", "3", "2.00 (1.50 to 2.50)"]


def test_rays_from_python_are_timed_on_the_mesh_of_the_file(tmp_path: Path) -> None:
    run.write_mesh(tmp_path / "t.mesh", TETRAHEDRON, FACES, run.view_of(TETRAHEDRON, inside=False))
    vertices, triangles = run.read_mesh(tmp_path / "t.mesh")
    assert np.array_equal(vertices, TETRAHEDRON)
    assert np.array_equal(triangles, FACES)
    rows = from_python.measure(tmp_path / "t.mesh", 0, count=1000)
    assert [(row["call"], row["name"]) for row in rows] == [
        (call, name) for call in ("intersect", "occluded") for name in ("Espalier", "embreex")
    ]
    assert all(len(row["ms"]) == 3 and min(row["ms"]) > 0 and row["rays"] == 1000 for row in rows)


def test_picture_is_compared_with_medium() -> None:
    group = {**group_of(2, balanced=[10, 30], Embree_MEDIUM=[20, 60]), "differ": 1}
    assert cells(markdown(report_of(preview=group)), "bunny", "2", "balanced")[3:] == [
        "20.00 (10.00 to 30.00)",
        "2",
        "2.00",
        "1",
    ]


def test_growth_and_memory_of_copies() -> None:
    group = group_of(2, balanced=[10, 20], Embree_MEDIUM=[20, 20])
    copies = group_of(2, balanced=[105, 210], Embree_MEDIUM=[230, 230])["rows"]
    group["rows"] += [{**row, "name": f"{row['name']}, copies"} for row in copies]
    group.update(copies=10, triangles=500_000)
    group["memory"] = [
        {"name": "balanced", "peak_mb": 90.0, "kept_mb": 50.0},
        {"name": "Embree MEDIUM", "peak_mb": 60.0, "kept_mb": 40.0},
    ]
    text = markdown(report_of(large=group, threads=2))
    ours = cells(text, "bunny", "10", "500000", "2", "balanced")
    assert ours[6:] == ["157.50 (105.00 to 210.00)", "2", "3.17", "10.50", "90", "50"]
    assert cells(text, "bunny", "10", "500000", "2", "Embree MEDIUM")[9] == "11.50"


def test_scaling_over_one_thread() -> None:
    rows = [{"name": "balanced", "threads": n, "ms": ms} for n, ms in [(1, [8, 16]), (2, [5, 10]), (4, [4, 4])]]
    text = markdown(report_of(scaling=[{"what": "build, balanced", "rows": rows}]))
    assert cells(text, "bunny", "build, balanced")[3:] == ["1.60 (0.80)", "3.00 (0.75)"]
