# SPDX-License-Identifier: GPL-3.0-or-later
"""Trees and hits, with NumPy alone."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import espalier_native
import numpy as np
import pytest

from tests.native_kit import (
    Doubles,
    Floats,
    Ints,
    bumpy_sheet,
    nearest_hits,
    output_of,
    rays_through,
    real_mesh,
    sphere,
)

QUALITIES = ("draft", "balanced", "best", "exact")
ONE_TRIANGLE = (np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32), np.array([[0, 1, 2]], np.int32))


def ray(origin: tuple[float, float, float], direction: tuple[float, float, float]) -> tuple[Floats, Floats]:
    return np.array([origin], np.float32), np.array([direction], np.float32)


DOWN = ray((0.25, 0.25, 2), (0, 0, -1))


@pytest.mark.parametrize("name", ["bunny", "sponza", "room-teapot"])
def test_hits_are_those_of_a_loop_over_all_triangles(name: str) -> None:
    vertices, triangles = real_mesh(name)
    origins, directions = rays_through(vertices, 200, seed=1)
    t, triangle = nearest_hits(vertices, triangles, origins, directions)
    assert np.count_nonzero(triangle >= 0) > 40, "the rays must meet something"
    for quality in QUALITIES:
        hits = espalier_native.build(vertices, triangles, quality).intersect(origins, directions)
        np.testing.assert_array_equal(hits["triangle"], triangle)
        np.testing.assert_allclose(hits["t"], t, rtol=2**-23)


@pytest.mark.parametrize("name", ["bunny", "sponza", "armadillo"])
def test_hits_are_embrees(name: str) -> None:
    vertices, triangles = real_mesh(name)
    from embreex import rtcore_scene
    from embreex.mesh_construction import TriangleMesh

    origins, directions = rays_through(vertices, 50_000, seed=2)
    embree_scene = rtcore_scene.EmbreeScene()
    TriangleMesh(embree_scene, vertices, triangles)
    theirs = embree_scene.run(origins, directions, query="INTERSECT", output=1)
    ours = espalier_native.build(vertices, triangles).intersect(origins, directions)

    their_hit = theirs["primID"] >= 0
    assert np.count_nonzero(their_hit) > 10_000
    size = float(np.linalg.norm(vertices.max(0) - vertices.min(0)))
    both = their_hit & (ours["triangle"] >= 0)
    np.testing.assert_allclose(ours["t"][both], theirs["tfar"][both], rtol=1e-5, atol=1e-5 * size)
    # Embree decides in float: where faces meet or nearly lie on one another it may name another.
    # The plain loop is the judge.
    differ = np.flatnonzero(theirs["primID"] != ours["triangle"])
    assert len(differ) <= 25
    _, triangle = nearest_hits(vertices, triangles, origins[differ], directions[differ])
    np.testing.assert_array_equal(ours["triangle"][differ], triangle)


@pytest.mark.parametrize("name", ["bunny", "sponza"])
@pytest.mark.parametrize("quality", QUALITIES)
def test_tree_is_the_same_for_any_number_of_threads(name: str, quality: str) -> None:
    vertices, triangles = real_mesh(name)
    serial = espalier_native.build(vertices, triangles, quality, threads=1)
    arrays = serial.arrays()
    assert arrays["nodes"].dtype == np.uint64
    assert len(arrays["nodes"]) == serial.report["nodes"] > 100
    for threads in (2, 3, 4, 8, 16):
        tree = espalier_native.build(vertices, triangles, quality, threads=threads)
        assert tree.report["threads"] == threads
        assert tree.report["checksum"] == serial.report["checksum"]
        for name_of_array, array in tree.arrays().items():
            np.testing.assert_array_equal(array, arrays[name_of_array], err_msg=name_of_array)


def test_hits_do_not_depend_on_quality_or_threads() -> None:
    vertices, triangles = bumpy_sheet(60)
    origins, directions = rays_through(vertices, 20_000, seed=3)
    expected = espalier_native.build(vertices, triangles, "draft").intersect(origins, directions, threads=1)
    for quality in QUALITIES:
        for threads in (1, 2, 5):
            hits = espalier_native.build(vertices, triangles, quality).intersect(origins, directions, threads=threads)
            for key in ("t", "triangle", "u", "v"):
                np.testing.assert_array_equal(hits[key], expected[key])


@pytest.mark.parametrize("target", espalier_native.simd_targets())
def test_hits_do_not_depend_on_the_instruction_set(target: str) -> None:
    script = (
        "import numpy as np, espalier_native as e, hashlib, sys\n"
        "from tests.native_kit import *\n"
        "vertices, triangles = bumpy_sheet(40)\n"
        "tree = e.build(vertices, triangles)\n"
        "hits = tree.intersect(*rays_through(vertices, 20000, seed=4))\n"
        "print(*(e.build(vertices, triangles, q).report['checksum'] for q in ('draft', 'balanced', 'best', 'exact')))\n"
        "print(tree.report['checksum'], *(hashlib.sha256(hits[k]).hexdigest() for k in sorted(hits)))\n"
    )

    assert output_of(script, ESPALIER_SIMD=target) == output_of(script)


def cost_of_plane(lower: Doubles, upper: Doubles, axis: int, plane: float) -> float:
    """What it would cost to split all boxes there, in the builder's model."""

    def area(size: Doubles) -> float:
        return float(size[0] * size[1] + size[1] * size[2] + size[2] * size[0])

    def blocks(references: int) -> float:
        return float(np.ceil(references / 8)) if references <= 128 else references / 8

    bottom, top = lower.min(0), upper.max(0)
    is_left = lower[:, axis] < plane
    is_right = ~is_left | (upper[:, axis] > plane)
    left, right = top - bottom, top - bottom
    left[axis], right[axis] = plane - bottom[axis], top[axis] - plane
    children = area(left) * blocks(is_left.sum()) + area(right) * blocks(is_right.sum())
    bonus = 1 if is_left.any() and is_right.any() else 0.9
    return 15 + 10 * bonus * children / area(top - bottom)


