"""Protects every decoder from hostile bytes: mutants of real messages break no promise, take no time, and leave nothing in memory."""

import gc
import random
import time
import tracemalloc
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings

from tests.fuzz.decoders import DECODERS, Decoder
from tests.fuzz.mutants import EDIT, edited, mutants

INPUTS = 2000
LONGEST_S = 5.0
"""Most processor time for one input; the usual one takes milliseconds."""
FINDS = Path(__file__).parent / "finds"
"""Inputs that have once broken a promise, a folder for each decoder."""
KEPT = 64 * 1024
"""Bytes that may be kept after the same inputs a second time: logs and caches differ a little."""


@pytest.mark.parametrize("decoder", DECODERS.values(), ids=list(DECODERS))
def test_real_messages_break_no_promise(decoder: Decoder) -> None:
    assert decoder.seeds()
    for seed in decoder.seeds():
        decoder.check(seed)


@pytest.mark.parametrize("name", DECODERS)
def test_mutants_of_real_messages_break_no_promise(name: str) -> None:
    seeds, check = DECODERS[name]

    @settings(max_examples=INPUTS, suppress_health_check=list(HealthCheck), database=None)
    @given(mutants(seeds()))
    def for_any(data: bytes) -> None:
        began_s = time.process_time()
        check(data)
        assert time.process_time() - began_s < LONGEST_S

    for_any()


@pytest.mark.parametrize("path", sorted(FINDS.glob("*/*")), ids=lambda path: f"{path.parent.name} {path.name}")
def test_what_has_once_broken_a_promise_breaks_none(path: Path) -> None:
    DECODERS[path.parent.name].check(path.read_bytes())


@pytest.mark.parametrize("name", DECODERS)
def test_hostile_bytes_leave_nothing_in_memory(name: str) -> None:
    seeds, check = DECODERS[name]
    draws = random.Random(7)
    inputs = [edited(draws.choice(seeds()), draws.randbytes(4 * EDIT)) for _ in range(25)]
    held = []
    tracemalloc.start()
    try:
        for _ in range(3):
            for data in inputs:
                check(data)
            gc.collect()
            held.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    assert held[2] - held[1] < KEPT
