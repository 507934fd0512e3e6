# SPDX-License-Identifier: GPL-3.0-or-later
"""What the tests of the native module share: meshes, cameras, lights and a tracer that is slow and plain."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import espalier_native
import numpy as np
import pytest
from numpy.typing import NDArray

MESHES = Path(__file__).resolve().parents[2] / "shared" / "meshes"

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Ints = NDArray[np.int32]


def real_mesh(name: str) -> tuple[Floats, Ints]:
    """Vertices and triangles of a mesh that lies beside the checkout; skips the test where it does not."""
    path = MESHES / f"{name}.npz"
    if not path.exists():
        pytest.skip(f"no mesh {name} beside this checkout")
    with np.load(path) as arrays:
        return arrays["vertices"], arrays["triangles"].astype(np.int32)


def sphere(rings: int = 12, segments: int = 24) -> tuple[Floats, Ints]:
    """A closed unit sphere, wound outwards."""
    polar = np.linspace(0, np.pi, rings + 1)
    around = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    p, a = np.meshgrid(polar[1:-1], around, indexing="ij")
    ring_points = np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], -1).reshape(-1, 3)
    points = np.vstack([[[0, 0, 1]], ring_points, [[0, 0, -1]]])
    faces = []
    last = len(points) - 1
    for s in range(segments):
        n = (s + 1) % segments
        faces.append((0, 1 + s, 1 + n))
        for r in range(rings - 2):
            upper, lower = 1 + r * segments, 1 + (r + 1) * segments
            faces += [(upper + s, lower + s, lower + n), (upper + s, lower + n, upper + n)]
        faces.append((1 + (rings - 2) * segments + s, last, 1 + (rings - 2) * segments + n))
    return points.astype(np.float32), np.array(faces, np.int32)


def bumpy_sheet(side: int) -> tuple[Floats, Ints]:
    """A rough height field of 2 * side * side triangles over the unit square, made to be slow to trace."""
    rng = np.random.default_rng(7)
    x, y = np.meshgrid(np.linspace(0, 1, side + 1), np.linspace(0, 1, side + 1), indexing="ij")
    points = np.stack([x, y, rng.uniform(0, 0.2, x.shape)], -1).reshape(-1, 3)
    index = np.arange((side + 1) ** 2).reshape(side + 1, side + 1)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).reshape(-1, 3)
    return points.astype(np.float32), faces.astype(np.int32)


def mesh(positions: NDArray[Any], triangles: NDArray[Any], normals: NDArray[Any] | None = None) -> dict[str, Any]:
    return {
        "name": "mesh",
        "positions": np.asarray(positions, np.float32),
        "triangles": np.asarray(triangles, np.int32),
        "normals": None if normals is None else np.asarray(normals, np.float32),
        "material_slots": None,
    }


def placed(matrix: NDArray[Any] | None = None, which: int = 0, name: str = "object") -> dict[str, Any]:
    matrix = np.eye(4) if matrix is None else np.asarray(matrix, np.float64)
    return {"object": name, "mesh": which, "matrix": matrix, "materials": np.zeros(1, np.int32)}


def scene(
    meshes: Sequence[dict[str, Any]],
    placements: Sequence[dict[str, Any]] | None = None,
    color: tuple[float, float, float] = (1, 1, 1),
) -> espalier_native.Scene:
    """A scene of one colour in which, unless told otherwise, each mesh stands once as it is."""
    if placements is None:
        placements = [placed(which=i) for i in range(len(meshes))]
    return espalier_native.Scene(list(meshes), list(placements), np.array([color], np.float32))


def moved(x: float, y: float, z: float) -> Doubles:
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def rotation(seed: int) -> Doubles:
    """Some rotation, as a 4x4 matrix."""
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    matrix = np.eye(4)
    matrix[:3, :3] = q * np.sign(np.linalg.det(q))
    return matrix


def looking(eye: Sequence[float], at: Sequence[float]) -> Doubles:
    """The matrix of a camera or light at `eye` whose -Z axis points `at` something."""
    z = np.subtract(eye, at).astype(float)
    z /= np.linalg.norm(z)
    up = [0.0, 1.0, 0.0] if abs(z[2]) > 0.9 else [0.0, 0.0, 1.0]
    x = np.cross(up, z)
    x /= np.linalg.norm(x)
    matrix = np.eye(4)
    matrix[:3, :4] = np.stack([x, np.cross(z, x), z, np.asarray(eye, float)], -1)
    return matrix


def frustum(left: float, right: float, bottom: float, top: float, near: float = 0.1, far: float = 1000.0) -> Doubles:
    """OpenGL's perspective projection of a window at depth 1."""
    return np.array(
        [
            [2 / (right - left), 0, (right + left) / (right - left), 0],
            [0, 2 / (top - bottom), (top + bottom) / (top - bottom), 0],
            [0, 0, -(far + near) / (far - near), -2 * far * near / (far - near)],
            [0, 0, -1, 0],
        ]
    )


