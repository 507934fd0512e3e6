# SPDX-License-Identifier: GPL-3.0-or-later
"""The page of the report: three plots and a table each, from the figures alone."""

from __future__ import annotations

import html
import io
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

Part = dict[str, Any]

# Okabe and Ito's colours, which everyone can tell apart.
OURS, THEIRS, INK, FAINT = "#0072b2", "#d55e00", "#222222", "#767676"
STYLE: Any = {
    "font.size": 10, "axes.spines.top": False, "axes.spines.right": False, "axes.edgecolor": FAINT,
    "axes.labelcolor": INK, "text.color": INK, "xtick.color": INK, "ytick.color": INK, "axes.titlesize": 11,
    "axes.titlelocation": "left", "axes.titleweight": "bold", "svg.fonttype": "path", "svg.hashsalt": "espalier",
}  # fmt: skip
CSS = """
body { font: 16px/1.5 system-ui, sans-serif; color: #222; max-width: 62rem; margin: 2rem auto; padding: 0 1rem }
h1 { margin-bottom: 0 } h2 { margin-top: 3rem } svg { max-width: 100%; height: auto }
table { border-collapse: collapse; font-size: 0.85rem; font-variant-numeric: tabular-nums }
th, td { padding: 0.2rem 0.8rem 0.2rem 0; text-align: right; border-bottom: 1px solid #ddd }
th { font-weight: 600; vertical-align: bottom } th:first-child, td:first-child { text-align: left }
.faint { color: #666; font-size: 0.9rem }
"""


def write(report: dict[str, Part], folder: Path) -> None:
    """Write index.html, with everything in it, and the plots as files of their own."""
    sections = []
    with plt.rc_context(STYLE):
        for name, title, draw, rows in SECTIONS:
            if name not in report:
                continue
            part = report[name]
            body = [f"<h2>{title}</h2>"]
            if draw is not None:
                figure = draw(part["measured"])
                figure.text(0.01, -0.02, named(part), fontsize=8, color=FAINT, va="top")
                body.append(saved(figure, folder / f"{name}.svg"))
                plt.close(figure)
            else:
                body.append(f'<p class="faint">{html.escape(named(part))}</p>')
            body.append(rows(part["measured"]))
            sections.append("\n".join(body))
    page = (
        '<!doctype html>\n<html lang="en">\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width">\n<title>Espalier: speed against error</title>\n'
        f"<style>{CSS}</style>\n<h1>Espalier: speed against error</h1>\n" + "\n".join(sections) + "\n</html>\n"
    )
    (folder / "index.html").write_text(page, encoding="utf-8")


