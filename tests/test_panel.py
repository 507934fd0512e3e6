# SPDX-License-Identifier: GPL-3.0-or-later
"""What Blender's interface is given: registration without traces, the panels, and the overlay's layout."""

from __future__ import annotations

import itertools
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from tests.stage import Stage


def a_row(threads: int, ms: float, **more: Any) -> dict[str, Any]:
    return {
        "threads": threads, "build_ms": ms, "build_ms_min": ms - 1.0, "build_ms_max": ms + 1.0, "repeats": 5,
        "speed_up": 100.0 / ms, "efficiency": 100.0 / ms / threads, "mtri_per_s": 1.0, "triangles": 1000, "nodes": 11,
        "leaves": 6, "empty_leaves": 1, "references": 1500, "bytes": 4_200_000, "sah_cost": 31.5,
        "sah_constants": {"traversal": 1.0, "intersection": 2.0}, "checksum": "00112233aabbccdd", **more,
    }  # fmt: skip


def a_report(**more: Any) -> dict[str, Any]:
    return {
        "scene": "Scene", "settings_used": "viewport", "quality": "balanced", "resolution": [64, 48], "triangles": 1000,
        "phases_ms": {"evaluation": 1.0, "export": 2.0, "top_levels": 40.0, "trace": 20.0}, "left_out": {},
        "objects": [{"object": "Terrain", "triangles": 1000, "rejected_faces": {"not_finite": 0, "no_area": 12},
                     "lost_precision": {}}],
        "machine": {}, "build": a_row(2, 60.0), **more,
    }  # fmt: skip


def a_comparison() -> dict[str, Any]:
    return a_report(serial=a_row(1, 100.0), threads=[a_row(1, 110.0), a_row(2, 55.0), a_row(4, 30.0)])


class Layout:
    """Stands in for Blender's layout: remembers what is asked of it, and that it exists."""

    def __init__(self, bpy: ModuleType, seen: list[str] | None = None) -> None:
        self.bpy = bpy
        self.seen: list[str] = [] if seen is None else seen

    def _part(self, **_: Any) -> Layout:
        return Layout(self.bpy, self.seen)

    row = column = split = _part

    def label(self, *, text: str, icon: str = "NONE") -> None:
        assert icon in self.bpy.types.UILayout.bl_rna.functions["label"].parameters["icon"].enum_items
        self.seen.append(text)

    def prop(self, owner: Any, name: str) -> None:
        self.seen.append(owner.bl_rna.properties[name].name)

    def operator(self, name: str, *, icon: str, **_: Any) -> None:
        assert icon in self.bpy.types.UILayout.bl_rna.functions["label"].parameters["icon"].enum_items
        module, function = name.split(".")
        self.seen.append(getattr(getattr(self.bpy.ops, module), function).get_rna_type().name)


def drawn(bpy: ModuleType, panel: Any) -> list[str]:
    layout = Layout(bpy)
    panel.draw(
        SimpleNamespace(layout=layout, kind=getattr(panel, "kind", None), draw_times=None), bpy.context
    ) if not hasattr(panel, "kind") else panel.draw(_Self(panel, layout), bpy.context)
    return layout.seen


class _Self:
    """A panel that is drawn without a screen."""

    def __init__(self, panel: Any, layout: Layout) -> None:
        self.layout, self.kind = layout, panel.kind
        self.draw_times = lambda *arguments: panel.draw_times(self, *arguments)


def state(bpy: ModuleType) -> dict[str, Any]:
    handlers = bpy.app.handlers
    lists = {name: len(getattr(handlers, name)) for name in dir(handlers) if isinstance(getattr(handlers, name), list)}
    engines = {
        panel.__name__
        for panel in bpy.types.Panel.__subclasses__()
        if "ESPALIER" in getattr(panel, "COMPAT_ENGINES", ())
    }
    return {
        "handlers": lists,
        "panels": engines,
        "property": hasattr(bpy.types.Scene, "espalier"),
        "types": {name for name in dir(bpy.types) if "espalier" in name.lower()},
        "operators": [name for name in dir(bpy.ops.espalier) if not name.startswith("_")],
    }


def test_registering_adds_no_handler_and_unregistering_leaves_nothing(bpy: ModuleType) -> None:
    import addon

    before = state(bpy)
    for _ in range(2):
        addon.register()
        try:
            during = state(bpy)
            assert during["handlers"] == before["handlers"]
            assert not addon.overlay.is_on()
            assert during["property"]
            assert sorted(during["operators"]) == ["cancel", "compare", "overlay", "preview"]
            assert {"RENDER_PT_format", "MATERIAL_PT_viewport"} & during["panels"]
        finally:
            addon.unregister()
        assert state(bpy) == before


def test_unregistering_ends_the_overlay(addon: ModuleType, bpy: ModuleType) -> None:
    if bpy.app.background and bpy.ops.espalier.overlay() == {"FINISHED"}:
        assert addon.overlay.is_on()
        addon.unregister()
        assert not addon.overlay.is_on()
        addon.register()


