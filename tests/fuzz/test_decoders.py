"""Protects every decoder from hostile bytes: mutants of real messages break no promise, take no time, and
leave nothing in memory.
"""

import gc
import logging
import random
import time
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.fuzz.decoders import DECODERS, Decoder
from tests.fuzz.mutants import EDIT, edited
from tests.fuzz.services import QUIET

FEW, MANY = 50, 2000
"""Mutants for each decoder in `make test`, and in `make test-all`."""
SEED = 7
LONGEST_S = 5.0
"""Most processor time for one input; the usual one takes milliseconds."""
FINDS = Path(__file__).parent / "finds"
"""Inputs that have once broken a promise, a folder for each decoder."""
KEPT = 64 * 1024
"""Bytes that may be kept after the same inputs a second time: logs and caches differ a little."""


@pytest.fixture(autouse=True)
def quiet() -> Iterator[None]:
    """Keep the services from writing a line for most inputs; other tests in this process look at these
    lines.
    """
    before = [logger.level for logger in QUIET]
    for logger in QUIET:
        logger.setLevel(logging.CRITICAL)
    yield
    for logger, level in zip(QUIET, before, strict=True):
        logger.setLevel(level)


def mutants(name: str, count: int) -> Iterator[bytes]:
    """Yield seeds of a decoder with up to six edits, the same on every run."""
    seeds, draws = DECODERS[name].seeds(), random.Random(SEED)
    for _ in range(count):
        yield edited(draws.choice(seeds), draws.randbytes(EDIT * draws.randint(1, 6)))


@pytest.mark.parametrize("decoder", DECODERS.values(), ids=list(DECODERS))
def test_real_messages_break_no_promise(decoder: Decoder) -> None:
    assert decoder.seeds()
    for seed in decoder.seeds():
        decoder.check(seed)


@pytest.mark.parametrize("count", [FEW, pytest.param(MANY, marks=pytest.mark.full)])
@pytest.mark.parametrize("name", DECODERS)
def test_mutants_of_real_messages_break_no_promise(name: str, count: int) -> None:
    check = DECODERS[name].check
    for data in mutants(name, count):
        began_s = time.process_time()
        try:
            check(data)
        except Exception as error:
            raise AssertionError(f"{name} breaks a promise with {data!r}") from error
        assert time.process_time() - began_s < LONGEST_S, data


@pytest.mark.parametrize(
    "path", sorted(FINDS.glob("*/*")), ids=lambda path: f"{path.parent.name} {path.name}"
)
def test_what_has_once_broken_a_promise_breaks_none(path: Path) -> None:
    DECODERS[path.parent.name].check(path.read_bytes())


@pytest.mark.full
@pytest.mark.parametrize("name", DECODERS)
def test_hostile_bytes_leave_nothing_in_memory(name: str) -> None:
    check = DECODERS[name].check
    inputs = [*mutants(name, 10)]
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
