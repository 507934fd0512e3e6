# SPDX-License-Identifier: GPL-3.0-or-later
"""Geometry and rays on which ray tracers lose hits, invent them, or name the wrong face. Random rays show nothing.

Each case is a function of a random generator and a number of rays that returns vertices float32 [N,3], triangles
int32 [M,3], origins and directions float32 [R,3]. Its docstring says what goes wrong there.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.random import Generator

from tests.judge import Doubles, Floats, Ints
from tests.native_kit import sphere

Case = tuple[Floats, Ints, Floats, Floats]
MakeCase = Callable[[Generator, int], Case]


def rounded(case: tuple[Doubles | Floats, Ints, Doubles | Floats, Doubles | Floats]) -> Case:
    vertices, triangles, origins, directions = case
    return (
        np.ascontiguousarray(vertices, np.float32),
        np.ascontiguousarray(triangles, np.int32),
        np.ascontiguousarray(origins, np.float32),
        np.ascontiguousarray(directions, np.float32),
    )


def rays_at(targets: Floats, rng: Generator, count: int, reach: float) -> tuple[Floats, Floats]:
    """Rays whose origins lie around the targets and whose float32 directions are target - origin."""
    aimed = targets[rng.integers(len(targets), size=count)]
    origins = (aimed + rng.normal(size=(count, 3)) * reach).astype(np.float32)
    return origins, (aimed - origins).astype(np.float32)


def edge_middles(vertices: Floats, triangles: Ints) -> Floats:
    corners = vertices[triangles].astype(np.float64)
    return ((corners + np.roll(corners, 1, axis=1)) / 2).reshape(-1, 3).astype(np.float32)


def at_vertices(rng: Generator, count: int) -> Case:
    """Rays straight at vertices of a closed mesh: the hit belongs to several faces, and none may let it through."""
    vertices, triangles = sphere(24, 32)
    return rounded((vertices, triangles, *rays_at(vertices, rng, count, 2.0)))


def at_edges(rng: Generator, count: int) -> Case:
    """Rays at the middles of shared edges: rounding puts them on either side."""
    vertices, triangles = sphere(24, 32)
    return rounded((vertices, triangles, *rays_at(edge_middles(vertices, triangles), rng, count, 2.0)))


def axis_parallel(rng: Generator, count: int) -> Case:
    """Two direction components are zero, of either sign, and the ray runs through vertices: 0 * inf in the box test."""
    vertices, triangles = sphere(24, 32)
    axis = rng.integers(3, size=count)
    directions = np.where(rng.integers(2, size=(count, 3)) == 1, np.float32(0.0), np.float32(-0.0)).astype(np.float32)
    directions[np.arange(count), axis] = rng.choice(np.array([-1, 1], np.float32), size=count)
    origins = vertices[rng.integers(len(vertices), size=count)] - 4 * directions
    return rounded((vertices, triangles, origins, directions))


def moved(make: MakeCase, offset: float) -> MakeCase:
    def case(rng: Generator, count: int) -> Case:
        vertices, triangles, origins, directions = make(rng, count)
        far = np.float32(offset)
        shifted = vertices + far
        # Aimed again, since both ends were rounded.
        targets = (origins + directions) + far
        new_origins = origins + far
        straight = np.count_nonzero(directions, axis=1, keepdims=True) == 1
        return rounded((shifted, triangles, new_origins, np.where(straight, directions, targets - new_origins)))

    case.__doc__ = f"The same, {offset:g} from the origin: vertices fall on a coarse grid, and differences lose digits."
    return case


def scaled(make: MakeCase, factor: float) -> MakeCase:
    def case(rng: Generator, count: int) -> Case:
        vertices, triangles, origins, directions = make(rng, count)
        scale = np.float32(factor)
        return rounded((vertices * scale, triangles, origins * scale, directions * scale))

    case.__doc__ = f"The same, {factor:g} times as large: products of coordinates leave float's comfortable range."
    return case


def needle_fan(rng: Generator, count: int) -> Case:
    """Triangles a million times as long as wide around one point: areas vanish against their error."""
    angles = np.arange(400) * 1e-6
    rim = np.stack([np.cos(angles), np.sin(angles), 0.1 * np.sin(5e4 * angles)], 1)
    vertices = np.vstack([[[0, 0, 0]], rim]).astype(np.float32)
    triangles = np.stack([np.zeros(399), np.arange(1, 400), np.arange(2, 401)], 1).astype(np.int32)
    weights = rng.dirichlet([1, 1, 1], size=len(triangles))
    inside = np.einsum("ij,ijk->ik", weights, vertices[triangles].astype(np.float64))
    return rounded((vertices, triangles, *rays_at(inside.astype(np.float32), rng, count, 1.0)))


def stacked_copies(rng: Generator, count: int) -> Case:
    """The same faces several times over, in shuffled order: the lowest index must win on every path."""
    vertices, triangles = sphere(8, 12)
    shuffled = rng.permutation(np.repeat(triangles, 5, axis=0))
    return rounded((vertices, shuffled, *rays_at(edge_middles(vertices, triangles), rng, count, 1.0)))


def flat_grid(rng: Generator, count: int) -> Case:
    """A mesh without thickness on an integer grid: rays down its vertices and edges, rays in its plane."""
    side = 20
    x, y = np.meshgrid(np.arange(side + 1), np.arange(side + 1), indexing="ij")
    vertices = np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3).astype(np.float32)
    index = np.arange((side + 1) ** 2).reshape(side + 1, side + 1)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    triangles = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).reshape(-1, 3)
    origins = np.stack(
        [rng.integers(0, 2 * side + 1, count) / 2, rng.integers(0, 2 * side + 1, count) / 2, np.full(count, 3.0)], 1
    )
    directions = np.tile([0.0, -0.0, -1.0], (count, 1))
    in_plane = rng.random(count) < 0.2
    origins[in_plane, 2] = 0
    origins[in_plane, 0] = -1
    directions[in_plane] = [1, 0, 0]
    return rounded((vertices, triangles, origins, directions))


def stacked_boxes(rng: Generator, count: int) -> Case:
    """Boxes that share faces, all planes on the grid: faces lie in split planes, and rays run along them."""
    corners = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)], np.float64)
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    places = np.array([[x, y, z] for x in range(4) for y in range(4) for z in range(4)], np.float64)
    vertices = (places[:, None, :] + corners).reshape(-1, 3)
    triangles = (np.arange(len(places))[:, None, None] * 8 + faces).reshape(-1, 3)
    origins = rng.integers(-2, 11, size=(count, 3)) / 2.0
    directions = rng.integers(-2, 3, size=(count, 3)).astype(np.float64)
    directions[np.all(directions == 0, axis=1)] = [0, 0, 1]
    return rounded((vertices, triangles, origins, directions))


def far_origins(rng: Generator, count: int) -> Case:
    """Origins thousands of diagonals away: the ray's rounding is larger than the faces."""
    vertices, triangles = sphere(12, 16)
    return rounded((vertices, triangles, *rays_at(vertices, rng, count, 5000.0)))


