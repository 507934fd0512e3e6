# SPDX-License-Identifier: GPL-3.0-or-later
"""Run inside a Blender with a window: window.py ZIP SCENE FOLDER. Uses the extension as an artist does, with shots.

FOLDER gets before.png, after.png and preview.png, and window.json: where the viewport, the sidebar and the overlay's
boxes are in them, in pixels from the screen's lower left corner.
"""

import json
import subprocess
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bpy

NAME = "bl_ext.user_default.espalier"
TICK_S = 0.25
PATIENCE = 240  # ticks


def viewport() -> tuple[Any, Any]:
    """The window and its 3D viewport"""
    window = bpy.context.window_manager.windows[0]
    return window, next(area for area in window.screen.areas if area.type == "VIEW_3D")


def region_of(area: Any, kind: str) -> Any:
    return next(region for region in area.regions if region.type == kind)


def rectangle(region: Any) -> dict[str, int]:
    return {"x": region.x, "y": region.y, "width": region.width, "height": region.height}


def shoot(path: Path) -> None:
    subprocess.run(["import", "-window", "root", str(path)], check=True, timeout=60)


def click(x: float, y: float) -> Iterator[bool]:
    """Moves the mouse to a place counted from the screen's lower left corner and clicks, Blender seeing each step"""
    height = bpy.context.window_manager.windows[0].height
    # The first move only enters the region; a button wakes at the second.
    moves = [["mousemove", str(round(x) - shift), str(round(height - y))] for shift in (3, 0)]
    for act in (*moves, ["mousedown", "1"], ["mouseup", "1"]):
        subprocess.run(["xdotool", *act], check=True, timeout=60)
        yield True


def steps(zip_file: str, folder: Path) -> Iterator[bool]:
    """What is done, tick by tick; yields whether to go on"""
    assert bpy.ops.extensions.package_install_files(
        filepath=zip_file, repo="user_default", enable_on_install=True, overwrite=True
    ) == {"FINISHED"}
    overlay = sys.modules[NAME + ".overlay"]
    session = sys.modules[NAME + ".session"]
    operators = sys.modules[NAME + ".operators"]
    scene = bpy.context.scene
    scene.render.resolution_percentage = 50
    window, area = viewport()
    space = area.spaces.active
    space.show_region_ui = True
    space.shading.color_type = "MATERIAL"
    space.overlay.show_extras = False
    space.region_3d.view_perspective = "CAMERA"
    view = region_of(area, "WINDOW")
    with bpy.context.temp_override(window=window, area=area, region=view):
        bpy.ops.view3d.view_center_camera()
    yield True
    sidebar = region_of(area, "UI")
    sidebar.active_panel_category = "Item"
    yield True
    yield True
    shoot(folder / "before.png")

    sidebar.active_panel_category = "Espalier"
    yield True
    yield True
    # The panel's header, then its first two buttons: Preview and Compare Thread Counts.
    unit = 20.0 * bpy.context.preferences.system.ui_scale
    top = sidebar.y + sidebar.height
    middle = sidebar.x + 0.4 * sidebar.width
    yield from click(middle, top - 3.65 * unit)
    yield from until(lambda: session.last_report(scene, session.COMPARE) is not None, "the comparison to end")
    yield from until(overlay.is_on, "the overlay")
    # Away from the button: as long as the mouse is on it, it stays drawn as it was when pressed.
    subprocess.run(["xdotool", "mousemove", str(window.width // 2), str(window.height // 3)], check=True, timeout=60)
    area.tag_redraw()
    yield True
    yield True
    shoot(folder / "after.png")

    import blf

    def text_width(text: str, size: float) -> float:
        blf.size(0, size)
        return float(blf.dimensions(0, text)[0])

    toolbar = region_of(area, "TOOLS").width if bpy.context.preferences.system.use_region_overlap else 0
    items = overlay.layout(
        session.last_report(scene, session.COMPARE),
        toolbar,
        view.width,
        bpy.context.preferences.system.ui_scale,
        text_width,
    )
    boxes = [item for item in items if isinstance(item, overlay.Box)]
    (folder / "window.json").write_text(
        json.dumps(
            {
                "screen": [window.width, window.height],
                "view": rectangle(view),
                "sidebar": rectangle(sidebar),
                "boxes": [
                    {"x": view.x + b.x, "y": view.y + b.y, "width": b.width, "height": b.height, "color": list(b.color)}
                    for b in boxes
                ],
                "labels": len(items) - len(boxes),
            }
        )
    )

    yield from click(middle, top - 2.4 * unit)
    yield from until(lambda: session.last_report(scene, session.PREVIEW) is not None, "the preview to end")
    yield from until(lambda: operators._Watched.running is None, "the operator to end")
    image = bpy.data.images["Espalier Preview"]
    assert tuple(image.size) == (scene.render.resolution_x // 2, scene.render.resolution_y // 2)
    shown = [
        area
        for window in bpy.context.window_manager.windows
        for area in window.screen.areas
        if area.type == "IMAGE_EDITOR" and area.spaces.active.image == image
    ]
    assert shown, "no image editor shows the preview"
    yield True
    yield True
    shoot(folder / "preview.png")

    # Maximised, the viewport cannot be split: the picture is drawn all the same.
    window, area = viewport()
    with bpy.context.temp_override(window=window, area=area, region=region_of(area, "WINDOW")):
        bpy.ops.screen.screen_full_area()
    yield True
    yield True
    window, area = viewport()
    assert window.screen.show_fullscreen
    before = session.last_report(scene, session.PREVIEW)
    with bpy.context.temp_override(window=window, area=area, region=region_of(area, "WINDOW")):
        assert bpy.ops.espalier.preview("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
    yield from until(lambda: operators._Watched.running is None, "the operator to end in a maximised viewport")
    assert session.last_report(scene, session.PREVIEW) is not before
    assert len(window.screen.areas) == 1
    assert bpy.ops.espalier.preview.poll()


def until(condition: Any, what: str) -> Iterator[bool]:
    for _ in range(PATIENCE):
        if condition():
            return
        yield True
    shoot(Path(sys.argv[-1]) / "failed.png")
    raise TimeoutError(f"waited in vain for {what}")


def main() -> None:
    zip_file, scene, folder = sys.argv[-3:]
    bpy.context.preferences.view.show_splash = False
    bpy.ops.wm.open_mainfile(filepath=scene, load_ui=False)
    work = steps(zip_file, Path(folder))

    def tick() -> float | None:
        try:
            next(work)
        except StopIteration:
            print("espalier: came to the end", flush=True)
        except BaseException:
            traceback.print_exc()
        else:
            return TICK_S
        bpy.ops.wm.quit_blender()
        return None

    bpy.app.timers.register(tick, first_interval=2.0)


main()
