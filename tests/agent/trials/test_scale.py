"""Protects searches from units of length: a field that is larger in all its lengths is searched in the same way."""

from pathlib import Path

import pytest

from agent.planners.registry import PLANNERS
from agent.planning.moves import HeadingAndStep, Headings, Move
from agent.trials.rollout import rollout
from plume.outcome import TracePoint
from plume.problem import Area, Problem
from plume.scenario import DIFFUSIVITIES, RATES, WIND_SPEEDS
from tests.agent.test_bundle import a_bundle

Decision = tuple[float, float]


def enlarged(scale: float) -> Problem:
    """Table 1 with its lengths so many times as long, and the same concentrations at the same parts of it.

    By dimensions: u and ζ grow as a length, d as its square; q/(d r) stays if q grows as its cube.
    """

    def span(of: tuple[float, float], power: int) -> tuple[float, float]:
        return of[0] * scale**power, of[1] * scale**power

    def square(low: float, high: float) -> Area:
        return Area((low * scale, low * scale), (high * scale, high * scale))

    return Problem(
        area=square(0.0, 30.0),
        step_m=scale,
        start=square(0.0, 5.0),
        source=square(10.0, 25.0),
        q=span(RATES, 3),
        u=span(WIND_SPEEDS, 1),
        d=span(DIFFUSIVITIES, 2),
        stop=f"spread:{0.5 * scale:g}",
    )


def flown(policy: str, scale: float, seed: int, assume: str, moves: int) -> list[TracePoint]:
    return rollout(seed, policy, particles=200, budget=moves, problem=enlarged(scale), assume=assume)[1]


def places(trace: list[TracePoint], scale: float) -> list[Decision]:
    return [(point.position[0] / scale, point.position[1] / scale) for point in trace]


@pytest.mark.parametrize("policy", PLANNERS)
def test_a_field_that_is_larger_in_all_its_lengths_is_searched_in_the_same_way(policy: str) -> None:
    """Powers of two round nothing, so the decisions are the same to the last bit."""
    here = flown(policy, 1.0, 1, "paper", 12)
    for scale in (0.5, 8.0):
        there = flown(policy, scale, 1, "paper", 12)
        assert places(there, scale) == places(here, 1.0)
        assert [point.reading for point in there] == [point.reading for point in here]


@pytest.mark.parametrize("seed", [1, 3, 4])
def test_so_it_is_by_homing_while_all_but_the_model_is_unknown(seed: int) -> None:
    """The rate's prior is log-normal, and a logarithm of a larger number rounds elsewhere: at last a move is
    accepted here and not there.
    """
    here, there = flown("homing", 1.0, seed, "field", 8), flown("homing", 8.0, seed, "field", 8)
    assert places(there, 8.0) == places(here, 1.0)
    assert [point.spread / 8 for point in there] == pytest.approx([point.spread for point in here], rel=1e-6)


@pytest.mark.parametrize("move", [Headings(16), HeadingAndStep()], ids=repr)
def test_so_it_is_by_a_learned_policy_that_sees_polar_2(tmp_path: Path, move: Move) -> None:
    """Its network is drawn by chance: whatever is learned from such an observation is flown alike."""
    policy = str(tmp_path / "any.zip")
    a_bundle(Path(policy), "polar-2", move, seed=4)
    here = flown(policy, 1.0, 1, "paper", 12)
    assert len(set(places(here, 1.0))) > 5
    for scale in (0.5, 8.0):
        assert places(flown(policy, scale, 1, "paper", 12), scale) == places(here, 1.0)
