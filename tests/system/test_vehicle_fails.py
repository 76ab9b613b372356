"""Protects how missions on a real autopilot fail: with the reason and status 1, and never with a vehicle
that nobody is in charge of.
"""

import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.autopilots.settings import Settings
from tests.autopilots.wire import Double
from tests.system.conftest import Part

SPEEDUP = 2.0
WORDS = ("--speedup", f"{SPEEDUP:g}", "--seed", "7", "--particles", "100", "--no-record")


@pytest.mark.full
def test_a_refused_arming_fails_the_mission_with_the_autopilots_reason(
    start: type[Part], tmp_path: Path
) -> None:
    with Double("ardupilot", settings=Settings(ready_s=5.0, faults=("arm",)), speedup=SPEEDUP) as double:
        flight = start("sitl", "fly", "--vehicle", double.url, *WORDS, cwd=tmp_path)
        assert flight.ended() == 1
    assert "Arming refused: Arm: Compass not healthy" in flight.err[-1]


@pytest.mark.full
def test_a_launcher_that_is_killed_leaves_no_vehicle_in_the_air(
    start: type[Part], tmp_path: Path, wait_until: Callable[..., None]
) -> None:
    with Double("ardupilot", settings=Settings(ready_s=5.0), speedup=SPEEDUP) as double:
        flight = start("sitl", "fly", "--vehicle", double.url, *WORDS, cwd=tmp_path)
        flight.comes_to("step   0/300")
        flight.process.send_signal(signal.SIGKILL)
        wait_until(lambda: not double.wire.autopilot.armed)
        assert double.wire.autopilot.mode == "RTL"


@pytest.mark.full
def test_a_mission_that_a_pilot_ends_fails_with_who_and_how(start: type[Part], tmp_path: Path) -> None:
    with Double(
        "ardupilot", settings=Settings(ready_s=5.0, radio=True, faults=("pilot@#3:RTL",)), speedup=SPEEDUP
    ) as double:
        flight = start("sitl", "fly", "--vehicle", double.url, *WORDS, cwd=tmp_path)
        assert flight.ended() == 1
    assert flight.err[-1].rstrip().endswith("error: ended by the pilot: RTL by a radio or a ground station")
