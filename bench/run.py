# SPDX-License-Identifier: GPL-3.0-or-later
"""Measures builds and rays beside Embree on the meshes that are there: python -m bench.run [--help]

Writes build/bench/bench.json and bench.md, or large, hostile or scaling in place of bench, and prints the latter.
build/bench/espalier_scaling and a .mesh file from there are all that another machine needs: it prints the JSON whose
place is report["meshes"][name][simd].
"""

from __future__ import annotations

import argparse
import datetime
import importlib
import importlib.util
import json
import os
import platform
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bench.tables import markdown

if TYPE_CHECKING:
    from addon.export import SceneArrays

ROOT = Path(__file__).resolve().parent.parent
BUILD = ROOT / "build/bench"
SHARED = ROOT.parent / "shared/meshes"
MESHES = ("sponza", "bunny", "armadillo", "dragon")  # .npz files
SCENES = ("sculpture",)  # shipped ones, exported as the world's triangles
INTERIORS = {"sponza"}  # looked at from within
HOSTILE = ("long", "copies", "coplanar", "furball")  # made by hostile_mesh
HOSTILE_TRIANGLES = (200_000, 2_000_000)
PARTS = ("memory", "quality", "builds", "rays", "preview", "python")
ONCE = {"memory", "quality", "python"}  # parts that are the same for every instruction set, or beside a peer's best
QUIET_LOAD = 0.3

Points = NDArray[np.float32]
Triangles = NDArray[np.uint32]


def view_of(vertices: Points, inside: bool) -> Points:
    """Eye, target, up, light and half the picture's width at distance 1, for a mesh whose Y points upwards"""
    low, high = vertices.min(axis=0).astype(float), vertices.max(axis=0).astype(float)
    centre, size = (low + high) / 2, high - low
    if inside:
        eye = np.array([low[0] + 0.08 * size[0], low[1] + 0.12 * size[1], centre[2]])
        target = np.array([high[0], low[1] + 0.2 * size[1], centre[2]])
        light = centre + np.array([0, 0.3 * size[1], 0])
        slope = 0.9
    else:
        slope = 0.36
        towards = np.array([0.35, 0.3, 1.0]) / np.linalg.norm([0.35, 0.3, 1.0])
        eye = centre + towards * np.linalg.norm(size) / 2 / slope
        target = centre
        light = centre + np.array([-1.2, 1.4, 1.0]) * np.linalg.norm(size)
    return np.array([*eye, *target, 0, 1, 0, *light, slope], np.float32)


def shipped_scene(name: str) -> SceneArrays:
    """A scene of scenes/, as its script makes it and the export reads it"""
    import bpy

    from addon.export import export_scene

    sys.path.insert(0, str(ROOT / "scenes"))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    importlib.import_module(name).build()
    bpy.context.view_layer.update()
    return export_scene(bpy.context.evaluated_depsgraph_get())


def world_mesh(arrays: SceneArrays) -> tuple[Points, Triangles, Points]:
    """All triangles where they are placed, and the camera's view, with a light over its left shoulder"""
    vertices, triangles, count = [], [], 0
    for placement, matrix in zip(arrays.placements, arrays.matrices, strict=True):
        mesh = arrays.meshes[placement.mesh]
        vertices.append(mesh.positions @ matrix[:3, :3].T + matrix[:3, 3])
        triangles.append(mesh.triangles + count)
        count += len(mesh.positions)
    assert arrays.camera is not None
    right, up, back, eye = arrays.camera.matrix_world[:3].T
    slope = 1 / arrays.camera.projection[0, 0]
    view = np.array([*eye, *(eye - back), *up, *(eye + 4 * up - 4 * right), slope], np.float32)
    return np.concatenate(vertices).astype(np.float32), np.concatenate(triangles).astype(np.uint32), view


