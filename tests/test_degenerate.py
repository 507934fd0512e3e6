# SPDX-License-Identifier: GPL-3.0-or-later
"""Input that is hardly a scene: builds end, sound faces are hit as if they were alone, and the rest is counted."""

from __future__ import annotations

import espalier_native
import numpy as np
import pytest

from tests.exactness import qualities
from tests.fast_judge import errors, judge_rays
from tests.hard_cases import edge_middles, loose, rays_at
from tests.judge import Floats, Ints
from tests.native_kit import sphere

MODES = [(quality, threads) for quality in qualities() for threads in (1, 3)]


def rays(vertices: Floats, triangles: Ints, count: int = 600) -> tuple[Floats, Floats]:
    """Rays at corners and edges, of directions that the module takes."""
    sound = np.abs(vertices).max(axis=1) <= 2.0**60
    aims = vertices[sound] if sound.any() else np.zeros((1, 3), np.float32)
    size = max(float(np.ptp(aims.astype(np.float64), axis=0).max()), 1.0)
    middles = edge_middles(aims, np.arange(len(aims) // 3 * 3, dtype=np.int32).reshape(-1, 3))
    origins, directions = rays_at(np.vstack([aims, middles]), np.random.default_rng(1), count, size)
    origins = np.clip(origins, -(2.0**60), 2.0**60).astype(np.float32)
    directions[np.all(directions == 0, axis=1)] = [0, 0, 1]
    return origins, directions


def check(vertices: Floats, triangles: Ints, rejected: dict[str, int]) -> None:
    origins, directions = rays(vertices, triangles)
    verdicts = judge_rays(vertices, triangles, origins, directions)
    for quality, threads in MODES:
        tree = espalier_native.build(vertices, triangles, quality, threads=threads)
        assert tree.report["triangles"] == len(triangles)
        assert tree.report["rejected_faces"] == {"not_finite": 0, "no_area": 0, "too_large": 0} | rejected
        hits = tree.intersect(origins, directions)
        assert not errors(hits, verdicts).any
        np.testing.assert_array_equal(tree.occluded(origins, directions), verdicts.triangle >= 0)


def floats(points: object) -> Floats:
    return np.array(points, np.float32)


@pytest.mark.parametrize("count", [1, 2, 7, 8, 9, 1000])
def test_everything_at_one_point(count: int) -> None:
    check(floats([[1, 2, 3]] * 3), np.array([[0, 1, 2]] * count, np.int32), {"no_area": count})


@pytest.mark.parametrize("count", [1, 8, 1000])
def test_nothing_but_not_finite(count: int) -> None:
    vertices = floats([[np.nan, 0, 0], [0, np.inf, 0], [0, 0, -np.inf]])
    check(vertices, np.array([[0, 1, 2]] * count, np.int32), {"not_finite": count})


def test_only_lines() -> None:
    points = np.random.default_rng(2).integers(-9, 9, (200, 1, 3)) * np.array([[1], [2], [-3]])
    vertices, triangles = loose(points.astype(np.float64))
    check(vertices.astype(np.float32), triangles, {"no_area": 200})


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_a_few_triangles(count: int) -> None:
    vertices = floats([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 1], [2, 0, 1]])
    check(vertices, np.array([[0, 1, 2], [1, 3, 2], [1, 4, 3]], np.int32)[:count], {})


@pytest.mark.parametrize("normal", [(0, 0, 1), (0, 1, 0), (1, 0, 0), (1, 2, -1)])
@pytest.mark.parametrize("offset", [0, -7, 65536])
def test_flat_scenes(normal: tuple[int, int, int], offset: int) -> None:
    flat = np.random.default_rng(3).integers(-20, 20, (300, 3, 3)).astype(np.float64)
    axis = int(np.flatnonzero(np.array(normal) == 1)[-1]) if sum(map(abs, normal)) == 1 else 2
    others = [a for a in range(3) if a != axis]
    flat[:, :, axis] = -sum(flat[:, :, a] * normal[a] for a in others) / normal[axis] + offset
    edges = flat[:, 1:] - flat[:, :1]
    lines = np.count_nonzero(np.all(np.cross(edges[:, 0], edges[:, 1]) == 0, axis=1))
    vertices, triangles = loose(flat)
    check(vertices.astype(np.float32), triangles, {"no_area": int(lines)})


def test_near_floats_limits() -> None:
    largest, beyond = 2.0**60, np.nextafter(np.float32(2.0**60), np.float32(np.inf))
    maximum, smallest = np.finfo(np.float32).max, 2.0**-149
    corners = floats(
        [
            [[largest, 0, 0], [-largest, largest, 0], [-largest, -largest, largest]],
            [[largest, largest, largest], [-largest, -largest, largest], [0, 0, smallest]],
            [[beyond, 0, 0], [0, 1, 0], [0, 0, 1]],
            [[maximum, maximum, 0], [-maximum, 0, 0], [0, 0, maximum]],
            [[smallest, 0, 0], [0, smallest, 0], [0, 0, smallest]],
            [[smallest, 0, 0], [2 * smallest, 0, 0], [3 * smallest, 0, 0]],
            [[1, 0, 0], [1 + 2.0**-23, 0, 0], [1, 2.0**-60, 0]],
        ]
    )
    vertices, triangles = loose(corners)
    check(vertices.astype(np.float32), triangles, {"too_large": 2, "no_area": 1})


@pytest.mark.parametrize(("copies", "count"), [(100, 600), (10_000, 20)])
def test_copies_of_one_face(copies: int, count: int) -> None:
    vertices = floats([[0, 0, 0], [1, 0, 0.5], [0, 1, 0.25]])
    origins, directions = rays(vertices, np.array([[0, 1, 2]], np.int32), count)
    triangles = np.array([[0, 1, 2], [1, 2, 0], [2, 1, 0]], np.int32)[np.arange(copies) % 3]
    one = judge_rays(vertices, triangles[:1], origins, directions)
    assert (one.triangle >= 0).sum() > count / 4
    for quality, threads in MODES:
        tree = espalier_native.build(vertices, triangles, quality, threads=threads)
        assert not errors(tree.intersect(origins, directions), one).any, "the first of them wins"


def test_sound_faces_do_not_notice_the_others() -> None:
    vertices, triangles = sphere(20, 30)
    rng = np.random.default_rng(4)
    bad = floats([[np.nan, 0, 0], [np.inf, 0, 0], [-np.inf, 1, 0], [3e38, 0, 0], [0, 2e18, 0]])
    faulty = rng.integers(len(vertices), size=(2000, 3)).astype(np.int32)
    faulty[:, 1] = len(vertices) + rng.integers(5, size=2000)
    faulty[::4, 1] = faulty[::4, 2]
    whole = np.insert(faulty, np.sort(rng.integers(2000, size=len(triangles))), triangles, axis=0)
    where = np.flatnonzero(np.isin(whole @ [1, 10**4, 10**8], triangles @ [1, 10**4, 10**8]))
    assert len(where) == len(triangles)
    origins, directions = rays(vertices, triangles, 3000)
    for quality, threads in MODES:
        clean = espalier_native.build(vertices, triangles, quality, threads=threads).intersect(origins, directions)
        tree = espalier_native.build(np.vstack([vertices, bad]), whole, quality, threads=threads)
        assert sum(tree.report["rejected_faces"].values()) == len(faulty)
        hits = tree.intersect(origins, directions)
        for key in ("t", "u", "v"):
            np.testing.assert_array_equal(hits[key], clean[key])
        expected = np.where(clean["triangle"] >= 0, where[clean["triangle"]], -1)
        np.testing.assert_array_equal(hits["triangle"], expected)
