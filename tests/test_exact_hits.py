# SPDX-License-Identifier: GPL-3.0-or-later
"""Every hit is the one that infinite precision gives, on the hard cases, in every build mode and instruction set."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor

import pytest

from tests.exactness import SLOW, WAYS, ask, qualities, trace_everywhere, tracers
from tests.hard_cases import CASES

RAYS = {case: 4_000 if case in SLOW else 20_000 for case in CASES}

JUDGED: dict[str, int] = {}


@pytest.fixture(scope="module")
def pools() -> Iterator[dict[str, ProcessPoolExecutor]]:
    with tracers() as pools:
        yield pools


@pytest.mark.parametrize("case", CASES)
def test_hits_are_exact(case: str, pools: dict[str, ProcessPoolExecutor]) -> None:
    question = ask(case, RAYS[case])
    assert (question.verdicts.triangle >= 0).mean() > 0.1, "the rays must meet something"
    every_way = [(quality, way) for quality in qualities() for way in WAYS]
    found = trace_everywhere(pools, case, question, [every_way] * len(pools))
    JUDGED[case] = len(question.origins)
    assert [outcome for outcome in found if outcome.wrong] == []
    assert len({(outcome.quality, outcome.tree) for outcome in found}) == len(qualities()), "one tree per mode"
    assert len({outcome.fingerprint for outcome in found if WAYS[outcome.way].share == 1}) == 1, "the same, bit for bit"


def test_a_million_rays_were_judged() -> None:
    if JUDGED.keys() != CASES.keys():
        pytest.skip("not all cases were run")
    assert sum(JUDGED.values()) >= 1_000_000
