# SPDX-License-Identifier: GPL-3.0-or-later
"""A real Blender in a real window on a virtual screen: the panel is there, its buttons work, the overlay is drawn."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from tests.blenders import BLENDERS, REAL, ROOT
from tests.test_package import ZIP

WINDOW = ROOT / "tests/in_blender/window.py"
SHOTS = ROOT / "build/screenshots"
SIZE = (1280, 800)

pytestmark = [
    pytest.mark.skipif(not ZIP.exists(), reason=f"no {ZIP.name} here: make package"),
    *(pytest.mark.skipif(bool(made.missing()), reason=made.missing() or "") for made in (BLENDERS[0], REAL)),
]


def test_panel_and_overlay_in_a_window() -> None:
    width, height = SIZE
    screen = f"-screen 0 {width}x{height}x24 -nolisten tcp"
    start = ("blender", "--factory-startup", "-p", "0", "0", str(width), str(height), "--python")
    SHOTS.mkdir(parents=True, exist_ok=True)
    with BLENDERS[0].folder() as maker, REAL.folder() as folder:
        # Made in the oldest Blender, which all others can read.
        maker.add(ROOT / "scenes/kit.py")
        done = maker.run_script(ROOT / "scenes/interior.py", str(maker.path / "interior.blend"))
        assert done.returncode == 0, done.stderr
        arguments = (folder.add(ZIP), folder.add(maker.path / "interior.blend"), folder.inside(folder.path))
        done = folder.run("xvfb-run", "-a", "-s", screen, *start, folder.add(WINDOW), "--", *arguments)
        for shot in folder.path.glob("*.png"):
            shutil.copy(shot, SHOTS)
        assert "espalier: came to the end" in done.stdout, f"{done.stdout[-4000:]}\n{done.stderr[-4000:]}"
        places = json.loads((folder.path / "window.json").read_text(encoding="utf-8"))
        shots = {}
        for name in ("before", "after"):
            raw = folder.path / f"{name}.rgb"
            folder.run("convert", folder.inside(folder.path / f"{name}.png"), "-depth", "8", folder.inside(raw))
            shots[name] = np.fromfile(raw, np.uint8).reshape(height, width, 3)[::-1].astype(float) / 255.0

    def part(shot: str, box: dict[str, float]) -> np.ndarray:
        x, y = round(box["x"]), round(box["y"])
        return shots[shot][y : y + round(box["height"]), x : x + round(box["width"])]

    changed = np.abs(part("after", places["sidebar"]) - part("before", places["sidebar"])).max(axis=-1) > 0.1
    assert np.mean(changed) > 0.02, "the sidebar looks the same with and without the Espalier tab"

    background, *bars = places["boxes"]
    assert len(bars) >= 2  # serial, and at least one thread count
    assert places["labels"] == 1 + 2 * len(bars)
    # Judged below the bars: how much of the box they and the text cover depends on what the builds took.
    ground = {**background, "height": min(bar["y"] for bar in bars) - background["y"] - 1.0}
    assert np.median(part("after", ground) / part("before", ground)) < 0.75, "no dark ground for the bars"
    for bar in bars:
        inner = part("after", bar)[2:-2, 1:-1]
        assert np.abs(np.median(inner, axis=(0, 1)) - bar["color"][:3]).max() < 0.03
        assert np.abs(np.median(part("before", bar), axis=(0, 1)) - bar["color"][:3]).max() > 0.05
    # Text beside the bars: light on dark.
    left = {**background, "width": bars[0]["x"] - background["x"]}
    assert np.mean(part("after", left).min(axis=-1) > 0.6) > 0.01