def test_every_setting_says_what_it_is_for(addon: ModuleType, stage: Stage) -> None:
    properties = [p for p in stage.scene.espalier.bl_rna.properties if p.identifier not in {"rna_type", "name"}]
    assert {p.identifier for p in properties} >= {"quality", "threads", "samples", "percentage"}
    assert all(p.description and not p.description.endswith(".") for p in properties)


def test_settings_become_options(addon: ModuleType, stage: Stage) -> None:
    from addon.pipeline import Options
    from addon.settings import options_of

    assert options_of(stage.scene) == Options()
    settings = stage.scene.espalier
    settings.quality, settings.threads, settings.samples, settings.percentage = "best", 3, 9, 25
    assert options_of(stage.scene) == Options("best", 3, 9, None)
    settings.use_percentage = True
    assert options_of(stage.scene) == Options("best", 3, 9, 25)


def test_the_main_panel_has_the_buttons_and_the_settings(addon: ModuleType, stage: Stage) -> None:
    seen = drawn(stage.bpy, addon.panels.ESPALIER_PT_preview)
    assert seen[:2] == ["Preview", "Compare Thread Counts"]
    assert {"Build Quality", "Threads", "Resolution", "Samples"} <= set(seen)


def test_the_result_panels_say_what_the_reports_say(
    addon: ModuleType, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    panels, session = addon.panels, addon.session
    context = stage.bpy.context
    assert not panels.ESPALIER_PT_preview_result.poll(context)
    key = stage.scene.session_uid
    monkeypatch.setitem(session._reports, (key, session.PREVIEW), a_report(left_out={"Fur": "hair curves"}))
    monkeypatch.setitem(session._reports, (key, session.COMPARE), a_comparison())
    assert panels.ESPALIER_PT_preview_result.poll(context)
    seen = drawn(stage.bpy, panels.ESPALIER_PT_preview_result)
    assert "Viewport settings" in seen
    assert "1,000 triangles, balanced" in seen
    assert seen[seen.index("Top levels") + 1] == "40.0 ms"
    assert "Terrain: 12 faces have no area" in seen
    assert "Fur: hair curves are not drawn" in seen
    seen = drawn(stage.bpy, panels.ESPALIER_PT_compare_result)
    assert seen[seen.index("serial") + 1] == "100.0 ms"
    assert seen[seen.index("4 threads") + 1] == "30.0 ms   3.33x   83%"
    assert "1.50 references per triangle, 4.2 MB" in seen


def test_different_trees_are_not_passed_over() -> None:
    from addon import report

    done = a_comparison()
    assert not any("differ" in line for line in report.warnings(done))
    done["threads"][2]["checksum"] = "ffff"
    assert any("differ" in line for line in report.warnings(done))


def text_width(text: str, size: float) -> float:
    return 0.6 * size * len(text)


@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_the_bars_are_as_long_as_the_builds_took(scale: float) -> None:
    from addon import overlay

    items = overlay.layout(a_comparison(), 50.0, 2000.0, scale, text_width)
    boxes = [item for item in items if isinstance(item, overlay.Box)]
    labels = [item for item in items if isinstance(item, overlay.Label)]
    panel, *bars = boxes
    assert [bar.width / bars[1].width for bar in bars] == pytest.approx([100 / 110, 1.0, 0.5, 30 / 110])
    assert bars[0].color != bars[1].color
    assert panel.x >= 50.0
    assert panel.x + panel.width <= 2000.0
    for bar in bars:
        assert panel.x < bar.x
        assert bar.x + bar.width < panel.x + panel.width
        assert panel.y < bar.y
        assert bar.y + bar.height < panel.y + panel.height
    for upper, lower in itertools.pairwise(bars):
        assert lower.y + lower.height < upper.y
    for label in labels:
        assert label.size == 12.0 * scale
        assert panel.x < label.x
        assert label.x + text_width(label.text, label.size) < panel.x + panel.width
        for bar in bars:
            apart = label.x + text_width(label.text, label.size) <= bar.x or label.x >= bar.x + bar.width
            assert apart or not bar.y <= label.y <= bar.y + bar.height
    assert [label.text for label in labels[1::2]] == ["serial", "1 thread", "2 threads", "4 threads"]


def test_without_a_comparison_the_phases_are_shown() -> None:
    from addon import overlay

    items = overlay.layout(a_report(), 0.0, 2000.0, 1.0, text_width)
    texts = [item.text for item in items if isinstance(item, overlay.Label)]
    assert texts[1::2] == ["Evaluation", "Export", "Top levels", "Trace"]


def test_a_narrow_viewport_stays_free() -> None:
    from addon import overlay

    assert overlay.layout(a_comparison(), 40.0, 200.0, 1.0, text_width) == []
    narrower = overlay.layout(a_comparison(), 0.0, 480.0, 1.0, text_width)
    assert narrower
    panel = narrower[0]
    assert isinstance(panel, overlay.Box)
    assert panel.x + panel.width <= 480.0