def saved(figure: Figure, path: Path) -> str:
    """Write a figure to a file and return it as a part of the page."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", bbox_inches="tight", metadata={"Date": None})
    path.write_text(buffer.getvalue(), encoding="utf-8")
    figure.savefig(path.with_suffix(".png"), dpi=150, bbox_inches="tight")
    text = buffer.getvalue()
    # Who made it with what is said for files; in a page it is but links.
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    return text[text.index("<svg") :]


def named(part: Part) -> str:
    """What was measured on; and whether it is to be trusted."""
    measured = part["measured"]
    here = measured["machine"] if isinstance(measured, dict) and "machine" in measured else part["machine"]
    threads = here.get("threads") or here["cores"]
    parts = [here["cpu"], f"{threads} hardware thread{'' if threads == 1 else 's'}", part["machine"]["simd"]]
    load = here.get("load", part["load"])
    if load > 0.5:
        parts.append(f"BUSY at the start (load {load:.1f}): not for quoting")
    if part["quick"]:
        parts.append("quick run")
    return ", ".join(parts)


def draw_builds(measured: Part) -> Figure:
    """Build time against SAH excess, a panel for each mesh."""
    meshes = list(dict.fromkeys(row["mesh"] for row in measured["rows"]))
    figure, panels = plt.subplots(1, len(meshes), figsize=(3.1 * len(meshes), 3.4), sharey=True, squeeze=False)
    excesses = [row["sah_excess_percent"] or 0.0 for row in measured["rows"]]
    top, bottom = max(*excesses, 1.0), min(*excesses, 0.0)
    for axes, mesh in zip(panels[0], meshes, strict=True):
        rows = [row for row in measured["rows"] if row["mesh"] == mesh]
        ours = sorted((r for r in rows if r["sah_excess_percent"] is not None), key=lambda r: float(r["build_ms"]))
        axes.plot([r["build_ms"] for r in ours], [r["sah_excess_percent"] for r in ours], "o-", color=OURS, lw=1)
        # Modes that came out alike share a label.
        labels: list[tuple[float, float, str]] = []
        for row in ours:
            x, y = float(row["build_ms"]), float(row["sah_excess_percent"])
            if labels and abs(labels[-1][0] / x - 1) < 0.15 and abs(labels[-1][1] - y) < 0.05 * top:
                labels[-1] = (*labels[-1][:2], f"{labels[-1][2]}, {row['builder']}")
            else:
                labels.append((x, y, row["builder"]))
        for x, y, text in labels:
            axes.annotate(text, (x, y), (5, 5), textcoords="offset points", color=OURS, fontsize=9,
                          bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5})  # fmt: skip
        for row in rows:
            if row["sah_excess_percent"] is None:
                axes.axvline(row["build_ms"], color=THEIRS, lw=1, ls=(0, (4, 3)))
                axes.text(row["build_ms"], 1.7 * top, row["builder"], rotation=90, ha="right", va="top", fontsize=8,
                          color=THEIRS)  # fmt: skip
        times = [float(row["build_ms"]) for row in rows]
        axes.set(xscale="log", xlim=(min(times) / 1.6, max(times) * 1.8), ylim=(bottom - 0.08 * top, 1.72 * top))
        axes.set_title(f"{mesh}, {rows[0]['triangles']:,} triangles")
        axes.set_xlabel("build time, ms")
        plain_numbers(axes, "x")
    against = "exact" if measured["against"] == "exact" else "the least found"
    panels[0][0].set_ylabel(f"SAH cost over {against}, %")
    threads = measured["rows"][0]["threads"]
    figure.suptitle(
        f"What a better tree costs, {threads} threads (Embree: time only, its SAH is that of another kind of tree)",
        x=0.01, ha="left", fontsize=11,
    )  # fmt: skip
    figure.tight_layout()
    return figure


def draw_tracers(measured: Part) -> Figure:
    """Speed and each kind of error, a row for each tracer."""
    rows = measured["rows"][::-1]
    panels = {
        "mrays_per_s": "Mrays/s, one thread",
        "lost_per_million": "lost per million",
        "false_per_million": "false per million",
        "wrong_face_per_million": "wrong face per million",
        "t_error_ulps_999_of_1000": "t off by, ulps (99.9 %)",
    }
    figure, axes = plt.subplots(
        1, len(panels), figsize=(11, 0.9 + 0.48 * len(rows)), sharey=True, width_ratios=[1.5, 1, 1, 1, 1.2]
    )
    for panel, (key, title) in zip(axes, panels.items(), strict=True):
        values = [float(row[key]) for row in rows]
        colors = [OURS if row["tracer"].startswith("Espalier") else THEIRS for row in rows]
        if key == "mrays_per_s":
            panel.set_xscale("log")
            panel.set_xlim(min(values) / 2, max(values) * 6)
            start = min(values) / 2
        else:
            panel.set_xscale("symlog", linthresh=0.5 if "ulps" in key else 10.0)
            panel.set_xlim(0, max([*values, 20.0]) * 30)
            start = 0.0
        panel.hlines(range(len(rows)), start, values, color="#dddddd", lw=1)
        panel.scatter(values, range(len(rows)), color=colors, s=34, zorder=3, clip_on=False)
        for y, (value, color) in enumerate(zip(values, colors, strict=True)):
            panel.annotate(
                f"{value:,.2f}" if value < 10 and value % 1 else f"{value:,.0f}", (value, y), (7, 0),
                textcoords="offset points", va="center", fontsize=9, color=color,
            )  # fmt: skip
        panel.set_title(title, fontsize=9.5, weight="normal")
        panel.set_xticks([])
        panel.minorticks_off()
        panel.spines["bottom"].set_visible(False)
        panel.tick_params(axis="y", length=0)
    axes[0].set_yticks(range(len(rows)), [row["tracer"] for row in rows])
    axes[0].set_ylim(-0.6, len(rows) - 0.4)
    figure.suptitle(
        f"Speed on the camera rays of the living room; errors of {measured['hard_rays']:,} hard rays: aimed at "
        "vertices and edges\nor along axes, near and far from the origin. "
        "Espalier traces in packets, the others ray by ray.",
        x=0.01, ha="left", fontsize=11,
    )  # fmt: skip
    figure.tight_layout()
    return figure


def draw_pictures(measured: Part) -> Figure:
    """Time of build and picture against its error, a line for each build mode."""
    figure, axes = plt.subplots(figsize=(7.5, 4.4))
    qualities = list(dict.fromkeys(row["quality"] for row in measured["rows"]))
    for quality, color in zip(qualities, (OURS, THEIRS, "#009e73", "#cc79a7"), strict=False):
        rows = [row for row in measured["rows"] if row["quality"] == quality]
        axes.plot([r["picture_s"] for r in rows], [r["rmse"] for r in rows], "o-", color=color, lw=1.2, ms=4,
                  label=quality)  # fmt: skip
    axes.legend(title="build mode", frameon=False, alignment="left", labelcolor="linecolor")
    last = [row for row in measured["rows"] if row["quality"] == qualities[0]]
    for row in last:
        slowest = max(r["picture_s"] for r in measured["rows"] if r["samples"] == row["samples"])
        text = f"{row['samples']} sample{'' if row['samples'] == 1 else 's'}"
        axes.annotate(text, (slowest, row["rmse"]), (8, 2), textcoords="offset points", fontsize=8.5, color=FAINT)
    axes.set(xscale="log", yscale="log")
    times = [row["picture_s"] for row in measured["rows"]]
    errors = [row["rmse"] for row in measured["rows"]]
    axes.set(xlim=(min(times) / 2, max(times) * 1.9), ylim=(min(errors) / 1.3, max(errors) * 1.9))
    width, height = measured["resolution"]
    axes.set_xlabel(f"build and picture, s on {measured['threads']} threads")
    axes.set_ylabel("RMSE, linear RGB")
    axes.set_title(
        f"The living room at {width} x {height}, against {measured['converged_samples']:,} samples per pixel"
    )
    plain_numbers(axes, "both")
    return figure


def plain_numbers(axes: Axes, which: str) -> None:
    """Ticks as people write numbers, and as many as fit."""
    for axis in (axes.xaxis, axes.yaxis)[: 1 if which == "x" else 2]:
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.10g}"))
        axis.set_minor_formatter(NullFormatter())


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table of the page."""

    def line(cells: Sequence[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"

    return "<table>" + line(head, "th") + "".join(line(row, "td") for row in rows) + "</table>"


def builds_table(measured: Part) -> str:
    """A row for each mesh and builder."""
    head = ("mesh", "builder", "threads", "build, ms", "least to greatest", "SAH cost", "over " + measured["against"])
    return table(
        head,
        (
            (
                row["mesh"],
                row["builder"],
                str(row["threads"]),
                f"{row['build_ms']:.1f}",
                f"{row['build_ms_min']:.1f} to {row['build_ms_max']:.1f}",
                "another tree's" if row["sah_cost"] is None else f"{row['sah_cost']:.1f}",
                "" if row["sah_excess_percent"] is None else f"{row['sah_excess_percent']:.2f} %",
            )
            for row in measured["rows"]
        ),
    )


def tracers_table(measured: Part) -> str:
    """A row for each tracer."""
    head = (
        "tracer",
        "Mrays/s",
        "least to greatest",
        "lost",
        "false",
        "wrong face",
        "t, ulps: median",
        "99.9 %",
        "worst",
    )
    rows = (
        (
            row["tracer"],
            f"{row['mrays_per_s']:.2f}",
            f"{row['mrays_per_s_min']:.2f} to {row['mrays_per_s_max']:.2f}",
            *(f"{row[f'{kind}_per_million']:,.0f}" for kind in ("lost", "false", "wrong_face")),
            *(f"{row[f't_error_ulps_{key}']:,.3g}" for key in ("median", "999_of_1000", "max")),
        )
        for row in measured["rows"]
    )
    note = (
        "Errors per million hard rays, judged in exact arithmetic; another face at the same exact distance is no "
        "error. All are called from Python on one thread. Embree (embreex) takes arrays and traces them ray by ray; "
        "BVHTree is called for each ray, which is most of its time. "
        f"Cases: {', '.join(measured['hard_cases'])}."
    )
    return table(head, rows) + f'<p class="faint">{html.escape(note)}</p>'


def pictures_table(measured: Part) -> str:
    """A row for each build mode and number of samples."""
    rows = ((r["quality"], str(r["samples"]), f"{r['picture_s']:.3f}", f"{r['rmse']:.5f}") for r in measured["rows"])
    return table(("mode", "samples", "build and picture, s", "RMSE"), rows)


def cycles_table(measured: list[Part]) -> str:
    """A row for each scene."""
    shares = {
        "object_differs": "other object",
        "depth_differs": "depth off by > 1e-4",
        "normal_differs": "normal off by > 0.01 rad",
        "by_filter": "explained by the filter",
        "by_tie": "by faces that coincide",
        "unexplained": "not explained",
    }
    head = ("scene", "pixels", *shares.values(), "median depth error", "median normal error, rad")
    rows = (
        (
            row["scene"],
            f"{row['pixels']:,}",
            *(f"{row[key] * row['pixels']:,.0f}" for key in shares),
            f"{row['median_depth_error']:.1e}",
            f"{row['median_normal_error']:.1e}",
        )
        for row in measured
    )
    note = (
        "Pixels in which Cycles' first hit (one sample, its thinnest filter, a hundredth of a pixel) and ours at the "
        "pixel's centre differ. What is not explained are two faces that meet at an outline, of which Cycles names the "
        "other one at the same depth."
    )
    return table(head, rows) + f'<p class="faint">{html.escape(note)}</p>'


SECTIONS: tuple[tuple[str, str, Any, Any], ...] = (
    ("tracers", "Rays", draw_tracers, tracers_table),
    ("builds", "Trees", draw_builds, builds_table),
    ("pictures", "Pictures", draw_pictures, pictures_table),
    ("cycles", "A second opinion: Cycles", None, cycles_table),
)
