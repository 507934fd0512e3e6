# SPDX-License-Identifier: GPL-3.0-or-later
"""The Blenders that `make blenders` prepares, and running a script or a command in one of them."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "espalier"
CHROOT = CACHE / "blender-trixie"
TIMEOUT_S = 300


@dataclass(frozen=True)
class Blender:
    """A Blender: pip's module in an environment of its own, or (environment None) the executable in the chroot."""

    name: str
    environment: Path | None = None

    def missing(self) -> str | None:
        """Why this Blender cannot be used here, or None"""
        if self.environment is not None:
            return None if (self.environment / "bin/python").exists() else f"{self.name} is not here: make blenders"
        if not (CHROOT / "espalier-ready").exists():
            return f"{self.name} is not here: make blenders"
        return None if os.geteuid() == 0 else f"{self.name} is in a chroot, which needs root"

    @contextmanager
    def folder(self) -> Iterator[Folder]:
        """An empty folder that this Blender can see, its user resources included; gone afterwards"""
        base = None if self.environment is not None else CHROOT / "tmp"
        path = Path(tempfile.mkdtemp(prefix="espalier-", dir=base))
        try:
            yield Folder(self, path)
        finally:
            shutil.rmtree(path)


@dataclass(frozen=True)
class Folder:
    """Where one test works with one Blender"""

    blender: Blender
    path: Path

    def inside(self, path: Path) -> str:
        """The path as this Blender sees it"""
        return str(path) if self.blender.environment is not None else f"/{path.relative_to(CHROOT)}"

    def add(self, source: Path) -> str:
        """Copies a file here and returns its path as this Blender sees it"""
        return self.inside(Path(shutil.copy(source, self.path)))

    def run(self, *command: str) -> subprocess.CompletedProcess[str]:
        """Runs a command beside this Blender, its settings and extensions being those of this folder alone"""
        home = self.inside(self.path)
        own = {"HOME": home, "BLENDER_USER_RESOURCES": f"{home}/resources", "LC_ALL": "C.UTF-8"}
        if self.blender.environment is None:
            own |= {"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "LIBGL_ALWAYS_SOFTWARE": "1"}
            clean = ("env", "-i", *(f"{name}={value}" for name, value in own.items()))
            command = ("chroot", str(CHROOT), *clean, *command)
        return subprocess.run(
            command, env=os.environ | own, cwd=self.path, capture_output=True, text=True, timeout=TIMEOUT_S, check=False
        )

    def run_script(self, script: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Runs a Python script in this Blender, without a screen; exit code 0 only when it came to its end"""
        seen = self.add(script)
        if self.blender.environment is not None:
            return self.run(str(self.blender.environment / "bin/python"), seen, *arguments)
        return self.run("blender", "-b", "--python-exit-code", "1", "--python", seen, "--", *arguments)


REAL = Blender("blender 4.3.2")
# Never the environment that the tests run in: the native module is in there without any zip.
BLENDERS = (*(Blender(f"bpy {version}", CACHE / f"bpy-{version}") for version in ("4.2.23", "5.0.1", "5.2.3")), REAL)
