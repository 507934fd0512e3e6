# SPDX-License-Identifier: GPL-3.0-or-later
"""A fluted, twisted knot of about a million triangles under one key light: python scenes/sculpture.py OUT.blend

The cage is a grid around a trefoil; Subdivision Surface makes the million, as a sculptor's multiresolution model would.
"""

from __future__ import annotations

import numpy as np
from kit import camera, lathe, light, main, modify, picture, place, sheet

ALONG, AROUND = 896, 144  # faces of the cage; one subdivision step makes 4 quads, so 8 triangles, of each


def knot(along: int, around: int) -> np.ndarray:
    """Points [along, around, 3] of a tube about a trefoil knot: seven turning flutes with fine rings."""
    t = np.linspace(0, 2 * np.pi, along, endpoint=False)[:, None]
    spine = np.concatenate(
        [np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -1.15 * np.sin(3 * t)], axis=1
    )
    tangent = np.roll(spine, -1, axis=0) - np.roll(spine, 1, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    # The knot lies around the z axis, so "away from the axis" gives a frame that closes on itself.
    across = np.cross(tangent, np.concatenate([np.zeros((along, 2)), np.ones((along, 1))], axis=1))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    up = np.cross(across, tangent)
    a = np.linspace(0, 2 * np.pi, around, endpoint=False)[None, :]
    flute = np.abs(np.cos(3.5 * (a + 2 * t))) ** 0.7
    swell = 0.66 + 0.13 * np.cos(3 * t)
    chased = (
        0.022 * np.cos(112 * t) * np.cos(7 * (a + 2 * t)) ** 2
    )  # fine rings, strongest on the crests and in the grooves
    radius = swell * (0.7 + 0.3 * flute) + chased
    points: np.ndarray = spine[:, None, :] + radius[..., None] * (
        np.cos(a)[..., None] * across[:, None, :] + np.sin(a)[..., None] * up[:, None, :]
    )
    return points


def build() -> None:
    """Fills the current scene, which should be empty."""
    picture("#15171c")
    statue = place(
        sheet("knot", knot(ALONG, AROUND) * 0.3, closed_rows=True, closed_columns=True),
        "#e9dcc6",
        (0, 0, 1.98),
        (90, 0, 14),
    )
    modify(statue, "SUBSURF", levels=1, render_levels=1)

    plinth = [
        (0, 0),
        (0.8, 0),
        (0.8, 0.06),
        (0.74, 0.09),
        (0.7, 0.12),
        (0.62, 0.16),
        (0.6, 0.2),
        (0.6, 0.84),
        (0.63, 0.88),
        (0.7, 0.92),
        (0.74, 0.95),
        (0.74, 1.0),
        (0, 1.0),
    ]
    place(lathe("plinth", plinth, 128), "#3d4046", (0, 0, 0))
    # A studio backdrop: the floor bends up into the wall.
    bend = np.linspace(0, np.pi / 2, 24)
    y = np.concatenate([[-9.0], 2.5 + 2.5 * np.sin(bend), [5.0]])
    z = np.concatenate([[0.0], 2.5 - 2.5 * np.cos(bend), [9.0]])
    x = np.linspace(-12, 12, 9)
    place(
        sheet("backdrop", np.stack([np.tile(x, (len(y), 1)), np.tile(y[:, None], 9), np.tile(z[:, None], 9)], axis=-1)),
        "#5a6672",
    )

    light("AREA", "#ffe6c8", 760, (-4.2, -2.6, 5.0), (0, 0, 1.9), shape="DISK", size=1.0)  # the key
    light(
        "AREA", "#8fb4ff", 300, (5.5, -9.0, 3.4), (0, 0, 1.7), shape="RECTANGLE", size=4, size_y=4
    )  # what the room would throw back
    light(
        "SPOT", "#ffae70", 900, (2.4, 2.0, 4.2), (0, 0, 1.9), spot_size=0.75, spot_blend=0.6, shadow_soft_size=0.3
    )  # a rim
    camera((0.3, -7.2, 1.95), (0, 0, 1.62), 58)


if __name__ == "__main__":
    main(build)
