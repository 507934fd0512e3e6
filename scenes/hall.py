# SPDX-License-Identifier: GPL-3.0-or-later
"""The teapot in the stadium, 0.2 m of fine detail in 220 m, under the sky: python scenes/hall.py OUT.blend

Most of the triangles lie in less than a millionth of the scene's volume, which is what a kd-tree has to find out.
There is no lamp in the scene, so the tracer's soft sky lights it.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from kit import ball, box, camera, collection, instance, lathe, main, picture, place, sheet, tube

TABLE = 1.1  # height of the drum on which the teapot stands
CHINA, GLAZE, GOLD = "#f2ece0", "#2f5f8f", "#d3a84c"


def turned(profile: np.ndarray, flutes: int, depth: np.ndarray, around: int) -> np.ndarray:
    """Points [rows, around, 3] of a profile of (radius, height) rows turned about z, with flutes of depth [rows]."""
    a = np.linspace(0, 2 * np.pi, around, endpoint=False)[None, :]
    radius = profile[:, :1] * (1 + depth[:, None] * (np.abs(np.cos(flutes / 2 * a)) - 0.6))
    return np.stack([radius * np.cos(a), radius * np.sin(a), np.broadcast_to(profile[:, 1:], radius.shape)], axis=-1)


def swept(path: np.ndarray, radius: np.ndarray, along: int, around: int, flat: float = 1.0) -> np.ndarray:
    """Points [along, around, 3] of a tube along a path in the xz plane; flat widens it along y."""
    knots = np.linspace(0, 1, len(path))
    degree = len(path) - 1
    t = np.linspace(0, 1, along)
    spine = np.stack([np.polyval(np.polyfit(knots, path[:, i], degree), t) for i in range(2)], axis=-1)
    thick = np.interp(t, knots, radius)
    tangent = np.gradient(spine, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    a = np.linspace(0, 2 * np.pi, around, endpoint=False)[None, :]
    out, side = thick[:, None] * np.cos(a), flat * thick[:, None] * np.sin(a)
    return np.stack([spine[:, :1] - out * tangent[:, 1:], side, spine[:, 1:] + out * tangent[:, :1]], axis=-1)


def rope(radius: float, height: float, thick: float, turns: int) -> np.ndarray:
    """Points [600, 20, 3] of a twisted cord laid round the z axis."""
    a = np.linspace(0, 2 * np.pi, 600, endpoint=False)[:, None]
    b = np.linspace(0, 2 * np.pi, 20, endpoint=False)[None, :]
    r = thick * (0.75 + 0.25 * np.abs(np.cos(b + turns * a / 2)))
    return np.stack(
        [(radius + r * np.cos(b)) * np.cos(a), (radius + r * np.cos(b)) * np.sin(a), height + r * np.sin(b)], axis=-1
    )


def teapot() -> None:
    """A fluted teapot 0.2 m high with lid, spout, handle and cord mouldings, and a cup on its saucer.

    They are one collection, drawn once, on the drum.
    """
    tea = collection("tea set")
    put = partial(place, into=tea)
    up = np.linspace(0, 1, 150)
    bulge = np.sin(np.pi * (0.16 + 0.70 * up)) ** 0.75
    body = np.stack([0.102 * bulge, 0.018 + 0.122 * up], axis=-1)
    put(sheet("body", turned(body, 28, 0.11 * np.sin(np.pi * up) ** 0.6, 504), closed_columns=True), CHINA)
    put(lathe("foot", [(0, 0), (0.062, 0), (0.064, 0.004), (0.056, 0.009), (0.052, 0.02), (0, 0.02)], 160), GLAZE)
    put(sheet("foot cord", rope(0.0525, 0.018, 0.0042, 72), closed_rows=True, closed_columns=True), GOLD)
    put(sheet("rim cord", rope(0.046, 0.1405, 0.0046, 64), closed_rows=True, closed_columns=True), GOLD)
    rise = np.linspace(0, 1, 60)
    lid = np.stack(
        [0.045 * np.cos(rise * np.pi / 2) ** 0.7 + 0.0005, 0.141 + 0.026 * np.sin(rise * np.pi / 2)], axis=-1
    )
    put(sheet("lid", turned(lid, 28, 0.08 * (1 - rise), 336), closed_columns=True), CHINA)
    knob = np.stack([0.0135 * np.sin(np.pi * (0.08 + 0.9 * rise)) ** 0.8, 0.164 + 0.027 * rise], axis=-1)
    put(sheet("knob", turned(knob, 10, 0.3 * np.sin(np.pi * rise), 120), closed_columns=True), GOLD)
    spout = np.array([(0.078, 0.052), (0.118, 0.066), (0.138, 0.106), (0.156, 0.137), (0.176, 0.146)])
    put(
        sheet("spout", swept(spout, np.array([0.029, 0.0215, 0.0145, 0.011, 0.0105]), 130, 96), closed_columns=True),
        CHINA,
    )
    handle = np.array([(-0.082, 0.118), (-0.125, 0.137), (-0.157, 0.108), (-0.140, 0.064), (-0.088, 0.046)])
    put(
        sheet(
            "handle",
            swept(handle, np.array([0.0095, 0.0085, 0.008, 0.0085, 0.0095]), 130, 48, 1.35),
            closed_columns=True,
        ),
        GLAZE,
    )

    x, y = 0.165, -0.17
    cup = [
        (0, 0.006),
        (0.021, 0.006),
        (0.023, 0.009),
        (0.034, 0.025),
        (0.041, 0.052),
        (0.0395, 0.052),
        (0.032, 0.026),
        (0.02, 0.012),
        (0, 0.011),
    ]
    put(lathe("cup", cup, 160, 80), GLAZE, (x, y, 0.004))
    put(lathe("tea", [(0, 0.043), (0.0365, 0.043)], 96), "#8a4b22", (x, y, 0.004))
    put(
        lathe("saucer", [(0, 0), (0.04, 0), (0.072, 0.011), (0.0715, 0.0125), (0.04, 0.006), (0, 0.006)], 192, 60),
        CHINA,
        (x, y, 0),
    )
    put(sheet("saucer cord", rope(0.071, 0.0115, 0.0022, 96), closed_rows=True, closed_columns=True), GOLD, (x, y, 0))
    ear = np.array([(0.036, 0.042), (0.058, 0.046), (0.060, 0.024), (0.030, 0.018)])
    put(
        sheet("ear", swept(ear, np.array([0.004, 0.0035, 0.0035, 0.004]), 48, 24), closed_columns=True),
        GLAZE,
        (x, y, 0.004),
        (0, 0, -50),
    )
    put(ball("sugar", 0.009, 12), "#fbf8f0", (x + 0.062, y + 0.01, 0.02))
    instance(tea, (0, 0, TABLE), (0, 0, -64))


def squared(v: np.ndarray) -> np.ndarray:
    """Bends a cosine or sine so that the circle it belongs to turns into a rounded rectangle."""
    bent: np.ndarray = np.sign(v) * np.abs(v) ** 0.7
    return bent


def oval(offset: np.ndarray, segments: int) -> tuple[np.ndarray, np.ndarray]:
    """X and y [len(offset), segments] of the stadium's rounded outline, offset metres outside the field."""
    a = np.linspace(0, 2 * np.pi, segments, endpoint=False)[None, :]
    return (62 + offset[:, None]) * squared(np.cos(a)), (44 + offset[:, None]) * squared(np.sin(a))


