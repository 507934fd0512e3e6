# SPDX-License-Identifier: GPL-3.0-or-later
"""Traces the hard cases in every way there is and counts what is not the exact hit.

    python -m tests.exactness [RAYS]

goes on with new seeds until so many rays (1e8 unless told) have been judged, prints a table per case, keeps it in
build/long-run.json after every round, and fails if a single hit is wrong. The tests use the same functions.
"""

from __future__ import annotations

import json
import os
import re
import sys
import time
import zlib
from collections import defaultdict
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import espalier_native
import numpy as np
from numpy.typing import NDArray

from tests.fast_judge import Errors, Verdicts, errors, judge_rays
from tests.hard_cases import CASES, PACKET, along_a_curve, make
from tests.judge import Floats, Ints

ROOT = Path(__file__).resolve().parent.parent

# Cases whose rays are nearly all decided by expansions.
SLOW = {
    "any_length",
    "any_magnitude",
    "near_degenerate_scaled_1e-30",
    "small_and_far",
    "splits_near_zero",
    "subnormal",
    "ulps_apart",
}


@dataclass(frozen=True)
class Question:
    """Rays through a mesh, and what infinite precision says of them."""

    vertices: Floats
    triangles: Ints
    origins: Floats
    directions: Floats
    t_min: Floats
    t_max: Floats
    verdicts: Verdicts


@dataclass(frozen=True)
class Way:
    """How rays are handed over: in what order, how many at a time, and to how many threads."""

    order: str
    batch: int
    threads: int = 1
    share: int = 1  # takes one run of 256 rays of so many


WAYS = {
    "stream": Way("given", 1 << 30),
    "shuffled": Way("shuffled", 1 << 30, share=3),
    "sorted": Way("sorted", 1 << 30, share=3),
    "threads": Way("given", 1 << 30, threads=3, share=3),
    "1000": Way("given", 1000, share=5),
    "packets": Way("given", PACKET, share=5),
    "7": Way("sorted", 7, share=11),
    "single": Way("given", 1, share=17),
}


@dataclass(frozen=True)
class Outcome:
    """What one way of tracing, on one instruction set, in trees of one build mode, made of a case."""

    case: str
    target: str
    quality: str
    way: str
    rays: int
    errors: Errors
    shadows: int  # rays whose occlusion is wrong
    fingerprint: int  # of every bit that came back, for the ways that take all rays
    tree: str  # the checksum of the tree

    @property
    def wrong(self) -> bool:
        return self.errors.any or self.shadows > 0


@cache
def qualities() -> tuple[str, ...]:
    """Every build mode that the module offers, by the names that it gives when it is asked for none of them."""
    try:
        espalier_native.build(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), quality="none")
    except ValueError as error:
        names = re.findall(r"'(\w+)'", str(error))
        assert names.pop() == "none"
        return tuple(names)
    raise AssertionError("a mode called 'none'?")


