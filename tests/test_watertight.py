# SPDX-License-Identifier: GPL-3.0-or-later
"""No ray passes through a closed mesh: a corollary of exactness, seen here on meshes too large for the judge."""

from __future__ import annotations

import espalier_native
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.judge import Doubles, Floats, Ints
from tests.native_kit import real_mesh, sphere


def directed_edges(triangles: Ints) -> NDArray[np.int64]:
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    return np.asarray(edges, np.int64)


def unmatched(triangles: Ints) -> NDArray[np.int64]:
    """The directed edges that no triangle runs along the other way: none in a closed mesh."""
    edges = directed_edges(triangles)
    size = int(triangles.max()) + 1
    forth, back = edges[:, 0] * size + edges[:, 1], edges[:, 1] * size + edges[:, 0]
    return edges[~np.isin(forth, back)]


def capped(triangles: Ints) -> Ints:
    """Closes every hole with a fan of triangles from one of the corners on its rim."""
    rim = {int(b): int(a) for a, b in unmatched(triangles)}  # against the direction of the faces beside it
    caps = []
    while rim:
        first, corner = rim.popitem()
        while rim[corner] != first:
            following = rim.pop(corner)
            caps.append((first, corner, following))
            corner = following
        del rim[corner]
    return np.vstack([triangles, np.array(caps, np.int32).reshape(-1, 3)])


def winding_number(point: Doubles, vertices: Floats, triangles: Ints) -> float:
    """How often the mesh goes around the point: the sum of its faces' solid angles (van Oosterom and Strackee 1983)."""
    a, b, c = (vertices[triangles[:, k]] - point for k in range(3))
    la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
    above = np.einsum("ij,ij->i", a, np.cross(b, c))
    below = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
    return float(np.arctan2(above, below).sum() / (2 * np.pi))


def aims(vertices: Floats, triangles: Ints) -> Floats:
    """Every corner and the middle of every edge."""
    edges = directed_edges(triangles)
    ends = vertices[edges[edges[:, 0] < edges[:, 1]]].astype(np.float64)
    return np.vstack([vertices, ends.mean(axis=1).astype(np.float32)])


def passed(vertices: Floats, triangles: Ints, inside: Doubles, at: Floats, quality: str = "balanced") -> int:
    """How many rays from inside at these points leave, and how many from outside through them get to the inside."""
    tree = espalier_native.build(vertices, triangles, quality)
    centre = inside.astype(np.float32)
    out = at - centre
    left = np.count_nonzero(~tree.occluded(np.broadcast_to(centre, at.shape).copy(), out))
    left += np.count_nonzero(tree.intersect(np.broadcast_to(centre, at.shape).copy(), out)["triangle"] < 0)
    # Aimed at the point from three times as far, the ray is back inside at 3/2 of the way, and ends there.
    outside = (inside + 3 * (at - inside)).astype(np.float32)
    return int(left + np.count_nonzero(~tree.occluded(outside, at - outside, t_max=1.5)))


def quantised(vertices: Floats, cells: int) -> Floats:
    """On an integer grid of so many cells."""
    size = np.ptp(vertices, axis=0).max()
    return np.asarray(np.round((vertices.astype(np.float64) - vertices.min(axis=0)) / size * cells), np.float32)


@pytest.mark.parametrize("offset", [0.0, 1e3, 1e5, 1e7])
@pytest.mark.parametrize("name", ["sphere", "bunny"])
def test_nothing_passes_far_from_the_origin(name: str, offset: float) -> None:
    vertices, triangles, inside = closed(name)
    far = np.array([offset, -offset, offset])
    # A thousand units across, so that the mesh is one still where floats are whole numbers.
    size = 1000 / np.ptp(vertices, axis=0).max()
    placed = (vertices * size + far).astype(np.float32)
    assert passed(placed, triangles, inside * size + far, aims(placed, triangles)) == 0


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1.0, 1e3, 1e6])
@pytest.mark.parametrize("name", ["sphere", "bunny"])
def test_nothing_passes_at_any_scale(name: str, scale: float) -> None:
    vertices, triangles, inside = closed(name)
    placed = (vertices.astype(np.float64) * scale).astype(np.float32)
    assert passed(placed, triangles, inside * scale, aims(placed, triangles), "draft") == 0


def closed(name: str) -> tuple[Floats, Ints, Doubles]:
    """A closed mesh and a point well inside."""
    if name == "sphere":
        return *sphere(64, 96), np.array([0.1, -0.05, 0.07])
    vertices, triangles = real_mesh(name)
    triangles = capped(triangles)
    assert len(unmatched(triangles)) == 0
    inside = {"bunny": np.array([-0.03, 0.08, 0.0]), "dragon": np.array([-0.04, 0.074, -0.009])}[name]
    assert abs(winding_number(inside, vertices, triangles)) == pytest.approx(1, abs=1e-3)
    assert np.linalg.norm(vertices - inside, axis=1).min() > 0.005
    return vertices, triangles, inside


def test_nothing_passes_the_dragon_on_integers() -> None:
    vertices, triangles, inside = closed("dragon")
    whole = quantised(np.vstack([vertices, inside.astype(np.float32)]), 4096)
    assert passed(whole[:-1], triangles, whole[-1].astype(np.float64), aims(whole[:-1], triangles)[::3]) == 0
