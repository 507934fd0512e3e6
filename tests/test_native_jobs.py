# SPDX-License-Identifier: GPL-3.0-or-later
"""Scenes, and the jobs that work on them in the background, with NumPy alone."""

from __future__ import annotations

import gc
import os
import statistics
import subprocess
import sys
import threading
import time
from typing import Any

import espalier_native
import numpy as np
import pytest

from tests.native_kit import box_view, bumpy_sheet, camera, frustum, light, looking, mesh, moved, placed, scene, sphere

VIEW = camera(looking((0.5, -1, 1), (0.5, 0.5, 0)), frustum(-0.5, 0.5, -0.5, 0.5))
LIGHTS = [light("POINT", moved(0.5, 0.5, 1), 20.0, radius=0.1)]
# What is asked for is a tenth of a second; the rest is for a machine that is busy with other tests.
CANCEL_S = 0.3


def preview(what: espalier_native.Scene, size: int = 64, **settings: Any) -> espalier_native.Job:
    return espalier_native.start_preview(what, VIEW, LIGHTS, (0.1, 0.1, 0.1), size, size, **settings)


@pytest.fixture(scope="module")
def small() -> espalier_native.Scene:
    return scene([mesh(*bumpy_sheet(30))])


@pytest.fixture(scope="module")
def large() -> espalier_native.Scene:
    return scene([mesh(*bumpy_sheet(700))])


def wait_for_stage(job: espalier_native.Job, stage: str) -> None:
    end = time.monotonic() + 60
    while job.stage != stage:
        assert not job.done, job.stage
        assert time.monotonic() < end
        time.sleep(0.001)


def expect_cancelled(job: espalier_native.Job) -> None:
    start = time.monotonic()
    job.cancel()
    assert job.wait(30)
    assert time.monotonic() - start < CANCEL_S
    assert job.done
    assert job.stage == "cancelled"
    with pytest.raises(espalier_native.Cancelled):
        job.result()


def test_preview_gives_the_picture_that_render_gives(small: espalier_native.Scene) -> None:
    job = preview(small)
    assert job.wait()
    assert job.done
    assert job.stage == "done"
    assert job.progress == 1
    expected = espalier_native.render(small, VIEW, LIGHTS, (0.1, 0.1, 0.1), 64, 64)["image"]
    np.testing.assert_array_equal(job.result()["image"], expected)
    seen = job.image()
    assert seen is not None
    np.testing.assert_array_equal(seen, expected)


def test_progress_never_falls_and_the_picture_grows(small: espalier_native.Scene) -> None:
    job = preview(small, 128, samples=64, threads=1)
    progress, stages, finished = [], [], []
    while not job.done:
        progress.append(job.progress)
        stages.append(job.stage)
        image = job.image()
        finished.append(0 if image is None else np.count_nonzero(image[..., 3]))
        time.sleep(0.002)
    final = job.result()["image"]
    assert progress == sorted(progress)
    assert 0 <= progress[0] <= progress[-1] <= 1
    assert len(set(progress)) > 5
    assert finished == sorted(finished)
    assert any(0 < count < 128 * 128 for count in finished), "seen while it grew"
    assert set(stages) <= {"placing", "building", "tracing", "done"}
    assert np.all(final[..., 3] == 1)


def test_unfinished_picture_holds_finished_tiles_only(small: espalier_native.Scene) -> None:
    expected = preview(small, 128, samples=64).result()["image"]
    job = preview(small, 128, samples=64, threads=1)
    while (partial := job.image()) is None:
        time.sleep(0.001)
    job.cancel()
    done = partial[..., 3] == 1
    assert done[48:80, 48:80].any(), "the middle comes first"
    np.testing.assert_array_equal(partial[done], expected[done])
    assert np.all(partial[~done] == 0)


@pytest.mark.parametrize("threads", [1, 0])
@pytest.mark.parametrize("delay", [0.0, 0.05, 0.2])
def test_build_can_be_cancelled(large: espalier_native.Scene, threads: int, delay: float) -> None:
    job = preview(large, threads=threads, quality="best")
    wait_for_stage(job, "building")
    time.sleep(delay)
    if job.stage == "building":
        expect_cancelled(job)


@pytest.mark.parametrize("threads", [1, 0])
def test_trace_can_be_cancelled(large: espalier_native.Scene, threads: int) -> None:
    job = preview(large, 2048, threads=threads, quality="draft", samples=256)
    wait_for_stage(job, "tracing")
    time.sleep(0.2)
    expect_cancelled(job)


def test_comparison_can_be_cancelled(large: espalier_native.Scene) -> None:
    job = espalier_native.start_compare(large, [1, 2], repeats=50)
    wait_for_stage(job, "comparing")
    time.sleep(0.1)
    expect_cancelled(job)
    assert job.image() is None


