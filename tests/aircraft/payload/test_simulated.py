"""Protects the simulated payload: its values are those of the same mission in-process, and its plume blows
with the vehicle's wind.
"""

import math
from typing import Any

import pytest

from aircraft.payload.command import sensor_in
from aircraft.payload.messages import Question
from aircraft.payload.simulated import Simulated
from link.bus.log import Log
from link.bus.tally import Tally
from plume.scenario import WorldError, draw
from plume.sensors.sensor import Gaussian
from plume.worlds.world import World

SEED = 7
CLEAR = Gaussian(0.0, 1e-9)
"""A sensor with next to no noise, g/m³."""


Pair = tuple[float, float]


def question(
    number: int = 0, position: Pair = (3.0, 4.0), wind: Pair | None = None, at_ms: int = 1000
) -> Question:
    return Question(1, at_ms, number, position, wind)


def by_hand(x: float, y: float, wind: Pair) -> float:
    """Vergassola et al. 2007, eq. (S5), in plain arithmetic, g/m³."""
    s = draw(SEED)
    east, north, u = x - s.source[0], y - s.source[1], math.hypot(*wind)
    r = math.hypot(east, north)
    decay = math.sqrt(s.d * s.tau / (1 + u * u * s.tau / (4 * s.d)))
    return (
        s.q / (4 * math.pi * s.d * r) * math.exp(-r / decay - (east * wind[0] + north * wind[1]) / (2 * s.d))
    )


def test_its_values_are_those_of_the_mission_in_process_to_the_last_bit() -> None:
    simulated, world = Simulated(World(draw(SEED), SEED)), World(draw(SEED), SEED)
    for number, place in enumerate([(3.0, 4.0), (12.0, 9.5), (20.0, 20.0)]):
        for wind in (None, world.wind):
            sample = simulated(question(number, place, wind))
            assert (sample.gas, sample.wind) == (world.gas(place, number), world.wind)


def test_the_same_question_has_the_same_answer_whatever_was_asked_before() -> None:
    simulated = Simulated(World(draw(SEED), SEED, name="cv-1-correlated"))
    asked = [question(number, (10.0 + number, 12.0), (1.0, number / 4)) for number in range(6)]
    forwards = [simulated(each) for each in asked]
    again = Simulated(World(draw(SEED), SEED, name="cv-1-correlated"))
    assert [again(each) for each in reversed(asked)] == forwards[::-1]


@pytest.mark.parametrize("wind", [(2.0, 0.0), (-2.0, 0.0), (0.0, 3.0), (0.5, -1.5), (0.0, 0.0)])
def test_the_plume_blows_with_the_wind_that_the_vehicle_reports(wind: Pair) -> None:
    simulated = Simulated(World(draw(SEED), SEED, CLEAR))
    x, y = draw(SEED).source
    for place in ((x - 3.0, y + 1.0), (x + 2.0, y - 2.5)):
        sample = simulated(question(position=place, wind=wind))
        assert sample.gas == pytest.approx(by_hand(*place, wind), rel=1e-5, abs=1e-6)
        assert sample.wind == wind


def test_without_a_reported_wind_the_scenarios_blows_and_is_answered() -> None:
    simulated = Simulated(World(draw(SEED), SEED, CLEAR))
    x, y = draw(SEED).source
    sample = simulated(question(position=(x - 2.0, y)))
    s = draw(SEED)
    wind = s.u * math.cos(s.phi), s.u * math.sin(s.phi)
    assert sample.wind == pytest.approx(wind, rel=1e-6)
    assert sample.gas == pytest.approx(by_hand(x - 2.0, y, wind), rel=1e-5)


def test_in_a_world_that_loses_readings_a_lost_one_has_a_value_when_it_is_asked_for_again() -> None:
    simulated = Simulated(World(draw(SEED), SEED, name="readings-lost"))
    first = [math.isnan(simulated(question(number, at_ms=2 * number)).gas) or number for number in range(200)]
    lost = [number for number, said in enumerate(first) if said is True and number]
    assert 20 <= len(lost) <= 60  # a fifth of them
    for number in lost:
        assert math.isnan(simulated(question(number)).gas)
        assert math.isfinite(simulated(question(number, at_ms=5000)).gas)


def test_where_the_world_fails_it_has_no_value_which_the_log_says_once(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """As a recorded plume of which a later frame is broken."""

    class Broken(World):
        def measure(self, position: Pair, step: int, *moment: Any) -> tuple[float, Pair]:
            if step > 1:
                raise WorldError("world recorded failed: frame 9: cut off")
            return super().measure(position, step, *moment)

    log = Log("payload", "uav/1", Tally(), "info")
    measure, world = sensor_in(Broken(draw(SEED), SEED), log), World(draw(SEED), SEED)
    assert measure(question(1)).gas == world.gas((3.0, 4.0), 1)
    for number in (2, 3):
        assert math.isnan(measure(question(number)).gas)
    assert capsys.readouterr().err.count("frame 9: cut off") == 1
    assert log.tally.refused.total() == 2