def ask(case: str, rays: int, seed: int = 0) -> Question:
    """A case's rays, in packets that end at infinity, at 1 and before; and for some rays that hit, the same cut off at
    the hit or an ulp before it, and begun at the hit or an ulp behind."""
    vertices, triangles, origins, directions = make(case, rays * 5 // 8, seed)
    whole = judge_rays(vertices, triangles, origins, directions)
    t_min = np.zeros(len(origins), np.float32)
    # What was aimed at lies at 1, or an ulp beside it.
    t_max = np.resize(np.repeat(np.array([np.inf, 1, 1, 0.99, 1], np.float32), PACKET), len(origins))

    with np.errstate(over="ignore"):
        nearest = whole.t.astype(np.float32)
    cut = np.flatnonzero((whole.triangle >= 0) & np.isfinite(nearest))[::5][: rays * 3 // 32]
    at, zero, infinite = nearest[cut], np.zeros(len(cut), np.float32), np.full(len(cut), np.inf, np.float32)
    after, before = np.nextafter(at, np.float32(np.inf)), np.nextafter(at, np.float32(0))
    pick = np.concatenate([np.arange(len(origins)), cut, cut, cut, cut])
    t_min = np.concatenate([t_min, zero, zero, at, np.minimum(after, np.finfo(np.float32).max)])
    t_max = np.concatenate([t_max, at, before, infinite, infinite])
    rays_of = vertices, triangles, origins[pick], directions[pick], t_min, t_max
    return Question(*rays_of, cut_short(whole, pick, *rays_of))


def cut_short(whole: Verdicts, pick: NDArray[np.intp], *rays_of: Any) -> Verdicts:
    """Verdicts on rays with ends, where `whole` has those on the same without any, of which these are `pick`."""
    vertices, triangles, origins, directions, t_min, t_max = rays_of
    triangle, t, u, v = whole.triangle[pick], whole.t[pick], whole.u[pick], whole.v[pick]
    # The nearest hit of all stays the nearest, or lies beyond the end. Near the ends that has to be asked again.
    beyond = t > t_max
    triangle[beyond] = -1
    t[beyond] = u[beyond] = v[beyond] = 0
    with np.errstate(invalid="ignore"):
        is_near = ~(np.abs(whole.t[pick] - t_max) > 2.0**-40 * t_max) & ~np.isinf(t_max)
    again = np.flatnonzero((whole.triangle[pick] >= 0) & ((t_min > 0) | is_near))
    asked = judge_rays(vertices, triangles, *(array[again] for array in (origins, directions, t_min, t_max)))
    triangle[again], t[again], u[again], v[again] = asked.triangle, asked.t, asked.u, asked.v
    return Verdicts(triangle, t, u, v)


def selection(question: Question, way: Way) -> NDArray[np.intp]:
    """Which rays go this way, in which order."""
    count = len(question.origins)
    chosen = np.flatnonzero(np.arange(count) // 256 % way.share == 0)
    if way.order == "shuffled":
        return np.random.default_rng(count).permutation(chosen)
    if way.order == "sorted":
        octant = (question.directions[chosen] < 0) @ np.array([1, 2, 4])
        keys = along_a_curve(question.origins[chosen]), along_a_curve(question.directions[chosen]), octant
        return np.asarray(chosen[np.lexsort(keys)])
    return chosen


def trace(tree: espalier_native.Tree, question: Question, way: Way) -> tuple[dict[str, NDArray[Any]], int]:
    """The hits of the rays that go this way, in the order of the question, and how many shadows are wrong."""
    order = selection(question, way)
    batches = [order[i : i + way.batch] for i in range(0, len(order), way.batch)]
    inputs = [
        (question.origins[b], question.directions[b], question.t_min[b], question.t_max[b], way.threads)
        for b in batches
    ]
    found = [tree.intersect(*rays) for rays in inputs]
    blocked = np.concatenate([tree.occluded(*rays) for rays in inputs])
    back = np.argsort(order, kind="stable")
    hits = {key: np.concatenate([h[key] for h in found])[back] for key in found[0]}
    return hits, int(np.count_nonzero(blocked[back] != (question.verdicts.triangle[np.sort(order)] >= 0)))


def outcomes(case: str, question: Question, ways: Iterable[tuple[str, str]]) -> list[Outcome]:
    """Traces by the instruction set of this process, in the given ways, each a build mode and a name of WAYS."""
    found: list[Outcome] = []
    trees: dict[str, espalier_native.Tree] = {}
    first: dict[str, NDArray[Any]] = {}
    for quality, name in ways:
        if quality not in trees:
            trees[quality] = espalier_native.build(question.vertices, question.triangles, quality, threads=1)
        hits, shadows = trace(trees[quality], question, WAYS[name])
        taken = np.sort(selection(question, WAYS[name]))
        fingerprint = 0
        if WAYS[name].share == 1:
            first = first or hits
            fingerprint = zlib.crc32(b"".join(hits[key].tobytes() for key in sorted(hits)))
        elif first:
            for key, array in hits.items():
                np.testing.assert_array_equal(array, first[key][taken], f"{quality}, {name}: {key}", strict=True)
        true = question.verdicts
        judged = errors(hits, Verdicts(true.triangle[taken], true.t[taken], true.u[taken], true.v[taken]))
        target = espalier_native.simd_targets()[0]
        tree = trees[quality].report["checksum"]
        found.append(Outcome(case, target, quality, name, len(taken), judged, shadows, fingerprint, tree))
    return found


@contextmanager
def tracers() -> Iterator[dict[str, ProcessPoolExecutor]]:
    """One process per instruction set of this machine, since a process uses one."""
    pools = {}
    before = os.environ.get("ESPALIER_SIMD")
    try:
        for target in espalier_native.simd_targets():
            os.environ["ESPALIER_SIMD"] = target
            pools[target] = ProcessPoolExecutor(1, mp_context=get_context("spawn"))
            assert pools[target].submit(espalier_native.simd_targets).result()[0] == target
        yield pools
    finally:
        os.environ.pop("ESPALIER_SIMD", None)
        if before is not None:
            os.environ["ESPALIER_SIMD"] = before
        for pool in pools.values():
            pool.shutdown(cancel_futures=True)


def trace_everywhere(
    pools: dict[str, ProcessPoolExecutor], case: str, question: Question, ways: list[list[tuple[str, str]]]
) -> list[Outcome]:
    """All outcomes of a case; `ways` holds those of each instruction set."""
    running: list[Future[list[Outcome]]] = [
        pool.submit(outcomes, case, question, some) for pool, some in zip(pools.values(), ways, strict=True)
    ]
    return [outcome for future in running for outcome in future.result()]


def bound(rays: float) -> str:
    """The rule of three: what no error among so many rays says of the share of wrong ones, at 95 %."""
    return f"fewer than {3 / rays:.1e} of such rays are wrong (95 %)"


def table(judged: dict[str, int], totals: dict[str, list[Outcome]]) -> str:
    rows = [f"{'case':30} {'judged':>11} {'traced':>11} {'lost':>5} {'false':>5} {'face':>5} {'shadow':>6} {'ulps':>6}"]
    for case, found in totals.items():
        sums = [sum(getattr(o.errors, kind) for o in found) for kind in ("lost", "false", "wrong_face")]
        worst = max(o.errors.t_ulps for o in found)
        traced, shadows = sum(o.rays for o in found), sum(o.shadows for o in found)
        rows.append(
            f"{case:30} {judged[case]:11,} {traced:11,} {sums[0]:5} {sums[1]:5} {sums[2]:5} {shadows:6} {worst:6.3f}"
        )
    return "\n".join(rows)


def long_run(rays: float) -> int:
    """Judges new rays until there are enough. Every ray is traced on every instruction set, the ways by turns."""
    start = time.monotonic()
    judged: dict[str, int] = defaultdict(int)
    totals: dict[str, list[Outcome]] = defaultdict(list)
    choices = [(quality, way) for way in WAYS for quality in qualities()]
    done, seed = 0, 0
    with tracers() as pools:
        while done < rays:
            seed += 1
            for number, case in enumerate(CASES):
                question = ask(case, 8_000 if case in SLOW else 40_000, seed)
                turn = seed + 5 * number
                ways = [[choices[(turn + 7 * i) % len(choices)]] for i in range(len(pools))]
                found = trace_everywhere(pools, case, question, ways)
                for outcome in found:
                    if outcome.wrong:
                        print(f"seed {seed}: {outcome}", flush=True)
                judged[case] += len(question.origins)
                totals[case] = merged(totals[case] + found)
                done += len(question.origins)
            wrong = sum(outcome.wrong for found in totals.values() for outcome in found)
            ROOT.joinpath("build/long-run.json").write_text(
                json.dumps(
                    {
                        "judged": done,
                        "seeds": seed,
                        "seconds": round(time.monotonic() - start),
                        "wrong": wrong,
                        "outcomes": [asdict(outcome) for found in totals.values() for outcome in found],
                    }
                )
            )
            print(f"seed {seed}: {done:,} rays judged, {time.monotonic() - start:.0f} s, {wrong} wrong", flush=True)
    print(table(judged, totals))
    print(f"{done:,} rays judged on {', '.join(pools)}: {bound(done) if wrong == 0 else f'{wrong} ways went wrong'}")
    return 1 if wrong else 0


def merged(found: list[Outcome]) -> list[Outcome]:
    """One outcome for each way, with the sums of all rounds."""
    sums: dict[tuple[str, str, str], Outcome] = {}
    for o in found:
        key = (o.target, o.quality, o.way)
        if key in sums:
            a, b = sums[key].errors, o.errors
            both = Errors(
                a.lost + b.lost,
                a.false + b.false,
                a.wrong_face + b.wrong_face,
                max(a.t_ulps, b.t_ulps),
                max(a.uv, b.uv),
            )
            sums[key] = Outcome(o.case, *key, sums[key].rays + o.rays, both, sums[key].shadows + o.shadows, 0, "")
        else:
            sums[key] = o
    return list(sums.values())


if __name__ == "__main__":
    sys.exit(long_run(float(sys.argv[1]) if len(sys.argv) > 1 else 1e8))
