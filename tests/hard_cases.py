# SPDX-License-Identifier: GPL-3.0-or-later
"""Geometry and rays on which ray tracers lose hits, invent them, or name the wrong face. Random rays show nothing.

Each case is a function of a random generator and a number of rays that returns vertices float32 [N,3], triangles
int32 [M,3], origins and directions float32 [R,3]. Its docstring says what goes wrong there.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from tests.judge import Doubles, Floats, Ints
from tests.native_kit import sphere

Case = tuple[Floats, Ints, Floats, Floats]
MakeCase = Callable[[Generator, int], Case]


PACKET = 32  # as many as the tracer takes as one packet


def make(name: str, rays: int, seed: int = 0) -> Case:
    """About so many rays of a case: a third as the case makes them, a third from one point, and a third to one point,
    a packet at a time, as cameras and lamps have them. Nearly all end at what was aimed at, at t = 1."""
    rng = np.random.default_rng([zlib.crc32(name.encode()), seed])
    vertices, triangles, origins, directions = CASES[name](rng, max(rays // 3, PACKET))
    # Rays that the module refuses give way to others, and whole packets are left.
    kept = np.resize(np.flatnonzero(is_taken(origins, directions)), -(-len(origins) // PACKET) * PACKET)
    origins, directions = origins[kept], directions[kept]

    points, aims = packets_of(origins, directions)
    # Lamps are met within rounding: half of them not in one point.
    ends = points + np.spacing(points) * rng.integers(-3, 4, points.shape) * (np.arange(len(points)) % 2)[:, None, None]
    both = np.stack([np.stack([points, aims - points], 2), np.stack([aims, ends.astype(np.float32) - aims], 2)], 1)
    packets = both.reshape(-1, PACKET, 2, 3)
    sound = packets[np.all(is_taken(packets[:, :, 0], packets[:, :, 1]), axis=1)].reshape(-1, 2, 3)
    return vertices, triangles, np.vstack([origins, sound[:, 0]]), np.vstack([directions, sound[:, 1]])


def is_taken(origins: Floats, directions: Floats) -> NDArray[np.bool_]:
    """Whether the module takes such rays."""
    largest = np.abs(directions).max(axis=-1)
    return np.asarray((largest >= 2.0**-100) & (largest <= 2.0**100) & (np.abs(origins).max(axis=-1) <= 2.0**60))


def packets_of(origins: Floats, directions: Floats) -> tuple[Floats, Floats]:
    """For one ray per packet its origin, or a point some way behind, and, of all that rays aim at, the points that it
    sees closest to the ray; both [N,PACKET,3]."""
    every = np.unique(origins + directions, axis=0)
    every = every[:: -(-len(every) // 4096)]  # each ray looks at all of them
    every = np.resize(every, (max(len(every), PACKET), 3))
    points, aims = [], []
    for number, (origin, direction) in enumerate(zip(origins[::PACKET], directions[::PACKET], strict=True)):
        point = origin - np.float32((0, 3, 15)[number % 3]) * direction
        way = every - point.astype(np.float64)
        way /= np.maximum(np.abs(way).max(axis=1, keepdims=True), 1e-300)
        straight = direction.astype(np.float64) / np.abs(direction).max()
        cosine = way @ straight / np.maximum(np.linalg.norm(way, axis=1), 1e-3)
        aims.append(every[np.sort(np.argpartition(-cosine, PACKET - 1)[:PACKET])])
        points.append(np.broadcast_to(point, (PACKET, 3)))
    return np.array(points, np.float32), np.array(aims, np.float32)


def along_a_curve(points: Floats) -> NDArray[np.int64]:
    """Morton's order of points: what is near by number is near in space."""
    size = np.maximum(np.ptp(points.astype(np.float64), axis=0), 1e-300)
    cells = np.clip((points - points.min(axis=0)) / size * 1023, 0, 1023).astype(np.int64)
    code = np.zeros(len(points), np.int64)
    for bit in range(10):
        for axis in range(3):
            code |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return code


def rounded(case: tuple[Doubles | Floats, Ints, Doubles | Floats, Doubles | Floats]) -> Case:
    vertices, triangles, origins, directions = case
    return (
        np.ascontiguousarray(vertices, np.float32),
        np.ascontiguousarray(triangles, np.int32),
        np.ascontiguousarray(origins, np.float32),
        np.ascontiguousarray(directions, np.float32),
    )


# ---- meshes and aims ------------------------------------------------------------------------------------------------


def grid(side: int) -> tuple[Doubles, Ints]:
    """(side + 1)^2 points on the integers of the plane z = 0, two triangles in each square."""
    x, y = np.meshgrid(np.arange(side + 1.0), np.arange(side + 1.0), indexing="ij")
    index = np.arange((side + 1) ** 2).reshape(side + 1, side + 1)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).reshape(-1, 3)
    return np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3), faces.astype(np.int32)


def boxes(places: NDArray[np.generic], size: float = 1.0) -> tuple[Doubles, Ints]:
    """A box of that size at each place, of twelve triangles."""
    corners = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)], np.float64) * size
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    vertices = (np.asarray(places, np.float64)[:, None, :] + corners).reshape(-1, 3)
    return vertices, (np.arange(len(places))[:, None, None] * 8 + faces).reshape(-1, 3).astype(np.int32)


def together(meshes: Sequence[tuple[Doubles | Floats, Ints]]) -> tuple[Doubles, Ints]:
    firsts = np.cumsum([0] + [len(vertices) for vertices, _ in meshes])
    faces = [faces + first for (_, faces), first in zip(meshes, firsts[:-1], strict=True)]
    return np.vstack([vertices.astype(np.float64) for vertices, _ in meshes]), np.vstack(faces).astype(np.int32)


