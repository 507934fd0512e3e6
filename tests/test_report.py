# SPDX-License-Identifier: GPL-3.0-or-later
"""The report: its figures are what was measured, errors are counted as they are, and every plot says what it shows."""

from __future__ import annotations

import itertools
import json
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.fast_judge import judge_rays
from tests.hard_cases import make
from tests.judge import Floats, Ints
from tools import page, report

MACHINE = {"cpu": "A Processor", "threads": 4, "simd": "avx9"}


def a_part(measured: Any, **more: Any) -> dict[str, Any]:
    return {"machine": MACHINE, "load": 0.0, "quick": False, "measured": measured, **more}


def tracer_row(name: str, speed: float, wrong: float) -> dict[str, Any]:
    kinds = {f"{kind}_per_million": wrong * factor for kind, factor in (("lost", 1), ("false", 2), ("wrong_face", 3))}
    ulps = {f"t_error_ulps_{key}": 0.25 + wrong for key in ("median", "999_of_1000", "max")}
    return {"tracer": name, "mrays_per_s": speed, "mrays_per_s_min": speed, "mrays_per_s_max": speed, **kinds, **ulps}


TRACERS = {
    "hard_rays": 7000, "hard_cases": ["at_vertices"], "speed_rays": 100,
    "rows": [tracer_row("Espalier", 3.0, 0.0), tracer_row("Embree, robust", 3.5, 77.0)],
}  # fmt: skip
PICTURES = {
    "resolution": [64, 48], "converged_samples": 512, "threads": 4,
    "rows": [{"quality": quality, "samples": n, "picture_s": seconds * n, "rmse": 0.2 / n}
             for quality, seconds in (("draft", 0.1), ("best", 0.2)) for n in (1, 2, 4)],
}  # fmt: skip
CYCLES = [
    {"scene": "hall", "pixels": 1000, "object_differs": 0.003, "depth_differs": 0.0, "normal_differs": 0.0,
     "median_depth_error": 1e-7, "median_normal_error": 0.0, "by_filter": 0.003, "by_tie": 0.0, "unexplained": 0.0}
]  # fmt: skip


def bench_file(folder: Path) -> Path:
    """What `make bench` writes, as far as the report reads it."""
    rows = [("draft", [5.0, 4.0, 6.0]), ("exact", [50.0]), ("Embree LOW", [3.0]), ("Embree HIGH", [70.0])]
    measured = {
        "triangles": 1000,
        "threads": 2,
        "quality": {"draft": {"sah_block": 110.0}, "exact": {"sah_block": 100.0}},
        "builds": [
            {"threads": 1, "rows": [{"name": "draft", "threads": 1, "ms": [9.0]}]},
            {
                "threads": 2,
                "rows": [{"name": name, "threads": 2, "ms": ms} for name, ms in rows]
                + [{"name": "draft", "threads": 1, "ms": [9.0]}],
            },
        ],
    }
    path = folder / "bench.json"
    machine = {"cpu": "A Processor", "cores": 2, "load": 3.0}
    path.write_text(json.dumps({"machine": machine, "meshes": {"bunny": {"avx9": measured, "sse4": measured}}}))
    return path


