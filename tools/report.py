# SPDX-License-Identifier: GPL-3.0-or-later
"""Measures speed against error and writes one page: python -m tools.report [--quick] [--parts …]

build/report/report.json has the figures, build/report/index.html the page that tools/page.py draws from them. Parts
that are not measured again stay as they were. All seeds are fixed.
"""

from __future__ import annotations

import argparse
import ctypes
import importlib
import json
import os
import sys
import tempfile
import time
import weakref
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from statistics import median
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "scenes")]

import bpy  # noqa: E402  the lines above find what is ours
import espalier_native  # noqa: E402
import numpy as np  # noqa: E402
from mathutils.bvhtree import BVHTree  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from addon.export import SceneArrays, export_scene  # noqa: E402
from addon.pipeline import machine  # noqa: E402
from tests import cycles  # noqa: E402
from tests.exactness import qualities  # noqa: E402
from tests.fast_judge import Verdicts, address, judge_rays  # noqa: E402
from tests.hard_cases import Case, make  # noqa: E402
from tests.judge import Floats, Ints, hit_one, rational  # noqa: E402
from tools import page  # noqa: E402

OUT = ROOT / "build/report"
BENCH = ROOT / "build/bench/bench.json"
PLAIN = ROOT / "build/release/libespalier_plain.so"
SCENES = ("interior", "sculpture", "forest", "hall")
SPEED_SCENE = PICTURE_SCENE = "interior"
TURNS = 5  # of each tracer, one after the other

# Hard, yet of the kind that a picture has, and without what only a convention decides (rays in the plane of a face).
HARD = (
    *("at_vertices", "at_edges", "axis_parallel", "far_origins"),
    *("at_vertices_moved_1e3", "at_vertices_moved_1e5", "axis_parallel_moved_1e5"),
)
NEAREST = 1e-3  # of t: nearer to the origin an error in ulps says nothing

Hits = tuple[Ints, Floats]  # triangle, -1 at a miss, and t
Tracer = Callable[[Floats, Floats], Hits]
Prepare = Callable[[Floats, Ints], Tracer]


def ours(vertices: Floats, triangles: Ints) -> Tracer:
    """Our path as it is shipped."""
    tree = espalier_native.build(vertices, triangles)

    def trace(origins: Floats, directions: Floats) -> Hits:
        hits = tree.intersect(origins, directions, threads=1)
        return hits["triangle"], hits["t"]

    return trace


def plain(vertices: Floats, triangles: Ints) -> Tracer:
    """Our path without its safeguards, which the shipped module does not have: tests/plain.cpp."""
    library = ctypes.CDLL(str(PLAIN))
    library.espalier_plain_build.restype = ctypes.c_void_p
    corners, faces = np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(triangles, np.int32)
    counts = ctypes.c_size_t(len(corners)), ctypes.c_size_t(len(faces))
    tree = ctypes.c_void_p(library.espalier_plain_build(address(corners), counts[0], address(faces), counts[1]))

    def trace(origins: Floats, directions: Floats) -> Hits:
        o, d = (np.ascontiguousarray(rays, np.float32) for rays in (origins, directions))
        triangle, t = np.empty(len(o), np.int32), np.empty(len(o), np.float32)
        count = ctypes.c_size_t(len(o))
        library.espalier_plain_intersect(tree, address(o), address(d), count, address(triangle), address(t))
        return triangle, t

    weakref.finalize(trace, library.espalier_plain_free, tree)
    return trace


def embree(robust: bool) -> Prepare:
    """Embree through embreex, which builds its tree at the first rays."""

    def prepare(vertices: Floats, triangles: Ints) -> Tracer:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        scene = EmbreeScene(robust=robust)
        TriangleMesh(scene, vertices, triangles)

        def trace(origins: Floats, directions: Floats) -> Hits:
            hits = scene.run(origins, directions, query="INTERSECT", output=1)
            return hits["primID"], hits["tfar"]

        return trace

    return prepare


def blender(vertices: Floats, triangles: Ints) -> Tracer:
    """Blender's own tree for scripts, asked ray by ray."""
    tree = BVHTree.FromPolygons(vertices.tolist(), triangles.tolist(), all_triangles=True)

    def trace(origins: Floats, directions: Floats) -> Hits:
        found = [tree.ray_cast(o, d) for o, d in zip(origins.tolist(), directions.tolist(), strict=True)]
        triangle = np.array([-1 if index is None else index for _, _, index, _ in found], np.int32)
        # Its distances are in units of length, those of the others in units of the direction.
        distance = np.array([np.inf if d is None else d for *_, d in found])
        return triangle, (distance / np.linalg.norm(directions.astype(np.float64), axis=1)).astype(np.float32)

    return trace


