"""Protects the sets of problems that training draws from: what is documented of them, and that a seed has one."""

import math

import pytest

from agent.learn.problems import SETS, anywhere
from plume.problem import Area, Problem
from plume.problems.names import PROBLEMS
from plume.scenario import DIFFUSIVITIES, RATES, draw

DRAWN = [anywhere(seed) for seed in range(300)]


def test_a_seed_has_one_problem() -> None:
    assert anywhere(7) == anywhere(7)
    assert len({problem.text for problem in DRAWN}) == len(DRAWN)


def test_a_set_is_no_problem() -> None:
    """Where one is wanted, a set is refused as an unknown name."""
    assert not SETS.keys() & PROBLEMS.keys()


def test_areas_steps_and_spreads_are_as_documented() -> None:
    for problem in DRAWN:
        width_m, height_m = problem.area.size_m
        side_m = problem.area.side_m
        assert side_m * (1 + 1e-9) >= 20
        assert side_m <= 400 * (1 + 1e-9)
        assert max(width_m, height_m) / min(width_m, height_m) <= 4 * (1 + 1e-9)
        assert 0.003 <= problem.step_m / side_m <= 0.1
        assert problem.budget == math.ceil(10 * side_m / problem.step_m)
        assert 0.25 / 30 <= float(problem.stop.removeprefix("spread:")) / side_m <= 0.63 / 30
    usual = [problem for problem in DRAWN if 0.02 <= problem.step_m / problem.area.side_m <= 0.05]
    assert len(usual) / len(DRAWN) == pytest.approx(0.75 + 0.25 * math.log(2.5) / math.log(100 / 3), abs=0.08)


def test_half_of_the_priors_are_the_area_and_half_of_the_missions_start_anywhere() -> None:
    assert sum(problem.prior is None for problem in DRAWN) / len(DRAWN) == pytest.approx(0.5, abs=0.1)
    assert sum(problem.start is None for problem in DRAWN) / len(DRAWN) == pytest.approx(0.5, abs=0.1)
    for problem in DRAWN:
        assert problem.start in (None, problem.area)


def test_sources_are_where_they_are_expected() -> None:
    for seed, problem in enumerate(DRAWN):
        assert isinstance(problem.expected, Area)
        assert problem.sources == problem.expected
        assert problem.expected.holds(draw(seed, problem).source)


def test_plumes_are_table_1s_with_all_lengths_and_times_times_a_number() -> None:
    def ends(of: object) -> tuple[float, float]:
        assert isinstance(of, tuple)
        return of

    for problem in DRAWN:
        larger = ends(problem.d)[0] / DIFFUSIVITIES[0]
        assert 0.5 - 1e-9 <= larger / (problem.area.side_m / 30) <= 1.5 + 1e-9
        assert ends(problem.d)[1] == pytest.approx(DIFFUSIVITIES[1] * larger)
        assert ends(problem.q) == pytest.approx([rate * larger**2 for rate in RATES])
        assert problem.tau == pytest.approx(10 * larger)
        assert problem.u == Problem().u
