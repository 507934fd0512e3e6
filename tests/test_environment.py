# SPDX-License-Identifier: GPL-3.0-or-later
"""tools/environment: what an interrupted call leaves behind is made again, what is ready is left alone."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from tests.blenders import ROOT


def test_an_environment_without_pip_is_made_again_and_a_whole_one_is_kept(tmp_path: Path) -> None:
    folder = tmp_path / "environment"
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], timeout=60, check=True)
    left_behind = folder / "left-behind"
    left_behind.touch()
    # Nothing to install: nothing is asked of the network.
    command: list[str | Path] = [
        ROOT / "tools/environment",
        folder,
        version,
        "--no-index",
        "--requirement",
        tmp_path / "none.txt",
    ]
    (tmp_path / "none.txt").touch()

    subprocess.run(command, timeout=120, check=True)
    assert not left_behind.exists()
    subprocess.run([folder / "bin/python", "-c", "import pip"], timeout=60, check=True)

    left_behind.touch()
    subprocess.run(command, timeout=120, check=True)
    assert left_behind.exists()