def from_the_surface(rng: Generator, count: int) -> Case:
    """Origins on the faces themselves, as shadow rays have: t is zero or nearly so."""
    vertices, triangles = sphere(12, 16)
    chosen = vertices[triangles[rng.integers(len(triangles), size=count)]].astype(np.float64)
    origins = np.einsum("ij,ijk->ik", rng.dirichlet([1, 1, 1], size=count), chosen)
    origins[::3] = chosen[::3, 0]
    return rounded((vertices, triangles, origins, rng.normal(size=(count, 3))))


def small_beside_huge(rng: Generator, count: int) -> Case:
    """A tiny triangle over one 1e12 times as wide: one of them fixes the error, the other needs none."""
    vertices = [[-1e9, -1e9, 0], [1e9, -1e9, 0], [0, 1e9, 0], [0, 0, 1e-3], [2e-3, 0, 1e-3], [0, 2e-3, 1e-3]]
    triangles = [[0, 1, 2], [3, 4, 5]]
    targets = np.array([[5e-4, 5e-4, 1e-3], [1e-3, 1e-3, 1e-3], [0, 0, 1e-3], [1, 1, 0], [3e8, 0, 0]], np.float32)
    return rounded((np.array(vertices), np.array(triangles), *rays_at(targets, rng, count, 10.0)))


def nearly_coplanar(rng: Generator, count: int) -> Case:
    """Sheets a few ulps apart that cross one another: which is nearer is decided in the last bits."""
    base = np.array([[0, 0, 1], [1, 0, 1], [0, 1, 1]], np.float32)
    sheets = np.stack([base] * 40)
    steps = rng.integers(-3, 4, size=(40, 3))
    sheets[:, :, 2] += (steps * np.spacing(np.float32(1))).astype(np.float32)
    vertices = sheets.reshape(-1, 3)
    targets = np.einsum("ij,jk->ik", rng.dirichlet([1, 1, 1], size=200), base.astype(np.float64))
    return rounded((vertices, np.arange(120).reshape(-1, 3), *rays_at(targets.astype(np.float32), rng, count, 1.0)))


def near_degenerate(rng: Generator, count: int) -> Case:
    """Triangles whose corners are a few ulps apart or almost on a line, and rays through those corners."""
    anchor = rng.normal(size=(150, 1, 3))
    spread = np.where(rng.random((150, 1, 1)) < 0.5, 1e-7, 1.0) * rng.normal(size=(150, 3, 3))
    spread[::2, 2] = (spread[::2, 0] + spread[::2, 1]) / 2 + 1e-8 * rng.normal(size=(75, 3))
    vertices = (anchor + spread).reshape(-1, 3).astype(np.float32)
    return rounded((vertices, np.arange(450).reshape(-1, 3), *rays_at(vertices, rng, count, 2.0)))


def subnormal(rng: Generator, count: int) -> Case:
    """Coordinates of a few hundred times the smallest float: flushing to zero, or underflow of a product, loses all."""
    vertices, triangles = sphere(6, 8)
    tiny = 2.0**-149
    grid = np.round(vertices.astype(np.float64) * 300) * tiny
    origins = np.round(rng.normal(size=(count, 3)) * 900) * tiny
    targets = grid[rng.integers(len(grid), size=count)]
    return rounded((grid, triangles, origins, (targets - origins) / tiny))


CASES: dict[str, MakeCase] = {
    "at_vertices": at_vertices,
    "at_edges": at_edges,
    "axis_parallel": axis_parallel,
    "at_vertices_moved_1e3": moved(at_vertices, 1e3),
    "at_vertices_moved_1e5": moved(at_vertices, 1e5),
    "at_vertices_moved_1e7": moved(at_vertices, 1e7),
    "axis_parallel_moved_1e5": moved(axis_parallel, 1e5),
    "at_vertices_scaled_1e-30": scaled(at_vertices, 1e-30),
    "at_edges_scaled_1e15": scaled(at_edges, 1e15),
    "needle_fan": needle_fan,
    "stacked_copies": stacked_copies,
    "flat_grid": flat_grid,
    "stacked_boxes": stacked_boxes,
    "far_origins": far_origins,
    "from_the_surface": from_the_surface,
    "small_beside_huge": small_beside_huge,
    "nearly_coplanar": nearly_coplanar,
    "near_degenerate": near_degenerate,
    "subnormal": subnormal,
}
