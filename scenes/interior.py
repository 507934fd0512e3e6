# SPDX-License-Identifier: GPL-3.0-or-later
"""A furnished room with every kind of light and many kinds of object: python scenes/interior.py OUT.blend

The room is 6.4 m wide (x), 7 m deep (y) and 2.8 m high; the windows are in the left wall, the camera looks along +y.
"""

from __future__ import annotations

from math import cos, pi, sin, tau

import bpy
import numpy as np
from kit import (
    Point,
    ball,
    box,
    camera,
    collection,
    instance,
    lathe,
    light,
    main,
    mesh,
    modify,
    picture,
    place,
    sheet,
    tube,
)

PLASTER, SAGE, OAK, WALNUT, BRASS, LINEN = "#eee6d8", "#8fa08a", "#c69c6d", "#7a5236", "#c9a14a", "#ddd0bb"
TERRACOTTA, NAVY, MUSTARD, LEAF, CHARCOAL, CREAM = "#c4694a", "#2f4a66", "#d9a441", "#5d8a3c", "#3b3a3c", "#f4ecdc"


def shell() -> None:
    """Floor of planks (Array and Bevel modifiers), walls, two windows with bars, skirting."""
    for i, tone in enumerate(["#b98b5e", "#c69a6b", "#a97c52"]):
        plank = place(box("plank", (0.157, 1.79, 0.03)), tone, (-3.2 + 0.16 * (i + 0.5), -3.4 - 0.6 * i, -0.03))
        modify(plank, "BEVEL", width=0.004, segments=2)
        modify(
            plank,
            "ARRAY",
            count=14,
            use_relative_offset=False,
            use_constant_offset=True,
            constant_offset_displace=(0.48, 0, 0),
        )
        modify(
            plank,
            "ARRAY",
            count=5,
            use_relative_offset=False,
            use_constant_offset=True,
            constant_offset_displace=(0, 1.8, 0),
        )
    place(box("under floor", (7, 8, 0.1)), WALNUT, (0, 0, -0.15))
    place(box("ceiling", (7, 8, 0.2)), PLASTER, (0, 0, 2.8))
    place(box("back wall", (6.8, 0.3, 2.8)), SAGE, (0, 3.65, 0))
    place(box("front wall", (6.8, 0.3, 2.8)), PLASTER, (0, -3.65, 0))
    place(box("right wall", (0.3, 7.4, 2.8)), PLASTER, (3.35, 0, 0))
    place(box("sill wall", (0.3, 7.4, 0.7)), PLASTER, (-3.35, 0, 0))
    place(box("lintel wall", (0.3, 7.4, 0.35)), PLASTER, (-3.35, 0, 2.45))
    for y, depth in [(-2.65, 1.9), (0.65, 0.5), (2.9, 1.6)]:  # what stands between the windows
        place(box("pier", (0.3, depth, 1.75)), PLASTER, (-3.35, y, 0.7))
    for y, depth in [(-0.65, 2.1), (1.5, 1.2)]:
        place(box("sill", (0.42, depth + 0.1, 0.04)), CREAM, (-3.27, y, 0.7))
        for z in (0.74, 1.55, 2.4):
            place(box("bar", (0.05, depth, 0.05)), CREAM, (-3.3, y, z))
        for i in range(5 if depth > 2 else 4):
            step = depth / (4 if depth > 2 else 3)
            place(box("bar", (0.05, 0.05, 1.75)), CREAM, (-3.3, y - depth / 2 + step * i, 0.7))
    for at, size in [
        ((0, 3.48, 0), (6.4, 0.04, 0.14)),
        ((3.18, 0, 0), (0.04, 7, 0.14)),
        ((-3.18, 0, 0), (0.04, 7, 0.14)),
    ]:
        modify(place(box("skirting", size), CREAM, at), "BEVEL", width=0.012, segments=2)


def curtains() -> None:
    """A folded curtain with Solidify, and its mirror copies by negative scale."""
    u, v = np.meshgrid(np.linspace(0, 1, 121), np.linspace(0, 1, 25))
    fold = 0.05 * np.sin(u * tau * 7 + 0.6 * np.sin(v * 3)) * (0.55 + 0.45 * v)
    cloth = sheet("curtain", np.stack([fold, 0.5 * (u - 0.5) * (1 - 0.18 * np.sin(pi * v)), -2.35 * v], axis=-1))
    for y, side in [(-1.95, 1), (0.55, -1), (2.35, -1)]:
        curtain = place(cloth, TERRACOTTA, (-3.06, y, 2.55), scale=(1, side, 1))
        modify(curtain, "SOLIDIFY", thickness=0.006)
    place(tube("rod", [(-3.06, -2.4, 2.56), (-3.06, 0, 2.56), (-3.06, 2.8, 2.56)], 0.014), BRASS)