def hostile_mesh(kind: str, count: int) -> tuple[Points, Triangles, Points]:
    """Triangles that planes hardly part: long ones in a cube, copies of one, many in one plane, or slivers of fur"""
    rng = np.random.default_rng(1)
    corners = rng.random((count, 3, 3))
    if kind == "long":
        sides = rng.integers(3, size=(count, 3, 1))
        np.put_along_axis(corners, sides, rng.integers(2, size=(count, 3, 1)).astype(float), 2)
    elif kind == "copies":
        corners[:] = [[0, 0, 0], [1, 0, 0.5], [0, 1, 0]]
    elif kind == "coplanar":
        corners = corners[:, :1] + 0.01 * corners
        corners[:, :, 2] = 0.25
    else:
        root = rng.standard_normal((count, 1, 3))
        root /= np.linalg.norm(root, axis=2, keepdims=True)
        tip = root * (1 + rng.random((count, 1, 1))) + 0.1 * rng.random((count, 1, 3))
        corners = np.concatenate([root, tip, root + np.array([1e-4, 1e-4, 0])], axis=1)
    vertices = corners.reshape(-1, 3).astype(np.float32)
    return vertices, np.arange(3 * count, dtype=np.uint32).reshape(-1, 3), view_of(vertices, inside=False)


def prepare_hostile(name: str) -> Path:
    """The file of a hostile mesh, whose name ends in its number of triangles"""
    kind, count = name.split("_")
    path = BUILD / f"{name}.mesh"
    write_mesh(path, *hostile_mesh(kind, int(count)))
    return path


def write_mesh(path: Path, vertices: Points, triangles: Triangles, view: Points) -> None:
    """A mesh as the C++ programs read it: two 64-bit counts, the view, positions and indices"""
    with path.open("wb") as file:
        np.array([len(vertices), len(triangles)], np.uint64).tofile(file)
        view.tofile(file)
        np.ascontiguousarray(vertices, np.float32).tofile(file)
        np.ascontiguousarray(triangles, np.uint32).tofile(file)


def read_mesh(path: Path) -> tuple[Points, Triangles]:
    """Positions and indices of such a file"""
    data = path.read_bytes()
    vertices, triangles = np.frombuffer(data, np.uint64, 2).tolist()
    start = 2 * 8 + 13 * 4
    positions = np.frombuffer(data, np.float32, 3 * vertices, start).reshape(-1, 3)
    return positions, np.frombuffer(data, np.uint32, 3 * triangles, start + positions.nbytes).reshape(-1, 3)


def prepare(name: str) -> Path | None:
    """The file of a mesh for the C++ programs, written when its source is newer; None where there is no source"""
    path = BUILD / f"{name}.mesh"
    source = ROOT / f"scenes/{name}.py" if name in SCENES else SHARED / f"{name}.npz"
    if not source.exists():
        print(f"{name}: skipped, there is no {source}", file=sys.stderr)
        return None
    made_after = max(file.stat().st_mtime for file in (source, Path(__file__)))
    if path.exists() and path.stat().st_mtime > made_after:
        return path
    if name in SCENES:
        vertices, triangles, view = world_mesh(shipped_scene(name))
    else:
        with np.load(source) as arrays:
            vertices, triangles = arrays["vertices"], arrays["triangles"]
        view = view_of(vertices, name in INTERIORS)
    write_mesh(path, vertices, triangles, view)
    return path


def machine() -> dict[str, Any]:
    """What the times are taken on, and how busy it is before the first of them"""
    names = [
        line.split(":", 1)[1].strip() for line in Path("/proc/cpuinfo").read_text().splitlines() if "model name" in line
    ]
    return {
        "cpu": names[0] if names else platform.machine(),
        "cores": len(os.sched_getaffinity(0)),
        "memory_gib": round(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30, 1),
        "system": platform.platform(),
        "load": os.getloadavg()[0],
        "quiet": os.getloadavg()[0] < QUIET_LOAD,
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC"),
    }