def loose(corners: Doubles | Floats) -> tuple[Doubles, Ints]:
    """Triangles [M,3,3] that share no vertices."""
    return corners.reshape(-1, 3).astype(np.float64), np.arange(corners.size // 3, dtype=np.int32).reshape(-1, 3)


def rays_at(targets: Doubles | Floats, rng: Generator, count: int, reach: float) -> tuple[Floats, Floats]:
    """Rays whose origins lie around the targets and whose float32 directions are target - origin."""
    aimed = targets[rng.integers(len(targets), size=count)].astype(np.float32)
    origins = (aimed + rng.normal(size=(count, 3)) * reach).astype(np.float32)
    return origins, (aimed - origins).astype(np.float32)


def edge_middles(vertices: Doubles | Floats, triangles: Ints) -> Floats:
    corners = vertices[triangles].astype(np.float64)
    return ((corners + np.roll(corners, 1, axis=1)) / 2).reshape(-1, 3).astype(np.float32)


def inner_points(vertices: Doubles | Floats, triangles: Ints, rng: Generator, count: int) -> Doubles:
    chosen = vertices[triangles[rng.integers(len(triangles), size=count)]].astype(np.float64)
    return np.asarray(np.einsum("ij,ijk->ik", rng.dirichlet([1, 1, 1], size=count), chosen))


def everything(vertices: Doubles | Floats, triangles: Ints, rng: Generator, count: int) -> Doubles:
    """As many corners as middles of edges as points inside."""
    third = max(1, count // 3)
    return np.vstack(
        [
            vertices[rng.integers(len(vertices), size=third)].astype(np.float64),
            edge_middles(vertices, triangles)[rng.integers(3 * len(triangles), size=third)],
            inner_points(vertices, triangles, rng, third),
        ]
    )


def axes(rng: Generator, count: int) -> Floats:
    """Directions along the axes, both ways, whose other components are zeros of either sign."""
    directions = np.where(rng.integers(2, size=(count, 3)) == 1, np.float32(0.0), np.float32(-0.0)).astype(np.float32)
    chosen = rng.integers(3, size=count)
    directions[np.arange(count), chosen] = rng.choice(np.array([-1, 1], np.float32), size=count)
    return directions


def moved(make_case: MakeCase, offset: float) -> MakeCase:
    def case(rng: Generator, count: int) -> Case:
        vertices, triangles, origins, directions = make_case(rng, count)
        far = np.float32(offset)
        shifted = vertices + far
        # Aimed again, since both ends were rounded.
        targets = (origins + directions) + far
        new_origins = origins + far
        straight = np.count_nonzero(directions, axis=1, keepdims=True) == 1
        again = np.where(straight, directions, targets - new_origins)
        again[np.all(again == 0, axis=1)] = [1, 0, 0]  # both ends on one point of the coarse grid
        return rounded((shifted, triangles, new_origins, again))

    case.__doc__ = f"The same, {offset:g} from the origin: vertices fall on a coarse grid, and differences lose digits."
    return case


def scaled(make_case: MakeCase, factor: float) -> MakeCase:
    def case(rng: Generator, count: int) -> Case:
        vertices, triangles, origins, directions = make_case(rng, count)
        scale = np.float32(factor)
        return rounded((vertices * scale, triangles, origins * scale, directions * scale))

    case.__doc__ = f"The same, {factor:g} times as large: products of coordinates leave float's comfortable range."
    return case


# ---- seams: vertices and edges --------------------------------------------------------------------------------------


def at_vertices(rng: Generator, count: int) -> Case:
    """Rays straight at vertices of a closed mesh: the hit belongs to several faces, and none may let it through."""
    vertices, triangles = sphere(24, 32)
    return rounded((vertices, triangles, *rays_at(vertices, rng, count, 2.0)))


def nested_cylinders(rng: Generator, count: int) -> Case:
    """From inside one of ten nested cylinders at the next one's vertices: what slips through meets one farther out."""
    around = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    quads = [(s, (s + 1) % 24, 24 + (s + 1) % 24, 24 + s) for s in range(24)]
    faces = np.array([(a, b, c) for a, b, c, _ in quads] + [(a, c, d) for a, _, c, d in quads], np.int32)
    shells = []
    for shell in range(1, 11):
        ring = np.stack([np.cos(around) * shell, np.sin(around) * shell], 1)
        shells.append((np.vstack([np.insert(ring, 2, z, axis=1) for z in (-10, 10)]), faces))
    vertices, triangles = together(shells)
    near = rng.integers(10, size=count)
    targets = vertices[near * 48 + rng.integers(48, size=count)].astype(np.float32)
    origins = (rng.normal(size=(count, 3)) * 0.3 * (near[:, None] + 1)).astype(np.float32)
    return rounded((vertices, triangles, origins, targets - origins))


def at_edges(rng: Generator, count: int) -> Case:
    """Rays at the middles of shared edges: rounding puts them on either side."""
    vertices, triangles = sphere(24, 32)
    return rounded((vertices, triangles, *rays_at(edge_middles(vertices, triangles), rng, count, 2.0)))


def whole_numbers(rng: Generator, count: int) -> Case:
    """A closed mesh rounded to integers, and rays down a grid of halves: edges and corners are met exactly."""
    vertices, triangles = sphere(20, 28)
    vertices = np.round(vertices * 12)
    origins = np.round(rng.uniform(-13, 13, (count, 3)) * 2) / 2
    origins[:, 1] = 20
    directions = np.tile([0.0, -1.0, 0.0], (count, 1))
    slanted = rng.random(count) < 0.3
    directions[slanted] += np.round(rng.uniform(-2, 2, (int(slanted.sum()), 3))) * [1, 0, 1] / 4
    return rounded((vertices, triangles, origins, directions))


def glancing_edges(rng: Generator, count: int) -> Case:
    """Rays that graze a sphere along its tangents through shared edges: both faces are almost seen from the side."""
    vertices, triangles = sphere(24, 32)
    targets = edge_middles(vertices, triangles)[rng.integers(3 * len(triangles), size=count)].astype(np.float64)
    sideways = np.cross(targets, rng.normal(size=(count, 3)))
    tilt = targets * rng.choice([0, 1e-7, 1e-4, 1e-2], size=(count, 1))
    origins = (targets - 3 * sideways + tilt).astype(np.float32)
    return rounded((vertices, triangles, origins, targets.astype(np.float32) - origins))


def through_two_seams(rng: Generator, count: int) -> Case:
    """Lines through two corners or edges of a closed mesh: counted twice or not at all, the parity is lost."""
    vertices, triangles = sphere(16, 20)
    seams = np.vstack([vertices, edge_middles(vertices, triangles)]).astype(np.float64)
    a, b = (seams[rng.integers(len(seams), size=count)] for _ in range(2))
    b[np.all(a == b, axis=1)] *= -1
    start = rng.choice([-2.0, 0.5, 0.0], size=(count, 1))
    origins = (a + (b - a) * start).astype(np.float32)
    directions = np.where(start == 0, b.astype(np.float32) - origins, a.astype(np.float32) - origins)
    return rounded((vertices, triangles, origins, directions))


def twisted_quads(rng: Generator, count: int) -> Case:
    """Quads that are not flat, cut one way: rays that almost lie in one half's plane must keep to the chosen cut."""
    vertices, triangles = grid(12)
    vertices[:, 2] = rng.normal(size=len(vertices)) * 0.2
    chosen = vertices[triangles[rng.integers(len(triangles), size=count)]]
    weights = rng.dirichlet([0.5, 0.5, 0.5], size=(2, count))
    a, b = np.einsum("sij,ijk->sik", weights, chosen)
    beside = rng.normal(size=(count, 3)) * rng.choice([0, 1e-6, 1e-3], (count, 1))
    origins = (a - 3 * (b - a) + beside).astype(np.float32)
    return rounded((vertices, triangles, origins, b.astype(np.float32) - origins))


# ---- along the axes -------------------------------------------------------------------------------------------------


def axis_parallel(rng: Generator, count: int) -> Case:
    """Two direction components are zero, of either sign, and the ray runs through vertices: 0 * inf in the box test."""
    vertices, triangles = sphere(24, 32)
    directions = axes(rng, count)
    origins = vertices[rng.integers(len(vertices), size=count)] - 4 * directions
    return rounded((vertices, triangles, origins, directions))


def down_on_heights(rng: Generator, count: int) -> Case:
    """Straight down on a height field through corners, edges and faces: slabs of no width, or every leaf visited."""
    vertices, triangles = grid(20)
    vertices[:, 2] = rng.uniform(0, 3, len(vertices))
    origins = everything(vertices, triangles, rng, count)
    origins[:, 2] = 5
    return rounded((vertices, triangles, origins, np.tile([0.0, -0.0, -1.0], (len(origins), 1))))


def negative_zero(rng: Generator, count: int) -> Case:
    """Two triangles, and directions with zeros of both signs: 1 / -0 turns a slab inside out."""
    corners = np.array([[[-1, -1, 1], [2, -1, 1], [-1, 2, 1]], [[-1, -1, 2.1], [2, -1, 2.1], [-1, 2, 2.1]]])
    vertices, triangles = loose(np.vstack([corners, corners[:, :, [2, 0, 1]], corners[:, :, [1, 2, 0]]]))
    origins = rng.choice([-1.0, -0.0, 0.0, 0.5, 1.5], size=(count, 3))
    return rounded((vertices, triangles, origins, axes(rng, count)))


def in_face_planes(rng: Generator, count: int) -> Case:
    """From points in a box's faces along those faces: 0 * inf in the box test, and nothing in the plane counts."""
    vertices, triangles = boxes(np.array([[0, 0, 0], [-1, 0, 0], [0, -2, 0]]))
    origins = rng.uniform(-3, 2, (count, 3))
    directions = rng.normal(size=(count, 3))
    flat = rng.integers(3, size=count)
    origins[np.arange(count), flat] = rng.integers(-2, 2, size=count)
    directions[np.arange(count), flat] = rng.choice([0.0, -0.0], size=count)
    on_edge = rng.random(count) < 0.3
    origins[on_edge] = np.round(origins[on_edge])
    return rounded((vertices, triangles, origins, directions))


def fans_along_a_face(rng: Generator, count: int) -> Case:
    """Rays from one point within a plane that boxes touch from below only: whoever tilts them a little misses all."""
    places = np.column_stack([np.full(40, -1.0), rng.integers(-6, 6, (40, 2))])
    vertices, triangles = boxes(places)
    on_edges = vertices[rng.integers(len(vertices), size=count)]
    on_edges[:, 1:] += rng.choice([0, 0, 0.25, -0.5], size=(count, 2))
    on_edges[:, 0] = 0
    eyes = np.column_stack([np.zeros(12), rng.normal(size=(12, 2)) * 9]).astype(np.float32)
    origins = eyes[np.sort(rng.integers(12, size=count))]
    axis = int(rng.integers(3))
    vertices, origins, on_edges = (np.roll(points, axis, axis=1) for points in (vertices, origins, on_edges))
    return rounded((vertices, triangles, origins, on_edges - origins))


def at_cell_corners(rng: Generator, count: int) -> Case:
    """Slanted rays through the corners of a grid of boxes: two planes of different axes are met in one rounding."""
    places = np.array([[x, y, z] for x in range(3) for y in range(3) for z in range(3)]) * 1.1
    vertices, triangles = boxes(places, 0.9)
    return rounded((vertices, triangles, *rays_at(vertices, rng, count, 1.5)))


def touched_at_a_corner(rng: Generator, count: int, width: float = 100.0) -> Case:
    """From zero at the corners of leaves beside the ray: it enters where it leaves, each rounded in its own way."""
    corner = (rng.normal(size=(80, 1, 1, 3)) * width + [40, 60, 100]).astype(np.float32)
    side = rng.choice([-1, 1], size=(80, 1, 1, 3)) * 10.0 ** rng.uniform(-5, -1, size=(80, 1, 1, 1))
    beside = corner * (1 + side * rng.random((80, 8, 2, 3)))
    vertices, triangles = loose(np.concatenate([np.repeat(corner, 8, axis=1), beside], axis=2))
    directions = corner[rng.integers(80, size=count), 0, 0] * rng.choice([0.5, 1, 4, 3], size=(count, 1))
    return rounded((vertices, triangles, np.zeros((count, 3)), directions))


def touched_in_a_packet(rng: Generator, count: int) -> Case:
    """The same within a narrow cone, so that the rays make packets: one ray alone touches the box."""
    return touched_at_a_corner(rng, count, 5.0)


def flat_grid(rng: Generator, count: int) -> Case:
    """A mesh without thickness on an integer grid: rays down its vertices and edges, rays in its plane."""
    side = 16
    vertices, triangles = grid(side)
    vertices -= np.array([side / 2, side, 0])
    origins = np.column_stack([rng.integers(-side, side + 1, (count, 2)) / 2, np.full(count, 3.0)])
    origins[:, 1] -= side / 2
    directions = np.tile([0.0, -0.0, -1.0], (count, 1))
    in_plane = rng.random(count) < 0.2
    origins[in_plane, 2] = 0
    origins[in_plane, 0] = -side
    directions[in_plane] = [1, 0, 0]
    return rounded((vertices, triangles, origins, directions))


def stacked_boxes(rng: Generator, count: int) -> Case:
    """Boxes that share faces, all planes on the grid: faces lie in split planes, and rays run along them and at 0."""
    steps = range(-2, 2)
    vertices, triangles = boxes(np.array([[x, y, z] for x in steps for y in steps for z in steps]))
    origins = rng.integers(-6, 7, size=(count, 3)) / 2.0
    directions = rng.integers(-2, 3, size=(count, 3)).astype(np.float64)
    directions[np.all(directions == 0, axis=1)] = [0, 0, 1]
    return rounded((vertices, triangles, origins, directions))


def floor_between(rng: Generator, count: int) -> Case:
    """A floor that lies in a split plane, with things on both sides: met exactly where one cell ends."""
    floor, faces = grid(8)
    things = boxes(np.column_stack([rng.integers(0, 8, (60, 2)), rng.choice([-2, -1, 1], 60)]), 0.5)
    vertices, triangles = together([(floor, faces), things])
    targets = np.column_stack([rng.integers(0, 33, (count, 2)) / 4, np.zeros(count)]).astype(np.float32)
    origins = (targets + rng.normal(size=(count, 3)) * 2).astype(np.float32)
    straight = rng.random(count) < 0.3
    origins[straight, :2] = targets[straight, :2]
    return rounded((vertices, triangles, origins, targets - origins))


# ---- shapes that are hard to test or to sort ------------------------------------------------------------------------


def needle_fan(rng: Generator, count: int) -> Case:
    """Triangles a million times as long as wide around one point: areas vanish against their error."""
    angles = np.arange(400) * 1e-6
    rim = np.stack([np.cos(angles), np.sin(angles), 0.1 * np.sin(5e4 * angles)], 1)
    vertices = np.vstack([[[0, 0, 0]], rim]).astype(np.float32)
    triangles = np.stack([np.zeros(399), np.arange(1, 400), np.arange(2, 401)], 1).astype(np.int32)
    return rounded((vertices, triangles, *rays_at(everything(vertices, triangles, rng, 4000), rng, count, 1.0)))


def grazing_slivers(rng: Generator, count: int) -> Case:
    """Long thin triangles half a degree from the ray, hundreds away: the computed hit lies far outside the triangle."""
    base = rng.normal(size=(80, 1, 3)) * 100
    along, across = rng.normal(size=(2, 80, 3))
    vertices, triangles = loose(base + np.stack([np.zeros((80, 3)), along * 8, along * 7 + across * 0.7], axis=1))
    chosen = rng.integers(80, size=count)
    target = np.einsum("ij,ijk->ik", rng.dirichlet([1, 1, 1], size=count), vertices[triangles[chosen]])
    direction = along[chosen] + across[chosen] * rng.normal(size=(count, 1)) + rng.normal(size=(count, 3)) * 0.01
    origins = (target - direction * rng.choice([30, 300], size=(count, 1))).astype(np.float32)
    beside = rng.normal(size=(count, 3)) * rng.choice([0, 1e-4, 0.3], size=(count, 1))
    return rounded((vertices, triangles, origins, (target + beside).astype(np.float32) - origins))


def tiny_in_a_room(rng: Generator, count: int) -> Case:
    """Triangles of 0.2 mm in a room of metres: their determinants are below any fixed epsilon."""
    room = boxes(np.array([[-3.0, -3.0, -3.0]]), 6)
    places = np.vstack([[[0, 0, 0]], rng.uniform(-2, 2, (99, 3))])
    small = loose(places[:, None, :] + np.array([[0, 0, 0], [2e-4, 0, 0], [0, 2e-4, 0]]))
    vertices, triangles = together([room, small])
    return rounded((vertices, triangles, *rays_at(everything(*small, rng, 3000), rng, count, 1.0)))


def no_area(rng: Generator, count: int) -> Case:
    """Points and lines among the faces: they divide by zero; none may be hit, and no neighbour lost to them."""
    vertices, triangles = sphere(12, 16)
    some = rng.integers(len(vertices), size=(60, 2)).astype(np.int32)
    lines = np.column_stack([some[:, 0], some[:, 1], some[:, 1]])
    points = np.repeat(some[:, :1], 3, axis=1)
    shuffled = rng.permutation(np.vstack([triangles, lines, points]))
    return rounded((vertices, shuffled, *rays_at(edge_middles(vertices, shuffled), rng, count, 1.0)))


def not_finite(rng: Generator, count: int) -> Case:
    """Faces with NaN, infinite or huge corners: one of them poisons every box above it."""
    vertices, triangles = sphere(12, 16)
    bad = np.array([[np.nan, 0, 0], [0, np.inf, 0], [0, 0, -np.inf], [3e38, 0, 0], [0, 2e18, 0]], np.float32)
    faulty = rng.integers(len(vertices), size=(40, 3)).astype(np.int32)
    faulty[np.arange(40), rng.integers(3, size=40)] = len(vertices) + np.arange(40, dtype=np.int32) % 5
    shuffled = rng.permutation(np.vstack([triangles, faulty]))
    return rounded((np.vstack([vertices, bad]), shuffled, *rays_at(vertices, rng, count, 1.0)))


def stacked_copies(rng: Generator, count: int) -> Case:
    """The same faces several times over, in shuffled order: the lowest index must win on every path."""
    vertices, triangles = sphere(8, 12)
    shuffled = rng.permutation(np.repeat(triangles, 5, axis=0))
    return rounded((vertices, shuffled, *rays_at(edge_middles(vertices, triangles), rng, count, 1.0)))


def no_way_to_split(rng: Generator, count: int) -> Case:
    """Hundreds of copies of one face, of faces about one centre and of faces around one corner: no plane parts them."""
    face = np.array([[0, 0, 0], [1, 0, 0.5], [0, 1, 0.25]])
    angles = rng.uniform(0, 2 * np.pi, 24)[:, None] + np.arange(3) * 2 * np.pi / 3
    turned = np.stack([3 + np.cos(angles), np.sin(angles), np.zeros_like(angles)], -1)
    fans = np.array([0.0, 3, 0]) + rng.normal(size=(24, 3, 3)) * np.array([0, 1, 1])[:, None]
    vertices, triangles = loose(np.concatenate([np.stack([face] * 40), turned, fans]))
    return rounded((vertices, triangles, *rays_at(everything(vertices, triangles, rng, 3000), rng, count, 1.0)))


def coincident_pairs(rng: Generator, count: int) -> Case:
    """Walls of two objects on one another or a micrometre apart: which one shows must not flicker."""
    wall, faces = grid(6)
    gaps = rng.choice([0.0, 0.0, 1e-7, 4e-7, 1.6e-6], size=6)
    walls = [(wall + np.array([0, 0, 1 + gap]), faces) for gap in gaps]
    slanted = [(w[:, [0, 2, 1]] + w[:, [2, 1, 0]] * 0.3, f) for w, f in walls]
    vertices, triangles = together(walls + slanted)
    return rounded((vertices, triangles, *rays_at(everything(vertices, triangles, rng, 3000), rng, count, 2.0)))


def coplanar_overlap(rng: Generator, count: int) -> Case:
    """Overlapping triangles of one slanted plane, all on integers: distances tie exactly, and the lowest index wins."""
    corners = rng.integers(-8, 9, size=(120, 3, 3)).astype(np.float64)
    corners[:, :, 2] = corners[:, :, 0] - 2 * corners[:, :, 1]
    vertices, triangles = loose(corners)
    origins = rng.integers(-12, 13, size=(count, 3)).astype(np.float64)
    targets = vertices[rng.integers(len(vertices), size=count)]
    directions = (targets - origins) * rng.choice([1, 2, 0.5], size=(count, 1))
    directions[np.all(directions == 0, axis=1)] = [0, 0, 1]
    return rounded((vertices, triangles, origins, directions))


def lattice(rng: Generator, count: int) -> Case:
    """Triangles and rays on small integers: rays through corners, along edges, in planes, and ties between planes."""
    vertices, triangles = loose(rng.integers(-3, 4, size=(200, 3, 3)).astype(np.float64))
    origins = rng.integers(-5, 6, size=(count, 3)).astype(np.float64)
    directions = rng.integers(-3, 4, size=(count, 3)).astype(np.float64)
    directions[np.all(directions == 0, axis=1)] = [1, 1, 1]
    return rounded((vertices, triangles, origins, directions))


def furball(rng: Generator, count: int) -> Case:
    """Long thin triangles through everything, each cut by every plane: clipped again and again, none may be lost."""
    a, b = rng.uniform(size=(2, 150, 3))
    vertices, triangles = loose(np.stack([a, b, b + np.array([1e-4, 1e-4, -1e-4])], axis=1))
    return rounded((vertices, triangles, *rays_at(everything(vertices, triangles, rng, 6000), rng, count, 0.5)))


def splits_near_zero(rng: Generator, count: int) -> Case:
    """Coordinates from -1e-30 to 1 by way of every exponent: a plane found by halving an interval never ends."""
    size = 10.0 ** rng.uniform(-30, 0, size=(80, 1, 1))
    corners = rng.uniform(-0.1, 1, size=(80, 3, 3)) * size
    corners[::5, 0] = [-1e-30, 0, 1e-30]
    vertices, triangles = loose(corners)
    targets = everything(vertices, triangles, rng, 6000).astype(np.float32)
    aimed = targets[rng.integers(len(targets), size=count)]
    away = rng.normal(size=(count, 3)) * np.maximum(np.abs(aimed).max(axis=1, keepdims=True), 1e-30) * 3
    origins = (aimed + away).astype(np.float32)
    return rounded((vertices, triangles, origins, aimed - origins))


def nearly_touching(rng: Generator, count: int) -> Case:
    """Four spheres with gaps from a twentieth down to one ulp: shadow rays through the gap, and along it."""
    ball, faces = sphere(10, 14)
    gaps = [0.0, 0.05, 0.01, 2e-7]
    centres = np.cumsum([2 + gap for gap in gaps])
    vertices, triangles = together([(ball[:, [2, 0, 1]] + np.array([x, 0, 0]), faces) for x in centres])
    tips = np.array([[x + side, 0, 0] for x in centres for side in (-1, 1)])
    targets = np.vstack([tips, everything(vertices, triangles, rng, 60)])
    return rounded((vertices, triangles, *rays_at(targets, rng, count, 1.0)))


def deep_tree(rng: Generator, count: int) -> Case:
    """Each face half as large as the one before, all to one corner: as deep a tree as there is, and a full stack."""
    sizes = 2.0 ** -np.arange(60)
    corner = np.array([[1, 0.25, 0], [0.25, 1, 0.25], [0.25, 0, 1]])
    vertices, triangles = loose(sizes[:, None, None] * np.concatenate([np.stack([corner] * 60)]))
    inside = inner_points(vertices, triangles, rng, 2000)
    targets = inside[rng.integers(2000, size=count)]
    away = rng.uniform(-1, 3, size=(count, 1)) * rng.normal(size=(count, 3)) * np.abs(targets).max(1, keepdims=True)
    start = np.where(rng.random((count, 1)) < 0.5, np.array([2.0, 1.9, 2.1]), targets)
    origins = (start + away).astype(np.float32)
    return rounded((vertices, triangles, origins, targets.astype(np.float32) - origins))


def one_triangle(rng: Generator, count: int) -> Case:
    """A scene of one face: the root is a leaf, and its box may have no thickness."""
    vertices, triangles = loose(np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]]))
    return rounded((vertices, triangles, *rays_at(everything(vertices, triangles, rng, 300), rng, count, 1.0)))


