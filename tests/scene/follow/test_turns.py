"""Protects the true plume that people see from a wind that a mission script has turned since."""

import math

import pytest

from link.bus.keys import BELIEF, READING
from link.bus.mavlink import Codec, Reading, pack_reading
from scene.follow.described import WindTurn, turns_of
from scene.follow.history import History
from scene.scene import Backdrop, Release

RELEASE = Release((20.0, 12.0), (2.0, 0.0), q=300.0, d=4.0, tau=10.0)


def wind_after(turns: list[WindTurn], step: int, time_s: float) -> tuple[float, float]:
    """The true wind once the belief of a step was heard at a time."""
    history = History(Backdrop("uav/1", release=RELEASE), turns=turns)
    said = (
        f'{{"time_boot_ms":1,"step":{step},"position":[1,2],"altitude_m":5,"gas":0.5,"wind":[1,0],"sensor":"gaussian","rate":1,'
        '"diffusivity":1,"lifetime":1,"z":0,"unknowns":["x","y"],"means":[5,6],"stds":[1,1],"mean":[5,6],"covariance":[1,0,1],'
        '"spread":1.4,"effective_sample_size":2,"p_value":0.5,"ceased":false,"assume":"field","stop":"spread","evidence":0}'
    )
    history.take(BELIEF.name, said.encode(), b"", time_s, 0.0)
    return history.at().backdrop.release.wind


@pytest.mark.parametrize(
    ("step", "time_s", "wind"), [(11, 30.0, (2.0, 0.0)), (12, 30.0, (0.0, 3.0)), (12, 60.0, (0.0, 1.0))]
)
def test_the_wind_turns_at_a_step_or_a_time(step: int, time_s: float, wind: tuple[float, float]) -> None:
    turns = [WindTurn(12, 0.0, 3.0, math.pi / 2), WindTurn(None, 50.0, 1.0, None)]
    assert wind_after(turns, step, time_s) == pytest.approx(wind, abs=1e-12)


def test_the_plume_of_a_real_vehicle_blows_with_the_wind_of_its_readings() -> None:
    history = History(Backdrop("uav/1", release=RELEASE), turns=turns_of({"vehicle": "tcp:127.0.0.1:5760"}))
    assert history.at().backdrop.release.wind == RELEASE.wind  # as long as none is known
    for second, wind in enumerate([(0.5, 1.5), (-1.0, 0.25)]):
        history.take(
            READING.name,
            pack_reading(Codec(1, 1), Reading(1000 * second, (1.0, 2.0), 5.0, wind, 0.5)),
            b"",
            float(second),
            0.0,
        )
        assert history.at().backdrop.release.wind == wind
    assert history.at(0.0).backdrop.release.wind == (0.5, 1.5)


def test_the_turns_are_read_from_the_script_in_a_runs_description() -> None:
    events = [
        {"do": "wind", "step": 12, "u": 3.0, "phi": 2.1},
        {"do": "pause", "step": 3},
        {"do": "wind", "time_s": 7.5, "u": 1.0},
    ]
    assert turns_of({"mission": {"events": events}}) == [
        WindTurn(12, 0.0, 3.0, 2.1),
        WindTurn(None, 7.5, 1.0, None),
    ]
    assert turns_of({}) == turns_of({"mission": "odd"}) == []


@pytest.mark.parametrize(
    "turn", [{"time_s": "soon", "u": 1.0}, {"step": "2"}, {"step": 1, "phi": math.inf}, {"step": 1, "u": [1]}]
)
def test_a_turn_that_no_script_can_have_is_left_out(turn: dict[str, object]) -> None:
    honest = {"do": "wind", "step": 4, "u": 2.0, "phi": None}
    (left,) = turns_of({"mission": {"events": [{"do": "wind", **turn}, honest]}})
    assert left == (4, 0.0, 2.0, None)