TRACERS: dict[str, Prepare] = {
    "Espalier": ours,
    "Espalier without safeguards": plain,
    "Embree, robust": embree(True),
    "Embree, not robust": embree(False),
    "Blender's BVHTree": blender,
}


def exported(name: str, percentage: int = 100) -> SceneArrays:
    """A shipped scene as its script makes it."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    importlib.import_module(name).build()
    bpy.context.view_layer.update()
    return export_scene(bpy.context.evaluated_depsgraph_get(), percentage=percentage)


def measure_tracers(quick: bool) -> dict[str, Any]:
    """Speed on the camera rays of a shipped scene, errors on the hard cases."""
    rays = 2_000 if quick else 30_000
    cases = [make(name, rays) for name in HARD]
    verdicts = [judge_rays(*case) for case in cases]
    count = sum(len(origins) for _, _, origins, _ in cases)

    arrays = exported(SPEED_SCENE, 25 if quick else 50)
    eye = cycles.Eye(arrays, cycles.number_objects(bpy))
    origins, directions, _, _ = eye.rays(*eye.centres())
    tracers = {name: prepare(eye.vertices, eye.triangles) for name, prepare in TRACERS.items()}
    seconds: dict[str, list[float]] = {name: [] for name in tracers}
    for turn in range(TURNS + 1):
        for name, trace in tracers.items():
            start = time.perf_counter()
            trace(origins, directions)
            if turn:  # Embree builds its tree during the first
                seconds[name].append(time.perf_counter() - start)
    rows = []
    for name, prepare in TRACERS.items():
        rate = [len(origins) / s * 1e-6 for s in seconds[name]]
        speed = {"mrays_per_s": median(rate), "mrays_per_s_min": min(rate), "mrays_per_s_max": max(rate)}
        rows.append({"tracer": name, **speed, **errors_of(prepare, cases, verdicts)})
    return {
        "speed_scene": SPEED_SCENE,
        "speed_triangles": len(eye.triangles),
        "speed_rays": len(origins),
        "threads": 1,
        "turns": TURNS,
        "hard_rays": count,
        "hard_cases": list(HARD),
        "rows": rows,
    }


def errors_of(prepare: Prepare, cases: list[Case], verdicts: list[Verdicts]) -> dict[str, float]:
    """What a tracer gets wrong, each kind per million rays, and how far its distances are off where it is right."""
    wrong = {"lost": 0, "false": 0, "wrong_face": 0}
    ulps = []
    for case, true in zip(cases, verdicts, strict=True):
        found, t = prepare(case[0], case[1])(case[2], case[3])
        right = (found == true.triangle) | same_distance(case, found, true)
        wrong["lost"] += int(np.count_nonzero((found < 0) & (true.triangle >= 0)))
        wrong["false"] += int(np.count_nonzero((found >= 0) & (true.triangle < 0)))
        wrong["wrong_face"] += int(np.count_nonzero((found >= 0) & (true.triangle >= 0) & ~right))
        measured = right & (true.triangle >= 0) & (true.t > NEAREST)
        ulps.append(ulps_of(t[measured], true.t[measured]))
    count = sum(len(origins) for _, _, origins, _ in cases)
    off = np.concatenate(ulps)
    return {
        **{f"{kind}_per_million": number / count * 1e6 for kind, number in wrong.items()},
        "t_error_ulps_median": float(np.median(off)) if len(off) else 0.0,
        "t_error_ulps_999_of_1000": float(np.quantile(off, 0.999)) if len(off) else 0.0,
        "t_error_ulps_max": float(off.max(initial=0.0)),
    }


def same_distance(case: Case, found: Ints, true: Verdicts) -> NDArray[np.bool_]:
    """Where a tracer named another face than the lowest, which lies at the same exact distance: that is no error."""
    vertices, triangles, origins, directions = case
    tied = np.zeros(len(found), bool)
    for i in np.flatnonzero((found >= 0) & (true.triangle >= 0) & (found != true.triangle)):
        o, d = rational(origins[i]), rational(directions[i])
        named, nearest = (
            hit_one(o, d, *(rational(vertices[corner]) for corner in triangles[face]))
            for face in (found[i], true.triangle[i])
        )
        tied[i] = named is not None and nearest is not None and named[0] == nearest[0]
    return tied


def ulps_of(t: Floats, exact: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far float32 distances are off, in units of float32's spacing there."""
    spacing = np.spacing(exact.astype(np.float32)).astype(np.float64)
    off: NDArray[np.float64] = np.abs(t.astype(np.float64) - exact) / spacing
    return off


