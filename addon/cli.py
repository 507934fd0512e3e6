# SPDX-License-Identifier: GPL-3.0-or-later
"""`blender -b FILE -c espalier preview …`, or `python -m addon preview SCENE …` with pip's bpy; and `report`"""

from __future__ import annotations

import argparse
import json
import runpy
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import bpy
from mathutils import Euler, Vector

from . import picture, report
from .export import ExportError
from .pipeline import Cancelled, Options, Result, Run, evaluate, thread_counts

BAD_ARGUMENTS = 2
FAILURE = 1
MAX_THREADS = 1024
CHECKOUT = Path(__file__).resolve().parent.parent

_handle: Any = None


def command(argv: Sequence[str]) -> int:
    """What `blender -c espalier` runs: main(), but Blender's start-up scene is not drawn for a file it cannot open."""
    return main(argv, needs_file=True)


def main(argv: Sequence[str], *, needs_file: bool = False) -> int:
    """Run the command and return its exit code: 0 done, 1 failed, 2 bad arguments. Never leaves by an exception."""
    try:
        arguments = _parser().parse_args(list(argv))
    except SystemExit as leaving:  # argparse leaves the interpreter, which would be Blender
        return leaving.code if isinstance(leaving.code, int) else BAD_ARGUMENTS
    if needs_file and arguments.run is preview and arguments.scene is None and not Path(bpy.data.filepath).is_file():
        return _fail("no file is open: name one that exists, `blender -b FILE -c espalier …`, or a SCENE")
    try:
        code: int = arguments.run(arguments)
        return code
    except (KeyboardInterrupt, Cancelled):
        return _fail("cancelled")
    except Exception as error:  # a script reads the exit code, a person the sentence
        return _fail(str(error) or type(error).__name__)


def preview(arguments: argparse.Namespace) -> int:
    """Draw the scene, compare the builds, write what was asked for."""
    if arguments.json is not None and arguments.json.resolve() == arguments.output.resolve():
        _say("error: --output and --json name the same file")
        return BAD_ARGUMENTS
    files = [path for path in (arguments.output, arguments.json) if path is not None]
    for path in files:  # better now than after the work
        path.parent.mkdir(parents=True, exist_ok=True)
    if arguments.scene is not None:
        open_scene(arguments.scene)
        if bpy.context.scene.camera is None:
            frame_scene(bpy.context)
            _say("the scene has no camera: it is shown from one that takes it all in")
    counts = arguments.threads or thread_counts()
    options = Options(
        quality=arguments.quality,
        threads=max(arguments.threads, default=0),
        samples=arguments.samples,
        percentage=arguments.percentage,
    )
    depsgraph, evaluation_ms = evaluate(bpy.context)
    run = Run(depsgraph, options, counts=counts, evaluation_ms=evaluation_ms)
    result = _finished(run)
    for line in report.warnings(result.report):
        _say(line)
    assert result.image is not None
    picture.write_png(result.image, arguments.output, bpy.context.scene)
    if arguments.json is not None:
        with picture.replaced(arguments.json) as unfinished:
            unfinished.write_text(json.dumps(result.report, indent=2) + "\n", encoding="utf-8")
    print(report.table(result.report))
    if len(report.checksums(result.report)) > 1:
        return _fail("the trees differ between thread counts")
    return 0


def make_report(arguments: argparse.Namespace) -> int:
    """Measure speed against error and write the page, which takes the judge of a checkout, and the peers."""
    if not (CHECKOUT / "tools/report.py").is_file():
        return _fail("the report compares with other tracers and needs a checkout of Espalier: run `make report` there")
    # By name, since the extension comes without it, and may neither import it nor start a program.
    sys.path.insert(0, str(CHECKOUT))
    measure = runpy.run_module("tools.report")["main"]
    measure([*(["--quick"] if arguments.quick else []), "--output", str(arguments.output)])
    return 0


def open_scene(path: Path) -> None:
    """Open a .blend file, or import another file into an empty scene. Raises ExportError."""
    try:
        if path.suffix.lower() == ".blend":
            bpy.ops.wm.open_mainfile(filepath=str(path), load_ui=False)
        else:
            # Not factory settings: those would unload the extension that is at work here.
            bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
            bpy.context.scene.name = path.stem
            bpy.context.scene.world = bpy.data.worlds.new("World")
            IMPORTERS[path.suffix.lower()](path)
    except RuntimeError as error:
        raise ExportError(f"cannot read {path}: {str(error).strip()}") from error


IMPORTERS: dict[str, Callable[[Path], object]] = {
    ".obj": lambda path: bpy.ops.wm.obj_import(filepath=str(path)),
    ".ply": lambda path: bpy.ops.wm.ply_import(filepath=str(path)),
    ".glb": lambda path: bpy.ops.import_scene.gltf(filepath=str(path)),
    ".gltf": lambda path: bpy.ops.import_scene.gltf(filepath=str(path)),
}