def two_triangles(rng: Generator, count: int) -> Case:
    """A scene of two faces of one quad: both in one leaf, or a plane along the diagonal's box."""
    vertices = np.array([[0, 0, 1], [1, 0, 1], [1, 1, 1.5], [0, 1, 1]])
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    return rounded((vertices, triangles, *rays_at(everything(vertices, triangles, rng, 300), rng, count, 1.0)))


# ---- distances ------------------------------------------------------------------------------------------------------


def far_origins(rng: Generator, count: int) -> Case:
    """Origins thousands of diagonals away: the ray's rounding is larger than the faces."""
    vertices, triangles = sphere(12, 16)
    return rounded((vertices, triangles, *rays_at(vertices, rng, count, 5000.0)))


def small_and_far(rng: Generator, count: int) -> Case:
    """A sphere of radius 0.1 seen from 1e7 away, through a point and in parallel: the shape is below the ray's ulp."""
    vertices, triangles = sphere(4, 6)
    vertices = vertices * 0.1
    origins, directions = rays_at(vertices, rng, count, 1e7)
    parallel = rng.random(count) < 0.5
    beam = np.array([3, -2, 1]) * 2.0**21
    origins[parallel] = rng.uniform(-0.1, 0.1, (int(parallel.sum()), 3)) - beam
    directions[parallel] = beam / 2.0**21
    return rounded((vertices, triangles, origins, directions))


