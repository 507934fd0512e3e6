# SPDX-License-Identifier: GPL-3.0-or-later
"""The two buttons: Preview and Compare Thread Counts."""

from __future__ import annotations

from typing import ClassVar

import bpy

from . import overlay, picture, pipeline, report
from .session import COMPARE, PREVIEW, Session

TICK_S = 0.1


class _Watched:
    """What both operators do: start, tick, end; in background, all of it in one go."""

    kind: ClassVar[str]
    running: ClassVar[_Watched | None] = None  # one at a time, for the cores are shared

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if _Watched.running is not None:
            cls.poll_message_set("Espalier is at work: Esc cancels")  # type: ignore[attr-defined]
            return False
        return context.scene is not None

    def execute(self, context: bpy.types.Context) -> set[str]:
        if not self.begin(context):
            return {"CANCELLED"}
        try:
            while not self.session.run.wait(TICK_S):
                pass
        except KeyboardInterrupt:
            self.session.cancel()
            return {"CANCELLED"}
        return self.end(context)

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        if bpy.app.background or context.window is None:
            return self.execute(context)
        if not self.begin(context):
            return {"CANCELLED"}
        _Watched.running = self
        manager = context.window_manager
        self.timer = manager.event_timer_add(TICK_S, window=context.window)
        manager.progress_begin(0, 100)
        manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if event.type == "ESC" and event.value == "PRESS":
            self.cancel(context)
            self.report({"INFO"}, "Cancelled: the last picture is still there")  # type: ignore[attr-defined]
            return {"CANCELLED"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        if self.session.run.done:
            self.tidy(context)
            return self.end(context)
        self.tick(context)
        return {"PASS_THROUGH"}

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender calls this too, when the window closes or another file is opened."""
        self.tidy(context)
        self.session.cancel()
        redraw(context)

    def begin(self, context: bpy.types.Context) -> bool:
        try:
            self.session = Session(context, self.kind)
        except Exception as error:  # whatever it is, the artist is told and nothing is lost
            self.report({"ERROR"}, str(error))  # type: ignore[attr-defined]
            return False
        return True

    def tick(self, context: bpy.types.Context) -> None:
        context.window_manager.progress_update(100.0 * self.session.run.progress)
        context.workspace.status_text_set(self.session.status)
        image = self.session.look()
        if image is not None:
            picture.open_editor(context, image)

    def tidy(self, context: bpy.types.Context) -> None:
        _Watched.running = None
        manager = context.window_manager
        manager.event_timer_remove(self.timer)
        manager.progress_end()
        if context.workspace is not None:
            context.workspace.status_text_set(None)

    def end(self, context: bpy.types.Context) -> set[str]:
        try:
            done = self.session.finish()
        except pipeline.Cancelled:
            return {"CANCELLED"}
        except Exception as error:  # as above
            self.report({"ERROR"}, str(error))  # type: ignore[attr-defined]
            return {"CANCELLED"}
        for line in report.warnings(done):
            self.report({"WARNING"}, line)  # type: ignore[attr-defined]
        if not bpy.app.background:
            self.present(context)
            redraw(context)
        return {"FINISHED"}

    def present(self, context: bpy.types.Context) -> None:
        raise NotImplementedError


class ESPALIER_OT_preview(_Watched, bpy.types.Operator):
    """Build the kd-tree of what the viewport would draw, on all cores, and trace a picture from the active camera"""

    bl_idname = "espalier.preview"
    bl_label = "Preview"
    kind = PREVIEW

    def present(self, context: bpy.types.Context) -> None:
        """Open the picture"""
        picture.open_editor(context, bpy.data.images[picture.NAME])


class ESPALIER_OT_compare(_Watched, bpy.types.Operator):
    """Build the kd-tree with one thread, two, four and so on, and show what each costs"""

    bl_idname = "espalier.compare"
    bl_label = "Compare Thread Counts"
    kind = COMPARE

    def present(self, context: bpy.types.Context) -> None:  # noqa: ARG002
        """Show the bars"""
        overlay.switch(True)


class ESPALIER_OT_overlay(bpy.types.Operator):
    """Show the timings of the last run in the 3D viewports"""

    bl_idname = "espalier.overlay"
    bl_label = "Timings in Viewport"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Switch it on or off"""
        overlay.switch(not overlay.is_on())
        redraw(context)
        return {"FINISHED"}


def redraw(context: bpy.types.Context) -> None:
    """Let the sidebar and the overlay show what has changed."""
    for window in context.window_manager.windows:
        for area in window.screen.areas:
            if area.type in {"VIEW_3D", "IMAGE_EDITOR"}:
                area.tag_redraw()


classes = (ESPALIER_OT_preview, ESPALIER_OT_compare, ESPALIER_OT_overlay)


def register() -> None:
    """Make the operators known."""
    for cls in classes:
        bpy.utils.register_class(cls)


def unregister() -> None:
    """End what is at work, then take the operators away."""
    if _Watched.running is not None:
        _Watched.running.cancel(bpy.context)
    for cls in reversed(classes):
        bpy.utils.unregister_class(cls)
