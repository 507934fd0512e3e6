# SPDX-License-Identifier: GPL-3.0-or-later
"""The sidebar's tab. A panel draws what a report says and computes nothing."""

from __future__ import annotations

import textwrap

import bpy

from . import overlay, report
from .operators import ESPALIER_OT_cancel, ESPALIER_OT_compare, ESPALIER_OT_overlay, ESPALIER_OT_preview, at_work
from .session import COMPARE, PREVIEW, last_report

WARNING_WIDTH = 38  # characters that fit beside an icon in a sidebar of Blender's own width


class _Sidebar:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Espalier"


class ESPALIER_PT_preview(_Sidebar, bpy.types.Panel):
    """The buttons and the settings"""

    bl_label = "Espalier"

    def draw(self, context: bpy.types.Context) -> None:
        """Lay out buttons and settings"""
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        settings = context.scene.espalier
        buttons = layout.column(align=True)
        buttons.scale_y = 1.3
        buttons.operator(ESPALIER_OT_preview.bl_idname, icon="RENDER_STILL")
        buttons.operator(ESPALIER_OT_compare.bl_idname, icon="SORTTIME")
        if (session := at_work()) is not None:
            row = layout.row(align=True)
            row.progress(factor=session.run.progress, text=session.run.stage.capitalize())
            row.operator(ESPALIER_OT_cancel.bl_idname, text="", icon="X")
        layout.prop(settings, "quality")
        layout.prop(settings, "threads")
        layout.prop(settings, "samples")
        layout.prop(settings, "use_percentage")
        row = layout.row()
        row.active = settings.use_percentage
        row.prop(settings, "percentage")
        layout.operator(ESPALIER_OT_overlay.bl_idname, depress=overlay.is_on(), icon="OVERLAY")


class _Results(_Sidebar):
    kind: str

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return last_report(context.scene, cls.kind) is not None

    def draw(self, context: bpy.types.Context) -> None:
        last = last_report(context.scene, self.kind)
        if last is None:
            return
        layout = self.layout  # type: ignore[attr-defined]
        column = layout.column(align=True)
        column.label(text=report.size_line(last))
        column.label(text=report.settings_line(last).capitalize())
        self.draw_times(layout, last)
        column = layout.column(align=True)
        for line in report.tree_lines(last):
            column.label(text=line)
        for warning in report.warnings(last):
            column = layout.column(align=True)
            # A label does not wrap, and a sidebar is narrow.
            for index, line in enumerate(textwrap.wrap(warning, WARNING_WIDTH)):
                column.label(text=line, icon="BLANK1" if index else "ERROR")

    def draw_times(self, layout: bpy.types.UILayout, last: report.Report) -> None:
        raise NotImplementedError


class ESPALIER_PT_preview_result(_Results, bpy.types.Panel):
    """What the last preview cost"""

    bl_label = "Last Preview"
    kind = PREVIEW

    def draw_times(self, layout: bpy.types.UILayout, last: report.Report) -> None:
        """List the phases"""
        rows = [(name, f"{ms:,.1f} ms") for name, ms in report.phase_lines(last)]
        draw_rows(layout, rows)


class ESPALIER_PT_compare_result(_Results, bpy.types.Panel):
    """What the last comparison found"""

    bl_label = "Thread Counts"
    kind = COMPARE

    def draw_times(self, layout: bpy.types.UILayout, last: report.Report) -> None:
        """List the builds"""
        draw_rows(layout, [(label, note) for label, _, note in report.thread_lines(last)])


def draw_rows(layout: bpy.types.UILayout, rows: list[tuple[str, str]]) -> None:
    """A table of two columns, the second to the right."""
    column = layout.column(align=True)
    for name, value in rows:
        split = column.split(factor=0.4)
        split.label(text=name)
        right = split.row()
        right.alignment = "RIGHT"
        right.label(text=value)


classes = (ESPALIER_PT_preview, ESPALIER_PT_preview_result, ESPALIER_PT_compare_result)


def register() -> None:
    """Show the tab."""
    for cls in classes:
        bpy.utils.register_class(cls)


def unregister() -> None:
    """Take the tab away."""
    for cls in reversed(classes):
        bpy.utils.unregister_class(cls)
