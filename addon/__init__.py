# SPDX-License-Identifier: GPL-3.0-or-later
"""Espalier: ray tracing for Blender through a kd-tree that is built on all cores."""

from . import cli, engine, operators, overlay, panels, session, settings

_parts = (settings, operators, panels, engine, cli)


def register() -> None:
    """Make everything known to Blender; nothing runs until it is asked for."""
    for part in _parts:
        part.register()


def unregister() -> None:
    """Leave Blender as it was."""
    overlay.switch(False)
    for part in reversed(_parts):
        part.unregister()
    session.forget()