def test_waiting_has_a_timeout(large: espalier_native.Scene) -> None:
    job = preview(large, 2048, samples=256)
    start = time.monotonic()
    assert not job.wait(0.1)
    assert 0.09 < time.monotonic() - start < 2
    assert not job.wait(0)
    expect_cancelled(job)
    with pytest.raises(ValueError, match="timeout"):
        job.wait(float("nan"))


def test_python_goes_on_while_another_thread_waits(small: espalier_native.Scene) -> None:
    job = preview(small, 256, samples=16, threads=1)
    thread = threading.Thread(target=job.result)
    thread.start()
    steps = 0
    while not job.done:
        time.sleep(0.001)
        steps += 1
    thread.join(10)
    assert not thread.is_alive()
    assert steps > 5


def test_dropped_job_stops(large: espalier_native.Scene) -> None:
    job = preview(large, 2048, samples=256)
    wait_for_stage(job, "tracing")
    start = time.monotonic()
    del job
    gc.collect()
    assert time.monotonic() - start < CANCEL_S


def test_jobs_may_run_side_by_side(small: espalier_native.Scene) -> None:
    jobs = [preview(small, 128, threads=2) for _ in range(3)]
    first, *others = (job.result()["image"] for job in jobs)
    for other in others:
        np.testing.assert_array_equal(other, first)


def test_interpreter_ends_cleanly_while_a_job_runs() -> None:
    script = (
        "from tests.test_native_jobs import *\n"
        "job = preview(scene([mesh(*bumpy_sheet(300))]), 2048, samples=256)\n"
        "wait_for_stage(job, 'tracing')\n"
        "print('tracing')\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    start = time.monotonic()
    ended = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=False, timeout=60
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "tracing\n", "")
    assert time.monotonic() - start < 20


def test_comparison_measures_each_number_of_threads(small: espalier_native.Scene) -> None:
    job = espalier_native.start_compare(small, [1, 3, 2], repeats=3)
    result = job.result()
    assert job.progress == 1
    assert result["triangles"] == 1800
    assert [row["threads"] for row in result["threads"]] == [1, 3, 2]
    rows = [result["serial"], *result["threads"]]
    report = espalier_native.build(*bumpy_sheet(30)).report
    for row in rows:
        assert set(report) < set(row)
        assert row["repeats"] == 3
        assert 0 < row["build_ms_min"] <= row["build_ms"] <= row["build_ms_max"]
        assert row["speed_up"] == pytest.approx(result["serial"]["build_ms"] / row["build_ms"])
        assert row["efficiency"] == pytest.approx(row["speed_up"] / row["threads"])
        assert row["mtri_per_s"] == pytest.approx(1.8 / row["build_ms"])
        assert row["references_per_triangle"] == pytest.approx(row["references"] / 1800)
        assert all(phase >= 0 for phase in row["phases_ms"].values())
    assert len({row["checksum"] for row in rows}) == 1
    assert result["serial"]["speed_up"] == 1


def test_times_are_medians(small: espalier_native.Scene) -> None:
    row = espalier_native.start_compare(small, [1], repeats=2).result()["serial"]
    assert row["build_ms"] == pytest.approx(statistics.mean((row["build_ms_min"], row["build_ms_max"])))


@pytest.mark.parametrize(
    ("counts", "settings", "error", "says"),
    [
        ([], {}, ValueError, "thread_counts must name at least one"),
        ([0], {}, ValueError, "thread_counts must be positive"),
        ([-3], {}, ValueError, "thread_counts must be between"),
        ([1, 2, 1], {}, ValueError, "thread_counts must not repeat"),
        ([1], {"repeats": 0}, ValueError, "repeats must be between 1"),
        ([1], {"quality": "?"}, ValueError, "quality must be"),
        ("12", {}, TypeError, "thread_counts"),
    ],
)
def test_comparisons_are_refused(
    small: espalier_native.Scene, counts: Any, settings: dict[str, Any], error: type[Exception], says: str
) -> None:
    with pytest.raises(error, match=says):
        espalier_native.start_compare(small, counts, **settings)


def test_scene_stands_around_its_centre() -> None:
    vertices, triangles = sphere()
    far = np.array([1e7, -3e6, 12345.678])
    what = scene([mesh(vertices, triangles)], [placed(moved(*far)), placed(moved(*np.add(far, [10, 0, 0])))])
    assert what.triangle_count == 2 * len(triangles)
    assert what.centre.dtype == np.float64
    np.testing.assert_allclose(what.centre, np.add(far, [5, 0, 0]), rtol=0, atol=1e-6)
    empty = espalier_native.Scene([], [], np.zeros((0, 3), np.float32))
    assert empty.triangle_count == 0
    assert empty.centre.tolist() == [0, 0, 0]
    assert empty.objects == []