def stadium() -> None:
    """The field with its lines, two stands of stepped rows in coloured blocks, the roof on its columns, flags."""
    segments = 384
    place(box("plaza", (320, 280, 1.0)), "#b9b4a8", (0, 0, -1.05))
    for i in range(13):
        place(box("turf", (8.0, 68, 0.05)), ["#7aa862", "#8ab870"][i % 2], (8.0 * (i - 6), 0, -0.05))
    white = "#f4f4ee"
    thin = 0.12
    lines = [(0.0, 0.0, thin, 68.0), (0, 34, 104, thin), (0, -34, 104, thin)]
    for side in (-1, 1):
        for across, off, wide, deep in [(52, 0, thin, 68), (35.5, 0, thin, 40.3), (43.75, 20.15, 16.5, thin)]:
            lines += [(side * across, side * off, wide, deep), (side * across, -side * off, wide, deep)][
                : 2 if off else 1
            ]
        place(
            tube(
                "goal",
                [(side * 52, -3.66, 0), (side * 52, -3.66, 2.44), (side * 52, 3.66, 2.44), (side * 52, 3.66, 0)],
                0.06,
            ),
            white,
        )
    for across, off, wide, deep in lines:
        place(box("line", (wide, deep, 0.004)), white, (across, off, 0))
    place(lathe("centre circle", [(9.09, 0.004), (9.21, 0.004)], 160), white)

    for name, first, rows, base, step, lift in [
        ("lower stand", 4.0, 26, 1.2, 0.85, 0.34),
        ("upper stand", 27.0, 20, 11.5, 0.85, 0.48),
    ]:
        row = np.arange(rows)
        offset = np.repeat(np.append(first + step * row, first + step * rows), 2)[:-1]
        level = np.append(0.0 if base < 5 else base - 2.5, np.repeat(base + lift * row, 2))
        x, y = oval(offset, segments)
        steps = sheet(
            name, np.stack([x, y, np.broadcast_to(level[:, None], x.shape)], axis=-1), closed_columns=True, smooth=False
        )
        place(
            steps, ["#d6d2c8", "#3a6ea5", "#c8553a", "#efe9da", "#e0b04a", "#315f90", "#b0462e", "#d9d2c0", "#c99935"]
        )
        # Aisles every eighth segment; the blocks between them in colours, every other row a shade darker.
        block = np.arange(segments) // 8
        colour = np.where(np.arange(segments) % 8 == 7, 0, np.array([1, 2, 3, 1, 4, 3])[block % 6])
        darker = (np.arange(len(level) - 1) // 2 % 2)[:, None]
        slot = np.where(colour > 0, colour + 4 * darker, 0)
        slot[0] = 0
        steps.polygons.foreach_set("material_index", slot.ravel().astype(np.int32))

    outline, level = (
        np.array([46.0, 46.0, 37.0, 36.9, 46.4, 47.5, 47.5]),
        np.array([0.0, 27.0, 28.6, 29.1, 27.9, 27.6, 0.0]),
    )
    x, y = oval(outline, segments)
    place(
        sheet(
            "wall and roof",
            np.stack([x, y, np.broadcast_to(level[:, None], x.shape)], axis=-1),
            closed_columns=True,
            smooth=False,
        ),
        "#dedbd2",
    )
    x, y = oval(np.array([45.2]), 48)
    for i in range(48):
        place(lathe("column", [(0.7, 21), (0.5, 22), (0.42, 26), (0.7, 27.4)], 16), "#efece4", (x[0, i], y[0, i], 0))
    x, y = oval(np.array([37.4]), 36)
    for i in range(36):
        place(tube("pole", [(x[0, i], y[0, i], z) for z in (28, 31, 35)], 0.12, resolution=1), "#8d8f92")
        u, v = np.meshgrid(np.linspace(0, 1, 16), np.linspace(0, 1, 6))
        flag = np.stack([3.4 * u, 0.35 * u * np.sin(7 * u + i), 1.9 * v], axis=-1)
        place(sheet("flag", flag), ["#27476f", "#b5482f", "#d8a53f"][i % 3], (x[0, i], y[0, i], 33), (0, 0, 25))


def build() -> None:
    """Fills the current scene, which should be empty."""
    picture("#dceafb")
    stadium()
    drum = [
        (0, 0),
        (0.46, 0),
        (0.46, 0.06),
        (0.4, 0.1),
        (0.36, 0.16),
        (0.34, 0.9),
        (0.37, 0.98),
        (0.42, 1.0),
        (0.42, 1.08),
        (0.4, 1.095),
        (0.385, 1.1),
        (0, 1.1),
    ]
    place(lathe("drum", drum, 128, 10), "#e0d3bd")
    teapot()
    camera((-0.473, -0.619, TABLE + 0.13), (0.019, -0.023, TABLE + 0.143), 25)


if __name__ == "__main__":
    main(build)
