# SPDX-License-Identifier: GPL-3.0-or-later
"""A run that is watched: the picture grows, and whatever goes wrong, the last good picture and the last report stay."""

from __future__ import annotations

import time

import bpy

from . import picture, pipeline
from .report import Report
from .settings import options_of

PREVIEW = "preview"
COMPARE = "compare"

# The last report of each kind, by the scene's session_uid, which no other file's scene shares; the newest at the end.
_reports: dict[tuple[int, str], Report] = {}


def last_report(scene: bpy.types.Scene, kind: str) -> Report | None:
    """What the last run of that kind said about this scene in this session of Blender."""
    return _reports.get((scene.session_uid, kind))


def newest_report(scene: bpy.types.Scene) -> Report | None:
    """What the last run of either kind said about this scene in this session of Blender."""
    return next((report for (uid, _), report in reversed(_reports.items()) if uid == scene.session_uid), None)


def forget() -> None:
    """Drop all reports."""
    _reports.clear()


class Session:
    """One run on the context's scene, from the start until finish() or cancel()."""

    def __init__(self, context: bpy.types.Context, kind: str) -> None:
        """Evaluate and export the scene and start the native job. Raises what pipeline.Run raises."""
        self.kind = kind
        self._key = (context.scene.session_uid, kind)
        depsgraph, evaluation_ms = pipeline.evaluate(context)
        options = options_of(context.scene)
        self.run = pipeline.Run(
            depsgraph,
            options,
            preview=kind == PREVIEW,
            counts=pipeline.thread_counts(options.threads) if kind == COMPARE else (),
            evaluation_ms=evaluation_ms,
        )
        self._before = picture.remember() if kind == PREVIEW else None
        self.first_picture = kind == PREVIEW and not picture.exists()
        self._ended = False
        self._next_look = 0.0

    @property
    def status(self) -> str:
        """One line for the status bar."""
        return f"Espalier: {self.run.stage}, {self.run.progress:.0%}    Esc: Cancel"

    def look(self) -> bpy.types.Image | None:
        """Show what is drawn so far; the image, or None where there is nothing new to see."""
        start = time.perf_counter()
        if self.kind != PREVIEW or start < self._next_look:
            return None
        pixels = self.run.image()
        image = None if pixels is None else picture.show(pixels)
        end = time.perf_counter()
        # Looking must not slow down the work that is looked at.
        self._next_look = end + max(0.2, 5.0 * (end - start))
        return image

    def finish(self) -> Report:
        """The report of a run that is done. Raises Cancelled or the run's error, the last good picture restored."""
        self._ended = True
        try:
            result = self.run.result()
            if result.image is not None:
                picture.show(result.image)
        except BaseException:
            self._restore()
            raise
        _reports.pop(self._key, None)
        _reports[self._key] = result.report
        return result.report

    def cancel(self) -> None:
        """Stop the run, wait for its end, and put the last good picture back; nothing after finish()."""
        if self._ended:
            return
        self._ended = True
        self.run.cancel()
        while not self.run.wait(1.0):
            pass
        self._restore()

    def _restore(self) -> None:
        if self.kind == PREVIEW:
            picture.restore(self._before)