@pytest.mark.parametrize("count", [90, 120, 1000])
@pytest.mark.parametrize("flat", [False, True])
def test_exact_takes_the_cheapest_of_all_planes(count: int, flat: bool) -> None:
    for seed in range(5):
        rng = np.random.default_rng(seed)
        corners = rng.random((count, 1, 3)) + 0.1 * rng.random((count, 3, 3))
        if flat:  # walls, which have no extent along an axis, in a few planes
            corners[np.arange(count), :, rng.integers(0, 3, count)] = rng.integers(1, 9, (count, 1)) / 8
        corners = corners.astype(np.float32)
        triangles = np.arange(3 * count, dtype=np.int32).reshape(-1, 3)
        tree = espalier_native.build(corners.reshape(-1, 3), triangles, "exact")
        root = int(tree.arrays()["nodes"][0])
        axis, plane = root >> 32 & 3, float(np.array(root & 0xFFFFFFFF, np.uint32).view(np.float32))
        lower, upper = corners.min(1), corners.max(1)
        behind = np.nextafter(
            upper, np.float32(2)
        )  # what has no extent there lies before these, and behind its own end
        events = [np.unique([lower[:, k], upper[:, k], behind[:, k]]).astype(np.float64) for k in range(3)]
        lower, upper = lower.astype(np.float64), upper.astype(np.float64)
        planes = [(k, x) for k in range(3) for x in events[k] if lower[:, k].min() < x < upper[:, k].max()]
        least = min(cost_of_plane(lower, upper, k, x) for k, x in planes)
        assert axis < 3, "so many references are no leaf"
        assert cost_of_plane(lower, upper, axis, plane) == pytest.approx(least, rel=1e-5)


