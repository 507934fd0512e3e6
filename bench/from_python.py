# SPDX-License-Identifier: GPL-3.0-or-later
"""Times rays from Python beside embreex: python -m bench.from_python MESH SECONDS

Prints JSON for run.py. The rays start within the mesh's box and go in all directions. embreex traces on the calling
thread, with the best instruction set that it knows.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import espalier_native
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from bench.run import Points, read_mesh

RAYS = 1_000_000
LEAST_TURNS = 3


def incoherent_rays(vertices: Points, count: int) -> tuple[Points, Points]:
    """Origins within the box and directions of length 1, both evenly distributed"""
    rng = np.random.default_rng(1)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    origins = low + (high - low) * rng.random((count, 3))
    directions = rng.standard_normal((count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return origins.astype(np.float32), directions.astype(np.float32)


def measure(path: Path, seconds: float, count: int = RAYS) -> list[dict[str, Any]]:
    """Milliseconds of both calls of both contestants, in turns of all four after one that warms up"""
    vertices, triangles = read_mesh(path)
    origins, directions = incoherent_rays(vertices, count)
    tree = espalier_native.build(vertices, triangles)
    scene = EmbreeScene(robust=True)
    TriangleMesh(scene, vertices, triangles.astype(np.int32))
    scene.run(origins[:1], directions[:1])  # builds its tree
    calls: dict[tuple[str, str], Callable[[], object]] = {
        ("Espalier", "intersect"): lambda: tree.intersect(origins, directions),
        ("embreex", "intersect"): lambda: scene.run(origins, directions, query="INTERSECT", output=1),
        ("Espalier", "occluded"): lambda: tree.occluded(origins, directions),
        ("embreex", "occluded"): lambda: scene.run(origins, directions, query="OCCLUDED"),
    }
    times: dict[tuple[str, str], list[float]] = {key: [] for key in calls}
    end = time.perf_counter() + seconds
    while len(times["Espalier", "intersect"]) < 1 + LEAST_TURNS or time.perf_counter() < end:
        for key, call in calls.items():
            start = time.perf_counter()
            call()
            times[key].append(1e3 * (time.perf_counter() - start))
    threads = {"Espalier": espalier_native.hardware_threads(), "embreex": 1}
    return [
        {"name": name, "call": call, "threads": threads[name], "rays": count, "ms": ms[1:]}
        for (name, call), ms in times.items()
    ]


if __name__ == "__main__":
    print(json.dumps({"python": measure(Path(sys.argv[1]), float(sys.argv[2]))}))
