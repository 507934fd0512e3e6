# SPDX-License-Identifier: GPL-3.0-or-later
"""The extension as users get it: installed from its zip into each Blender, drawing the same picture in all of them."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from tests.blenders import BLENDERS, REAL, ROOT, Blender
from tests.test_package import ZIP

DRAW = ROOT / "tests/in_blender/draw.py"
# Linear. Blenders differ in the last bits of matrices, which moves an edge by far less than a sample; four samples a
# pixel make one lost or won sample a large step in that pixel alone.
CLOSE = 1e-4
MOST_OUTLIERS = 0.002

pytestmark = pytest.mark.skipif(not ZIP.exists(), reason=f"no {ZIP.name} here: make package")


def skip_without(blender: Blender) -> None:
    if reason := blender.missing():
        pytest.skip(reason)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Blender], Path]:
    """Installs and draws once in each Blender that is asked for; the files it left"""

    @cache
    def draw(blender: Blender) -> Path:
        skip_without(blender)
        kept = tmp_path_factory.mktemp("drawn")
        with blender.folder() as folder:
            done = folder.run_script(DRAW, folder.add(ZIP), folder.inside(folder.path))
            assert done.returncode == 0, said(done)
            assert "espalier: came to the end" in done.stdout, said(done)
            for name in ("preview.npy", "render.npy", "cli.png", "cli.json", "scene.blend"):
                shutil.copy(folder.path / name, kept)
        return kept

    return draw


def said(done: subprocess.CompletedProcess[str]) -> str:
    return f"exit code {done.returncode}\n{done.stdout[-4000:]}\n{done.stderr[-4000:]}"


def assert_same_picture(one: np.ndarray, other: np.ndarray) -> None:
    assert one.shape == other.shape
    outliers = np.mean(np.abs(one - other).max(axis=-1) > CLOSE)
    assert outliers <= MOST_OUTLIERS, f"{outliers:.2%} of the pixels differ by more than {CLOSE}"


@pytest.mark.parametrize("blender", BLENDERS, ids=lambda blender: blender.name)
def test_installed_extension_draws(blender: Blender, drawn: Callable[[Blender], Path]) -> None:
    files = drawn(blender)
    preview = np.load(files / "preview.npy")
    assert preview.shape == (64, 96, 3)
    assert np.isfinite(preview).all()
    # The red box, the blue row and the lit floor are all in it.
    red, green, blue = np.moveaxis(preview, -1, 0)
    assert np.mean(red > 2 * (blue + 1e-3)) > 0.02
    assert np.mean(blue > 2 * (red + 1e-3)) > 0.005
    assert np.mean(green) > 0.05
    assert_same_picture(np.load(files / "render.npy"), preview)
    report = json.loads((files / "cli.json").read_text(encoding="utf-8"))
    assert [row["threads"] for row in report["threads"]] == [1, 2]
    assert len({row["checksum"] for row in [report["serial"], *report["threads"]]}) == 1
    assert report["triangles"] == 12 + 12 + 4 * 4 + 2
    assert (files / "cli.png").stat().st_size > 1000


@pytest.mark.parametrize("blender", BLENDERS[1:], ids=lambda blender: blender.name)
def test_same_picture_in_every_blender(blender: Blender, drawn: Callable[[Blender], Path]) -> None:
    first = drawn(BLENDERS[0])
    other = drawn(blender)
    assert_same_picture(np.load(other / "preview.npy"), np.load(first / "preview.npy"))
    trees = [json.loads((files / "cli.json").read_text(encoding="utf-8"))["serial"] for files in (first, other)]
    assert trees[0]["nodes"] == trees[1]["nodes"]


def test_command_of_the_real_blender(drawn: Callable[[Blender], Path]) -> None:
    """Installed by Blender's own command line, then `blender -b FILE -c espalier`, with the exit codes of scripts"""
    files = drawn(REAL)
    with REAL.folder() as folder:
        zip_file, scene = folder.add(ZIP), folder.add(files / "scene.blend")
        done = folder.run("blender", "--command", "extension", "install-file", "-r", "user_default", "-e", zip_file)
        assert done.returncode == 0, said(done)

        def espalier(*arguments: str) -> subprocess.CompletedProcess[str]:
            return folder.run("blender", "-b", scene, "-c", "espalier", *arguments)

        picture, timings = folder.path / "out.png", folder.path / "timings.json"
        outputs = ("--output", folder.inside(picture), "--json", folder.inside(timings))
        done = espalier("preview", *outputs, "--threads", "1,2")
        assert done.returncode == 0, said(done)
        assert picture.read_bytes() == (files / "cli.png").read_bytes()
        report = json.loads(timings.read_text(encoding="utf-8"))
        assert [row["threads"] for row in report["threads"]] == [1, 2]
        assert report["serial"]["checksum"] in done.stdout

        done = folder.run("blender", "-b", "-c", "espalier", "preview", scene, *outputs, "--threads", "1,2")
        assert done.returncode == 0, said(done)
        assert picture.read_bytes() == (files / "cli.png").read_bytes()

        picture.unlink()
        done = folder.run("blender", "-b", "/missing.blend", "-c", "espalier", "preview", *outputs)
        assert done.returncode == 1, said(done)
        assert "no file is open" in done.stderr
        assert not picture.exists()

        done = espalier("preview", *outputs, "--threads", "0")
        assert done.returncode == 2, said(done)
        assert "--threads" in done.stderr
        done = espalier("preview", "--output", "/dev/null/out.png")
        assert done.returncode == 1, said(done)
        assert "error" in done.stderr