def measure_pictures(quick: bool) -> dict[str, Any]:
    """The time of build and picture, and how far it is from a converged one, by samples and build mode."""
    arrays = exported(PICTURE_SCENE, 10 if quick else 25)
    assert arrays.camera is not None
    scene = espalier_native.Scene(*arrays.to_native())
    camera = {
        "type": arrays.camera.type,
        "matrix_world": arrays.camera.matrix_world,
        "projection": arrays.camera.projection,
    }

    def draw(quality: str, samples: int) -> dict[str, Any]:
        return espalier_native.render(
            scene,
            camera,
            arrays.lights,
            arrays.world_color,
            arrays.width,
            arrays.height,
            quality=quality,
            samples=samples,
        )

    # Sixteen times the most samples that are compared: what they have in common with it is a few per cent of the error.
    most = 8 if quick else 16
    converged = draw("balanced", 16 * most)["image"][..., :3].astype(np.float64)
    rows = []
    samples = [1 << i for i in range(most.bit_length())]
    for count in samples:
        turns: dict[str, list[dict[str, Any]]] = {quality: [] for quality in qualities()}
        for _ in range(3):
            for quality, drawn in turns.items():
                drawn.append(draw(quality, count))
        for quality, drawn in turns.items():
            image = drawn[0]["image"][..., :3].astype(np.float64)
            rows.append(
                {
                    "quality": quality,
                    "samples": count,
                    "picture_s": median(d["build"]["build_ms"] + d["trace"]["trace_ms"] for d in drawn) * 1e-3,
                    "rmse": float(np.sqrt(np.mean((image - converged) ** 2))),
                }
            )
    return {
        "scene": PICTURE_SCENE,
        "resolution": [arrays.width, arrays.height],
        "converged_samples": 16 * most,
        "threads": espalier_native.hardware_threads(),
        "rows": rows,
    }


def compare_with_cycles(quick: bool) -> list[dict[str, Any]]:
    """Depth, normal and object of each pixel of each shipped scene."""
    rows = []
    for name in SCENES:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        importlib.import_module(name).build()
        bpy.context.scene.render.resolution_percentage = 25 if quick else 100
        numbers = cycles.number_objects(bpy)
        eye = cycles.Eye(cycles.exported_for_render(bpy), numbers)
        with tempfile.TemporaryDirectory() as folder:
            theirs = cycles.seen_by_cycles(bpy, Path(folder))
        rows.append({"scene": name, **asdict(cycles.compare(eye, theirs)[0])})
    return rows


def read_builds(_: bool) -> dict[str, Any]:
    """Build times and SAH costs from what `make bench` wrote, with the best instruction set and all threads."""
    if not BENCH.exists():
        raise FileNotFoundError(f"{BENCH} is missing: make bench BENCH=--quick")
    bench = json.loads(BENCH.read_text(encoding="utf-8"))
    rows = []
    for mesh, by_target in bench["meshes"].items():
        target, measured = next(iter(by_target.items()))
        if not {"quality", "builds"} <= measured.keys():
            continue
        group = measured["builds"][-1]
        costs = {mode: found["sah_block"] for mode, found in measured["quality"].items()}
        least = costs.get("exact", min(costs.values()))
        for row in group["rows"]:
            if row["threads"] == group["threads"]:
                cost = costs.get(row["name"])
                rows.append(
                    {
                        "mesh": mesh,
                        "triangles": measured["triangles"],
                        "builder": row["name"],
                        "threads": row["threads"],
                        "simd": target,
                        "build_ms": median(row["ms"]),
                        "build_ms_min": min(row["ms"]),
                        "build_ms_max": max(row["ms"]),
                        "sah_cost": cost,
                        "sah_excess_percent": None if cost is None else 100.0 * (cost / least - 1.0),
                    }
                )
    against = "exact" if any(row["builder"] == "exact" for row in rows) else "least"
    return {"machine": bench["machine"], "against": against, "rows": rows}


PARTS: dict[str, Callable[[bool], Any]] = {
    "builds": read_builds,
    "tracers": measure_tracers,
    "pictures": measure_pictures,
    "cycles": compare_with_cycles,
}


def main(argv: list[str] | None = None) -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(prog="espalier report", description="Measure speed against error: one page.")
    parser.add_argument("--quick", action="store_true", help="fewer rays, samples and pixels: a look, not a figure")
    parser.add_argument("--parts", default=",".join(PARTS), help="some of %(default)s, which is the default")
    parser.add_argument("--output", type=Path, default=OUT, metavar="FOLDER", help="default: %(default)s")
    arguments = parser.parse_args(argv)
    path = arguments.output / "report.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    report = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    load = os.getloadavg()[0]
    for part in arguments.parts.split(","):
        print(f"espalier: measuring {part}", file=sys.stderr, flush=True)
        report[part] = {
            "machine": machine(),
            "load": load,
            "quick": arguments.quick,
            "measured": PARTS[part](arguments.quick),
        }
        path.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    page.write(report, arguments.output)
    print(arguments.output / "index.html")


if __name__ == "__main__":
    main()