def run(*arguments: str | Path, simd: str = "") -> Any:
    """The JSON that a program prints, with an instruction set forced"""
    environment = {**os.environ, "ESPALIER_SIMD": simd}
    return json.loads(subprocess.run(arguments, env=environment, stdout=subprocess.PIPE, check=True).stdout)


def from_python(path: Path, seconds: str, simd: str) -> dict[str, Any]:
    """Rays from Python beside embreex, where that is installed"""
    if importlib.util.find_spec("embreex") is None:
        print("Rays from Python: skipped, there is no embreex (requirements/report.txt)", file=sys.stderr)
        return {}
    return dict(run(sys.executable, "-m", "bench.from_python", path, seconds, simd=simd))


def compare(options: argparse.Namespace) -> dict[str, Any]:
    """Every mesh with every instruction set; what does not depend on that, with the first alone"""
    start = time.monotonic()
    report: dict[str, Any] = {"machine": machine(), "meshes": {}}
    if not report["machine"]["quiet"]:
        print(f"This machine is busy (load {report['machine']['load']:.2f}): do not quote these times", file=sys.stderr)
    program = BUILD / ("espalier_scaling" if options.scaling else "espalier_bench")
    simds = options.simd.split(",") if options.simd else run(BUILD / "espalier_bench")
    for name in options.meshes.split(","):
        path = prepare_hostile(name) if options.hostile else prepare(name)
        if path is None:
            continue
        report["meshes"][name] = {}
        for simd in simds:
            print(f"{time.monotonic() - start:4.0f} s  {name}, {simd}", file=sys.stderr)
            parts = [part for part in options.parts if simd == simds[0] or part not in ONCE]
            seconds = "12" if options.large else "1" if options.quick or options.hostile else "3"
            if options.scaling or parts:
                arguments = [part for part in parts if part != "python"]
                report["meshes"][name][simd] = run(program, path, seconds, *arguments, simd=simd)
            if "python" in parts:
                report["meshes"][name][simd] |= from_python(path, seconds, simd)
    return report


def main() -> None:
    """See the module's text"""
    parser = argparse.ArgumentParser(description="Measure builds and rays beside Embree.")
    everything = ",".join(MESHES + SCENES)
    parser.add_argument("--quick", action="store_true", help="a third of the time, on sponza and bunny by default")
    parser.add_argument("--meshes", help=f"some of {everything}, which is the default")
    parser.add_argument("--simd", help="some of avx512,avx2,sse4,neon; by default all that the machine has")
    parser.add_argument("--parts", default=",".join(PARTS), help="some of %(default)s, which is the default")
    parser.add_argument(
        "--large",
        type=int,
        nargs="?",
        const=10,
        metavar="COPIES",
        help="instead: builds of %(const)s copies, by default of sculpture",
    )
    hostile = [f"{kind}_{count}" for kind in HOSTILE for count in HOSTILE_TRIANGLES]
    parser.add_argument("--hostile", action="store_true", help=f"instead: builds of {', '.join(hostile)}")
    parser.add_argument("--scaling", action="store_true", help="instead: 1, 2, 4 ... threads, without Embree")
    options = parser.parse_args()
    options.parts = options.parts.split(",")
    if options.large:
        options.parts, options.meshes = [f"copies={options.large}"], options.meshes or "sculpture"
    if options.hostile:
        options.parts, options.meshes = ["builds"], options.meshes or ",".join(hostile)
    if options.scaling:
        options.parts = []
    options.meshes = options.meshes or ("sponza,bunny" if options.quick else everything)
    BUILD.mkdir(parents=True, exist_ok=True)
    report = compare(options)
    kinds = {"large": options.large, "hostile": options.hostile, "scaling": options.scaling}
    name = next((kind for kind, is_asked in kinds.items() if is_asked), "bench")
    (BUILD / f"{name}.json").write_text(json.dumps(report), encoding="utf-8")
    (BUILD / f"{name}.md").write_text(markdown(report), encoding="utf-8")
    print(markdown(report))


if __name__ == "__main__":
    main()
