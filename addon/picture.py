# SPDX-License-Identifier: GPL-3.0-or-later
"""The preview as Blender's image datablock, as a PNG file, and in an image editor."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

NAME = "Espalier Preview"

Pixels = NDArray[np.float32]  # [H,W,4], bottom row first, linear RGBA


def show(pixels: Pixels) -> bpy.types.Image:
    """Put the pixels into the image “Espalier Preview”, which is made once and then used again."""
    image = bpy.data.images.get(NAME)
    if image is not None and not (image.is_float and image.source == "GENERATED"):
        bpy.data.images.remove(image)
        image = None
    height, width = pixels.shape[:2]
    if image is None:
        image = _new_image(NAME, width, height)
    elif tuple(image.size) != (width, height):
        image.scale(width, height)
    _fill(image, pixels)
    return image


def exists() -> bool:
    """Whether there is a picture's datablock already."""
    return NAME in bpy.data.images


def remember() -> Pixels | None:
    """A copy of the picture that is shown now, for restore()."""
    image = bpy.data.images.get(NAME)
    if image is None or not image.has_data:
        return None
    width, height = image.size
    pixels = np.empty((height, width, image.channels), np.float32)
    image.pixels.foreach_get(pixels.ravel())
    return pixels if image.channels == 4 else None


def restore(pixels: Pixels | None) -> None:
    """Show the remembered picture again; without one, take the unfinished picture away."""
    if pixels is not None:
        show(pixels)
    elif (image := bpy.data.images.get(NAME)) is not None:
        bpy.data.images.remove(image)


def write_png(pixels: Pixels, path: Path, scene: bpy.types.Scene) -> None:
    """Write a PNG with the scene's view transform; the file is there whole or not at all. Raises OSError."""
    height, width = pixels.shape[:2]
    image = _new_image(path.name, width, height)
    try:
        _fill(image, pixels)
        with replaced(path) as unfinished, _png_settings(scene):
            try:
                image.save_render(str(unfinished), scene=scene)
            except RuntimeError as error:
                raise OSError(f"cannot write {path}: {error}") from error
    finally:
        bpy.data.images.remove(image)


@contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """A path beside this one to write to, renamed into its place at the end; parent folders are made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder")
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield unfinished
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def open_editor(context: bpy.types.Context, image: bpy.types.Image) -> bool:
    """Show the image in an image editor that is open, else in half of the 3D viewport; whether it had to be made."""
    editors = [area for _, area in _editors(context)]
    if any(area.spaces.active.image == image for area in editors):
        return False
    free = [area for area in editors if not area.spaces.active.use_image_pin]
    if free:
        free[0].spaces.active.image = image
        return False
    # Not in a window of its own: that would take the keyboard, and Esc would not reach the operator.
    screen = context.window.screen
    if screen.show_fullscreen:  # a maximised area cannot be split
        return False
    areas = [area for area in screen.areas if area.type == "VIEW_3D"] or list(screen.areas)
    widest = max(areas, key=lambda area: area.width * area.height)
    before = set(screen.areas)
    with context.temp_override(area=widest, region=_window_region(widest)):
        if not bpy.ops.screen.area_split.poll():
            return False
        bpy.ops.screen.area_split(direction="VERTICAL", factor=0.5)
    made = set(screen.areas) - before
    for area in made:
        area.ui_type = "IMAGE_EDITOR"
        area.spaces.active.image = image
    return bool(made)


def is_shown(context: bpy.types.Context, image: bpy.types.Image) -> bool:
    """Whether an image editor that is open shows the image."""
    return any(area.spaces.active.image == image for _, area in _editors(context))


def fit(context: bpy.types.Context, image: bpy.types.Image) -> None:
    """Zoom the editor that shows the image so that all of it is seen; a new editor must have been drawn before."""
    for window, area in _editors(context):
        if area.spaces.active.image == image:
            with context.temp_override(window=window, area=area, region=_window_region(area)):
                bpy.ops.image.view_all(fit_view=True)
            return


def _editors(context: bpy.types.Context) -> list[tuple[bpy.types.Window, bpy.types.Area]]:
    return [
        (window, area)
        for window in context.window_manager.windows
        for area in window.screen.areas
        if area.ui_type == "IMAGE_EDITOR"
    ]


def _window_region(area: bpy.types.Area) -> bpy.types.Region:
    return next(region for region in area.regions if region.type == "WINDOW")


def _new_image(name: str, width: int, height: int) -> bpy.types.Image:
    image = bpy.data.images.new(name, width, height, alpha=True, float_buffer=True)
    image.use_view_as_render = True
    return image


def _fill(image: bpy.types.Image, pixels: Pixels) -> None:
    image.pixels.foreach_set(np.ascontiguousarray(pixels, np.float32).ravel())
    image.update()


@contextmanager
def _png_settings(scene: bpy.types.Scene) -> Iterator[None]:
    settings = scene.render.image_settings
    # The order matters: from Blender 5.0 the kind of medium decides which formats may be set.
    wanted = {"media_type": "IMAGE", "file_format": "PNG", "color_mode": "RGB", "color_depth": "8"}
    wanted["color_management"] = "FOLLOW_SCENE"
    before = {name: getattr(settings, name) for name in wanted if hasattr(settings, name)}
    try:
        for name in before:
            setattr(settings, name, wanted[name])
        yield
    finally:
        for name, value in before.items():
            setattr(settings, name, value)
