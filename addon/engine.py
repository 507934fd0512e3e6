# SPDX-License-Identifier: GPL-3.0-or-later
"""Espalier as a render engine: F12 through the same path, with the render settings of modifiers and visibility."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import bpy
import numpy as np
from numpy.typing import NDArray

from . import report
from .pipeline import Cancelled, Run
from .settings import options_of

TICK_S = 0.1


class ESPALIER_engine(bpy.types.RenderEngine):
    """Ray traced through Espalier's kd-tree, built on all cores"""

    bl_idname = "ESPALIER"
    bl_label = "Espalier"
    bl_use_preview = False
    bl_use_eevee_viewport = True

    def __init__(self, *args: object, **kwargs: object) -> None:
        super().__init__(*args, **kwargs)

    def render(self, depsgraph: bpy.types.Depsgraph) -> None:
        """Draw the frame that Blender asks for; what goes wrong is told as a render error."""
        try:
            self._draw_frame(depsgraph)
        except Cancelled:
            pass
        except Exception as error:  # Blender would print it and call the render finished
            self.error_set(str(error))  # for the picture's place
            self.report({"ERROR"}, str(error))  # for the operator, which a script hears

    def _draw_frame(self, depsgraph: bpy.types.Depsgraph) -> None:
        self.update_stats("", "Exporting")
        # Blender made room for the scene's own resolution; the other one is the preview's alone. Nobody is shown what
        # the build cost, so none of it is built for that.
        run = Run(depsgraph, replace(options_of(depsgraph.scene), percentage=None, on_demand=True))
        x0, y0, x1, y1 = shown_part(depsgraph.scene.render, *run.size)
        target = self.begin_result(0, 0, x1 - x0, y1 - y0, layer=depsgraph.view_layer.name)
        try:
            while not run.wait(TICK_S):
                if self.test_break():
                    run.cancel()
                    continue
                self.update_stats("", run.stage.capitalize())
                self.update_progress(run.progress)
                pixels = run.image()
                if pixels is not None:
                    self._fill(target, pixels[y0:y1, x0:x1])
                    self.update_result(target)
            result = run.result()
            assert result.image is not None
            self._fill(target, result.image[y0:y1, x0:x1])
        except BaseException:
            self.end_result(target, cancel=True)
            raise
        self.end_result(target)
        for line in report.warnings(result.report):
            self.report({"WARNING"}, line)

    @staticmethod
    def _fill(target: bpy.types.RenderResult, pixels: NDArray[np.float32]) -> None:
        target.layers[0].passes["Combined"].rect.foreach_set(pixels.reshape(-1))


def shown_part(render: bpy.types.RenderSettings, width: int, height: int) -> tuple[int, int, int, int]:
    """Left, bottom, right and top, in pixels, of what Blender shows: the render region, if one is set."""
    if not render.use_border:
        return 0, 0, width, height
    return (
        int(render.border_min_x * width),
        int(render.border_min_y * height),
        int(render.border_max_x * width),
        int(render.border_max_y * height),
    )


# Panels that have nothing of their own engine in them, and yet are made for it alone.
SHARED_PANELS = {
    "EEVEE_MATERIAL_PT_context_material",
    "EEVEE_MATERIAL_PT_surface",
    "EEVEE_WORLD_PT_surface",
    "DATA_PT_EEVEE_light",
}


def compatible_panels() -> Iterator[type[bpy.types.Panel]]:
    """The panels of Blender that say something about what Espalier draws."""
    for panel in bpy.types.Panel.__subclasses__():
        engines = getattr(panel, "COMPAT_ENGINES", None)
        if isinstance(engines, set) and ("BLENDER_RENDER" in engines or panel.__name__ in SHARED_PANELS):
            yield panel


def register() -> None:
    """Offer the engine, and its users the panels they need."""
    bpy.utils.register_class(ESPALIER_engine)
    for panel in compatible_panels():
        panel.COMPAT_ENGINES.add(ESPALIER_engine.bl_idname)


def unregister() -> None:
    """Take the engine away."""
    for panel in compatible_panels():
        panel.COMPAT_ENGINES.discard(ESPALIER_engine.bl_idname)
    bpy.utils.unregister_class(ESPALIER_engine)