def huge_box(size: float) -> MakeCase:
    def case(rng: Generator, count: int) -> Case:
        vertices, triangles = boxes(np.array([[-1.0, -1, 0]]), 2)
        vertices = vertices * [size, size, 6e4]
        origins = np.column_stack([rng.choice([0.5, -0.5, 1e3], size=(count, 2)), np.full(count, 120500.0)])
        inside = rng.random(count) < 0.5
        origins[inside, 2] = rng.choice([0.0, 120000.0, 6e4], size=int(inside.sum()))
        directions = rng.normal(size=(count, 3))
        directions[::3] = [0, 0, -1]
        return rounded((vertices, triangles, origins, directions))

    case.__doc__ = f"A box {size:g} wide and 1.2e5 high: a ray from its top hits the top again, or the bottom's void."
    return case


def small_beside_huge(rng: Generator, count: int) -> Case:
    """A tiny triangle over one 1e12 times as wide: one of them fixes the error, the other needs none."""
    vertices = [[-1e9, -1e9, 0], [1e9, -1e9, 0], [0, 1e9, 0], [0, 0, 1e-3], [2e-3, 0, 1e-3], [0, 2e-3, 1e-3]]
    triangles = [[0, 1, 2], [3, 4, 5]]
    targets = np.array([[5e-4, 5e-4, 1e-3], [1e-3, 1e-3, 1e-3], [0, 0, 1e-3], [1, 1, 0], [3e8, 0, 0]], np.float32)
    return rounded((np.array(vertices), np.array(triangles), *rays_at(targets, rng, count, 10.0)))


