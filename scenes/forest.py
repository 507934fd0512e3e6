# SPDX-License-Identifier: GPL-3.0-or-later
"""A wood round a lake: thousands of instances of a dozen plants under a low sun: python scenes/forest.py OUT.blend

Trees are instances on the faces of a mesh, bushes and stones collection instances, the meadow's grass a particle
system: three ways in which Blender places copies of one mesh.
"""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from kit import box, camera, collection, instance, lathe, light, main, mesh, modify, picture, place, sheet, tube

WATER = 0.0  # height of the lake


def height(x: np.ndarray | float, y: np.ndarray | float) -> np.ndarray:
    """The ground's height in metres: a basin for the lake, rolling hills behind it, a mountain far off."""
    x, y = np.asarray(x, float), np.asarray(y, float)
    basin = np.hypot((x + 6) / 34, (y - 34) / 22)
    shore = 5.0 * (1 - np.exp(-(np.maximum(basin - 0.9, 0) ** 1.3))) - 2.0 * np.exp(-((basin / 0.75) ** 4))
    rolls = 0.8 * np.sin(x / 13 + 1) * np.cos(y / 17) + 0.35 * np.sin(x / 5 + y / 7)
    hills = 9 / (1 + np.exp(-(y - 105) / 16)) * (1 + 0.45 * np.sin(x / 31 + 0.8)) + 6 / (
        1 + np.exp(-(np.abs(x) - 80) / 12)
    )
    peak = np.clip((y - 150) / 80, 0, 1) * (
        74 * np.exp(-np.hypot((x - 55) / 62, (y - 290) / 55)) + 60 * np.exp(-np.hypot((x + 75) / 55, (y - 280) / 50))
    )
    crags = 0.09 * peak * (np.sin(x / 6 + 2 * np.sin(y / 21)) + np.abs(np.sin(y / 9 + 1.7 * np.sin(x / 13))) - 0.6)
    ground: np.ndarray = shore + rolls * np.clip(basin - 0.7, 0, 1) + hills + peak + crags
    return ground


def conifer(name: str, tall: float, tiers: int, random: np.random.Generator) -> bpy.types.Mesh:
    """A spruce: tiers of ragged skirts round a stem; about 12 triangles per tier and branch."""
    vertices: list[Any] = []
    faces: list[tuple[int, ...]] = []
    for tier in range(tiers):
        low = tall * (0.12 + 0.8 * tier / tiers)
        reach = 0.24 * tall * (1 - tier / tiers) ** 0.85 + 0.05
        start, spikes = len(vertices), 11
        vertices.append((0, 0, low + 1.9 * tall / tiers))
        turn = random.uniform(0, 6)
        for i in range(2 * spikes):
            r = reach * (random.uniform(0.85, 1.1) if i % 2 else random.uniform(0.45, 0.6))
            a = turn + np.pi * i / spikes
            vertices.append((r * np.cos(a), r * np.sin(a), low - (0.35 * r if i % 2 else 0.12 * r)))
        faces += [(start, start + 1 + i, start + 1 + (i + 1) % (2 * spikes)) for i in range(2 * spikes)]
    stem = len(vertices)
    for z, r in [(-0.4, 0.022 * tall), (tall * 0.5, 0.012 * tall)]:
        vertices += [(r * np.cos(a), r * np.sin(a), z) for a in np.arange(6) * np.pi / 3]
    faces += [(stem + i, stem + (i + 1) % 6, stem + 6 + (i + 1) % 6, stem + 6 + i) for i in range(6)]
    data = mesh(name, np.array(vertices), faces)
    data.polygons.foreach_set("material_index", np.array([0] * (len(faces) - 6) + [1] * 6, np.int32))
    return data


