"""Protects the fast planners' results: scores and moves equal those of plain NumPy on beliefs of whole
missions.
"""

import numpy as np
import pytest

from agent.planning.moves import Reach
from agent.planning.predict import cloud, imagine
from agent.policies import choose
from benchmarks import planner_peers
from benchmarks.planner_peers import NUMPY
from benchmarks.planners import FIRST_SEED, Case, beliefs
from tests.agent.planners.test_planners import chosen_by


@pytest.fixture(scope="module")
def cases() -> list[Case]:
    """Beliefs from the first to the last before the stop, from missions with different numbers of
    particles.
    """
    flown = [beliefs(FIRST_SEED + i, count, kept=6) for i, count in enumerate((300, 500, 700, 1000))]
    assert min(mission[-1][0].spread for mission in flown) < 0.6  # nearly ceased
    return [case for mission in flown for case in mission]


def ours(name: str, case: Case, reach: Reach, rng: np.random.Generator) -> np.ndarray:
    """(A,): the scores of our planner of that name; the greatest is chosen."""
    belief, particles = case
    moves, hypotheses = reach.moves(belief.position), cloud(belief, particles)
    squared = np.square(moves[:, :, None] - hypotheses.places).sum(axis=1)
    imagined = imagine(hypotheses, moves, reach.measurements, rng, squared[:, None])
    return {
        "infotaxis": imagined.gains.mean(axis=1),
        "entrotaxis": imagined.gains.mean(axis=1)
        + hypotheses.sensor.entropy(imagined.means) @ hypotheses.weights,
        "dcee": -imagined.expectations.mean(axis=(1, 2)),
    }[name]


@pytest.mark.parametrize("headings", [4, 8])
@pytest.mark.parametrize("name", NUMPY)
def test_scores_are_those_of_plain_numpy(name: str, headings: int, cases: list[Case]) -> None:
    reach = Reach(headings=headings)
    for case in cases:
        expected = NUMPY[name](*case, reach, np.random.default_rng(1))
        assert ours(name, case, reach, np.random.default_rng(1)) == pytest.approx(
            expected, rel=1e-9, abs=1e-9
        )


@pytest.mark.parametrize("headings", [4, 8])
@pytest.mark.parametrize("name", NUMPY)
def test_moves_are_those_of_plain_numpy(name: str, headings: int, cases: list[Case]) -> None:
    reach = Reach(headings=headings)
    for case in cases:
        assert choose(name, *case, 7, reach) == planner_peers.choose(name, *case, 7, reach)
    chosen = {chosen_by(name, *case, reach, np.random.default_rng(1)) for case in cases}
    assert len(chosen) > 1  # the cases lead to different headings