def box_view(left: float, right: float, bottom: float, top: float, near: float = 0.1, far: float = 1000.0) -> Doubles:
    """OpenGL's orthographic projection."""
    return np.array(
        [
            [2 / (right - left), 0, 0, -(right + left) / (right - left)],
            [0, 2 / (top - bottom), 0, -(top + bottom) / (top - bottom)],
            [0, 0, -2 / (far - near), -(far + near) / (far - near)],
            [0, 0, 0, 1],
        ]
    )


def camera(matrix: Doubles, projection: Doubles) -> dict[str, Any]:
    return {
        "type": "PERSP" if projection[3, 3] == 0 else "ORTHO",
        "matrix_world": matrix,
        "projection": projection,
    }


def light(kind: str, matrix: Doubles, energy: float, **settings: Any) -> dict[str, Any]:
    return {"type": kind, "matrix": matrix, "color": (1.0, 1.0, 1.0), "energy": energy, **settings}


def nearest_hits(vertices: Floats, triangles: Ints, origins: Floats, directions: Floats) -> tuple[Doubles, Ints]:
    """The nearest hit of each ray by testing every triangle in double: t (inf: none) and triangle (-1: none)."""
    corners = vertices.astype(np.float64)[triangles]
    v0, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    t_best = np.full(len(origins), np.inf)
    hit = np.full(len(origins), -1, np.int32)
    for i, (o, d) in enumerate(zip(origins.astype(np.float64), directions.astype(np.float64), strict=True)):
        p = np.cross(d, e2)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1 / np.einsum("ij,ij->i", e1, p)
            u = np.einsum("ij,ij->i", o - v0, p) * inverse
            q = np.cross(o - v0, e1)
            v = q @ d * inverse
            t = np.einsum("ij,ij->i", e2, q) * inverse
            t[~((u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0))] = np.inf
        nearest = int(np.argmin(t))
        if t[nearest] < np.inf:
            t_best[i], hit[i] = t[nearest], nearest
    return t_best, hit


def rays_through(vertices: Floats, count: int, seed: int) -> tuple[Floats, Floats]:
    """Rays between points in and somewhat around the box of the vertices, of unit length."""
    rng = np.random.default_rng(seed)
    lower, upper = vertices.min(0), vertices.max(0)
    margin = 0.3 * (upper - lower)
    origins = rng.uniform(lower - margin, upper + margin, (count, 3))
    directions = rng.uniform(lower, upper, (count, 3)) - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return origins.astype(np.float32), directions.astype(np.float32)


def output_of(script: str, **environment: str) -> bytes:
    """What a script prints that Python runs in a process of its own, with these variables on top of this process's."""
    path = os.pathsep.join(p for p in sys.path if p)
    return subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, "PYTHONPATH": path, **environment},
        capture_output=True,
        check=True,
        timeout=120,
    ).stdout