@pytest.mark.parametrize("name", ["bunny", "armadillo", "sponza", "dragon"])
def test_qualities_keep_their_promises_of_cost(name: str) -> None:
    vertices, triangles = real_mesh(name)
    reports = {quality: espalier_native.build(vertices, triangles, quality).report for quality in QUALITIES}
    assert all(report["sah_constants"] == reports["exact"]["sah_constants"] for report in reports.values())
    excess = {quality: report["sah_cost"] / reports["exact"]["sah_cost"] - 1 for quality, report in reports.items()}
    assert 0 < excess["balanced"] <= 0.05
    assert excess["balanced"] < excess["draft"] <= 0.12
    # Greedy choices of the cheapest plane need not add up to the cheapest tree, but come near it.
    assert -0.02 <= excess["best"] <= 0.01


def test_hit_is_the_point_that_u_and_v_name() -> None:
    vertices, triangles = sphere()
    origins, directions = rays_through(vertices, 5000, seed=5)
    hits = espalier_native.build(vertices, triangles).intersect(origins, directions)
    assert hits["t"].dtype == hits["u"].dtype == hits["v"].dtype == np.float32
    assert hits["triangle"].dtype == np.int32
    assert all(array.shape == (5000,) for array in hits.values())
    hit = hits["triangle"] >= 0
    assert np.all(np.isinf(hits["t"][~hit]))
    assert np.all(hits["triangle"][~hit] == -1)
    assert np.all(hits["u"][~hit] == 0)
    assert np.all(hits["v"][~hit] == 0)
    v0, v1, v2 = (vertices[triangles[hits["triangle"][hit], k]] for k in range(3))
    u, v = hits["u"][hit, None], hits["v"][hit, None]
    along = origins[hit] + hits["t"][hit, None] * directions[hit]
    np.testing.assert_allclose((1 - u - v) * v0 + u * v1 + v * v2, along, atol=2e-6)


def test_occluded_is_whether_intersect_finds_something() -> None:
    vertices, triangles = bumpy_sheet(50)
    tree = espalier_native.build(vertices, triangles)
    origins, directions = rays_through(vertices, 10_000, seed=6)
    t_max = np.random.default_rng(6).uniform(0, 1, 10_000).astype(np.float32)
    for limits in ({}, {"t_min": 0.2}, {"t_max": 0.5}, {"t_min": 0.1, "t_max": 0.3}, {"t_max": t_max}):
        blocked = tree.occluded(origins, directions, **limits)
        assert blocked.dtype == np.bool_
        assert blocked.shape == (10_000,)
        found = tree.intersect(origins, directions, **limits)["triangle"] >= 0
        assert 0 < np.count_nonzero(found) < 10_000
        np.testing.assert_array_equal(blocked, found)


def test_ends_of_the_range_belong_to_it() -> None:
    tree = espalier_native.build(*ONE_TRIANGLE)
    after, before = np.nextafter(np.float32(2), np.float32(3)), np.nextafter(np.float32(2), np.float32(1))
    for limits, found in (
        ({"t_min": 2, "t_max": 2}, True),
        ({"t_min": float(after)}, False),
        ({"t_max": float(before)}, False),
        ({"t_min": np.array([2], np.float32)}, True),
        ({"t_max": np.array([before], np.float32)}, False),
    ):
        assert tree.occluded(*DOWN, **limits)[0] == found
        assert tree.intersect(*DOWN, **limits)["triangle"][0] == (0 if found else -1)


def test_range_per_ray_is_that_rays_own() -> None:
    vertices, triangles = bumpy_sheet(30)
    tree = espalier_native.build(vertices, triangles)
    origins, directions = rays_through(vertices, 9000, seed=8)
    t = tree.intersect(origins, directions)["t"]
    hit = np.isfinite(t)
    origins, directions, t = origins[hit], directions[hit], t[hit]
    # The distance that is returned is rounded; the true one lies between its two neighbours.
    before, after = np.nextafter(t, np.float32(0)), np.nextafter(t, np.float32(np.inf))
    np.testing.assert_array_equal(tree.intersect(origins, directions, t_max=after)["t"], t)
    np.testing.assert_array_equal(tree.intersect(origins, directions, t_min=before)["t"], t)
    assert not tree.occluded(origins, directions, t_max=before).any()
    assert np.all(tree.intersect(origins, directions, t_min=after)["t"] > t)