def from_the_surface(rng: Generator, count: int) -> Case:
    """Origins on the faces themselves, as shadow rays have: t is zero or nearly so."""
    vertices, triangles = sphere(12, 16)
    origins = inner_points(vertices, triangles, rng, count)
    origins[::3] = vertices[rng.integers(len(vertices), size=len(origins[::3]))]
    return rounded((vertices, triangles, origins, rng.normal(size=(count, 3))))


def thin_skin(rng: Generator, count: int) -> Case:
    """Two shells 4e-5 apart, and rays from one at the other: any fixed epsilon skips the next one."""
    ball, faces = sphere(12, 16)
    vertices, triangles = together([(ball, faces), (ball * (1 + 4e-5), faces)])
    origins = inner_points(ball, faces, rng, count).astype(np.float32)
    return rounded((vertices, triangles, origins, np.where(rng.random((count, 1)) < 0.7, origins, -origins)))


def just_ahead(rng: Generator, count: int) -> Case:
    """Faces from 1e-9 to 1e-3 ahead of the origin: a smallest distance above zero makes them vanish."""
    vertices, triangles = grid(4)
    origins = everything(vertices, triangles, rng, count)
    origins[:, 2] = 10.0 ** rng.uniform(-9, -3, len(origins)) * rng.choice([-1, 1], len(origins))
    directions = np.column_stack([rng.normal(size=(len(origins), 2)) * 0.1, -np.sign(origins[:, 2])])
    return rounded((vertices, triangles, origins, directions))


