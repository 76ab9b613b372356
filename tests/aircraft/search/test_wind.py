"""Protects the wind of a real vehicle's readings: told before arming, refused where there is none, and
never drawn when it goes quiet.
"""

import pytest

from aircraft.state import VehicleFailed
from link.bus.keys import READING
from link.bus.mavlink import unpack_reading
from plume.scenario import draw
from plume.sensor import Gaussian
from plume.worlds.world import World
from tests.aircraft.remote.cockpit import Cockpit
from tests.aircraft.remote.test_real import MEASURED, Others, fly, of_a_command
from tests.autopilots.faults import Fault

__all__ = ["of_a_command"]
KINDS = ("ardupilot", "px4")
both = pytest.mark.parametrize("kind", KINDS)
EASTERLY = (90.0, 2.0)
"""Of a double: where it comes from, degrees, and m/s."""
DRAWN = World(draw(1_000_000), 1, Gaussian()).wind


def drag(kind: str) -> dict[str, float]:
    """The parameters by which it estimates the wind."""
    return {"EK3_DRAG_MCOEF": 0.1} if kind == "ardupilot" else {"EKF2_DRAG_CTRL": 1}


def winds(bus: Others) -> list[tuple[float, float]]:
    return [unpack_reading(payload).wind for payload in bus.readings]


def read(number: int):
    return lambda bus: len(bus.readings) >= number


def told(caplog: pytest.LogCaptureFixture) -> list[str]:
    lines = [record.getMessage() for record in caplog.records]
    return [line for line in lines if line.startswith(("Check: wind: ", "Wind of the readings: "))]


@both
def test_without_any_wind_it_does_not_arm_and_says_what_to_set(
    kind: str, caplog: pytest.LogCaptureFixture
) -> None:
    cockpit = Cockpit(kind)
    armed = []
    with pytest.raises(
        VehicleFailed,
        match=r"^no wind for the readings: .*; set EK.*DRAG.*, use a payload that measures it, or give it "
        r"with --wind",
    ):
        fly(cockpit, lambda _: armed.append(cockpit.ap.armed), wind=lambda _: None)
    assert not any(armed)
    (line,) = told(caplog)
    assert line.startswith("Check: wind: not ok, no wind for the readings: ")


@both
def test_a_wind_that_is_given_is_that_of_all_readings_whatever_others_say(
    kind: str, caplog: pytest.LogCaptureFixture
) -> None:
    cockpit = Cockpit(kind, wind=EASTERLY, parameters=drag(kind))
    assert winds(fly(cockpit, read(2), wind=lambda _: None, given=(0.0, -3.0))) == [(0.0, -3.0)] * 2
    assert told(caplog) == ["Check: wind: ok, given by --wind, 3.0 m/s from 180°"]


@both
def test_an_autopilot_whose_parameters_promise_it_may_fly_and_its_estimate_is_taken(
    kind: str, caplog: pytest.LogCaptureFixture
) -> None:
    cockpit = Cockpit(kind, wind=EASTERLY, parameters=drag(kind))
    for wind in winds(fly(cockpit, read(2), wind=lambda _: None)):
        assert wind == pytest.approx((2.0, 0.0), abs=1e-6)
    assert len(told(caplog)) == 1
    assert "estimated by the autopilot" in told(caplog)[0]


def test_the_scenarios_wind_of_a_simulated_payload_is_told(caplog: pytest.LogCaptureFixture) -> None:
    cockpit = Cockpit("ardupilot")
    assert winds(fly(cockpit, read(2), wind=lambda _: DRAWN)) == [DRAWN] * 2
    (line,) = told(caplog)
    assert "the mission's, as the payload is simulated" in line


@both
def test_a_payload_that_stops_measuring_it_is_replaced_by_the_autopilot_in_so_many_words(
    kind: str, caplog: pytest.LogCaptureFixture
) -> None:
    cockpit = Cockpit(kind, wind=EASTERLY, parameters=drag(kind))
    got = winds(fly(cockpit, read(4), wind=lambda number: MEASURED if number < 3 else None))
    assert got[:2] == [MEASURED] * 2
    assert got[3] == pytest.approx((2.0, 0.0), abs=1e-6)
    assert "now estimated by the autopilot, 2.0 m/s from 90°" in told(caplog)[-1]


@both
def test_when_all_are_quiet_no_reading_is_taken_and_it_goes_home_after_the_silence(
    kind: str, caplog: pytest.LogCaptureFixture
) -> None:
    cockpit = Cockpit(kind)
    with pytest.raises(VehicleFailed, match="No waypoint for 30 s"):
        fly(cockpit, lambda _: False, wind=lambda number: MEASURED if number < 3 else None)
    assert "no readings until one does" in told(caplog)[-1]
    assert not cockpit.ap.armed
    assert sum("no readings until" in line for line in told(caplog)) == 1


@both
def test_when_it_is_back_the_search_goes_on(kind: str) -> None:
    cockpit = Cockpit(kind)
    bus = fly(cockpit, read(5), wind=lambda number: None if 3 <= number < 9 else MEASURED)
    assert winds(bus) == [MEASURED] * 5


def test_an_autopilots_wind_that_is_stale_is_none(caplog: pytest.LogCaptureFixture) -> None:
    """Its WIND stops while all else goes on."""
    cockpit = Cockpit("ardupilot", wind=EASTERLY, parameters={"EK3_DRAG_MCOEF": 0.1})

    def quiet(bus: Others) -> bool:
        if len(bus.readings) >= 2:
            cockpit.ap.says = {**cockpit.ap.says, 168: lambda _: None}
        return any("no readings until" in line for line in told(caplog))

    bus = fly(cockpit, quiet, wind=lambda _: None)
    for wind in winds(bus):
        assert wind == pytest.approx((2.0, 0.0), abs=1e-6)


@both
def test_a_sample_that_comes_within_a_glitch_is_no_reading(kind: str) -> None:
    """The payload takes its time, and the position jumps meanwhile: the reading is taken again when that
    is over.
    """
    cockpit = Cockpit(kind)

    def jumps(number: int) -> tuple[float, float]:
        if number == 3:
            cockpit.ap.faults.all.append(Fault("jump", when=cockpit.ap.now_s, argument="4"))
            for _ in range(10):
                cockpit.radio.advance()
            cockpit.vehicle.catch_up(cockpit.now_s + 0.001)
        return MEASURED

    bus = fly(cockpit, read(5), wind=jumps)
    assert bus.questions >= 7
    assert (
        len({unpack_reading(payload).time_boot_ms for key, payload, _ in bus.published if key is READING})
        == 5
    )
    for before, after in zip(bus.readings, bus.readings[1:], strict=False):
        assert unpack_reading(after).position[0] - unpack_reading(before).position[0] == pytest.approx(
            1.0, abs=0.6
        )
