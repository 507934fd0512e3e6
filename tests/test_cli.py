# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line as scripts use it: exit codes, files, messages, in a process of its own."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.stage import Stage

ROOT = Path(__file__).resolve().parent.parent
SMALL = ["--percentage", "2", "--samples", "1"]


def espalier(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "addon", *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)


@pytest.fixture
def blend(stage: Stage, tmp_path: Path) -> Path:
    stage.cube()
    stage.camera()
    path = tmp_path / "cube.blend"
    stage.bpy.ops.wm.save_as_mainfile(filepath=str(path))
    return path


def test_a_blend_file_gives_picture_and_timings(blend: Path, tmp_path: Path) -> None:
    picture, timings = tmp_path / "a" / "out.png", tmp_path / "b" / "timings.json"
    done = espalier("preview", blend, "--output", picture, "--json", timings, "--threads", "1,2", *SMALL)
    assert done.returncode == 0, done.stderr
    assert picture.read_bytes().startswith(b"\x89PNG")
    report = json.loads(timings.read_text())
    assert (report["triangles"], report["resolution"], report["settings_used"]) == (12, [38, 21], "viewport")
    assert [row["threads"] for row in report["threads"]] == [1, 2]
    assert len({row["checksum"] for row in [report["serial"], *report["threads"]]}) == 1
    assert report["build"]["checksum"] in done.stdout
    assert "2 threads" in done.stdout
    assert list((tmp_path / "a").iterdir()) == [picture]


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".glb"])
def test_other_files_are_imported_and_framed(stage: Stage, tmp_path: Path, suffix: str) -> None:
    stage.cube(location=(100.0, 0.0, 0.0))
    path = tmp_path / f"cube{suffix}"
    export = {
        ".obj": stage.bpy.ops.wm.obj_export,
        ".ply": stage.bpy.ops.wm.ply_export,
        ".glb": stage.bpy.ops.export_scene.gltf,
    }[suffix]
    export(filepath=str(path))
    picture, timings = tmp_path / "out.png", tmp_path / "timings.json"
    done = espalier("preview", path, "--output", picture, "--json", timings, "--threads", "1", *SMALL)
    assert done.returncode == 0, done.stderr
    assert "no camera" in done.stderr
    report = json.loads(timings.read_text())
    assert (report["scene"], report["triangles"]) == ("cube", 12)
    image = stage.bpy.data.images.load(str(picture))
    width, height = image.size
    values = list(image.pixels)
    centre, corner = (height // 2 * width + width // 2) * 4, 0
    assert sum(values[centre : centre + 3]) > sum(values[corner : corner + 3]) + 0.3


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ([], "COMMAND"),
        (["preview"], "--output"),
        (["preview", "--output", "out.gif"], "does not end in .png"),
        (["preview", "--output", "out.png", "--threads", "1,x"], "whole number"),
        (["preview", "--output", "out.png", "--threads", "0"], "whole number"),
        (["preview", "--output", "out.png", "--quality", "lavish"], "invalid choice"),
        (["preview", "--output", "out.png", "--samples", "0"], "whole number"),
        (["preview", "--output", "out.png", "--percentage", "-5"], "whole number"),
        (["preview", "nowhere.blend", "--output", "out.png"], "there is no file"),
        (["preview", "README.md", "--output", "out.png"], "neither a .blend"),
        (["preview", "--output", "out.png", "--json", "folder/../out.png"], "the same file"),
        (["draw"], "invalid choice"),
    ],
)
def test_bad_arguments_are_2_without_leaving_blender(
    arguments: list[str], reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    from addon.cli import main

    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert reason in captured.err
    assert captured.out == ""


def test_bad_arguments_are_2_in_a_process() -> None:
    done = espalier("preview", "--output", "out.png", "--samples", "many")
    assert done.returncode == 2
    assert "whole number" in done.stderr


def test_help_is_no_failure(capsys: pytest.CaptureFixture[str]) -> None:
    from addon.cli import main

    assert main(["preview", "--help"]) == 0
    assert "--percentage" in capsys.readouterr().out


def test_a_scene_without_a_camera_that_was_not_named_is_1(
    stage: Stage, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    from addon.cli import main

    stage.cube()
    assert main(["preview", "--output", str(tmp_path / "out.png"), *SMALL]) == 1
    assert "no active camera" in capfd.readouterr().err
    assert not (tmp_path / "out.png").exists()


def test_blenders_own_command_draws_no_start_up_scene(
    stage: Stage, blend: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from addon import cli

    commands: dict[str, Any] = {}
    monkeypatch.setattr(stage.bpy.utils, "register_cli_command", commands.__setitem__)
    cli.register()
    command = commands["espalier"]
    picture = tmp_path / "out.png"
    words = ["preview", "--output", str(picture), "--threads", "1", *SMALL]
    assert command(words) == 0  # the file is open

    picture.unlink()
    stage.bpy.ops.wm.read_homefile(use_factory_startup=True)
    assert stage.bpy.context.scene.camera is not None
    assert command(words) == 1
    assert "no file is open" in capfd.readouterr().err
    assert not picture.exists()
    assert cli.main(words) == 0  # a script knows what is in memory
    assert command([*words, str(blend)]) == 0


def test_failures_are_1_with_the_reason_on_standard_error(blend: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.blend"
    broken.write_text("this is no Blender file")
    done = espalier("preview", broken, "--output", tmp_path / "out.png")
    assert done.returncode == 1
    assert "cannot read" in done.stderr
    assert "Traceback" not in done.stderr

    in_the_way = tmp_path / "file"
    in_the_way.write_text("")
    done = espalier("preview", blend, "--output", in_the_way / "out.png", *SMALL)
    assert done.returncode == 1
    assert "espalier: error:" in done.stderr


def test_nothing_to_see_is_1(tmp_path: Path) -> None:
    empty = tmp_path / "empty.obj"
    empty.write_text("# nothing\n")
    done = espalier("preview", empty, "--output", tmp_path / "out.png")
    assert done.returncode == 1
    assert "nothing to see in “empty”" in done.stderr
