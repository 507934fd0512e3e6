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
    # One at a time, for the cores are shared. Not the operator: Blender frees that whenever it likes.
    running: ClassVar[Session | None] = None
    timer: ClassVar[bpy.types.Timer | None] = None

    session: Session
    outcome: set[str] | None  # None: still at work
    to_fit: bool  # an image editor was made, and has no size before it is drawn

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
        manager = context.window_manager
        _Watched.running = self.session
        _Watched.timer = manager.event_timer_add(TICK_S, window=context.window)
        manager.progress_begin(0, 100)
        manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        try:
            return self.step(context, event)
        except Exception as error:  # left alone, it would end the operator and nothing else
            self.report({"ERROR"}, str(error) or type(error).__name__)  # type: ignore[attr-defined]
            self.cancel(context)
            return {"CANCELLED"}

    def step(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if event.type == "ESC" and event.value == "PRESS" and self.outcome is None:
            self.cancel(context)
            self.report({"INFO"}, "Cancelled: the last picture is still there")  # type: ignore[attr-defined]
            return {"CANCELLED"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        if self.outcome is None and self.session.run.done:
            self.outcome = self.end(context)
        elif self.outcome is None:
            self.tick(context)
        elif self.to_fit:
            picture.fit(context, bpy.data.images[picture.NAME])
            self.to_fit = False
        if self.outcome is None or self.to_fit:
            return {"PASS_THROUGH"}
        tidy(context)
        return self.outcome

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender calls this too, when the window closes or another file is opened."""
        tidy(context)
        self.session.cancel()

    def begin(self, context: bpy.types.Context) -> bool:
        self.outcome = None
        self.to_fit = False
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
            self.show(context, image)
        for region in regions(context, "VIEW_3D", "UI"):
            region.tag_redraw()

    def show(self, context: bpy.types.Context, image: bpy.types.Image) -> None:
        if self.to_fit:
            picture.fit(context, image)
        self.to_fit = picture.open_editor(context, image)

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
        if self.session.first_picture:
            # Else undoing what the artist does next would take the picture away with it.
            bpy.ops.ed.undo_push(message="Espalier Preview")
        image = bpy.data.images[picture.NAME]
        self.show(context, image)
        if not picture.is_shown(context, image):
            self.report({"INFO"}, f"The picture is the image “{picture.NAME}”: no area can be split to show it")


class ESPALIER_OT_compare(_Watched, bpy.types.Operator):
    """Build the kd-tree with one thread, two, four and so on, and show what each costs"""

    bl_idname = "espalier.compare"
    bl_label = "Compare Thread Counts"
    kind = COMPARE

    def present(self, context: bpy.types.Context) -> None:  # noqa: ARG002
        """Show the bars"""
        overlay.switch(True)


class ESPALIER_OT_cancel(bpy.types.Operator):
    """Stop what Espalier is doing; the last picture stays"""

    bl_idname = "espalier.cancel"
    bl_label = "Cancel"

    def execute(self, context: bpy.types.Context) -> set[str]:  # noqa: ARG002
        """Stop it; its own operator hears of that at the next tick"""
        if (session := at_work()) is not None:
            session.run.cancel()
        return {"FINISHED"}


class ESPALIER_OT_overlay(bpy.types.Operator):
    """Show the timings of the last run in the 3D viewports"""

    bl_idname = "espalier.overlay"
    bl_label = "Timings in Viewport"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Switch it on or off"""
        overlay.switch(not overlay.is_on())
        redraw(context)
        return {"FINISHED"}


def at_work() -> Session | None:
    """The run that is being watched now."""
    return _Watched.running


def tidy(context: bpy.types.Context) -> None:
    """Let go of the window: no timer, no progress, no status; another run may start."""
    timer, _Watched.running, _Watched.timer = _Watched.timer, None, None
    manager = context.window_manager
    if timer is not None:
        manager.event_timer_remove(timer)
    manager.progress_end()
    if context.workspace is not None:
        context.workspace.status_text_set(None)
    redraw(context)


def regions(context: bpy.types.Context, area_type: str, region_type: str) -> list[bpy.types.Region]:
    """The regions of that kind in all windows."""
    return [
        region
        for window in context.window_manager.windows
        for area in window.screen.areas
        for region in area.regions
        if (area.type, region.type) == (area_type, region_type)
    ]


def redraw(context: bpy.types.Context) -> None:
    """Let the sidebars and the overlays show what has changed."""
    for kind in ("UI", "WINDOW"):
        for region in regions(context, "VIEW_3D", kind):
            region.tag_redraw()


classes = (ESPALIER_OT_preview, ESPALIER_OT_compare, ESPALIER_OT_cancel, ESPALIER_OT_overlay)


def register() -> None:
    """Make the operators known."""
    for cls in classes:
        bpy.utils.register_class(cls)


def unregister() -> None:
    """End what is at work, then take the operators away."""
    if (session := at_work()) is not None:
        tidy(bpy.context)
        session.cancel()
    for cls in reversed(classes):
        bpy.utils.unregister_class(cls)