def cushion(
    name: str, size: tuple[float, float, float], colour: str, at: Point, turn: Point = (0, 0, 0)
) -> bpy.types.Object:
    """A soft block: Bevel, then Subdivision Surface."""
    block = place(box(name, size), colour, at, turn)
    modify(block, "BEVEL", width=min(size) * 0.3, segments=2)
    modify(block, "SUBSURF", levels=2, render_levels=2)
    block.data.shade_smooth()
    return block


def seats() -> None:
    """A sofa before the back wall; an armchair on the left, mirrored by negative scale on the right; a pouf."""
    cushion("sofa base", (2.1, 0.9, 0.22), NAVY, (0.5, 2.75, 0.16))
    cushion("sofa back", (2.1, 0.24, 0.62), NAVY, (0.5, 3.16, 0.28))
    for x in (-0.62, 1.62):
        cushion("sofa arm", (0.22, 0.9, 0.5), NAVY, (x, 2.75, 0.14))
    for x in (-0.02, 1.02):
        cushion("seat", (1.02, 0.78, 0.2), "#38587a", (x, 2.68, 0.36))
    for x, tilt, colour in [(-0.28, 14, MUSTARD), (0.14, -10, CREAM), (1.3, -14, TERRACOTTA)]:
        cushion("pillow", (0.46, 0.16, 0.44), colour, (x, 2.9, 0.54), (-20, tilt, 0))
    for x in (-0.45, 1.45):
        for y in (2.4, 3.1):
            place(lathe("foot", [(0, 0), (0.018, 0), (0.03, 0.17), (0, 0.17)], 16), WALNUT, (x, y, 0))

    parts = [
        cushion("chair seat", (0.66, 0.66, 0.2), MUSTARD, (0, 0, 0.27)),
        cushion("chair back", (0.66, 0.18, 0.66), MUSTARD, (0, 0.3, 0.36), (-12, 0, 0)),
    ]
    hoop = [(-0.34, 0), (-0.36, 0.42), (-0.2, 0.58), (0.3, 0.55), (0.45, 0)]
    parts += [place(tube("arm", [(x, y, z) for y, z in hoop], 0.022), OAK) for x in (-0.36, 0.36)]
    parts.append(cushion("bolster", (0.5, 0.14, 0.3), CREAM, (0.05, 0.12, 0.48), (-18, 12, 0)))
    for at, turn, scale in [((-1.95, 1.1, 0), (0, 0, 58), (1, 1, 1)), ((2.25, 1.15, 0), (0, 0, -58), (-1, 1, 1))]:
        frame = bpy.data.objects.new("armchair", None)
        bpy.context.scene.collection.objects.link(frame)
        frame.location, frame.rotation_euler, frame.scale = at, [0, 0, turn[2] * pi / 180], scale
        for part in parts:
            one = part if part.parent is None else part.copy()
            if one is not part:
                bpy.context.scene.collection.objects.link(one)
            one.parent = frame

    angle, height = np.meshgrid(
        np.linspace(0, tau, 240, endpoint=False), np.linspace(-pi / 2 + 0.05, pi / 2 - 0.05, 24)
    )
    radius = 0.3 * np.cos(height) ** 0.45 * (1 + 0.035 * np.cos(24 * angle))
    pouf = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.2 + 0.2 * np.sin(height)], axis=-1)
    place(sheet("pouf", pouf, closed_columns=True), TERRACOTTA, (-1.0, -0.55, 0))


