"""Protects the promise that the stop arrives: at vehicle, agent and latecomers, whatever else floods the
bus.
"""

import math

import pytest

from benchmarks.stop import measure


@pytest.mark.full
def test_each_stop_reaches_vehicle_agent_and_latecomers_through_a_flood_and_past_a_subscriber_that_never_reads() -> (
    None
):
    trials = measure(30, flooded=True, every=10, settle_s=0.5)
    assert trials.lost == 0
    assert [len(times) for times in trials.taken.values()] == [30, 30]
    assert all(map(math.isfinite, trials.joined))
    assert len(trials.joined) == 3
