# SPDX-License-Identifier: GPL-3.0-or-later
"""The report of run.py as Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from statistics import median
from typing import Any

Times = Sequence[float]  # milliseconds of each turn
DEFAULT_MODE = "balanced"
NOT_EXACT = "not exact"  # the same tracer, on the same tree, without what makes hits exact

ABOUT = (
    "Contestants take turns in one process, every other turn in reverse. Times are medians (least to greatest); ratios "
    "are medians of the ratios within a turn and tell how many times as fast one is as the other. Both sides get fresh "
    "memory while the clock runs, the same threads and the same instruction set. Our builds go by the builder's own "
    "clock, which leaves out the report's checksum and cost; pictures go by the wall's. Embree LOW and MEDIUM build a "
    "ROBUST scene, HIGH one that is not, since ROBUST turns its spatial splits off."
)


def table(head: str, rows: Iterable[Sequence[object]]) -> str:
    """A Markdown table; `head` holds the column names, separated by bars"""
    columns = head.count("|") + 1
    lines = [f"| {head} |", "|---" * columns + "|"]
    lines += ["| " + " | ".join(str(cell) for cell in row) + " |" for row in rows]
    return "\n".join(lines)


def spread(values: Sequence[float]) -> str:
    """Median, least and greatest"""
    return f"{median(values):.2f} ({min(values):.2f} to {max(values):.2f})"


def ratios(over: Times, under: Times) -> list[float]:
    """The ratio of two contestants in each turn; one may have had fewer turns"""
    return [a / b for a, b in zip(over, under, strict=False)]


def times_of(group: dict[str, Any]) -> dict[tuple[str, int], Times]:
    """The times of a group's contestants by name and thread count"""
    return {(row["name"], row["threads"]): row["ms"] for row in group["rows"]}


def efficiency(times: dict[tuple[str, int], Times], name: str, threads: int) -> str:
    """Speed-up over one thread, by the number of threads; nothing where one thread was all"""
    if threads == 1 or (name, 1) not in times:
        return ""
    return f"{median(ratios(times[name, 1], times[name, threads])) / threads:.2f}"


def price(times: dict[tuple[str, int], Times], threads: int) -> str:
    """By how much the default mode is slower for exact hits than the same tracer without its safeguards"""
    if (NOT_EXACT, threads) not in times:
        return ""
    return f"{100 * (1 - median(ratios(times[NOT_EXACT, threads], times[DEFAULT_MODE, threads]))):.1f} %"


def per_simd(report: dict[str, Any], part: str) -> dict[str, list[tuple[str, dict[str, Any]]]]:
    """By instruction set: the meshes with what was measured of them, where that part was"""
    found: dict[str, list[tuple[str, dict[str, Any]]]] = {}
    for mesh, of_mesh in report["meshes"].items():
        for simd, measured in of_mesh.items():
            if part in measured:
                found.setdefault(simd, []).append((mesh, measured))
    return found


def build_rows(meshes: list[tuple[str, dict[str, Any]]]) -> Iterable[Sequence[object]]:
    """One row per mesh, thread count and builder"""
    for mesh, measured in meshes:
        for group in measured["builds"]:
            threads = group["threads"]
            times = times_of(group)
            medium = times["Embree MEDIUM", threads]
            for (builder, count), ms in times.items():
                if count != threads:
                    continue  # the serial builder beside the parallel one, for the efficiency alone
                yield (
                    mesh,
                    threads,
                    builder,
                    spread(ms),
                    len(ms),
                    f"{measured['triangles'] / median(ms) / 1e3:.2f}",
                    f"{median(ratios(medium, ms)):.2f}",
                    efficiency(times, builder, threads),
                )


def phase_table(meshes: list[tuple[str, dict[str, Any]]]) -> str:
    """Where the time of our builds goes"""
    rows: list[Sequence[object]] = []
    names: list[str] = []
    for mesh, measured in meshes:
        for group in measured["builds"]:
            for row in group["rows"]:
                if "phases_ms" in row and row["threads"] == group["threads"]:
                    names = list(row["phases_ms"])
                    phases = [f"{median(ms):.2f}" for ms in row["phases_ms"].values()]
                    rows.append((mesh, group["threads"], row["name"], *phases))
    return table(" | ".join(["mesh", "threads", "mode", *names]), rows)


