# SPDX-License-Identifier: GPL-3.0-or-later
"""The path from a scene to picture and report, watched or not, and through the render engine."""

from __future__ import annotations

import json
import time
from contextlib import nullcontext
from math import nan
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.stage import Stage

PHASES = ["evaluation", "export", "placing", "bounds", "top_levels", "subtrees", "compaction", "layout", "trace"]
ENDLESS = 4096  # samples that no test waits for


@pytest.fixture
def cube(stage: Stage) -> Stage:
    """A cube, a lamp, a camera that looks down on them; 64 x 48 pixels."""
    stage.cube()
    lamp = stage.bpy.data.lights.new("Lamp", "POINT")
    lamp.energy = 500.0
    stage.add("Lamp", lamp, location=(3, 2, 6))
    stage.camera()
    render = stage.scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = 64, 48, 100
    return stage


def run_of(stage: Stage, **settings: Any) -> Any:
    from addon import pipeline

    preview, counts = settings.pop("preview", True), settings.pop("counts", ())
    depsgraph, evaluation_ms = pipeline.evaluate(stage.bpy.context)
    options = pipeline.Options(**{"samples": 1, **settings})
    return pipeline.Run(depsgraph, options, preview=preview, counts=counts, evaluation_ms=evaluation_ms)


def remembered() -> np.ndarray:
    from addon import picture

    pixels = picture.remember()
    assert pixels is not None
    return pixels


def finished(run: Any) -> Any:
    end = time.monotonic() + 60.0
    while not run.wait(0.1):
        assert 0.0 <= run.progress <= 1.0
        assert time.monotonic() < end, f"still {run.stage} after a minute"
    return run.result()


def test_a_run_draws_and_reports(cube: Stage) -> None:
    result = finished(run_of(cube, counts=[1, 2]))
    image, report = result.image, result.report
    assert image.shape == (48, 64, 4)
    assert image.dtype == np.float32
    assert image[24, 32, :3].max() > 10.0 * image[2, 2, :3].max()
    assert list(report["phases_ms"]) == PHASES
    assert all(ms >= 0.0 for ms in report["phases_ms"].values())
    assert (report["scene"], report["settings_used"], report["resolution"]) == ("Scene", "viewport", [64, 48])
    assert report["triangles"] == report["build"]["triangles"] == 12
    assert [row["threads"] for row in report["threads"]] == [1, 2]
    assert {row["checksum"] for row in [report["serial"], *report["threads"], report["build"]]} == {
        report["build"]["checksum"]
    }
    (entry,) = report["objects"]
    assert (entry["object"], entry["triangles"]) == ("Cube", 12)
    assert json.loads(json.dumps(report)) == report


def test_a_comparison_needs_no_camera_and_draws_nothing(cube: Stage) -> None:
    cube.scene.camera = None
    result = finished(run_of(cube, preview=False, counts=[1]))
    assert result.image is None
    assert list(result.report["phases_ms"]) == ["evaluation", "export"]
    assert result.report["serial"]["triangles"] == 12


def test_options_reach_the_picture(cube: Stage) -> None:
    result = finished(run_of(cube, percentage=50, samples=3, threads=1, quality="draft"))
    assert result.image.shape == (24, 32, 4)
    assert result.report["trace"]["samples"] == 3
    assert result.report["build"]["threads"] == 1
    with pytest.raises(ValueError, match="quality"):
        finished(run_of(cube, quality="lavish"))


def test_every_quality_and_thread_count_gives_the_same_picture(cube: Stage) -> None:
    pictures = [finished(run_of(cube, quality=quality, threads=threads)).image for quality, threads in
                (("draft", 1), ("balanced", 2), ("best", 3))]  # fmt: skip
    for picture in pictures[1:]:
        np.testing.assert_array_equal(picture, pictures[0])


def test_negative_scale_does_not_turn_the_shading(cube: Stage) -> None:
    expected = finished(run_of(cube)).image
    cube.scene.objects["Cube"].scale = (-1.0, 1.0, 1.0)
    np.testing.assert_allclose(finished(run_of(cube)).image, expected, atol=1e-4)