def rug_and_table() -> None:
    """A round rug of coloured rings (material slots), a table with a metaball, a NURBS bowl and cups (Screw)."""
    angle = np.linspace(0, tau, 129)[:-1]
    radii = np.linspace(0.02, 1.65, 57)
    ring = np.stack(
        [
            np.outer(radii, np.cos(angle)),
            np.outer(radii, np.sin(angle)),
            np.outer(0.012 + 0.004 * np.sin(radii * 120), np.ones(128)),
        ],
        axis=-1,
    )
    rug = sheet("rug", ring, closed_columns=True)
    tones = [CREAM, TERRACOTTA, CREAM, NAVY, LINEN, MUSTARD, LINEN]
    place(rug, tones, (0.25, 0.95, 0))
    rug.polygons.foreach_set("material_index", np.repeat(np.arange(56) // 8, 128).astype(np.int32))

    top = [(0, 0.40), (0.52, 0.40), (0.55, 0.415), (0.55, 0.43), (0.54, 0.44), (0, 0.44)]
    place(lathe("table top", top, 96), OAK, (0.25, 0.9, 0))
    for i in range(3):
        a = tau * i / 3 + 0.3
        place(
            tube(
                "table leg",
                [
                    (0.25 + r * cos(a + t), 0.9 + r * sin(a + t), z)
                    for r, t, z in [(0.44, -0.2, 0.4), (0.5, 0, 0.012), (0.44, 0.2, 0.4)]
                ],
                0.011,
            ),
            CHARCOAL,
        )

    pebble = bpy.data.metaballs.new("pebble")
    pebble.resolution = pebble.render_resolution = 0.018
    for x, y, z, r in [
        (0, 0, 0, 0.11),
        (0.06, 0.01, 0.07, 0.085),
        (0.0, 0.0, 0.14, 0.08),
        (-0.05, 0.0, 0.2, 0.07),
        (0.01, 0, 0.27, 0.075),
    ]:
        element = pebble.elements.new()
        element.co, element.radius = (x, y, z), r
    place(pebble, CREAM, (-0.02, 1.12, 0.49))

    bowl = bpy.data.curves.new("bowl", "SURFACE")
    rows = [
        (0.02, 0.0),
        (0.08, 0.0),
        (0.16, 0.03),
        (0.2, 0.1),
        (0.195, 0.105),
        (0.15, 0.04),
        (0.08, 0.015),
        (0.02, 0.012),
    ]
    corner = [
        (1, 0, 1),
        (1, 1, 0.7071),
        (0, 1, 1),
        (-1, 1, 0.7071),
        (-1, 0, 1),
        (-1, -1, 0.7071),
        (0, -1, 1),
        (1, -1, 0.7071),
    ]
    for radius, z in rows:
        spline = bowl.splines.new("NURBS")
        spline.points.add(len(corner) - 1)
        for knot, (x, y, weight) in zip(spline.points, corner, strict=True):
            knot.co = (radius * x, radius * y, z, weight)
            knot.select = True
    thing = place(bowl, NAVY, (0.5, 0.72, 0.441))
    skin_surface(thing)
    for i, (x, y, z) in enumerate(
        [(0, 0, 0.075), (0.09, 0.03, 0.085), (-0.05, 0.08, 0.085), (-0.04, -0.08, 0.085), (0.02, 0.0, 0.15)]
    ):
        place(ball("fruit", 0.048), ["#d98a2b", "#d9742b"][i % 2], (0.5 + x, 0.72 + y, 0.441 + z))

    cup = bpy.data.meshes.new("cup")
    outline = [
        (0.001, 0.005),
        (0.025, 0.0),
        (0.032, 0.012),
        (0.042, 0.07),
        (0.039, 0.07),
        (0.028, 0.015),
        (0.001, 0.012),
    ]
    cup.from_pydata([(r, 0, z) for r, z in outline], [(i, i + 1) for i in range(6)], [])
    for x, y in [(0.02, 0.62), (0.32, 1.22)]:
        modify(
            place(cup, CREAM, (x, y, 0.44)),
            "SCREW",
            steps=40,
            render_steps=40,
            use_smooth_shade=True,
            use_merge_vertices=True,
        )


def skin_surface(thing: bpy.types.Object) -> None:
    """Joins the rows of a new surface into one patch, which only the edit operator can do."""
    bpy.context.view_layer.objects.active = thing
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.curve.make_segment()
    bpy.ops.object.mode_set(mode="OBJECT")
    for spline in thing.data.splines:
        spline.use_cyclic_v = spline.use_cyclic_u = False
        spline.resolution_u = spline.resolution_v = 6


def shelves() -> None:
    """A bookcase on the right wall, each shelf an instance of one collection of books."""
    books = collection("books")
    random = np.random.default_rng(7)
    y = 0.0
    for i in range(15):
        thick, tall = 0.028 + 0.03 * random.random(), 0.2 + 0.09 * random.random()
        colour = [TERRACOTTA, NAVY, CREAM, MUSTARD, SAGE, CHARCOAL, "#8c3b3b"][int(random.integers(7))]
        book = place(box("book", (0.2, thick, tall)), colour, (0, y + thick / 2, 0), into=books)
        modify(book, "BEVEL", width=0.004, segments=2)
        y += thick + 0.003 + (0.05 if i == 9 else 0)
    for y0 in (-0.55, 0.4, 1.35):
        modify(place(box("upright", (0.3, 0.035, 2.2)), OAK, (3.03, y0, 0)), "BEVEL", width=0.006, segments=2)
    for row in range(6):
        z = 0.08 + row * 0.42
        modify(place(box("shelf", (0.3, 1.93, 0.03)), OAK, (3.03, 0.4, z)), "BEVEL", width=0.006, segments=2)
        if row < 5:
            instance(books, (3.05, -0.5 + 0.05 * (row % 2), z + 0.03))
            instance(books, (3.05, 1.3 - 0.04 * (row % 3), z + 0.03), scale=(1, -1, 1))


def espalier() -> None:
    """The plant of the name: arms trained along wires, leaves by geometry nodes, fruit by a particle system."""
    x0, y0 = -2.15, 3.2
    place(box("planter", (1.0, 0.34, 0.36)), CHARCOAL, (x0, y0, 0))
    place(box("soil", (0.94, 0.28, 0.01)), "#4a3524", (x0, y0, 0.355))
    tiers = (0.85, 1.25, 1.65, 2.05)
    for z in tiers:
        place(tube("wire", [(x0 - 0.85, 3.42, z), (x0, 3.42, z), (x0 + 0.85, 3.42, z)], 0.004, resolution=1), CHARCOAL)
    bark = "#6b4a32"
    place(
        tube(
            "trunk",
            [(x0, y0, 0.35), (x0 + 0.02, 3.3, 0.8), (x0 - 0.01, 3.38, 1.4), (x0, 3.38, 2.08)],
            0.03,
            radii=[1.3, 1, 0.8, 0.4],
        ),
        bark,
    )
    twigs: list[np.ndarray] = []
    random = np.random.default_rng(3)
    for z in tiers:
        for side in (-1, 1):
            along = [
                (x0 + side * 0.75 * t, 3.38, z - 0.12 * (1 - min(1, 3 * t)) ** 2 + 0.01 * sin(9 * t))
                for t in np.linspace(0, 1, 6)
            ]
            place(tube("arm", along, 0.018, radii=[1, 0.9, 0.8, 0.65, 0.5, 0.3]), bark)
            spread = random.normal(0, 1, (75, 2)) * (0.035, 0.06) + (3.36, z)
            twigs.append(np.column_stack([x0 + side * 0.75 * random.uniform(0.06, 1.03, 75), spread]))

    u, v = np.meshgrid(np.linspace(-1, 1, 3), np.linspace(0, 1, 8))
    outline = np.sin(pi * v**0.8) * 0.024
    leaf = place(
        sheet("leaf", np.stack([u * outline, 0.09 * v, 0.012 * np.abs(u) + 0.03 * v * (1 - v)], axis=-1)),
        LEAF,
        into=collection("leaf"),
    )
    crown = place(mesh("crown", np.concatenate(twigs), []), LEAF)
    modify(crown, "NODES", node_group=scatter(leaf))

    fruit = place(ball("pear", 0.034, 16), "#d7c14a", into=collection("pear"))
    bough = mesh(
        "fruiting wood",
        np.array(
            [(x0 + dx, 3.33, z + dz) for z in tiers for dx, dz in [(-0.7, 0), (0.7, 0), (0.7, 0.02), (-0.7, 0.02)]]
        ),
        [(4 * i, 4 * i + 1, 4 * i + 2, 4 * i + 3) for i in range(4)],
    )
    wood = place(bough, bark)
    wood.show_instancer_for_viewport = wood.show_instancer_for_render = False
    particles = wood.modifiers.new("fruit", "PARTICLE_SYSTEM").particle_system
    particles.seed = 5
    settings = particles.settings
    settings.type, settings.count, settings.hair_length = "HAIR", 26, 1.0
    settings.render_type, settings.instance_object = "OBJECT", fruit
    settings.particle_size, settings.size_random = 1.0, 0.25


def scatter(thing: bpy.types.Object) -> bpy.types.NodeTree:
    """A geometry-nodes group that sets copies of an object, randomly turned, on the points of what it modifies."""
    group = bpy.data.node_groups.new("scatter", "GeometryNodeTree")
    group.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    group.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    nodes = {
        kind: group.nodes.new(kind)
        for kind in (
            "NodeGroupInput",
            "NodeGroupOutput",
            "GeometryNodeInstanceOnPoints",
            "GeometryNodeObjectInfo",
            "FunctionNodeRandomValue",
        )
    }
    nodes["GeometryNodeObjectInfo"].inputs["Object"].default_value = thing
    turn = nodes["FunctionNodeRandomValue"]
    turn.data_type = "FLOAT_VECTOR"
    turn.inputs[0].default_value, turn.inputs[1].default_value = (-0.4, -0.9, 0), (1.2, 0.9, tau)
    on_points = nodes["GeometryNodeInstanceOnPoints"]
    group.links.new(nodes["NodeGroupInput"].outputs[0], on_points.inputs["Points"])
    group.links.new(nodes["GeometryNodeObjectInfo"].outputs["Geometry"], on_points.inputs["Instance"])
    group.links.new(turn.outputs[0], on_points.inputs["Rotation"])
    group.links.new(on_points.outputs[0], nodes["NodeGroupOutput"].inputs[0])
    return group


def lamps() -> None:
    """A pendant (Wireframe modifier) and a standing lamp, each with its point light; spots; sun and sky."""
    ring = ball("pendant", 0.24, 14)
    pendant = place(ring, BRASS, (0.25, 0.9, 1.98))
    modify(pendant, "WIREFRAME", thickness=0.012)
    place(tube("cord", [(0.25, 0.9, 2.8), (0.25, 0.9, 2.5), (0.25, 0.9, 2.22)], 0.006), CHARCOAL)
    light("POINT", "#ffd9a0", 55, (0.25, 0.9, 1.98), shadow_soft_size=0.05)

    x, y = 2.3, 2.85
    place(lathe("lamp foot", [(0, 0), (0.16, 0), (0.16, 0.015), (0.03, 0.03), (0, 0.03)], 48), BRASS, (x, y, 0))
    place(tube("lamp stem", [(x, y, 0.02), (x, y, 0.8), (x, y, 1.5)], 0.011), BRASS)
    place(lathe("shade", [(0.23, 1.38), (0.14, 1.72), (0.135, 1.72), (0.225, 1.38)], 64), CREAM, (x, y, 0))
    light("POINT", "#ffcf8f", 40, (x, y, 1.56), shadow_soft_size=0.06)

    text = bpy.data.curves.new("lettering", "FONT")
    text.body, text.size, text.extrude, text.bevel_depth, text.align_x = "espalier", 0.36, 0.015, 0.004, "CENTER"
    place(text, CREAM, (0.55, 3.47, 1.5), (90, 0, 0))
    light(
        "SPOT", "#ffe3b8", 90, (0.55, 1.9, 2.7), (0.55, 3.5, 1.6), spot_size=1.25, spot_blend=0.6, shadow_soft_size=0.04
    )
    light(
        "SPOT",
        "#fff0d8",
        110,
        (-1.9, 1.7, 2.7),
        (-2.15, 3.4, 1.3),
        spot_size=1.1,
        spot_blend=0.8,
        shadow_soft_size=0.06,
    )

    light("SUN", "#fff0d2", 7.0, (-6, -2.6, 4.1), (0, 0.9, 0), angle=0.01)
    for y, depth in [(-0.65, 2.0), (1.5, 1.1)]:  # the sky seen through each window
        light("AREA", "#cfe2ff", 45 * depth, (-3.15, y, 1.6), (0, y, 1.2), shape="RECTANGLE", size=1.6, size_y=depth)
    light("AREA", "#ffe9cf", 38, (0.3, 0.2, 2.75), (0.3, 0.2, 0), shape="RECTANGLE", size=3.5, size_y=3.5)
    light("AREA", "#fff1e0", 42, (0.4, -3.3, 1.7), (0.2, 3, 1.2), shape="DISK", size=2.2)
    # What the floor would throw back on ceiling and undersides, since only direct light is traced.
    light("SUN", "#ffe0bd", 0.5, (0, 0, -1), (0, 0, 0), use_shadow=False)


def build() -> None:
    """Fills the current scene, which should be empty."""
    picture("#bcd3ea")
    shell()
    curtains()
    seats()
    rug_and_table()
    shelves()
    espalier()
    lamps()
    camera((0.75, -3.2, 1.45), (-0.05, 2.2, 1.02), 23)


if __name__ == "__main__":
    main(build)