def test_faces_are_accounted_for_by_object() -> None:
    vertices, triangles = sphere()
    n = len(vertices)
    bad = np.array([[np.nan, 0, 0], [1e30, 0, 0]], np.float32)
    faults = np.array([[0, 1, n], [n, 1, 2], [0, 1, n + 1], [3, 3, 4]], np.int32)
    broken = mesh(np.vstack([vertices, bad]), np.vstack([triangles, faults]))
    whole = mesh(vertices, triangles)
    flattened = np.diag([0.0, 0.0, 1.0, 1.0])
    what = scene(
        [broken, whole],
        [placed(name="broken"), placed(which=1, name="whole"), placed(name="broken"), placed(flattened, 1, "needle")],
    )
    sound = {"not_finite": 0, "no_area": 0, "too_large": 0}
    assert what.objects == [
        {
            "object": "broken",
            "triangles": 2 * (len(triangles) + 4),
            "rejected_faces": {"not_finite": 4, "no_area": 2, "too_large": 2},
            "lost_precision": {},
        },
        {"object": "whole", "triangles": len(triangles), "rejected_faces": sound, "lost_precision": {}},
        {
            "object": "needle",
            "triangles": len(triangles),
            "rejected_faces": sound | {"no_area": len(triangles)},
            "lost_precision": {},
        },
    ]
    built = preview(what, 8).result()["build"]["rejected_faces"]
    for reason, count in built.items():
        assert count == sum(entry["rejected_faces"][reason] for entry in what.objects), reason


def test_scene_outlives_its_input() -> None:
    vertices, triangles = sphere()
    given = mesh(vertices, triangles, normals=vertices.copy())
    what = scene([given])
    view = camera(moved(0, 0, 5), box_view(-2, 2, -2, 2))
    before = espalier_native.render(what, view, LIGHTS, (0, 0, 0), 16, 16)["image"]
    for array in given.values():
        if isinstance(array, np.ndarray):
            array[:] = 0
    np.testing.assert_array_equal(espalier_native.render(what, view, LIGHTS, (0, 0, 0), 16, 16)["image"], before)


@pytest.mark.parametrize(
    ("change", "error", "says"),
    [
        ({"positions": np.zeros((3, 3))}, TypeError, "mesh 'mesh': positions must be float32"),
        ({"triangles": np.array([[0, 1, 99]], np.int32)}, IndexError, "mesh 'mesh': triangles: .* vertex index 99"),
        ({"normals": np.zeros((2, 3), np.float32)}, ValueError, "mesh 'mesh': normals must have shape"),
        ({"normals": np.zeros((1, 2, 3), np.float32)}, ValueError, "mesh 'mesh': normals must have shape"),
        ({"material_slots": np.zeros(2, np.int32)}, ValueError, "mesh 'mesh': material_slots must have shape"),
        ({"material_slots": np.array([-1], np.int32)}, IndexError, "mesh 'mesh': material_slots .* negative"),
        ({"name": 7}, TypeError, r"meshes\[0\]: entry 'name'"),
    ],
)
def test_meshes_are_refused(change: dict[str, Any], error: type[Exception], says: str) -> None:
    given = mesh(np.eye(3), np.array([[0, 1, 2]])) | change
    with pytest.raises(error, match=says):
        scene([given])


@pytest.mark.parametrize(
    ("change", "error", "says"),
    [
        ({"mesh": 1}, IndexError, "object 'object': mesh index 1 is outside"),
        ({"mesh": -1}, IndexError, "object 'object': mesh index -1"),
        ({"matrix": np.full((4, 4), np.inf)}, ValueError, "object 'object': matrix is not finite"),
        ({"matrix": np.eye(3)}, ValueError, r"object 'object': matrix must have shape \[4, 4\]"),
        ({"materials": np.array([1], np.int32)}, IndexError, "object 'object': material index 1 is outside"),
        ({"materials": np.array([-1], np.int32)}, IndexError, "object 'object': material index -1"),
        ({"materials": np.zeros(0, np.int32)}, ValueError, "object 'object': materials must have at least one"),
        ({"materials": [0]}, TypeError, "object 'object': materials must be a NumPy array"),
    ],
)
def test_placements_are_refused(change: dict[str, Any], error: type[Exception], says: str) -> None:
    with pytest.raises(error, match=says):
        scene([mesh(np.eye(3), np.array([[0, 1, 2]]))], [placed() | change])


def test_incomplete_scenes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"meshes\[0\] has no entry 'positions'"):
        scene([{"name": "empty"}])
    with pytest.raises(ValueError, match=r"placements\[0\] has no entry 'object'"):
        scene([mesh(np.eye(3), np.array([[0, 1, 2]]))], [{}])
    with pytest.raises(TypeError, match=r"placements\[0\] must be a dict"):
        scene([], [3])  # type: ignore[list-item]
    with pytest.raises(ValueError, match="materials must be finite"):
        espalier_native.Scene([], [], np.full((1, 3), np.nan, np.float32))