def broadleaf(name: str, tall: float, random: np.random.Generator) -> bpy.types.Mesh:
    """A birch or oak: a stem and a crown of some 150 turned leaf clumps."""
    count = 150
    way = random.normal(size=(count, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    centre = way * random.uniform(0.75, 1.0, (count, 1)) * np.array([0.27, 0.27, 0.33]) * tall + np.array(
        [0, 0, 0.62 * tall]
    )
    size = tall * random.uniform(0.06, 0.1, (count, 1))
    side = np.cross(way, random.normal(size=(count, 3)))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(way, side)
    tip = centre + 0.35 * size * way
    clump = np.stack(
        [tip, centre + size * side, centre + size * other, centre - size * side, centre - size * other], axis=1
    ).reshape(-1, 3)
    base = 5 * np.arange(count)[:, None]
    leaves = np.concatenate([base + np.array([[0, i, i % 4 + 1]]) for i in range(1, 5)], axis=1).reshape(-1, 3)
    ring = np.arange(6) * np.pi / 3
    stem = np.concatenate(
        [
            np.stack([r * tall * np.cos(ring), r * tall * np.sin(ring), np.full(6, z * tall)], axis=1)
            for z, r in [(-0.04, 0.025), (0.6, 0.012)]
        ]
    )
    n = 5 * count
    trunk = [(n + i, n + (i + 1) % 6, n + 6 + (i + 1) % 6, n + 6 + i) for i in range(6)]
    data = mesh(name, np.concatenate([clump, stem]), [tuple(f) for f in leaves.tolist()] + trunk)
    data.polygons.foreach_set("material_index", np.array([0] * len(leaves) + [1] * 6, np.int32))
    return data


def plant(
    tree: bpy.types.Mesh, colours: list[str], spots: np.ndarray, sizes: np.ndarray, random: np.random.Generator
) -> None:
    """Instances of a tree on the faces of a mesh: one small square per spot, whose size and turn are the tree's."""
    # The viewport, unlike a render, also shows the tree that is copied, so it stands on the first of the spots itself.
    offsets, sizes = spots[1:] - spots[0], sizes[1:]
    angle = random.uniform(0, 2 * np.pi, (len(offsets), 1)) + np.arange(4) * np.pi / 2
    reach = (
        np.sqrt(0.5) * sizes[:, None]
    )  # a square of side `size`: its face scales the instance by the root of its area
    corner = np.stack([reach * np.cos(angle), reach * np.sin(angle), np.zeros_like(angle)], axis=-1)
    squares = (offsets[:, None, :] + corner).reshape(-1, 3)
    bed = mesh(f"{tree.name} bed", squares, np.arange(4 * len(offsets)).reshape(-1, 4))
    parent = place(bed, colours[0], spots[0])
    parent.instance_type, parent.use_instance_faces_scale = "FACES", True
    parent.show_instancer_for_viewport = parent.show_instancer_for_render = False
    place(tree, colours).parent = parent


def trees(random: np.random.Generator) -> None:
    """Some three thousand trees of eight kinds: spruces up the slopes, broadleaved ones near the water."""
    x, y = random.uniform(-130, 130, 16000), random.uniform(14, 235, 16000)
    z = height(x, y)
    view = np.abs(x) < 14 + 0.62 * (y + 12)  # what the camera can see, and a margin for shadows
    shore = (z > 1.1) & (z < 46) & view
    clearing = np.hypot(x - 13, y - 16) < 9
    thin = random.random(len(x)) < np.clip(0.1 + (y - 30) / 160, 0.12, 0.62)
    keep = np.flatnonzero(shore & thin & ~clearing)[:3600]
    x, y, z = x[keep], y[keep], z[keep]
    leafy = random.random(len(x)) < np.clip(0.75 - (z - 2) / 9, 0.03, 0.75)
    kind = random.integers(0, 4, len(x))
    size = random.uniform(0.65, 1.25, len(x))
    # Three spruces on the near shore frame the picture.
    near = np.array([(-5.6, 5.5), (-8.2, 8.5), (-4.6, 9.5)])
    x, y, z = np.append(x, near[:, 0]), np.append(y, near[:, 1]), np.append(z, height(near[:, 0], near[:, 1]))
    leafy, kind, size = (
        np.append(leafy, [False, False, False]),
        np.append(kind, [2, 0, 3]),
        np.append(size, [0.95, 1.15, 0.7]),
    )
    spots = np.stack([x, y, z - 0.05], axis=1)
    for i, (green, tall) in enumerate([("#3d6e48", 8.5), ("#487d4e", 7.0), ("#356549", 10.0), ("#588553", 6.0)]):
        here = ~leafy & (kind == i)
        plant(conifer(f"spruce {i}", tall, 10 + i, random), [green, "#5a4130"], spots[here], size[here], random)
    for i, (green, tall) in enumerate([("#7f9a3c", 6.5), ("#c58a2e", 5.8), ("#8fa347", 7.2), ("#b8622f", 5.0)]):
        here = leafy & (kind == i)
        plant(broadleaf(f"broadleaf {i}", tall, random), [green, "#d8d2c4"], spots[here], size[here], random)


def undergrowth(random: np.random.Generator) -> None:
    """Bushes and stones as collection instances along the shore."""
    bush = collection("bush")
    place(broadleaf("bush", 1.6, random), ["#5f7f38", "#5a4130"], (0, 0, -0.35), scale=(1.3, 1.3, 0.9), into=bush)
    stone = collection("stone")
    angle, rise = np.meshgrid(np.linspace(0, 2 * np.pi, 14, endpoint=False), np.linspace(-1.5, 1.5, 8))
    r = 0.5 * (1 + 0.18 * np.sin(3 * angle + rise) + 0.12 * np.cos(5 * rise + 2 * angle))
    rock = np.stack(
        [1.3 * r * np.cos(rise) * np.cos(angle), r * np.cos(rise) * np.sin(angle), 0.7 * r * np.sin(rise)], axis=-1
    )
    place(sheet("stone", rock, closed_columns=True, smooth=False), "#8d8a84", into=stone)
    x, y = random.uniform(-45, 40, 5000), random.uniform(4, 66, 5000)
    z = height(x, y)
    for i in np.flatnonzero((z > WATER - 0.15) & (z < 1.3))[:330]:
        what, up = (stone, 0.0) if i % 3 else (bush, 0.15)
        if what is bush and z[i] < 0.5:
            continue
        instance(what, (x[i], y[i], z[i] + up), (0, 0, random.uniform(0, 360)), random.uniform(0.35, 1.1))


def meadow() -> None:
    """Tufts of grass on the near shore, set by a particle system (Hair, drawn as objects)."""
    random = np.random.default_rng(21)
    root = random.normal(0, 0.05, (9, 2))
    lean = random.normal(0, 0.14, (9, 2))
    blades = []
    for (x, y), (dx, dy) in zip(root, lean, strict=True):
        side = np.array([-dy, dx]) / np.hypot(dx, dy) * 0.018
        blades += [
            (x - side[0], y - side[1], -0.03),
            (x + side[0], y + side[1], -0.03),
            (x + dx, y + dy, random.uniform(0.3, 0.5)),
        ]
    # Hair particles put the instance's Y axis along the ground's normal, so the tuft is built lying along Y.
    tuft = place(
        mesh("tuft", np.array(blades)[:, [0, 2, 1]], np.arange(27).reshape(9, 3)), "#8aa04a", into=collection("tuft")
    )
    u, v = np.meshgrid(np.linspace(-24, 28, 60), np.linspace(-5, 15, 40))
    near = place(sheet("near ground", np.stack([u, v, height(u, v) + 0.01], axis=-1)), "#7d8f4a")
    near.show_instancer_for_viewport = near.show_instancer_for_render = False
    particles = near.modifiers.new("grass", "PARTICLE_SYSTEM").particle_system
    particles.seed = 11
    settings = particles.settings
    settings.type, settings.count, settings.hair_length = "HAIR", 7000, 1.0
    settings.render_type, settings.instance_object = "OBJECT", tuft
    settings.particle_size, settings.size_random = 0.75, 0.6
    settings.use_rotations, settings.rotation_mode, settings.phase_factor_random = True, "NOR", 2.0


def cabin() -> None:
    """A cabin with a jetty, the one made thing, to give the wood its scale."""
    house = bpy.data.objects.new("cabin", None)
    bpy.context.scene.collection.objects.link(house)
    house.location, house.rotation_euler = (12.3, 15.0, float(height(12.3, 15.0)) - 0.1), (0, 0, -0.42)
    parts = [place(box("gable", (0.2, 3.3, 2.7)), "#7a4f32", (2.3 * side, 0, 0)) for side in (-1, 1)]
    parts += [
        place(box("roof", (5.6, 2.9, 0.12)), "#a3432f", (0, side * 1.08, 3.05), (-38 * side, 0, 0)) for side in (-1, 1)
    ]
    for i in range(11):
        log = place(
            lathe("log", [(0, -2.5), (0.13, -2.5), (0.13, 2.5), (0, 2.5)], 12),
            "#8a5a38",
            (0, -1.7, 0.1 + 0.24 * i),
            (0, 90, 0),
        )
        parts.append(
            modify(
                log,
                "ARRAY",
                count=2,
                use_relative_offset=False,
                use_constant_offset=True,
                constant_offset_displace=(0, 3.4, 0),
            )
        )
    for name, size, colour, at in [
        ("chimney", (0.6, 0.6, 2.2), "#8f8880", (1.4, 0.5, 2.6)),
        ("door", (0.9, 0.1, 1.9), "#e8d8b0", (-1.2, -1.85, 0.1)),
        ("window", (1.0, 0.1, 0.8), "#f5e3a8", (0.9, -1.85, 1.0)),
        ("cross bar", (1.0, 0.14, 0.06), "#7a4f32", (0.9, -1.86, 1.37)),
        ("cross bar", (0.06, 0.14, 0.8), "#7a4f32", (0.9, -1.86, 1.0)),
    ]:
        parts.append(place(box(name, size), colour, at))
    for part in parts:
        part.parent = house
    jetty = place(box("board", (0.22, 1.7, 0.05)), "#9c7a55", (1.8, 16.2, WATER + 0.35))
    modify(
        jetty,
        "ARRAY",
        count=26,
        use_relative_offset=False,
        use_constant_offset=True,
        constant_offset_displace=(0.25, 0, 0),
    )
    for i in range(4):
        for side in (-0.8, 0.8):
            place(tube("post", [(2 + 1.8 * i, 16.2 + side, z) for z in (-1.5, 0, 0.9)], 0.08), "#6f553a")


def build() -> None:
    """Fills the current scene, which should be empty."""
    random = np.random.default_rng(2024)
    picture("#a9cbe8")
    u, v = np.meshgrid(np.linspace(-190, 190, 190), np.linspace(-20, 380, 200))
    ground = place(sheet("ground", np.stack([u, v, height(u, v)], axis=-1)), ["#7d8f4a", "#8f8c88", "#eef2f6"])
    middle = np.array([p.center[2] for p in ground.data.polygons])
    ground.data.polygons.foreach_set("material_index", ((middle > 34).astype(np.int32) + (middle > 52)))
    u, v = np.meshgrid(np.linspace(-60, 50, 160), np.linspace(5, 70, 240))
    waves = WATER + 0.02 * np.sin(2.6 * v + 1.5 * np.sin(0.5 * u)) + 0.012 * np.sin(4.1 * v + 1.3 * u)
    place(sheet("lake", np.stack([u, v, waves], axis=-1)), "#5f9cc0")
    trees(random)
    undergrowth(random)
    meadow()
    cabin()
    light("SUN", "#ffdcae", 3.5, (-60, -25, 42), (0, 20, 0), angle=0.02)
    camera((3, -9, 6.4), (1.5, 40, 3.6), 30)


if __name__ == "__main__":
    main(build)
