# SPDX-License-Identifier: GPL-3.0-or-later
"""The timings of the last run as bars in the 3D viewport.

What to draw and where is a pure function; drawing it is thin.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import bpy

from . import report
from .session import newest_report

Color = tuple[float, float, float, float]

PANEL: Color = (0.05, 0.05, 0.05, 0.72)
TEXT: Color = (0.92, 0.92, 0.92, 1.0)
FAINT: Color = (0.65, 0.65, 0.65, 1.0)
SERIAL: Color = (0.55, 0.55, 0.55, 1.0)
BAR: Color = (0.36, 0.66, 0.33, 1.0)

# Unscaled pixels.
MARGIN = 20.0
PADDING = 10.0
ROW = 20.0
FONT = 12.0
GAP = 8.0
BAR_WIDTH = 180.0


@dataclass(frozen=True)
class Box:
    """A filled rectangle in region pixels."""

    x: float
    y: float
    width: float
    height: float
    color: Color


@dataclass(frozen=True)
class Label:
    """A text whose baseline begins at x, y."""

    x: float
    y: float
    text: str
    size: float
    color: Color


def rows_of(last: report.Report) -> list[tuple[str, float, str]]:
    """Label, milliseconds and note of each bar: builds by thread count where they were compared, else the phases."""
    return report.thread_lines(last) or [(name, ms, f"{ms:,.1f} ms") for name, ms in report.phase_lines(last)]


def layout(
    last: report.Report, left: float, width: float, scale: float, text_width: Callable[[str, float], float]
) -> list[Box | Label]:
    """Boxes and labels for the lower left corner of a region.

    left: pixels taken by a toolbar; width: pixels up to the region's end or the sidebar; scale: the interface's scale;
    text_width(text, size) in pixels. Nothing where the region is too narrow for it.
    """
    rows = rows_of(last)
    margin, padding, row_height, font, gap = (scale * value for value in (MARGIN, PADDING, ROW, FONT, GAP))
    label_width = max(text_width(label, font) for label, _, _ in rows)
    note_width = max(text_width(note, font) for _, _, note in rows)
    bar_width = scale * BAR_WIDTH
    room = width - left - 2.0 * margin - 2.0 * padding
    bar_width = min(bar_width, room - label_width - note_width - 2.0 * gap)
    if bar_width < scale * GAP:
        return []
    inner = label_width + gap + bar_width + gap + note_width
    titles = (f"Espalier: {report.headline(last)}", f"Espalier: {last['triangles']:,} triangles", "Espalier")
    title = next((text for text in titles if text_width(text, font) <= room), "")
    inner = max(inner, text_width(title, font))
    longest = max(ms for _, ms, _ in rows) or 1.0
    x0, y0 = left + margin, margin
    x = x0 + padding
    top = y0 + padding + len(rows) * row_height
    items: list[Box | Label] = [
        Box(x0, y0, inner + 2.0 * padding, (len(rows) + 1) * row_height + 2.0 * padding, PANEL),
        Label(x, top + 0.3 * row_height, title, font, TEXT),
    ]
    for index, (label, ms, note) in enumerate(rows):
        y = top - (index + 1) * row_height
        bar_x = x + label_width + gap
        color = SERIAL if last.get("serial") and index == 0 else BAR
        items += [
            Label(x, y + 0.3 * row_height, label, font, TEXT),
            Box(bar_x, y + 0.15 * row_height, max(1.0, bar_width * ms / longest), 0.7 * row_height, color),
            Label(bar_x + bar_width + gap, y + 0.3 * row_height, note, font, FAINT),
        ]
    return items


class _Handler:
    """Blender's handle of the draw callback; there is none while the overlay is off."""

    handle: Any = None


def is_on() -> bool:
    """Whether the viewports show the timings."""
    return _Handler.handle is not None


def switch(on: bool) -> None:
    """Show the timings in every 3D viewport, or stop that."""
    if on and _Handler.handle is None:
        _Handler.handle = bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_PIXEL")
    elif not on and _Handler.handle is not None:
        bpy.types.SpaceView3D.draw_handler_remove(_Handler.handle, "WINDOW")
        _Handler.handle = None


def _draw() -> None:
    import blf
    import gpu
    from gpu_extras.batch import batch_for_shader

    context = bpy.context
    last = newest_report(context.scene)
    if last is None or not context.space_data.overlay.show_overlays:
        return
    system = context.preferences.system
    covered = dict.fromkeys(("TOOLS", "UI"), 0)
    if system.use_region_overlap:
        covered |= {region.type: region.width for region in context.area.regions if region.type in covered}

    def text_width(text: str, size: float) -> float:
        blf.size(0, size)
        return float(blf.dimensions(0, text)[0])

    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    gpu.state.blend_set("ALPHA")
    free = float(context.region.width - covered["UI"])
    for item in layout(last, float(covered["TOOLS"]), free, system.ui_scale, text_width):
        if isinstance(item, Label):
            blf.size(0, item.size)
            blf.color(0, *item.color)
            blf.position(0, item.x, item.y, 0.0)
            blf.draw(0, item.text)
        else:
            x1, y1 = item.x + item.width, item.y + item.height
            corners = ((item.x, item.y), (x1, item.y), (x1, y1), (item.x, y1))
            batch = batch_for_shader(shader, "TRIS", {"pos": corners}, indices=((0, 1, 2), (0, 2, 3)))
            shader.uniform_float("color", item.color)
            batch.draw(shader)
    gpu.state.blend_set("NONE")