def test_the_table_says_what_the_report_says(cube: Stage) -> None:
    from addon import report

    done = finished(run_of(cube, counts=[1, 2])).report
    text = report.table(done)
    for name in PHASES:
        assert name.replace("_", " ").capitalize() in text
    row = next(line for line in text.splitlines() if line.startswith("2 threads")).split()
    last = done["threads"][1]
    assert row[2] == f"{last['build_ms']:.2f}"
    assert row[6:] == [
        f"{last['speed_up']:.2f}",
        f"{last['efficiency']:.0%}",
        f"{last['mtri_per_s']:.2f}",
        last["checksum"],
    ]
    assert f"{done['build']['nodes']:,} nodes" in text
    for name in done["build"]["sah_constants"]:
        assert name.replace("_", " ") in text


def test_faults_are_named_by_object(cube: Stage) -> None:
    from addon import report

    vertices = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (2.0, 0.0, 0.0), (0.0, 1.0, 0.0), (nan, 0.0, 0.0)]
    flat = cube.mesh("Terrain", vertices[:4], [(0, 1, 2), (0, 1, 1), (0, 1, 3)])
    cube.add("Terrain", flat)
    broken = cube.mesh("Broken", [(0.0, 0.0, 0.0)] * 5, [(0, 1, 2), (0, 1, 4)])
    broken.attributes["position"].data.foreach_set("vector", np.array(vertices, np.float32).ravel())
    cube.add("Broken", broken)
    done = finished(run_of(cube)).report
    lines = report.warnings(done)
    assert "Broken: 1 face is not finite" in lines
    assert "Terrain: 2 faces have no area" in lines or "Terrain: 1 face has no area" in lines
    assert not any(line.startswith("Cube") for line in lines)


def test_an_empty_scene_gives_the_background_and_a_warning(stage: Stage) -> None:
    from addon import report

    stage.camera()
    stage.scene.render.resolution_x = stage.scene.render.resolution_y = 8
    result = finished(run_of(stage))
    assert result.image.shape == (8, 8, 4)
    assert report.warnings(result.report) == ["Nothing to draw: the scene has no visible faces"]


def test_cancel_is_quick_and_says_so(cube: Stage) -> None:
    from addon import pipeline

    run = run_of(cube, samples=ENDLESS, percentage=1000, counts=[1, 2])
    time.sleep(0.3)
    assert not run.done
    start = time.monotonic()
    run.cancel()
    assert run.wait(5.0)
    assert time.monotonic() - start < 1.0  # 0.1 s by promise; the rest is for a busy machine
    with pytest.raises(pipeline.Cancelled):
        run.result()


@pytest.mark.parametrize("way", ["Esc", "Cancel button"])
def test_a_watched_run_keeps_picture_and_report(addon: ModuleType, cube: Stage, way: str) -> None:
    from addon import picture
    from addon.session import PREVIEW, Session, last_report

    session = Session(cube.bpy.context, PREVIEW)
    assert session.run.wait(30.0)
    report = session.finish()
    assert last_report(cube.scene, PREVIEW) is report
    shown = cube.bpy.data.images[picture.NAME]
    assert tuple(shown.size) == (64, 48)
    good = remembered()
    assert good[24, 32, :3].max() > 0.0

    names = {block.name for block in cube.bpy.data.objects}
    cube.scene.espalier.samples = ENDLESS
    cube.scene.render.resolution_percentage = 1000
    session = Session(cube.bpy.context, PREVIEW)
    end = time.monotonic() + 30.0
    while session.look() is None and time.monotonic() < end:
        time.sleep(0.05)
    assert tuple(shown.size) == (640, 480)  # the new picture was growing
    if way == "Esc":
        session.cancel()
    else:
        session.run.cancel()
        assert session.run.wait(5.0)
        with pytest.raises(addon.session.pipeline.Cancelled):
            session.finish()
    assert tuple(shown.size) == (64, 48)
    np.testing.assert_array_equal(remembered(), good)
    assert last_report(cube.scene, PREVIEW) is report
    assert {block.name for block in cube.bpy.data.objects} == names


def test_a_first_run_that_is_cancelled_leaves_no_picture(addon: ModuleType, cube: Stage) -> None:
    from addon import picture
    from addon.session import PREVIEW, Session, last_report

    cube.scene.espalier.samples = ENDLESS
    cube.scene.render.resolution_percentage = 1000
    session = Session(cube.bpy.context, PREVIEW)
    session.cancel()
    assert picture.NAME not in cube.bpy.data.images
    assert last_report(cube.scene, PREVIEW) is None


