# SPDX-License-Identifier: GPL-3.0-or-later
"""The one path from an evaluated scene to a picture and its timings.

The panel, the render engine, the command line and the tests all take it.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from .export import SceneArrays, export_scene
from .report import Report

try:
    import espalier_native
except ImportError as error:
    raise ImportError(
        "Espalier's native module cannot be loaded: install the extension's zip for this platform and Blender version "
        f"(in a checkout, run `make preview` once). {error}"
    ) from error

Cancelled = espalier_native.Cancelled


@dataclass(frozen=True)
class Options:
    """How to build and trace."""

    quality: str = "balanced"  # "draft", "balanced" or "best"
    threads: int = 0  # 0: all
    samples: int = 4  # per pixel
    percentage: int | None = None  # of the scene's resolution; None: the scene's own percentage
    on_demand: bool = False  # build subtrees of a large scene when rays enter them; no figures of the whole tree then


@dataclass(frozen=True)
class Result:
    """What a run that went well leaves behind."""

    image: NDArray[np.float32] | None  # [H,W,4], bottom row first, linear RGBA; None where only builds were compared
    report: Report


def thread_counts(limit: int = 0) -> list[int]:
    """1, 2, 4 … and at last `limit`, which is all threads of the machine where it is 0."""
    limit = limit or espalier_native.hardware_threads()
    return sorted({limit, *(1 << i for i in range(limit.bit_length()) if 1 << i <= limit)})


def evaluate(context: bpy.types.Context) -> tuple[bpy.types.Depsgraph, float]:
    """The evaluated depsgraph of the context, with viewport settings, and the milliseconds its evaluation took."""
    start = time.perf_counter()
    context.view_layer.update()
    depsgraph = context.evaluated_depsgraph_get()
    return depsgraph, (time.perf_counter() - start) * 1e3


class Run:
    """One exported scene, and the native jobs that work on it one after the other.

    The jobs own their threads and the scene is read before the constructor returns, so Blender may go on meanwhile:
    poll done, or wait(). preview: draw a picture; counts: the thread counts whose builds are compared, if any.
    Raises ExportError, or ValueError for an option that the native side does not know.
    """

    def __init__(
        self,
        depsgraph: bpy.types.Depsgraph,
        options: Options,
        *,
        preview: bool = True,
        counts: Sequence[int] = (),
        evaluation_ms: float = 0.0,
    ) -> None:
        arrays = export_scene(depsgraph, percentage=options.percentage, camera=preview)
        arrays.evaluation_ms += evaluation_ms
        self.size = arrays.width, arrays.height
        self._report = _report_of_export(arrays, depsgraph.scene.name, options)
        self._not_finite = arrays.not_finite
        scene = espalier_native.Scene(*arrays.to_native())
        self._objects = scene.objects
        self._report["precision"] = scene.precision
        self._preview: Any = None
        self._compare: Any = None
        self._waiting: list[Callable[[], None]] = []
        if preview:
            self._waiting.append(lambda: self._start_preview(scene, arrays, options))
        if counts:
            self._waiting.append(lambda: self._start_compare(scene, list(counts), options))
        self._steps = len(self._waiting)
        self._job: Any = None
        self._start_next()

    @property
    def done(self) -> bool:
        """Whether result() has something to say; starts the next job when one has ended well."""
        while self._job.done and self._waiting and self._job.stage == "done":
            self._start_next()
        return bool(self._job.done)

    @property
    def progress(self) -> float:
        """From 0 to 1 over all jobs of the run."""
        begun = self._steps - len(self._waiting)
        return (begun - 1 + float(self._job.progress)) / self._steps

    @property
    def stage(self) -> str:
        """What the native side does now, in one word."""
        return str(self._job.stage)

    def wait(self, timeout: float) -> bool:
        """Wait so many seconds at most; whether the run is done."""
        self._job.wait(timeout)
        return self.done

    def cancel(self) -> None:
        """Stop; the run is done within a tenth of a second, and its result() raises Cancelled."""
        self._waiting.clear()
        self._job.cancel()

    def image(self) -> NDArray[np.float32] | None:
        """What is drawn so far, float32 [H,W,4]; None before the first tile."""
        image: NDArray[np.float32] | None = None if self._preview is None else self._preview.image()
        return image

    def result(self) -> Result:
        """The picture and the report of a run that is done; raises Cancelled, or what went wrong."""
        report = self._report
        objects = self._objects
        image = None
        drawn = None if self._preview is None else self._preview.result()
        compared = None if self._compare is None else self._compare.result()
        if drawn is not None:
            image = drawn["image"]
            objects = drawn["objects"]
            report["phases_ms"]["placing"] = drawn["placing_ms"]
            report["phases_ms"].update(drawn["build"]["phases_ms"])
            report["phases_ms"]["trace"] = drawn["trace"]["trace_ms"]
            report["build"] = drawn["build"]
            report["trace"] = drawn["trace"]
        if compared is not None:
            report["serial"] = compared["serial"]
            report["threads"] = compared["threads"]
        report["objects"] = _with_lost_faces(objects, self._not_finite)
        return Result(image, report)

    def _start_next(self) -> None:
        self._waiting.pop(0)()

    def _start_preview(self, scene: espalier_native.Scene, arrays: SceneArrays, options: Options) -> None:
        assert arrays.camera is not None
        self._job = self._preview = espalier_native.start_preview(
            scene,
            {
                "type": arrays.camera.type,
                "matrix_world": arrays.camera.matrix_world,
                "projection": arrays.camera.projection,
            },
            arrays.lights,
            arrays.world_color,
            arrays.width,
            arrays.height,
            quality=options.quality,
            threads=options.threads,
            samples=options.samples,
            on_demand=options.on_demand,
        )

    def _start_compare(self, scene: espalier_native.Scene, counts: list[int], options: Options) -> None:
        self._job = self._compare = espalier_native.start_compare(scene, counts, quality=options.quality)


def machine() -> dict[str, Any]:
    """What the times were taken on."""
    cpu = platform.processor() or platform.machine()
    cpu_info = Path("/proc/cpuinfo")
    if cpu_info.exists():
        names = [
            line.split(":", 1)[1].strip() for line in cpu_info.read_text().splitlines() if line.startswith("model name")
        ]
        cpu = names[0] if names else cpu
    return {
        "cpu": cpu,
        "threads": espalier_native.hardware_threads(),
        "simd": espalier_native.simd_targets()[0],
        "system": platform.platform(),
        "blender": bpy.app.version_string,
        "python": platform.python_version(),
    }


def _report_of_export(arrays: SceneArrays, scene: str, options: Options) -> Report:
    return {
        "scene": scene,
        "settings_used": arrays.settings_used,
        "quality": options.quality,
        "resolution": [arrays.width, arrays.height],
        "triangles": arrays.triangle_count,
        "phases_ms": {"evaluation": arrays.evaluation_ms, "export": arrays.export_ms},
        "objects": [],
        "left_out": arrays.left_out,
        "machine": machine(),
    }


def _with_lost_faces(objects: list[dict[str, Any]], not_finite: dict[str, int]) -> list[dict[str, Any]]:
    """The native side's account of each object, with the faces added that the export had to leave out."""
    entries = {entry["object"]: {**entry, "rejected_faces": dict(entry["rejected_faces"])} for entry in objects}
    for name, count in not_finite.items():
        entry = entries.setdefault(name, {"object": name, "triangles": 0, "rejected_faces": {}, "lost_precision": {}})
        rejected = entry["rejected_faces"]
        rejected["not_finite"] = rejected.get("not_finite", 0) + count
    return list(entries.values())
