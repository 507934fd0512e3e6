# SPDX-License-Identifier: GPL-3.0-or-later
"""The judges themselves: on cases solved by hand, and one against the other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from gmpy2 import mpq
from numpy.typing import ArrayLike

from tests.exactness import ask
from tests.fast_judge import Errors, Verdicts, errors, judge_rays
from tests.hard_cases import CASES, make
from tests.judge import MISS, Floats, Ints, Verdict, judge, ulps

VERTICES = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0], [0, 0, 1], [4, 0, 1], [0, 4, 1]], np.float32)
TRIANGLES = np.array([[0, 1, 2], [3, 4, 5], [0, 1, 2]], np.int32)


@pytest.mark.parametrize(
    ("origin", "direction", "expected"),
    [
        ((1, 2, -3), (0, 0, 1), Verdict(0, mpq(3), mpq(1, 4), mpq(1, 2))),  # and triangle 2 as near: the lowest index
        ((1, 2, 3), (0, 0, -2), Verdict(1, mpq(1), mpq(1, 4), mpq(1, 2))),
        ((0, 0, -1), (0, 0, 1), Verdict(0, mpq(1), mpq(0), mpq(0))),  # a corner belongs to the triangle
        ((2, 2, -1), (0, 0, 1), Verdict(0, mpq(1), mpq(1, 2), mpq(1, 2))),  # and so does an edge
        ((2.0000002, 2, -1), (0, 0, 1), MISS),  # one ulp beside it
        ((-1, 1, 0), (1, 0, 0), MISS),  # in the plane
        ((1, 1, 0), (0, 0, 1), Verdict(0, mpq(0), mpq(1, 4), mpq(1, 4))),  # from the surface: t = 0
        ((1, 1, 2), (0, 0, 1), MISS),  # behind
        ((1, 1, -3), (0, 0, 3), Verdict(0, mpq(1), mpq(1, 4), mpq(1, 4))),
        ((0, 0, -1), (1, 1, 3), Verdict(0, mpq(1, 3), mpq(1, 12), mpq(1, 12))),
    ],
)
def test_hand_solved(origin: tuple[float, ...], direction: tuple[float, ...], expected: Verdict) -> None:
    assert judge(np.array(origin, np.float32), np.array(direction, np.float32), VERTICES, TRIANGLES) == expected
    assert_fast_judge_agrees(VERTICES, TRIANGLES, [origin], [direction], [expected])


def assert_fast_judge_agrees(
    vertices: Floats,
    triangles: Ints,
    origins: ArrayLike,
    directions: ArrayLike,
    expected: Sequence[Verdict],
    t_min: float = 0.0,
    t_max: float = np.inf,
) -> None:
    rays = np.asarray(origins, np.float32), np.asarray(directions, np.float32)
    fast = judge_rays(vertices, triangles, *rays, t_min, t_max)
    for i, verdict in enumerate(expected):
        assert fast.triangle[i] == verdict.triangle
        for found, exact in ((fast.t[i], verdict.t), (fast.u[i], verdict.u), (fast.v[i], verdict.v)):
            assert abs(mpq(float(found)) - exact) <= abs(exact) * mpq(1, 2**51)


@pytest.mark.parametrize("t_max", [np.inf, 1.0])
@pytest.mark.parametrize("case", CASES)
def test_judges_agree(case: str, t_max: float) -> None:
    vertices, triangles, origins, directions = make(case, 50, seed=77)
    expected = [judge(*ray, vertices, triangles, 0.25, t_max) for ray in zip(origins, directions, strict=True)]
    assert_fast_judge_agrees(vertices, triangles, origins, directions, expected, 0.25, t_max)


def test_interval_is_closed() -> None:
    ray = np.array([1, 1, -1], np.float32), np.array([0, 0, 1], np.float32)
    for t_min, t_max, triangle in (
        (1.0, np.inf, 0),
        (1.0000001, np.inf, 1),
        (1.5, 2.0, 1),
        (1.5, 1.9999999, -1),
        (0.0, 1.0, 0),
        (0.0, 0.99999994, -1),
    ):
        assert judge(*ray, VERTICES, TRIANGLES, t_min, t_max).triangle == triangle
        assert judge_rays(VERTICES, TRIANGLES, ray[0][None], ray[1][None], t_min, t_max).triangle == triangle


def test_faces_that_cannot_be_hit() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0], [np.nan, 0, 0], [np.inf, 0, 0], [0, 2e18, 0]])
    triangles = np.array([[0, 1, 3], [1, 1, 1], [0, 1, 4], [0, 5, 2], [0, 1, 6]], np.int32)
    points = vertices.astype(np.float32)
    origins, directions = np.array([[0, 0, -1], [0.5, 0, -1]], np.float32), np.array([[0, 0, 1]] * 2, np.float32)
    assert [judge(o, d, points, triangles) for o, d in zip(origins, directions, strict=True)] == [MISS, MISS]
    assert judge_rays(points, triangles, origins, directions).triangle.tolist() == [-1, -1]
    nothing = np.zeros((0, 3), np.int32)
    assert judge_rays(points, nothing, origins, directions).triangle.tolist() == [-1, -1]


@pytest.mark.parametrize("case", ["at_edges", "any_length", "ulps_apart", "stacked_copies", "from_the_surface"])
def test_rays_with_ends_are_judged_as_if_they_were_new(case: str) -> None:
    question = ask(case, 2_000)
    rays = (question.origins, question.directions, question.t_min, question.t_max)
    anew = judge_rays(question.vertices, question.triangles, *rays)
    assert 0.1 < np.mean(anew.triangle >= 0) < 0.9, "some end before what they would hit"
    for key in ("triangle", "t", "u", "v"):
        np.testing.assert_array_equal(getattr(question.verdicts, key), getattr(anew, key), key)


def test_ulps() -> None:
    assert ulps(1.0, mpq(1)) == 0
    assert ulps(float(np.nextafter(np.float32(1), np.float32(2))), mpq(1)) == 1
    assert ulps(1.0, 1 + mpq(1, 2**24)) == 0.5


def test_each_kind_of_error_is_counted() -> None:
    true = np.array([5, 5, -1, -1, 5, 5, 5, 5], np.int32)
    t = np.array([1, 1, 0, 0, 1, 2, 1e39, 4])
    verdicts = Verdicts(true, t, np.full(8, 0.25), np.zeros(8))
    hits = {
        "triangle": np.array([5, -1, -1, 3, 4, 5, 5, 5], np.int32),
        "t": np.array([1, np.inf, np.inf, 1, 1, 2 + 2**-21, np.inf, 4], np.float32),
        "u": np.array([0.25, 0, 0, 0, 0, 0.25, 0.25, 0.25 + 2**-20], np.float32),
        "v": np.zeros(8, np.float32),
    }
    assert errors(hits, verdicts) == Errors(lost=1, false=1, wrong_face=1, t_ulps=2.0, uv=2.0**-20)
    hits["t"][6] = 3e38
    assert errors(hits, verdicts).t_ulps > 1, "a distance beyond float's range is infinite"
