# SPDX-License-Identifier: GPL-3.0-or-later
"""Every hit is the one that infinite precision gives, on the hard cases, in every build mode and instruction set."""

from __future__ import annotations

import os
import subprocess
import sys
import zlib

import espalier_native
import numpy as np
import pytest

from tests.hard_cases import CASES, Case
from tests.judge import MISS, Verdict, judge, ulps

QUALITIES = ("draft", "balanced", "best")
RAYS = 300


def make(name: str, rays: int = RAYS) -> Case:
    """The case without the few rays that the module refuses: directions below 2^-100 or above 2^100."""
    vertices, triangles, origins, directions = CASES[name](np.random.default_rng(zlib.crc32(name.encode())), rays)
    largest = np.abs(directions).max(axis=1)
    taken = (largest >= 2.0**-100) & (largest <= 2.0**100)
    assert taken.sum() > rays * 0.9
    return vertices, triangles, origins[taken], directions[taken]


@pytest.mark.parametrize("name", CASES)
def test_hits_are_exact(name: str) -> None:
    vertices, triangles, origins, directions = make(name)
    verdicts = [judge(o, d, vertices, triangles) for o, d in zip(origins, directions, strict=True)]
    assert any(verdict != MISS for verdict in verdicts), "the rays must meet something"
    for quality in QUALITIES:
        tree = espalier_native.build(vertices, triangles, quality)
        hits = tree.intersect(origins, directions)
        lost: list[int] = []
        invented: list[int] = []
        wrong: list[int] = []
        for i, verdict in enumerate(verdicts):
            found = int(hits["triangle"][i])
            if found != verdict.triangle:
                (invented if verdict == MISS else lost if found < 0 else wrong).append(i)
        assert (lost, invented, wrong) == ([], [], []), f"{quality}: rays lost, invented, on the wrong face"
        worst = max((ulps(float(hits["t"][i]), v.t) for i, v in enumerate(verdicts) if v != MISS), default=0.0)
        assert worst <= 1, f"{quality}: t is off by {worst} ulps"
        for i, verdict in enumerate(verdicts):
            if verdict != MISS:
                assert abs(float(hits["u"][i]) - float(verdict.u)) <= 2.0**-22
                assert abs(float(hits["v"][i]) - float(verdict.v)) <= 2.0**-22
        np.testing.assert_array_equal(tree.occluded(origins, directions), hits["triangle"] >= 0)


def test_interval_ends_are_decided_exactly() -> None:
    """t_min and t_max at the hit's own float32 distance and one ulp to either side."""
    vertices, triangles, origins, directions = make("at_vertices", 200)
    tree = espalier_native.build(vertices, triangles)
    t = tree.intersect(origins, directions)["t"]
    for i in np.flatnonzero(np.isfinite(t)):
        for end in (np.nextafter(t[i], np.float32(0)), t[i], np.nextafter(t[i], np.float32(np.inf))):
            for interval in ((float(end), float("inf")), (0.0, float(end))):
                verdict: Verdict = judge(origins[i], directions[i], vertices, triangles, *interval)
                found = tree.intersect(origins[i : i + 1], directions[i : i + 1], *interval)
                assert int(found["triangle"][0]) == verdict.triangle


FINGERPRINT = """
import zlib
import espalier_native
from tests.test_exact_hits import make
from tests.hard_cases import CASES
sum = 0
for name in CASES:
    vertices, triangles, origins, directions = make(name)
    tree = espalier_native.build(vertices, triangles)
    hits = tree.intersect(origins, directions)
    for key in ("triangle", "t", "u", "v"):
        sum = zlib.crc32(hits[key].tobytes(), sum)
    sum = zlib.crc32(tree.report["checksum"].encode(), sum)
print(sum)
"""


def test_every_instruction_set_gives_the_same_hits_and_trees() -> None:
    sums = {}
    for target in espalier_native.simd_targets():
        run = subprocess.run(
            [sys.executable, "-c", FINGERPRINT],
            env={**os.environ, "ESPALIER_SIMD": target},
            capture_output=True,
            text=True,
            timeout=300,
            check=True,
        )
        sums[target] = run.stdout.strip()
    assert len(set(sums.values())) == 1, sums