def low_poly_shadow(rng: Generator, count: int) -> Case:
    """Shadow rays at the terminator of a coarse sphere: the stairs that show there are the mesh's own, no tracer's."""
    vertices, triangles = sphere(6, 8)
    points = inner_points(vertices, triangles, rng, count)
    light = np.cross(points, rng.normal(size=(count, 3)))
    lifted = points * (1 + rng.choice([0, 1e-7, 1e-4], size=(count, 1)))
    return rounded((vertices, triangles, lifted, light + points * rng.normal(size=(count, 1)) * 0.05))


# ---- the last bits --------------------------------------------------------------------------------------------------


def nearly_coplanar(rng: Generator, count: int) -> Case:
    """Sheets a few ulps apart that cross one another: which is nearer is decided in the last bits."""
    base = np.array([[0, 0, 1], [1, 0, 1], [0, 1, 1]], np.float32)
    sheets = np.stack([base] * 24)
    steps = rng.integers(-3, 4, size=(24, 3))
    sheets[:, :, 2] += (steps * np.spacing(np.float32(1))).astype(np.float32)
    vertices, triangles = loose(sheets)
    targets = np.einsum("ij,jk->ik", rng.dirichlet([1, 1, 1], size=200), base.astype(np.float64))
    return rounded((vertices, triangles, *rays_at(targets, rng, count, 1.0)))


