# SPDX-License-Identifier: GPL-3.0-or-later
"""The exact judge for millions of rays: tests/judge.cpp, and what it says of a tracer's hits."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.judge import Doubles, Floats, Ints

BUILT = Path(__file__).resolve().parent.parent / "build" / "release" / "libespalier_judge.so"


@dataclass(frozen=True)
class Verdicts:
    """Per ray the triangle, -1 on a miss, and t, u and v, off by less than 2^-51 of themselves."""

    triangle: Ints
    t: Doubles
    u: Doubles
    v: Doubles


@dataclass(frozen=True)
class Errors:
    """What is wrong with a tracer's hits. Lost, false and wrong face are counted apart and never merged."""

    lost: int
    false: int
    wrong_face: int
    t_ulps: float  # the worst, of hits on the right face
    uv: float  # likewise, absolute

    @property
    def any(self) -> bool:
        return bool(self.lost or self.false or self.wrong_face) or self.t_ulps > 1 or self.uv > 2.0**-22


@cache
def library() -> ctypes.CDLL:
    if not BUILT.exists():
        raise FileNotFoundError(f"{BUILT} is missing: `make test-native` builds it")
    return ctypes.CDLL(str(BUILT))


def address(array: NDArray[Any]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def judge_rays(
    vertices: Floats,
    triangles: Ints,
    origins: Floats,
    directions: Floats,
    t_min: Floats | float = 0.0,
    t_max: Floats | float = np.inf,
) -> Verdicts:
    count = len(origins)
    inputs = [np.ascontiguousarray(a, np.float32) for a in (vertices, origins, directions)]
    ends = [np.ascontiguousarray(np.broadcast_to(np.float32(t), count)) for t in (t_min, t_max)]
    faces = np.ascontiguousarray(triangles, np.int32)
    assert inputs[1].shape == inputs[2].shape == (count, 3)
    assert len(faces) == 0 or (faces.min() >= 0 and faces.max() < len(vertices))
    triangle = np.empty(count, np.int32)
    t, u, v = np.empty((3, count))
    library().espalier_judge(
        address(inputs[0]),
        ctypes.c_size_t(len(vertices)),
        address(faces),
        ctypes.c_size_t(len(faces)),
        address(inputs[1]),
        address(inputs[2]),
        address(ends[0]),
        address(ends[1]),
        ctypes.c_size_t(count),
        ctypes.c_int(len(os.sched_getaffinity(0))),
        *map(address, (triangle, t, u, v)),
    )
    return Verdicts(triangle, t, u, v)


def errors(hits: Mapping[str, NDArray[Any]], verdicts: Verdicts) -> Errors:
    """Compares hits as the native module returns them with what is true."""
    found, true = hits["triangle"], verdicts.triangle
    right = (found == true) & (true >= 0)
    t, exact = hits["t"][right].astype(np.float64), verdicts.t[right]
    with np.errstate(over="ignore"):  # a distance beyond float's range has to be returned as infinite
        nearest = exact.astype(np.float32)
    beyond = np.isinf(nearest)
    spacing = np.where(beyond, 1.0, np.spacing(np.where(beyond, 1, nearest)).astype(np.float64))
    off = np.where(beyond, np.where(np.isinf(t), 0.0, np.inf), np.abs(t - np.where(beyond, 0.0, exact)) / spacing)
    uv = np.maximum(np.abs(hits["u"][right] - verdicts.u[right]), np.abs(hits["v"][right] - verdicts.v[right]))
    return Errors(
        lost=int(np.count_nonzero((found < 0) & (true >= 0))),
        false=int(np.count_nonzero((found >= 0) & (true < 0))),
        wrong_face=int(np.count_nonzero((found >= 0) & (true >= 0) & ~right)),
        t_ulps=float(off.max(initial=0.0)),
        uv=float(uv.max(initial=0.0)),
    )
