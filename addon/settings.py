# SPDX-License-Identifier: GPL-3.0-or-later
"""The artist's settings, kept with each scene."""

import bpy

from .pipeline import Options


class EspalierSettings(bpy.types.PropertyGroup):
    """How Espalier builds and draws this scene"""

    quality: bpy.props.EnumProperty(
        name="Build Quality",
        description="How much time is spent on the tree; the picture is the same with each, only sooner or later",
        items=(
            ("draft", "Draft", "The quickest build, for a quick look"),
            ("balanced", "Balanced", "The least time for build and picture together"),
            ("best", "Best", "The slowest build and the fastest rays, for big pictures"),
        ),
        default="balanced",
    )
    threads: bpy.props.IntProperty(
        name="Threads",
        description="How many threads build and draw; 0 uses all of them",
        default=0,
        min=0,
        max=1024,
    )
    samples: bpy.props.IntProperty(
        name="Samples",
        description="Rays per pixel",
        default=4,
        min=1,
        soft_max=64,
        max=4096,
    )
    use_percentage: bpy.props.BoolProperty(
        name="Own Resolution",
        description="Draw the preview at a percentage of its own instead of the scene's",
        default=False,
    )
    percentage: bpy.props.IntProperty(
        name="Resolution",
        description="Size of the preview, as a percentage of the scene's resolution",
        default=50,
        min=1,
        soft_max=100,
        max=1000,
        subtype="PERCENTAGE",
    )


def options_of(scene: bpy.types.Scene) -> Options:
    """The scene's settings in the words of the pipeline."""
    settings = scene.espalier
    return Options(
        quality=settings.quality,
        threads=settings.threads,
        samples=settings.samples,
        percentage=settings.percentage if settings.use_percentage else None,
    )


def register() -> None:
    """Give every scene its settings."""
    bpy.utils.register_class(EspalierSettings)
    bpy.types.Scene.espalier = bpy.props.PointerProperty(type=EspalierSettings)


def unregister() -> None:
    """Take the settings away; what was set stays in the file."""
    del bpy.types.Scene.espalier
    bpy.utils.unregister_class(EspalierSettings)