def quality_rows(meshes: list[tuple[str, dict[str, Any]]]) -> Iterable[Sequence[object]]:
    """One row per mesh and mode"""
    for mesh, measured in meshes:
        modes = measured["quality"]
        for mode, found in modes.items():
            excess = (
                f"{100 * (found['sah_block'] / modes['exact']['sah_block'] - 1):+.1f} %" if "exact" in modes else ""
            )
            yield (
                mesh,
                mode,
                f"{found['sah_block']:.1f}",
                excess,
                f"{found['sah_classic']:.1f}",
                found["nodes"],
                found["wide_nodes"],
                f"{found['references_per_triangle']:.2f}",
                found["checksum"],
            )


def memory_rows(meshes: list[tuple[str, dict[str, Any]]]) -> Iterable[Sequence[object]]:
    """One row per mesh and builder"""
    for mesh, measured in meshes:
        medium = next(row for row in measured["memory"] if row["name"] == "Embree MEDIUM")
        for row in measured["memory"]:
            yield (
                mesh,
                row["name"],
                f"{row['peak_mb']:.1f}",
                f"{row['kept_mb']:.1f}",
                f"{row['kept_mb'] * 2**20 / measured['triangles']:.0f}",
                f"{row['peak_mb'] / medium['peak_mb']:.2f}",
                f"{row['kept_mb'] / medium['kept_mb']:.2f}",
            )


def ray_table(meshes: list[tuple[str, dict[str, Any]]]) -> str:
    """One row per mesh and set of rays; ours with the wide nodes and triangle blocks that a ray visits"""
    groups = [(mesh, group) for mesh, measured in meshes for group in measured["rays"]]
    names = list(dict.fromkeys(row["name"] for _, group in groups for row in group["rows"]))
    rows = []
    for mesh, group in groups:
        threads, times = group["threads"], times_of(group)
        steps = {row["name"]: row["steps"] for row in group["rows"] if "steps" in row}

        def cell(name: str, group: dict[str, Any] = group, times: Any = times, steps: Any = steps) -> str:
            if (name, group["threads"]) not in times:
                return ""
            speed = f"{group['rays'] / median(times[name, group['threads']]) / 1e3:.2f}"
            return speed + (f" ({steps[name]['nodes']:.1f}, {steps[name]['blocks']:.1f})" if name in steps else "")

        ours = times[DEFAULT_MODE, threads]
        peers = [ms for (name, _), ms in times.items() if name.startswith("Embree")]
        gain = ratios(min(peers, key=median), ours)
        rows.append(
            (
                mesh,
                group["set"],
                group["rays"],
                *map(cell, names),
                spread(gain),
                price(times, threads),
                efficiency(times, DEFAULT_MODE, threads),
                group["differ"],
            )
        )
    ends = [f"{DEFAULT_MODE} to the better of Embree's", "price of exactness", "efficiency", "other face than Embree"]
    return table(" | ".join(["mesh", "rays", "number", *names, *ends]), rows)


def preview_rows(meshes: list[tuple[str, dict[str, Any]]]) -> Iterable[Sequence[object]]:
    """One row per mesh and builder"""
    for mesh, measured in meshes:
        group = measured["preview"]
        times = times_of(group)
        medium = times["Embree MEDIUM", group["threads"]]
        for (name, threads), ms in times.items():
            yield mesh, threads, name, spread(ms), len(ms), f"{median(ratios(medium, ms)):.2f}", group["differ"]


def large_rows(meshes: list[tuple[str, dict[str, Any]]]) -> Iterable[Sequence[object]]:
    """One row per mesh and builder: copies beside the mesh itself"""
    for mesh, measured in meshes:
        group = measured["large"]
        times = times_of(group)
        threads = measured["threads"]
        for memory in group["memory"]:
            name = memory["name"]
            copies = times[f"{name}, copies", threads]
            yield (
                mesh,
                group["copies"],
                group["triangles"],
                threads,
                name,
                spread(times[name, threads]),
                spread(copies),
                len(copies),
                f"{group['triangles'] / median(copies) / 1e3:.2f}",
                f"{median(ratios(copies, times[name, threads])):.2f}",
                f"{memory['peak_mb']:.0f}",
                f"{memory['kept_mb']:.0f}",
            )


def scaling_table(meshes: list[tuple[str, dict[str, Any]]]) -> str:
    """One row per mesh and task: the median time on one thread, then speed-up and efficiency"""
    groups = [(mesh, group) for mesh, measured in meshes for group in measured["scaling"]]
    counts = [row["threads"] for row in groups[0][1]["rows"]]
    rows = []
    for mesh, group in groups:
        alone, *others = (row["ms"] for row in group["rows"])
        gains = [(median(ratios(alone, ms)), count) for ms, count in zip(others, counts[1:], strict=True)]
        rows.append((mesh, group["what"], spread(alone), *(f"{gain:.2f} ({gain / n:.2f})" for gain, n in gains)))
    return table(" | ".join(["mesh", "task", "ms on 1", *(f"speed-up on {count}" for count in counts[1:])]), rows)