def frame_scene(context: bpy.types.Context) -> None:
    """Give the scene an active camera that sees all of it from the front, the right and above. Raises ExportError."""
    scene = context.scene
    depsgraph, _ = evaluate(context)
    corners = [
        instance.matrix_world @ Vector(corner)
        for instance in depsgraph.object_instances
        if instance.show_self and instance.object.type == "MESH" and len(instance.object.data.polygons)
        for corner in instance.object.bound_box
    ]
    if not corners:
        raise ExportError(f"there is nothing to see in “{scene.name}”")
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.rotation_euler = Euler((1.15, 0.0, 0.55))
    scene.collection.objects.link(camera)
    scene.camera = camera
    depsgraph, _ = evaluate(context)
    camera.location, _ = camera.camera_fit_coords(depsgraph, [value for corner in corners for value in corner])
    reach = max((corner - camera.location).length for corner in corners)
    # A step back, so that nothing touches the frame.
    camera.location += camera.rotation_euler.to_matrix() @ Vector((0.0, 0.0, 0.05 * reach))
    camera.data.clip_start, camera.data.clip_end = reach / 1000.0, reach * 10.0


def register() -> None:
    """Make `blender -c espalier` known."""
    global _handle  # noqa: PLW0603  Blender wants it back
    _handle = bpy.utils.register_cli_command("espalier", command)


def unregister() -> None:
    """Take the command away."""
    global _handle  # noqa: PLW0603
    bpy.utils.unregister_cli_command(_handle)
    _handle = None


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="espalier", description="A ray-traced preview, and what building its tree cost."
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    command = commands.add_parser("preview", help="draw the scene from its camera, compare builds by thread count")
    command.set_defaults(run=preview)
    command.add_argument(
        "scene",
        nargs="?",
        type=_scene,
        metavar="SCENE",
        help=f"a .blend file, or {', '.join(IMPORTERS)} to import; without it, the scene that Blender has open",
    )
    command.add_argument("--output", required=True, type=_png, metavar="PNG", help="the picture to write")
    command.add_argument("--json", type=Path, metavar="JSON", help="write the timings here")
    command.add_argument(
        "--threads",
        type=_counts,
        default=[],
        metavar="N,N…",
        help="thread counts to compare, the last one draws; default: 1, 2, 4 … all",
    )
    command.add_argument("--quality", choices=("draft", "balanced", "best"), default="balanced")
    command.add_argument("--samples", type=_number(1, 4096), default=4, metavar="N", help="rays per pixel; default: 4")
    command.add_argument(
        "--percentage", type=_number(1, 1000), metavar="P", help="of the scene's resolution; default: the scene's own"
    )
    command = commands.add_parser("report", help="measure speed against error beside other tracers (in a checkout)")
    command.set_defaults(run=make_report)
    command.add_argument("--quick", action="store_true", help="fewer rays, samples and pixels: a look, not a figure")
    command.add_argument(
        "--output", type=lambda text: Path(text).absolute(), default=CHECKOUT / "build/report", metavar="FOLDER"
    )
    return parser


def _number(low: int, high: int) -> Callable[[str], int]:
    def number(text: str) -> int:
        if not text.isascii() or not text.isdigit() or not low <= int(text) <= high:
            raise argparse.ArgumentTypeError(f"“{text}” is not a whole number from {low} to {high}")
        return int(text)

    return number


def _counts(text: str) -> list[int]:
    number = _number(1, MAX_THREADS)
    return sorted({number(part.strip()) for part in text.split(",")})


def _scene(text: str) -> Path:
    path = Path(text)
    if path.suffix.lower() not in {".blend", *IMPORTERS}:
        raise argparse.ArgumentTypeError(f"“{text}” is neither a .blend file nor one of {', '.join(IMPORTERS)}")
    if not path.is_file():
        raise argparse.ArgumentTypeError(f"there is no file “{text}”")
    return path.absolute()


def _png(text: str) -> Path:
    path = Path(text)
    if path.suffix.lower() != ".png":
        raise argparse.ArgumentTypeError(f"“{text}” does not end in .png")
    return path.absolute()


def _finished(run: Run) -> Result:
    try:
        while not run.wait(0.1):  # in steps, so that Ctrl+C is heard
            pass
    except KeyboardInterrupt:
        run.cancel()
        raise
    return run.result()


def _say(line: str) -> None:
    print(f"espalier: {line}", file=sys.stderr)


def _fail(reason: str) -> int:
    _say(f"error: {reason}")
    return FAILURE