def test_tiny_inputs() -> None:
    vertices, _ = ONE_TRIANGLE
    empty = espalier_native.build(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    assert empty.report["triangles"] == 0
    assert empty.intersect(*DOWN)["triangle"].tolist() == [-1]
    assert empty.occluded(*DOWN).tolist() == [False]
    one = espalier_native.build(*ONE_TRIANGLE)
    assert one.intersect(*DOWN)["triangle"].tolist() == [0]
    two = espalier_native.build(vertices, np.array([[0, 1, 2], [0, 1, 2]], np.uint32))
    assert two.report["triangles"] == 2
    assert two.intersect(*DOWN)["triangle"].tolist() == [0], "of equal distances the lowest index"
    nothing = one.intersect(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32))
    assert all(array.shape == (0,) for array in nothing.values())


def test_unsound_faces_are_counted_and_never_hit() -> None:
    vertices, triangles = sphere()
    bad = np.array([[np.nan, 0, 0], [np.inf, 0, 0], [1e30, 0, 0], [0.5, 0.5, 0.5]], np.float32)
    n = len(vertices)
    faults = np.array([[0, 1, n], [0, n + 1, 2], [0, 1, n + 2], [3, 3, 4], [n + 3, n + 3, n + 3]], np.int32)
    tree = espalier_native.build(np.vstack([vertices, bad]), np.vstack([triangles, faults]))
    assert tree.report["rejected_faces"] == {"not_finite": 2, "no_area": 2, "too_large": 1}
    assert tree.report["triangles"] == len(triangles) + 5
    origins, directions = rays_through(vertices, 3000, seed=9)
    clean = espalier_native.build(vertices, triangles).intersect(origins, directions)
    hits = tree.intersect(origins, directions)
    for key, array in clean.items():
        np.testing.assert_array_equal(hits[key], array)


def test_report_tells_what_was_built() -> None:
    vertices, triangles = bumpy_sheet(40)
    tree = espalier_native.build(vertices, triangles, threads=2)
    report = tree.report
    assert set(report["phases_ms"]) == {"bounds", "top_levels", "subtrees", "compaction", "layout"}
    assert 0 < sum(report["phases_ms"].values()) <= report["build_ms"] * 1.001
    assert report["threads"] == 2
    assert report["triangles"] == len(triangles)
    assert report["nodes"] == 2 * report["leaves"] - 1, "every inner node has two children"
    assert 0 <= report["empty_leaves"] < report["leaves"]
    assert report["references"] >= len(triangles)
    assert report["bytes"] == sum(array.nbytes for array in tree.arrays().values())
    assert report["sah_cost"] > 0
    assert report["sah_constants"]
    assert len(report["checksum"]) == 16
    assert int(report["checksum"], 16) >= 0


def test_all_threads_are_used_when_none_are_named() -> None:
    assert espalier_native.build(*ONE_TRIANGLE).report["threads"] == espalier_native.hardware_threads() >= 1


def test_input_may_lie_in_memory_in_any_way_and_is_left_alone() -> None:
    vertices, triangles = sphere()
    tree = espalier_native.build(vertices, triangles)
    wide = np.zeros((len(vertices), 6), np.float32)
    wide[:, ::2] = vertices
    strided = espalier_native.build(wide[:, ::2], np.asfortranarray(triangles))
    assert strided.report["checksum"] == tree.report["checksum"]
    vertices.flags.writeable = triangles.flags.writeable = False
    assert espalier_native.build(vertices, triangles.view(np.uint32)).report["checksum"] == tree.report["checksum"]


def test_tree_outlives_its_input() -> None:
    vertices, triangles = ONE_TRIANGLE[0].copy(), ONE_TRIANGLE[1].copy()
    tree = espalier_native.build(vertices, triangles)
    vertices[:], triangles[:] = 7, 0
    assert tree.intersect(*DOWN)["t"][0] == 2