def crossing_sheets(rng: Generator, count: int) -> Case:
    """Pairs of sheets at almost right angles to the ray, which meets them where they cross: only depth has an error."""
    tilts = 10.0 ** rng.uniform(-6, -2, size=(40, 2, 2, 1)) * rng.choice([-1, 1], size=(40, 2, 2, 1))
    flat = np.array([[-4.0, -4, 0], [8, -4, 0], [-4, 8, 0]])
    corners = np.tile(flat, (40, 2, 1, 1))
    corners[..., 2] = 1 + tilts[:, :, 0] * flat[:, 0] + tilts[:, :, 1] * flat[:, 1]
    corners[..., 0] += 16 * np.arange(40)[:, None, None]
    corners = corners.astype(np.float32).astype(np.float64)
    vertices, triangles = loose(corners)

    # Per sheet z = a + b x + c y through its rounded corners, and on a pair's common line the y of some x.
    sheets = np.linalg.solve(np.concatenate([np.ones((40, 2, 3, 1)), corners[..., :2]], -1), corners[..., 2:])[..., 0]
    pair = rng.integers(40, size=count)
    a, b, c = np.moveaxis(sheets[pair, 0] - sheets[pair, 1], -1, 0)
    x = 16 * pair + rng.uniform(-1, 1, count)
    y = np.clip(-(a + b * x) / c, -3, 3)
    steep = np.column_stack([rng.normal(size=(count, 2)) * rng.choice([0, 1e-3, 0.1], (count, 1)), np.ones(count)])
    targets = np.column_stack([x, y, np.ones(count)])
    origins = targets - steep * 10.0 ** rng.uniform(-1, 2, size=(count, 1))
    return rounded((vertices, triangles, origins, steep))


def near_degenerate(rng: Generator, count: int) -> Case:
    """Triangles whose corners are a few ulps apart or almost on a line, and rays through those corners."""
    anchor = rng.normal(size=(150, 1, 3))
    spread = np.where(rng.random((150, 1, 1)) < 0.5, 1e-7, 1.0) * rng.normal(size=(150, 3, 3))
    spread[::2, 2] = (spread[::2, 0] + spread[::2, 1]) / 2 + 1e-8 * rng.normal(size=(75, 3))
    vertices, triangles = loose(anchor + spread)
    return rounded((vertices, triangles, *rays_at(vertices, rng, count, 2.0)))


def ulps_apart(rng: Generator, count: int) -> Case:
    """Corners one to four ulps apart at any magnitude, and origins only a few ulps more away: nothing but last bits."""
    anchor = (10.0 ** rng.uniform(-15, 15, (120, 1, 1)) * rng.normal(size=(120, 1, 3))).astype(np.float32)
    grain = np.abs(np.spacing(anchor))
    corners = (anchor + rng.integers(-4, 5, size=(120, 3, 3)) * grain).astype(np.float32)
    vertices, triangles = loose(corners)
    chosen = rng.integers(120, size=count)
    steps = rng.choice([4, 50, 1e4, 3e6], size=(count, 1))
    away = np.round(rng.normal(size=(count, 3)) * steps) * grain[chosen, 0]
    origins = (anchor[chosen, 0] + away).astype(np.float32)
    directions = corners[chosen, rng.integers(3, size=count)] - origins
    directions[np.all(directions == 0, axis=1)] = [1, 0, 0]
    return rounded((vertices, triangles, origins, directions))


