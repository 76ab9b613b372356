"""Protects missions from faults: twelve runs of the fault campaign, each judged as the campaign does.
`make chaos` flies the others.
"""

from functools import cache

import pytest

from benchmarks.chaos.__main__ import cannot, fly
from benchmarks.chaos.arena import lacking
from benchmarks.chaos.judge import AS_UNDISTURBED, TOLD

missing = cache(lacking)


@pytest.mark.full
@pytest.mark.parametrize(
    ("kind", "seed", "outcome"),
    [
        ("kill", 49, AS_UNDISTURBED),
        ("kill", 5, TOLD),
        ("hang", 49, AS_UNDISTURBED),
        ("cut", 49, AS_UNDISTURBED),
        ("unplug", 49, AS_UNDISTURBED),
        ("loss", 5, AS_UNDISTURBED),
        ("radio", 49, AS_UNDISTURBED),
        ("echo", 24, AS_UNDISTURBED),
        ("deaf", 24, AS_UNDISTURBED),
        ("second", 24, AS_UNDISTURBED),
        ("clock", 49, AS_UNDISTURBED),
        ("disk", 5, AS_UNDISTURBED),
    ],
)
def test_a_mission_with_a_fault_keeps_its_promise(kind: str, seed: int, outcome: str) -> None:
    if reason := cannot(seed, kind, missing()):
        pytest.skip(reason)
    said = fly(seed, kind, isolated="" not in missing())
    assert (said["outcome"], said["reasons"]) == (outcome, []), said
    assert [fault["kind"] for fault in said["done"]] == [kind]
