# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender as a module for the tests that ask for it: an empty scene before each, and nothing registered after it."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from tests.stage import Stage  # noqa: E402  it is found through the line above


@pytest.fixture
def bpy() -> Iterator[ModuleType]:
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    yield bpy
    bpy.ops.wm.read_factory_settings(use_empty=True)


@pytest.fixture
def addon(bpy: ModuleType) -> Iterator[ModuleType]:
    """The extension, registered; a used render engine that is left registered crashes Blender at exit."""
    import addon

    addon.register()
    yield addon
    addon.unregister()


@pytest.fixture
def stage(bpy: ModuleType) -> Stage:
    return Stage(bpy)