def any_magnitude(rng: Generator, count: int) -> Case:
    """Coordinates of 1e-30 to 1e17 in one triangle, and rays at its corners: sums lose all of a term, or nothing."""
    exponents = rng.uniform(-30, 17, size=(60, 3, 3))
    same = rng.random(60) < 0.5
    exponents[same] = exponents[same, :1, :1] + rng.uniform(-3, 3, size=(int(same.sum()), 3, 3))
    vertices, triangles = loose(rng.normal(size=(60, 3, 3)) * 10.0 ** np.minimum(exponents, 17))
    targets = vertices[rng.integers(len(vertices), size=count)].astype(np.float32)
    reach = 10.0 ** rng.uniform(-2, 2, size=(count, 1)) * np.abs(targets).max(axis=1, keepdims=True)
    origins = (targets + rng.normal(size=(count, 3)) * reach).astype(np.float32)
    return rounded((vertices, triangles, origins, targets - origins))


def any_length(rng: Generator, count: int) -> Case:
    """Directions of length 1e-29 to 1e29: distances, reciprocals and their products under- and overflow."""
    vertices, triangles, origins, directions = at_edges(rng, count)
    return rounded((vertices, triangles, origins, directions * 10.0 ** rng.uniform(-29, 29, size=(count, 1))))


def almost_in_plane(rng: Generator, count: int) -> Case:
    """Rays that leave a face's plane by an ulp or not at all: the determinant is its own error."""
    vertices, triangles = sphere(8, 10)
    chosen = vertices[triangles[rng.integers(len(triangles), size=count)]].astype(np.float64)
    a, b = np.einsum("sij,ijk->sik", rng.dirichlet([1, 1, 1], size=(2, count)), chosen)
    a[::2], b[::4] = chosen[::2, 0], chosen[::4, 1]
    origins = (a - 2 * (b - a)).astype(np.float32)
    nudged = b.astype(np.float32) + rng.integers(-1, 2, size=(count, 3)) * np.spacing(b.astype(np.float32))
    return rounded((vertices, triangles, origins, nudged - origins))


def subnormal(rng: Generator, count: int) -> Case:
    """Coordinates of a few hundred times the smallest float: flushing to zero, or underflow of a product, loses all."""
    vertices, triangles = sphere(6, 8)
    tiny = 2.0**-149
    on_grid = np.round(vertices.astype(np.float64) * 300) * tiny
    origins = np.round(rng.normal(size=(count, 3)) * 900) * tiny
    targets = on_grid[rng.integers(len(on_grid), size=count)]
    directions = (targets - origins) / tiny
    directions[np.all(directions == 0, axis=1)] = [1, 0, 0]
    return rounded((on_grid, triangles, origins, directions))


def subnormal_among_ones(rng: Generator, count: int) -> Case:
    """Metres with corners and origins a smallest float off zero: flushed to zero, rays start on the other side."""
    tiny = 2.0**-149
    corners = rng.choice([-1.0, 0.0, 1.0], size=(100, 3, 3)) + rng.integers(-2, 3, size=(100, 3, 3)) * tiny
    vertices, triangles = loose(corners)
    origins = rng.choice([-2.0, 0.0, 1.0], size=(count, 3)) + rng.integers(-2, 3, size=(count, 3)) * tiny
    directions = rng.integers(-2, 3, size=(count, 3)) + rng.integers(-2, 3, size=(count, 3)) * tiny
    directions[np.abs(directions).max(axis=1) < 0.5] = [0, 1, tiny]
    return rounded((vertices, triangles, origins, directions))


CASES: dict[str, MakeCase] = {
    **{
        case.__name__: case
        for case in (
            at_vertices,
            nested_cylinders,
            at_edges,
            whole_numbers,
            glancing_edges,
            through_two_seams,
            twisted_quads,
            axis_parallel,
            down_on_heights,
            negative_zero,
            in_face_planes,
            fans_along_a_face,
            at_cell_corners,
            touched_at_a_corner,
            touched_in_a_packet,
            flat_grid,
            stacked_boxes,
            floor_between,
            needle_fan,
            grazing_slivers,
            tiny_in_a_room,
            no_area,
            not_finite,
            stacked_copies,
            no_way_to_split,
            coincident_pairs,
            coplanar_overlap,
            lattice,
            furball,
            splits_near_zero,
            nearly_touching,
            deep_tree,
            one_triangle,
            two_triangles,
            far_origins,
            small_and_far,
            small_beside_huge,
            from_the_surface,
            thin_skin,
            just_ahead,
            low_poly_shadow,
            nearly_coplanar,
            crossing_sheets,
            near_degenerate,
            ulps_apart,
            any_magnitude,
            any_length,
            almost_in_plane,
            subnormal,
            subnormal_among_ones,
        )
    },
    "at_vertices_moved_1e3": moved(at_vertices, 1e3),
    "at_vertices_moved_1e5": moved(at_vertices, 1e5),
    "touched_at_a_corner_moved_1e3": moved(touched_at_a_corner, 1e3),
    "at_vertices_moved_1e7": moved(at_vertices, 1e7),
    "axis_parallel_moved_1e5": moved(axis_parallel, 1e5),
    "at_edges_scaled_2e-20": scaled(at_edges, 2e-20),
    "near_degenerate_scaled_1e-30": scaled(near_degenerate, 1e-30),
    "at_edges_scaled_1e15": scaled(at_edges, 1e15),
    "from_the_surface_scaled_1e-3": scaled(from_the_surface, 1e-3),
    "from_the_surface_scaled_1e4": scaled(from_the_surface, 1e4),
    "huge_box_1e5": huge_box(1e5),
    "huge_box_6e11": huge_box(5.9e11),
}
