# SPDX-License-Identifier: GPL-3.0-or-later
"""The judge itself, on cases solved by hand."""

from __future__ import annotations

import numpy as np
import pytest
from gmpy2 import mpq

from tests.judge import MISS, Verdict, judge, ulps

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


def test_interval_is_closed() -> None:
    ray = np.array([1, 1, -1], np.float32), np.array([0, 0, 1], np.float32)
    assert judge(*ray, VERTICES, TRIANGLES, t_min=1.0).triangle == 0
    assert judge(*ray, VERTICES, TRIANGLES, t_min=1.0000001).triangle == 1
    assert judge(*ray, VERTICES, TRIANGLES, t_min=1.5, t_max=2.0).triangle == 1
    assert judge(*ray, VERTICES, TRIANGLES, t_min=1.5, t_max=1.9999999) == MISS


def test_ulps() -> None:
    assert ulps(1.0, mpq(1)) == 0
    assert ulps(float(np.nextafter(np.float32(1), np.float32(2))), mpq(1)) == 1
    assert ulps(1.0, 1 + mpq(1, 2**24)) == 0.5