def f32(*shape: int) -> Floats:
    return np.zeros(shape, np.float32)


def i32(*rows: tuple[int, ...]) -> Ints:
    return np.array(rows, np.int32)


@pytest.mark.parametrize(
    ("vertices", "triangles", "error", "says"),
    [
        ([[0, 0, 0]], i32((0, 0, 0)), TypeError, "vertices must be a NumPy array, not list"),
        (np.zeros((3, 3)), i32((0, 1, 2)), TypeError, "vertices must be float32, not float64"),
        (f32(3, 2), i32((0, 1, 2)), ValueError, r"vertices must have shape \[N, 3\], not \(3, 2\)"),
        (f32(9), i32((0, 1, 2)), ValueError, r"vertices must have shape \[N, 3\]"),
        (f32(3, 3), np.zeros((1, 3), np.int64), TypeError, "triangles must be int32 or uint32, not int64"),
        (f32(3, 3), np.zeros((1, 3), ">i4"), TypeError, "triangles must be int32 or uint32"),
        (f32(3, 3), i32((0, 1)), ValueError, r"triangles must have shape \[N, 3\]"),
        (f32(3, 3), i32((0, 1, 2), (0, 3, 1)), IndexError, "triangle 1 has vertex index 3, but there are 3 vertices"),
        (f32(3, 3), i32((0, -1, 2)), IndexError, "triangle 0 has vertex index -1"),
        (f32(0, 3), i32((0, 0, 0)), IndexError, "there are 0 vertices"),
    ],
)
def test_build_refuses(vertices: Any, triangles: Any, error: type[Exception], says: str) -> None:
    with pytest.raises(error, match=says):
        espalier_native.build(vertices, triangles)


def test_build_refuses_unknown_settings() -> None:
    with pytest.raises(ValueError, match="quality must be 'draft', 'balanced', 'best' or 'exact', not 'fast'"):
        espalier_native.build(*ONE_TRIANGLE, quality="fast")
    for threads in (-1, 100_000):
        with pytest.raises(ValueError, match="threads must be between 0"):
            espalier_native.build(*ONE_TRIANGLE, threads=threads)


@pytest.mark.parametrize(
    ("origins", "directions", "limits", "error", "says"),
    [
        (np.zeros((1, 3)), f32(1, 3), {}, TypeError, "origins must be float32"),
        (f32(1, 3), np.zeros((1, 3), np.int32), {}, TypeError, "directions must be float32"),
        (f32(3), f32(1, 3), {}, ValueError, "origins must have shape"),
        (f32(2, 3), f32(1, 3), {}, ValueError, "directions must have as many rows as origins"),
        (*ray((0, np.nan, 0), (0, 0, 1)), {}, ValueError, "ray 0: origins is not finite"),
        (*ray((0, 2.0**61, 0), (0, 0, 1)), {}, ValueError, "ray 0: origins must not lie beyond"),
        (*ray((0, 0, 0), (0, np.inf, 1)), {}, ValueError, "ray 0: directions is not finite"),
        (*ray((0, 0, 0), (0, 0, 0)), {}, ValueError, "ray 0: directions is zero"),
        (*ray((0, 0, 0), (0, 1e-38, 0)), {}, ValueError, "ray 0: directions must have its largest component"),
        (*DOWN, {"t_min": 2.0, "t_max": 1.0}, ValueError, "ray 0: t_max must not be less than t_min"),
        (*DOWN, {"t_min": -1.0}, ValueError, "ray 0: t_min must be finite and not negative"),
        (*DOWN, {"t_min": np.nan}, ValueError, "ray 0: t_min"),
        (*DOWN, {"t_max": np.nan}, ValueError, "ray 0: t_max"),
        (*DOWN, {"t_min": "near"}, TypeError, "t_min must be a number or a float32 array"),
        (*DOWN, {"t_max": f32(2)}, ValueError, r"t_max must have shape \[1\]"),
        (*DOWN, {"t_max": np.zeros(1)}, TypeError, "t_max must be float32"),
        (*DOWN, {"threads": -2}, ValueError, "threads must be between"),
    ],
)
def test_rays_are_refused(
    origins: Any, directions: Any, limits: dict[str, Any], error: type[Exception], says: str
) -> None:
    tree = espalier_native.build(*ONE_TRIANGLE)
    methods: tuple[Callable[..., Any], ...] = (tree.intersect, tree.occluded)
    for method in methods:
        with pytest.raises(error, match=says):
            method(origins, directions, **limits)


