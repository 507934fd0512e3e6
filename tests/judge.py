# SPDX-License-Identifier: GPL-3.0-or-later
"""The exact judge: which triangle a ray hits, and where, in rational arithmetic over the float32 inputs themselves.

It shares nothing with the native code. The rules: triangles are closed; a ray in a triangle's plane misses it;
t_min <= t <= t_max; the smallest exact t wins, of equal ones the lowest triangle index. Faces with a coordinate that is
not finite or lies beyond 2^60 are set aside.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from gmpy2 import mpq
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Ints = NDArray[np.int32]
Point = tuple[mpq, mpq, mpq]


@dataclass(frozen=True)
class Verdict:
    """The nearest hit; triangle is -1 and the rest zero on a miss. P = (1 - u - v) v0 + u v1 + v v2."""

    triangle: int
    t: mpq
    u: mpq
    v: mpq


MISS = Verdict(-1, mpq(0), mpq(0), mpq(0))


def rational(p: Floats) -> Point:
    return mpq(float(p[0])), mpq(float(p[1])), mpq(float(p[2]))


def minus(a: Point, b: Point) -> Point:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def cross(a: Point, b: Point) -> Point:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def dot(a: Point, b: Point) -> mpq:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def hit_one(origin: Point, direction: Point, v0: Point, v1: Point, v2: Point) -> tuple[mpq, mpq, mpq] | None:
    """Moeller and Trumbore's solution for (t, u, v), which in rationals is the solution."""
    edge1, edge2 = minus(v1, v0), minus(v2, v0)
    p = cross(direction, edge2)
    determinant = dot(edge1, p)
    if determinant == 0:
        return None
    s = minus(origin, v0)
    u = dot(s, p) / determinant
    q = cross(s, edge1)
    v = dot(direction, q) / determinant
    if u < 0 or v < 0 or u + v > 1:
        return None
    return dot(edge2, q) / determinant, u, v


def candidates(origin: Floats, direction: Floats, corners: Doubles) -> NDArray[np.intp]:
    """Every sound triangle that the line may meet: its three sides, in float64, are not surely of both signs.

    A side is a determinant of float32 differences; its error in float64 is below 16 * 2^-53 times the sum of the
    magnitudes of its terms, of which four times is allowed.
    """
    sound = np.flatnonzero((np.abs(corners) <= 2.0**60).all(axis=(1, 2)))
    p = corners[sound] - origin.astype(np.float64)
    d = direction.astype(np.float64)
    positive = np.ones(len(p), bool)
    negative = np.ones(len(p), bool)
    for k in range(3):
        a, b = p[:, k], p[:, (k + 1) % 3]
        terms = np.stack(
            [
                a[:, 1] * b[:, 2],
                a[:, 2] * b[:, 1],
                a[:, 2] * b[:, 0],
                a[:, 0] * b[:, 2],
                a[:, 0] * b[:, 1],
                a[:, 1] * b[:, 0],
            ],
            1,
        )
        side = (
            d[0] * (terms[:, 0] - terms[:, 1]) + d[1] * (terms[:, 2] - terms[:, 3]) + d[2] * (terms[:, 4] - terms[:, 5])
        )
        size = np.abs(terms) @ np.abs(d[[0, 0, 1, 1, 2, 2]])
        positive &= side >= -size * 2.0**-47
        negative &= side <= size * 2.0**-47
    return np.asarray(sound[positive | negative])


def judge(
    origin: Floats,
    direction: Floats,
    vertices: Floats,
    triangles: Ints,
    t_min: float = 0.0,
    t_max: float = float("inf"),
) -> Verdict:
    """The hit of one ray: origin, direction float32 [3]; vertices float32 [N,3]; triangles int [M,3]."""
    best = MISS
    o, d = rational(origin), rational(direction)
    for index in candidates(origin, direction, vertices.astype(np.float64)[triangles]):
        found = hit_one(o, d, *(rational(vertices[corner]) for corner in triangles[index]))
        if found is None or found[0] < mpq(t_min) or (t_max != float("inf") and found[0] > mpq(t_max)):
            continue
        if best.triangle < 0 or found[0] < best.t:  # candidates come by rising index, so the first of equals stays
            best = Verdict(int(index), *found)
    return best


def ulps(value: float, exact: mpq) -> float:
    """How far a float32 is from the exact value, in units of the spacing of float32 there."""
    spacing = max(float(np.spacing(np.float32(abs(float(exact))))), 2.0**-149)
    return abs(float((mpq(float(value)) - exact) / mpq(spacing)))