def test_builds_are_those_of_all_threads_with_the_excess_over_exact(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(report, "BENCH", bench_file(tmp_path))
    measured = report.read_builds(False)
    found = {row["builder"]: (row["build_ms"], row["threads"], row["sah_excess_percent"]) for row in measured["rows"]}
    assert found == {
        "draft": (5.0, 2, pytest.approx(10.0)),
        "exact": (50.0, 2, 0.0),
        "Embree LOW": (3.0, 2, None),
        "Embree HIGH": (70.0, 2, None),
    }
    monkeypatch.setattr(report, "BENCH", tmp_path / "nowhere.json")
    with pytest.raises(FileNotFoundError, match="make bench"):
        report.read_builds(False)


def test_each_kind_of_error_is_counted() -> None:
    case = make("at_edges", 400)
    true = judge_rays(*case)
    hits, count = np.count_nonzero(true.triangle >= 0), len(true.triangle)

    def broken(change: Any) -> dict[str, float]:
        def prepare(_v: Floats, _t: Ints) -> report.Tracer:
            return lambda _o, _d: change(true.triangle.copy(), true.t.astype(np.float32))

        return report.errors_of(prepare, [case], [true])

    right = broken(lambda triangle, t: (triangle, t))
    assert [right[f"{kind}_per_million"] for kind in ("lost", "false", "wrong_face")] == [0.0] * 3
    assert 0.0 < right["t_error_ulps_max"] <= 0.5
    blind = broken(lambda triangle, t: (np.full_like(triangle, -1), t))
    assert blind["lost_per_million"] == pytest.approx(hits / count * 1e6)
    seeing = broken(lambda triangle, t: (np.zeros_like(triangle), t))
    assert seeing["false_per_million"] == pytest.approx((count - hits) / count * 1e6)
    assert seeing["wrong_face_per_million"] == pytest.approx(np.count_nonzero(true.triangle > 0) / count * 1e6)
    late = broken(lambda triangle, t: (triangle, t + 4 * np.spacing(t)))
    assert 3.4 < late["t_error_ulps_median"] < 4.6


def test_another_face_at_the_same_exact_distance_is_no_error() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    triangles = np.array([[0, 1, 2], [0, 1, 2]], np.int32)
    case = vertices, triangles, np.array([[0.25, 0.25, 1]], np.float32), np.array([[0, 0, -1]], np.float32)
    other = np.ones(1, np.int32), np.ones(1, np.float32)
    found = report.errors_of(lambda _v, _t: lambda _o, _d: other, [case], [judge_rays(*case)])
    assert found["wrong_face_per_million"] == 0.0


def test_ours_is_exact_and_the_peers_are_not(tmp_path: Path) -> None:
    report.main(["--quick", "--parts", "tracers", "--output", str(tmp_path)])
    written = json.loads((tmp_path / "report.json").read_text())["tracers"]
    rows = {row["tracer"]: row for row in written["measured"]["rows"]}
    assert rows.keys() == report.TRACERS.keys()
    for row in rows.values():
        assert 0.0 < row["mrays_per_s_min"] <= row["mrays_per_s"] <= row["mrays_per_s_max"]
    for kind in ("lost", "false", "wrong_face"):
        assert rows["Espalier"][f"{kind}_per_million"] == 0.0
        assert rows["Espalier without safeguards"][f"{kind}_per_million"] > 0.0
        assert rows["Embree, robust"][f"{kind}_per_million"] > 0.0
        assert rows["Blender's BVHTree"][f"{kind}_per_million"] > 0.0
    assert rows["Espalier"]["t_error_ulps_max"] <= 1.0
    assert (tmp_path / "index.html").read_text().count("<svg") == 1


def test_more_samples_are_nearer_to_the_converged_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "qualities", lambda: ("draft",))
    measured = report.measure_pictures(quick=True)
    errors = [row["rmse"] for row in measured["rows"]]
    assert [row["samples"] for row in measured["rows"]] == [1, 2, 4, 8]
    assert all(more < 0.85 * fewer for fewer, more in itertools.pairwise(errors))
    assert measured["rows"][0]["picture_s"] > 0.0


def test_the_page_shows_all_that_was_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "BENCH", bench_file(tmp_path))
    parts = {
        "builds": a_part(report.read_builds(False)),
        "tracers": a_part(TRACERS),
        "pictures": a_part(PICTURES),
        "cycles": a_part(CYCLES),
    }
    page.write(parts, tmp_path)
    text = (tmp_path / "index.html").read_text()
    assert text.count("<svg") == 3
    assert "http://" not in text.replace("http://www.w3.org", "")
    for cell in ("bunny", "10.00 %", "Embree, robust", "231", "0.20000", "hall", "A Processor"):
        assert cell in text
    for name in ("builds", "tracers", "pictures"):
        assert (tmp_path / f"{name}.svg").read_text().startswith("<?xml")
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("draw", "measured", "units"),
    [
        (page.draw_tracers, TRACERS, ["Mrays/s", "lost per million", "false per", "wrong face", "ulps"]),
        (page.draw_pictures, PICTURES, ["s on 4 threads", "RMSE, linear RGB"]),
    ],
)
def test_axes_say_what_they_measure(draw: Any, measured: Any, units: list[str]) -> None:
    figure = draw(measured)
    said = " ".join(text for axes in figure.axes for text in (axes.get_xlabel(), axes.get_ylabel(), axes.get_title()))
    for unit in units:
        assert unit in said


def test_a_figure_names_its_machine_and_whether_it_was_busy() -> None:
    assert page.named(a_part(TRACERS)) == "A Processor, 4 hardware threads, avx9"
    assert "BUSY" in page.named(a_part(TRACERS, load=2.0))
    bench = {"machine": {"cpu": "Another", "cores": 8, "load": 0.0}, "rows": []}
    assert page.named(a_part(bench, quick=True)) == "Another, 8 hardware threads, avx9, quick run"


def test_the_command_needs_a_checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    from addon import cli

    started: list[list[str]] = []
    monkeypatch.setattr(runpy, "run_module", lambda name: {"main": lambda words: started.append([name, *words])})
    assert cli.main(["report", "--quick", "--output", str(tmp_path)]) == 0
    assert started == [["tools.report", "--quick", "--output", str(tmp_path)]]
    monkeypatch.setattr(cli, "CHECKOUT", tmp_path)
    assert cli.command(["report"]) == 1
    assert "needs a checkout" in capsys.readouterr().err
    assert len(started) == 1