def python_rows(meshes: list[tuple[str, dict[str, Any]]]) -> Iterable[Sequence[object]]:
    """One row per mesh and call: millions of rays per second, and the ratio for one thread of each"""
    for mesh, measured in meshes:
        of = {(row["call"], row["name"]): row for row in measured["python"]}
        for call in dict.fromkeys(call for call, _ in of):
            ours, theirs = of[call, "Espalier"], of[call, "embreex"]
            gains = [gain * theirs["threads"] / ours["threads"] for gain in ratios(theirs["ms"], ours["ms"])]
            rates = [f"{row['rays'] / median(row['ms']) / 1e3:.2f}" for row in (ours, theirs)]
            yield mesh, call, ours["rays"], ours["threads"], *rates, len(gains), spread(gains)


def header(report: dict[str, Any]) -> str:
    """What was measured on, and with what"""
    machine = report["machine"]
    measured = next(iter(next(iter(report["meshes"].values())).values()))
    peer = f"Embree {measured['embree']}; " if "embree" in measured else ""
    busy = "" if machine["quiet"] else " **The machine was busy: do not quote these times.**"
    return (
        f"{machine['cpu']}, {machine['cores']} cores, {machine['memory_gib']} GiB, {machine['system']}; "
        f"{measured['compiler']}, {peer}{machine['date']}, "
        f"load at the start {machine['load']:.2f}.{busy}\n\n{ABOUT}"
    )


def markdown(report: dict[str, Any]) -> str:
    """All tables of what the report holds"""
    if not report["meshes"]:
        return "No mesh was found.\n"
    parts = ["# What Espalier takes", header(report)]
    for simd, meshes in per_simd(report, "builds").items():
        head = "mesh | threads | builder | ms | turns | Mtri/s | times as fast as MEDIUM | efficiency"
        parts += [f"## Builds, {simd}", table(head, build_rows(meshes))]
        parts += [f"### Phases, {simd}, median ms", phase_table(meshes)]
    for simd, meshes in per_simd(report, "large").items():
        head = (
            "mesh | copies | their triangles | threads | builder | ms of one | ms of all | turns | Mtri/s | "
            "growth | peak MB over the input | kept MB"
        )
        parts += [f"## Larger, {simd}", table(head, large_rows(meshes))]
    for simd, meshes in per_simd(report, "scaling").items():
        parts += [f"## Threads, {simd}: speed-up (efficiency)", scaling_table(meshes)]
    for simd, meshes in per_simd(report, "rays").items():
        threads = meshes[0][1]["threads"]
        parts += [
            f"## Rays, {simd}, {threads} threads, millions per second",
            "In brackets: wide nodes and blocks of eight triangles that a ray visits. Embree is MEDIUM and ROBUST.",
            ray_table(meshes),
        ]
    for simd, meshes in per_simd(report, "python").items():
        head = "mesh | call | rays | threads | Espalier | embreex, one thread | turns | as fast per thread"
        parts += [
            f"## Incoherent rays from Python, {simd}, millions per second",
            "embreex traces on the calling thread, with an Embree and an instruction set of its own.",
            table(head, python_rows(meshes)),
        ]
    for simd, meshes in per_simd(report, "preview").items():
        head = "mesh | threads | builder | ms | turns | times as fast as MEDIUM | pixels that differ"
        parts += [
            f"## From triangles to a picture of 1024 x 1024 with shadows, {simd}",
            table(head, preview_rows(meshes)),
        ]
    for meshes in per_simd(report, "quality").values():
        model = next(iter(meshes[0][1]["quality"].values()))
        head = (
            f"mesh | mode | SAH cost, step {model['step']:g} and block {model['block']:g} | over exact | "
            "SAH cost, step 15 and triangle 20 | nodes | wide nodes | references per triangle | checksum"
        )
        parts += ["## Quality", table(head, quality_rows(meshes))]
    for meshes in per_simd(report, "memory").values():
        head = "mesh | builder | peak MB | kept MB | kept bytes per triangle | peak, of MEDIUM's | kept, of MEDIUM's"
        parts += ["## Memory over the input, all threads", table(head, memory_rows(meshes))]
    return "\n\n".join(parts) + "\n"