def test_the_buttons_work_in_background_and_reuse_the_image(addon: ModuleType, cube: Stage) -> None:
    from addon import picture, pipeline
    from addon.session import COMPARE, PREVIEW, last_report, newest_report

    bpy = cube.bpy
    for percentage in (100, 50):
        cube.scene.espalier.use_percentage = True
        cube.scene.espalier.percentage = percentage
        assert bpy.ops.espalier.preview() == {"FINISHED"}
        assert [image.name for image in bpy.data.images if image.type != "RENDER_RESULT"] == [picture.NAME]
        assert tuple(bpy.data.images[picture.NAME].size) == (64 * percentage // 100, 48 * percentage // 100)
    assert bpy.ops.espalier.compare() == {"FINISHED"}
    compared = last_report(cube.scene, COMPARE)
    assert compared is not None
    assert [row["threads"] for row in compared["threads"]] == pipeline.thread_counts()

    good = remembered()
    cube.scene.camera = None
    with pytest.raises(RuntimeError, match="no active camera"):
        bpy.ops.espalier.preview()
    np.testing.assert_array_equal(remembered(), good)
    assert last_report(cube.scene, PREVIEW) is not None
    other = bpy.data.scenes.new("Other")
    assert last_report(other, PREVIEW) is newest_report(other) is None


def test_the_overlay_shows_the_run_that_was_last(addon: ModuleType, cube: Stage) -> None:
    from addon.session import COMPARE, PREVIEW, last_report, newest_report

    assert newest_report(cube.scene) is None
    for operator, kind in (("preview", PREVIEW), ("compare", COMPARE), ("preview", PREVIEW)):
        assert getattr(cube.bpy.ops.espalier, operator)() == {"FINISHED"}
        assert newest_report(cube.scene) is last_report(cube.scene, kind)


class Watcher:
    """Blender's part while an operator is at work in a window: the operator's own methods, and what it asks for."""

    def __init__(self, addon: ModuleType, stage: Stage) -> None:
        operators = addon.operators
        self.asked: list[str] = []
        self.told: list[tuple[set[str], str]] = []

        class Operator(operators._Watched):  # type: ignore[name-defined]
            kind = operators.PREVIEW
            present = operators.ESPALIER_OT_preview.present

            def report(operator, kind: set[str], text: str) -> None:  # noqa: N805
                self.told.append((kind, text))

        manager = SimpleNamespace(
            windows=[],
            event_timer_add=lambda *_, **__: "timer",
            event_timer_remove=lambda timer: self.asked.append(f"remove {timer}"),
            modal_handler_add=lambda _: None,
            progress_begin=lambda *_: None,
            progress_update=lambda _: None,
            progress_end=lambda: self.asked.append("progress_end"),
        )
        self.context = SimpleNamespace(
            scene=stage.scene,
            view_layer=stage.bpy.context.view_layer,
            evaluated_depsgraph_get=stage.bpy.context.evaluated_depsgraph_get,
            window=SimpleNamespace(),
            window_manager=manager,
            workspace=SimpleNamespace(status_text_set=lambda text: self.asked.append(f"status {text}")),
        )
        self.operator: Any = Operator()

    def start(self, operators: ModuleType, monkeypatch: pytest.MonkeyPatch) -> Any:
        app = SimpleNamespace(background=False)
        monkeypatch.setattr(operators, "bpy", SimpleNamespace(**{**vars(operators.bpy), "app": app}))
        assert self.operator.invoke(self.context, None) == {"RUNNING_MODAL"}
        return operators.at_work()

    def tick(self) -> set[str]:
        done: set[str] = self.operator.modal(self.context, SimpleNamespace(type="TIMER", value="NOTHING"))
        return done


@pytest.mark.parametrize("when", ["at work", "done"])
def test_an_error_in_the_window_ends_the_run_and_frees_the_buttons(
    addon: ModuleType, cube: Stage, monkeypatch: pytest.MonkeyPatch, when: str
) -> None:
    from addon import operators, picture

    good = np.full((48, 64, 4), 0.25, np.float32)
    picture.show(good)
    if when == "at work":
        cube.scene.espalier.samples = ENDLESS
        cube.scene.render.resolution_percentage = 1000
    watcher = Watcher(addon, cube)
    session = watcher.start(operators, monkeypatch)

    def fail(*_: Any) -> bool:
        raise RuntimeError("no area for you")

    monkeypatch.setattr(picture, "open_editor", fail)
    if when == "done":
        assert session.run.wait(30.0)
    end = time.monotonic() + 30.0
    while (outcome := watcher.tick()) == {"PASS_THROUGH"} and time.monotonic() < end:
        time.sleep(0.05)
    assert outcome == {"CANCELLED"}
    assert ({"ERROR"}, "no area for you") in watcher.told
    assert watcher.asked[-3:] == ["remove timer", "progress_end", "status None"]
    assert session.run.done
    assert operators.at_work() is None
    if when == "at work":
        np.testing.assert_array_equal(remembered(), good)
    else:
        assert np.abs(remembered() - good).max() > 0.1  # the new picture is whole, only no area shows it


def test_unregistering_ends_the_run_without_its_operator(
    addon: ModuleType, cube: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    from addon import operators

    cube.scene.espalier.samples = ENDLESS
    cube.scene.render.resolution_percentage = 1000
    watcher = Watcher(addon, cube)
    with monkeypatch.context() as window:
        session = watcher.start(operators, window)
    monkeypatch.setattr(operators, "tidy", lambda _, tidy=operators.tidy: tidy(watcher.context))
    del watcher.operator.session  # freed
    addon.unregister()
    try:
        assert session.run.done
        assert watcher.asked == ["remove timer", "progress_end", "status None"]
        assert operators.at_work() is None
    finally:
        addon.register()


@pytest.mark.parametrize("why", ["maximised", "poll"])
def test_what_cannot_be_split_is_left_alone(
    addon: ModuleType, cube: Stage, monkeypatch: pytest.MonkeyPatch, why: str
) -> None:
    from addon import picture

    image = picture.show(np.zeros((2, 2, 4), np.float32))

    class Area(SimpleNamespace):
        __hash__ = object.__hash__  # type: ignore[assignment]

    class Split:
        poll = staticmethod(lambda: why != "poll")

        def __call__(self, **_: Any) -> None:
            raise RuntimeError("Operator bpy.ops.screen.area_split.poll() failed, context is incorrect")

    ops = SimpleNamespace(screen=SimpleNamespace(area_split=Split()))
    monkeypatch.setattr(picture, "bpy", SimpleNamespace(**{**vars(cube.bpy), "ops": ops}))
    area = Area(type="VIEW_3D", ui_type="VIEW_3D", width=9, height=9, regions=[SimpleNamespace(type="WINDOW")])
    screen = SimpleNamespace(show_fullscreen=why == "maximised", areas=[area])
    window = SimpleNamespace(screen=screen)
    context: Any = SimpleNamespace(
        window=window,
        window_manager=SimpleNamespace(windows=[window]),
        temp_override=lambda **_: nullcontext(),
    )
    assert not picture.open_editor(context, image)
    assert not picture.is_shown(context, image)


def test_undo_does_not_take_the_picture_away(addon: ModuleType, cube: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    from addon import operators, picture

    bpy = cube.bpy
    bpy.ops.ed.undo_push(message="before")
    watcher = Watcher(addon, cube)
    with monkeypatch.context() as window:
        window.setattr(picture, "open_editor", lambda *_: False)
        assert watcher.start(operators, window).run.wait(30.0)
        assert watcher.tick() == {"FINISHED"}
    bpy.context.scene.render.resolution_x = 77
    bpy.ops.ed.undo_push(message="an edit")
    bpy.ops.ed.undo()
    assert bpy.context.scene.render.resolution_x == 64
    assert picture.NAME in bpy.data.images


def test_the_picture_file_has_the_view_transform_and_leaves_the_settings_alone(cube: Stage, tmp_path: Path) -> None:
    from addon import picture

    settings = cube.scene.render.image_settings
    settings.file_format = "OPEN_EXR"
    cube.scene.view_settings.view_transform = "Standard"
    cube.scene.render.dither_intensity = 0.0
    pixels = np.zeros((2, 3, 4), np.float32)
    pixels[..., 3] = 1.0
    pixels[0, 0, :3] = (0.5, 0.0, 1.0)
    path = tmp_path / "new" / "folder" / "picture.png"
    picture.write_png(pixels, path, cube.scene)
    assert settings.file_format == "OPEN_EXR"
    assert path.read_bytes().startswith(b"\x89PNG")
    assert [item.name for item in path.parent.iterdir()] == ["picture.png"]
    loaded = cube.bpy.data.images.load(str(path))
    assert tuple(loaded.size) == (3, 2)
    assert list(loaded.pixels[:3]) == pytest.approx([188 / 255, 0.0, 1.0], abs=1 / 255)
    assert list(loaded.pixels[4:7]) == [0.0, 0.0, 0.0]


def test_a_file_that_cannot_be_written_leaves_the_old_one(tmp_path: Path) -> None:
    from addon import picture

    path = tmp_path / "timings.json"
    path.write_text("old")

    def fail() -> None:
        with picture.replaced(path) as unfinished:
            unfinished.write_text("half")
            raise RuntimeError("disk full")

    with pytest.raises(RuntimeError, match="disk full"):
        fail()
    assert [item.name for item in tmp_path.iterdir()] == ["timings.json"]
    assert path.read_text() == "old"


def rendered(stage: Stage, path: Path) -> np.ndarray:
    """The pixels that F12 gives, float32 [H,W,4], bottom row first."""
    render = stage.scene.render
    render.image_settings.file_format, render.filepath = "OPEN_EXR", str(path)
    render.image_settings.color_mode, render.image_settings.color_depth = "RGBA", "32"
    stage.bpy.ops.render.render(write_still=True)
    image = stage.bpy.data.images.load(str(path))
    pixels = np.empty((image.size[1], image.size[0], 4), np.float32)
    image.pixels.foreach_get(pixels.ravel())
    return pixels


def test_f12_draws_the_same_picture_with_render_settings(addon: ModuleType, cube: Stage, tmp_path: Path) -> None:
    cube.cube("Render only", hide_viewport=True, location=(2.5, 0, 0), scale=(0.5,) * 3)
    cube.scene.render.engine = "ESPALIER"
    cube.scene.espalier.samples = 2
    drawn = rendered(cube, tmp_path / "f12.exr")
    viewport = finished(run_of(cube, samples=2)).image
    assert np.abs(drawn - viewport).max() > 0.1
    cube.scene.objects["Render only"].hide_viewport = False
    np.testing.assert_allclose(finished(run_of(cube, samples=2)).image, drawn, atol=1e-6)


def test_f12_keeps_the_scenes_resolution(addon: ModuleType, cube: Stage, tmp_path: Path) -> None:
    cube.scene.render.engine = "ESPALIER"
    whole = rendered(cube, tmp_path / "whole.exr")
    for percentage in (50, 200):
        cube.scene.espalier.use_percentage, cube.scene.espalier.percentage = True, percentage
        np.testing.assert_array_equal(rendered(cube, tmp_path / f"{percentage}.exr"), whole)


@pytest.mark.parametrize("crop", [False, True])
def test_f12_shows_only_the_render_region(addon: ModuleType, cube: Stage, tmp_path: Path, crop: bool) -> None:
    cube.scene.render.engine = "ESPALIER"
    whole = rendered(cube, tmp_path / "whole.exr")
    render = cube.scene.render
    render.use_border, render.use_crop_to_border = True, crop
    render.border_min_x, render.border_max_x, render.border_min_y, render.border_max_y = 0.3, 0.71, 0.4, 0.9
    part = rendered(cube, tmp_path / "part.exr")
    left, right, bottom, top = int(0.3 * 64), int(0.71 * 64), int(0.4 * 48), int(0.9 * 48)
    if not crop:
        assert part.shape == whole.shape
        assert part[0, 0].max() == 0.0
        part = part[bottom:top, left:right]
    np.testing.assert_array_equal(part, whole[bottom:top, left:right])


def test_f12_without_a_usable_camera_is_an_error(addon: ModuleType, cube: Stage) -> None:
    cube.scene.render.engine = "ESPALIER"
    cube.scene.camera.data.type = "PANO"
    with pytest.raises(RuntimeError, match="panoramic"):
        cube.bpy.ops.render.render()
