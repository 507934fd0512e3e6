# SPDX-License-Identifier: GPL-3.0-or-later
"""Builds the native wheels and the extension's zip, all under build/.

python tools/package.py wheel   the wheel of this Python, installed into its environment
python tools/package.py         the wheels of all Pythons that Blender uses and this machine has, and their zip
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
BUILD = ROOT / "build"
WHEELS = BUILD / "wheels"
STAGE = BUILD / "extension"
PYTHONS = ("3.11", "3.13")  # of Blender 4.2-5.0 and of 5.1-5.2 (and Debian's 4.3)


def run(*command: str | Path) -> None:
    """Runs a command in the repository; raises CalledProcessError when it fails"""
    subprocess.run([str(part) for part in command], cwd=ROOT, check=True)


def python_for(version: str) -> Path | None:
    """The Python of an environment that can build a wheel for that version, or None where the machine has none"""
    if version == f"{sys.version_info.major}.{sys.version_info.minor}":
        return Path(sys.executable)
    if subprocess.run([ROOT / "tools/find-python", version], stdout=subprocess.DEVNULL, check=False).returncode:
        return None
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "espalier"
    folder = cache / f"build-{version}"
    run("tools/environment", folder, version, "-r", "requirements/build.txt")
    return folder / "bin/python"


def build_wheel(python: Path, version: str) -> Path:
    """Compiles what changed and returns the one wheel of that Python version in build/wheels"""
    tag = "cp" + version.replace(".", "")
    for old in WHEELS.glob(f"*-{tag}-*.whl"):
        old.unlink()
    options = ("--no-build-isolation", "--no-deps", "--quiet", "--disable-pip-version-check")
    run(python, "-m", "pip", "wheel", *options, "--config-settings", f"build-dir=build/{tag}", "-w", WHEELS, ROOT)
    (wheel,) = WHEELS.glob(f"*-{tag}-*.whl")
    return wheel


def stage(wheels: list[Path]) -> None:
    """Lays the extension out as it is in the zip; its manifest lists the wheels that are there"""
    shutil.rmtree(STAGE, ignore_errors=True)
    shutil.copytree(ROOT / "addon", STAGE, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "LICENSE", STAGE)
    (STAGE / "wheels").mkdir()
    for wheel in wheels:
        shutil.copy(wheel, STAGE / "wheels")
    names = "".join(f'  "./wheels/{wheel.name}",\n' for wheel in wheels)
    before, found, after = (ROOT / "blender_manifest.toml").read_text(encoding="utf-8").partition("wheels = []")
    if not found:
        raise SystemExit("blender_manifest.toml: found no line “wheels = []” to fill in")
    (STAGE / "blender_manifest.toml").write_text(f"{before}wheels = [\n{names}]{after}", encoding="utf-8")


def main() -> None:
    """See the module's text"""
    here = f"{sys.version_info.major}.{sys.version_info.minor}"
    if sys.argv[1:] == ["wheel"]:
        wheel = build_wheel(Path(sys.executable), here)
        run(sys.executable, "-m", "pip", "install", "--quiet", "--force-reinstall", "--no-deps", "--no-index", wheel)
        return
    wheels = []
    for version in PYTHONS:
        python = python_for(version)
        if python:
            wheels.append(build_wheel(python, version))
        else:
            print(f"No Python {version} here: the zip will not serve the Blenders that use it", file=sys.stderr)
    stage(wheels)
    (tool,) = Path(sysconfig.get_path("purelib")).glob("bpy/*/scripts/addons_core/bl_pkg/cli/blender_ext.py")
    run(sys.executable, tool, "validate", STAGE)
    run(sys.executable, tool, "build", "--source-dir", STAGE, "--output-dir", BUILD)


if __name__ == "__main__":
    main()
