# SPDX-License-Identifier: GPL-3.0-or-later
"""The zip that users install: valid by Blender's own tool, complete, and in need of the system's C library only."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from pathlib import Path

import pytest

from tests.blenders import BLENDERS, ROOT

MANIFEST = tomllib.loads((ROOT / "blender_manifest.toml").read_text(encoding="utf-8"))
ZIP = ROOT / f"build/{MANIFEST['id']}-{MANIFEST['version']}.zip"

pytestmark = pytest.mark.skipif(not ZIP.exists(), reason=f"no {ZIP.name} here: make package")


def test_blenders_own_tool_finds_the_zip_valid() -> None:
    (tool,) = Path(sysconfig.get_path("purelib")).glob("bpy/*/scripts/addons_core/bl_pkg/cli/blender_ext.py")
    done = subprocess.run(
        [sys.executable, tool, "validate", ZIP], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "WARN" not in done.stdout + done.stderr


def test_zip_holds_the_whole_addon_and_nothing_else() -> None:
    with zipfile.ZipFile(ZIP) as package:
        names = {name for name in package.namelist() if not name.endswith("/") and not name.startswith("wheels/")}
    sources = {path.name for path in (ROOT / "addon").glob("*.py")}
    assert names == sources | {"blender_manifest.toml", "LICENSE"}


def test_wheels_of_the_manifest_are_in_the_zip_one_for_each_python() -> None:
    with zipfile.ZipFile(ZIP) as package:
        listed = tomllib.loads(package.read("blender_manifest.toml").decode())["wheels"]
        inside = {name for name in package.namelist() if name.endswith(".whl")}
    assert {f"./{name}" for name in inside} == set(listed)
    tags = {re.search(r"-(cp\d+)-", name)[1] for name in inside}  # type: ignore[index]
    if any(blender.missing() for blender in BLENDERS):
        assert f"cp{sys.version_info.major}{sys.version_info.minor}" in tags <= {"cp311", "cp313"}
    else:
        assert tags == {"cp311", "cp313"}


def test_one_version_everywhere() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    cmake = re.search(r"project\(\S+ VERSION (\S+)", (ROOT / "CMakeLists.txt").read_text(encoding="utf-8"))
    with zipfile.ZipFile(ZIP) as package:
        wheels = {name.split("-")[1] for name in package.namelist() if name.endswith(".whl")}
    assert {MANIFEST["version"], project, cmake[1] if cmake else None} | wheels == {project}


def test_native_modules_need_only_the_c_library(tmp_path: Path) -> None:
    with zipfile.ZipFile(ZIP) as package:
        wheels = [package.extract(name, tmp_path) for name in package.namelist() if name.endswith(".whl")]
    for wheel in wheels:
        with zipfile.ZipFile(wheel) as opened:
            (name,) = [name for name in opened.namelist() if ".so" in name]
            module = opened.extract(name, tmp_path / Path(wheel).stem)
        dynamic = subprocess.run(
            ["readelf", "-d", module], capture_output=True, text=True, timeout=60, check=True
        ).stdout
        needed = {name.split(".")[0] for name in re.findall(r"\(NEEDED\).*\[(.*)\]", dynamic)}
        assert needed <= {"libc", "libm", "libpthread", "ld-linux-x86-64"}, needed
        assert "RPATH" not in dynamic
        assert "RUNPATH" not in dynamic


def test_addon_keeps_the_rules_for_extensions() -> None:
    """Relative imports of itself; nothing that downloads, installs or starts programs"""
    allowed = {"bpy", "bmesh", "mathutils", "blf", "gpu", "gpu_extras", "numpy", "espalier_native"}
    forbidden = {"pip", "ensurepip", "subprocess", "urllib", "http", "socket", "ctypes.util", "importlib"}
    for source in (ROOT / "addon").glob("*.py"):
        for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
            names: list[str] = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                names = [node.module or ""]
            for name in names:
                top = name.split(".")[0]
                assert top in allowed | set(sys.stdlib_module_names) - forbidden, f"{source.name}: imports {name}"
