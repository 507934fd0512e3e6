# SPDX-License-Identifier: GPL-3.0-or-later
"""What a run says about itself: the table for people, the lines of the panel, and the warnings.

A report is a plain dict, written as JSON as it is; every number carries its unit in its name.
"""

from __future__ import annotations

from typing import Any

Report = dict[str, Any]

# What is wrong with faces that are not in the tree: one of them, several of them.
FAULTS = {
    "not_finite": ("is not finite", "are not finite"),
    "no_area": ("has no area", "have no area"),
    "too_large": ("is too large", "are too large"),
}

# Where float's rounding took detail away, and what came of it.
LOSSES = {
    "mesh": "detail finer than {ulp} was lost before it came here, at {distance} from the object's origin",
    "placement": "placed only to within {ulp}, at {distance} from the world's origin",
    "scene": "detail finer than {ulp} is lost, at {distance} from the middle of the scene",
}


def warnings(report: Report) -> list[str]:
    """One sentence for everything that is in the scene and not, or not exactly, in the picture."""
    lines = []
    if not report["triangles"]:
        lines.append("Nothing to draw: the scene has no visible faces")
    for entry in report["objects"]:
        for fault, count in entry["rejected_faces"].items():
            if count:
                one, many = FAULTS.get(fault, (f"was left out ({fault})", f"were left out ({fault})"))
                lines.append(f"{entry['object']}: {count:,} {f'face {one}' if count == 1 else f'faces {many}'}")
    lines.extend(lost_precision(report))
    lines.extend(f"{name}: {what} are not drawn" for name, what in report["left_out"].items())
    if len(checksums(report)) > 1:
        lines.append("The trees differ between thread counts: please report this")
    return lines


def lost_precision(report: Report) -> list[str]:
    """One sentence for each cause, with the object that lost most by it: a scene far away loses in all its objects."""
    lines = []
    for cause, what in LOSSES.items():
        losers = [entry for entry in report["objects"] if cause in entry["lost_precision"]]
        if losers:
            worst = max(losers, key=lambda entry: float(entry["lost_precision"][cause]["ulp_per_median_edge"]))
            lost = worst["lost_precision"][cause]
            who = worst["object"] + (f" and {len(losers) - 1:,} more" if len(losers) > 1 else "")
            lines.append(f"{who}: {what.format(ulp=length(lost['ulp_m']), distance=length(lost['distance_m']))}")
    return lines


def length(metres: float) -> str:
    """A length in the unit in which it is easily read, with two digits."""
    if metres >= 10.0:
        return f"{metres:,.0f} m"
    for factor, unit in ((1.0, "m"), (1e2, "cm"), (1e3, "mm")):
        if metres * factor >= 1.0:
            return f"{metres * factor:.2g} {unit}"
    return f"{metres * 1e6:.2g} µm"


def precision_line(report: Report) -> str:
    """How fine the numbers are in which the scene is kept, against how fine the scene is."""
    margin = report["precision"]
    if not margin["median_edge_m"]:
        return "Precision: no edges"
    steps = margin["median_edge_m"] / margin["ulp_m"]
    return (
        f"Precision: steps of {length(margin['ulp_m'])} at {length(margin['distance_m'])} from the middle, "
        f"{steps:,.0f} to a median edge of {length(margin['median_edge_m'])}"
    )


def checksums(report: Report) -> set[str]:
    """The checksums of every tree that the run built; a single one where all is well."""
    rows = [*_thread_rows(report), *filter(None, [report.get("build")])]
    return {row["checksum"] for row in rows}


def phase_lines(report: Report) -> list[tuple[str, float]]:
    """Name and milliseconds of each phase, in the order in which they ran."""
    return [(name.replace("_", " ").capitalize(), ms) for name, ms in report["phases_ms"].items()]


def thread_lines(report: Report) -> list[tuple[str, float, str]]:
    """Label, milliseconds and a note for each build of a comparison, the serial builder first."""
    lines = []
    for row in _thread_rows(report):
        note = f"{row['build_ms']:,.1f} ms"
        if row is not report["serial"]:
            note += f"   {row['speed_up']:.2f}x   {row['efficiency']:.0%}"
        lines.append((_row_name(report, row), float(row["build_ms"]), note))
    return lines


def headline(report: Report) -> str:
    """What was measured, in a few words."""
    return f"{size_line(report)}, {settings_line(report)}"


def size_line(report: Report) -> str:
    """How many triangles were built, and how."""
    return f"{report['triangles']:,} triangles, {report['quality']}"


def settings_line(report: Report) -> str:
    """Whose levels of modifiers and whose visibility were used: the viewport's or the render's."""
    return f"{report['settings_used']} settings"


def tree_lines(report: Report) -> list[str]:
    """The size and the quality of the tree, as short lines."""
    tree = report.get("build") or report["serial"]
    per_triangle = tree["references"] / tree["triangles"] if tree["triangles"] else 0.0
    constants = [f"{name.replace('_', ' ')} {value:g}" for name, value in tree["sah_constants"].items()]
    return [
        f"{tree['nodes']:,} nodes, {tree['leaves']:,} leaves ({tree['empty_leaves']:,} empty)",
        f"{per_triangle:.2f} references per triangle, {tree['bytes'] / 1e6:,.1f} MB",
        f"SAH cost {tree['sah_cost']:.3f}",
        *(f"with {', '.join(constants[i : i + 2])}" for i in range(0, len(constants), 2)),
        f"Checksum {tree['checksum']}",
    ]


def table(report: Report) -> str:
    """The whole report as text for a terminal."""
    machine = report["machine"]
    width, height = report["resolution"]
    lines = [
        f"{report['scene']}: {headline(report)}, {width} x {height} pixels",
        f"{machine['cpu']}, {machine['threads']} threads, {machine['simd']}, Blender {machine['blender']}",
        "",
        *(f"{name:<14}{ms:>12,.2f} ms" for name, ms in phase_lines(report)),
    ]
    if trace := report.get("trace"):
        rays = trace["primary_rays"] + trace["shadow_rays"]
        lines.append(f"{rays:,} rays, {trace['samples']} per pixel, {trace['mrays_per_s']:.2f} Mrays/s")
    lines += ["", precision_line(report), *tree_lines(report)]
    if rows := _thread_rows(report):
        lines += ["", _ROW_HEAD]
        lines.extend(
            f"{_row_name(report, row):<12}{row['build_ms']:>11.2f}{row['build_ms_min']:>10.2f} to"
            f"{row['build_ms_max']:>8.2f}{row['speed_up']:>10.2f}{row['efficiency']:>11.0%}{row['mtri_per_s']:>9.2f}"
            f"  {row['checksum']}"
            for row in rows
        )
        lines.append(f"Median of {rows[0]['repeats']} builds; speed-up is against the serial builder.")
    return "\n".join(lines)


_ROW_HEAD = f"{'threads':<12}{'build ms':>11}{'spread ms':>20}{'speed-up':>10}{'efficiency':>11}{'Mtri/s':>9}  checksum"


def _thread_rows(report: Report) -> list[Report]:
    return [report["serial"], *report["threads"]] if "serial" in report else []


def _row_name(report: Report, row: Report) -> str:
    if row is report["serial"]:
        return "serial"
    return f"{row['threads']} thread{'' if row['threads'] == 1 else 's'}"