UNSOUND = [
    *((part, axis, value) for part in ("origins", "directions") for axis in range(3) for value in (np.nan, np.inf)),
    *(("origins", axis, -(2.0**61)) for axis in range(3)),
    *(("directions", axis, 2.0**101) for axis in range(3)),
    ("directions", slice(None), 2.0**-101),
    ("t_min", None, np.nan),
    ("t_min", None, np.inf),
    ("t_min", None, -1.0),
    ("t_max", None, np.nan),
    ("t_max", None, 0.5),
]


@pytest.mark.parametrize("at", [0, 3, 6])
@pytest.mark.parametrize(("part", "axis", "value"), UNSOUND)
def test_one_unsound_number_among_sound_rays_is_found(part: str, axis: Any, value: float, at: int) -> None:
    tree = espalier_native.build(*ONE_TRIANGLE)
    arrays: dict[str, Any] = {
        "origins": np.zeros((7, 3), np.float32),
        "directions": np.ones((7, 3), np.float32),
        "t_min": np.ones(7, np.float32),
        "t_max": np.full(7, 2, np.float32),
    }
    arrays[part][(at,) if axis is None else (at, axis)] = value
    with pytest.raises(ValueError, match=f"ray {at}: {'t_m' if axis is None else part}"):
        tree.intersect(**arrays)


@pytest.mark.parametrize(
    ("part", "value", "triangle"),
    [
        ("origins", (2.0**60, -(2.0**60), 2.0**60), -1),
        ("directions", (0, 0, -(2.0**-100)), 0),
        ("directions", (0, -(2.0**-100), 0), -1),
        ("directions", (2.0**-100, 0, 0), -1),
        ("directions", (2.0**100, -(2.0**100), 2.0**100), -1),
        ("t_min", -0.0, 0),
        ("t_min", np.finfo(np.float32).max, -1),
        ("t_max", 0.0, -1),
        ("t_max", np.inf, 0),
    ],
)
def test_extreme_rays_are_traced(part: str, value: Any, triangle: int) -> None:
    tree = espalier_native.build(*ONE_TRIANGLE)
    arrays: dict[str, Any] = {
        "origins": np.tile(DOWN[0], (7, 1)),
        "directions": np.tile(DOWN[1], (7, 1)),
        "t_min": np.zeros(7, np.float32),
        "t_max": np.full(7, np.inf, np.float32),
    }
    arrays[part][:] = value
    assert tree.intersect(**arrays)["triangle"].tolist() == [triangle] * 7


def test_first_unsound_ray_is_named_whatever_thread_meets_it() -> None:
    tree = espalier_native.build(*ONE_TRIANGLE)
    origins, directions = np.zeros((50_000, 3), np.float32), np.ones((50_000, 3), np.float32)
    directions[[20_001, 12_345, 49_999]] = 0
    with pytest.raises(ValueError, match="ray 12345: directions is zero"):
        tree.intersect(origins, directions, threads=4)


def test_python_goes_on_while_a_tree_is_built() -> None:
    vertices, triangles = bumpy_sheet(500)
    done = threading.Event()

    def build() -> None:
        espalier_native.build(vertices, triangles, threads=1)
        done.set()

    thread = threading.Thread(target=build)
    thread.start()
    steps = 0
    while not done.wait(0.001):
        steps += 1
    thread.join()
    assert steps > 10
