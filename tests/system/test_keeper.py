"""Protects a vehicle in the air from a uav that is stopped, killed or runs in circles, with real
processes.
"""

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.autopilots.settings import Settings
from tests.autopilots.wire import Double
from tests.system.conftest import Part

SPEEDUP = 10.0
WORDS = ("--speedup", f"{SPEEDUP:g}", "--seed", "7", "--particles", "100", "--no-record")
IN_CIRCLES = """
import signal
def in_circles(*_):
    while True:
        pass
signal.signal(signal.SIGUSR2, in_circles)
"""


@pytest.fixture
def double() -> Iterator[Double]:
    with Double("ardupilot", settings=Settings(ready_s=5.0), speedup=SPEEDUP) as flown:
        yield flown


def keeper_of(uav: int) -> int:
    """The process id of a uav's keeper; 0 while it has none."""
    for child in Path(f"/proc/{uav}/task/{uav}/children").read_text().split():
        if "aircraft.keeper.keeper" in Path(f"/proc/{child}/cmdline").read_text():
            return int(child)
    return 0


def end(
    number: signal.Signals,
    start: type[Part],
    family: Callable,
    double: Double,
    cwd: Path,
    wait_until: Callable[..., None],
    patience_s: float = 300.0,
) -> tuple[Part, int, int]:
    """Fly, and give the uav a signal in mid-air; returns the mission, the uav and its keeper when the
    vehicle has landed. The launcher takes a uav that is silent for `patience_s` for one that hangs, and ends it.
    """
    mission = start("sitl", "fly", "--vehicle", double.url, *WORDS, "--patience", f"{patience_s:g}", cwd=cwd)
    mission.comes_to("step   0/300")
    uav = family(mission.process.pid)["uav"]
    keeper = keeper_of(uav)
    os.kill(uav, number)
    wait_until(lambda: double.wire.autopilot.mode == "RTL")
    wait_until(lambda: not double.wire.autopilot.armed)
    return mission, uav, keeper


def test_a_uav_that_is_killed_has_its_vehicle_sent_home_by_its_keeper_which_then_ends(
    start: type[Part], family: Callable, double: Double, tmp_path: Path, wait_until: Callable[..., None]
) -> None:
    mission, _, keeper = end(signal.SIGKILL, start, family, double, tmp_path, wait_until)
    assert mission.ended() == 1
    words = (
        "The keeper sends the vehicle home: the uav has ended",
        "The vehicle is left in RTL",
    )  # the second comes within a second
    assert mission.err[-1] in [
        f"error: uav was killed by signal 9; its last words: keeper: warning: {said}\n" for said in words
    ]
    wait_until(lambda: not Path(f"/proc/{keeper}").exists())


@pytest.mark.full
def test_a_launcher_and_a_uav_that_are_killed_together_leave_no_vehicle_in_the_air(
    start: type[Part], family: Callable, double: Double, tmp_path: Path, wait_until: Callable[..., None]
) -> None:
    mission = start("sitl", "fly", "--vehicle", double.url, *WORDS, cwd=tmp_path)
    mission.comes_to("step   0/300")
    uav = family(mission.process.pid)["uav"]
    mission.process.kill()
    os.killpg(uav, signal.SIGKILL)
    wait_until(lambda: double.wire.autopilot.mode == "RTL")


@pytest.mark.full
def test_a_uav_that_was_stopped_finds_its_search_over_and_says_why(
    start: type[Part], family: Callable, double: Double, tmp_path: Path, wait_until: Callable[..., None]
) -> None:
    mission, uav, _ = end(signal.SIGSTOP, start, family, double, tmp_path, wait_until)
    os.kill(uav, signal.SIGCONT)
    assert mission.ended() == 1
    assert mission.says("The keeper sends the vehicle home: the uav was silent for 3 s")
    assert "The keeper has taken the vehicle over: the uav was silent for 3 s" in mission.err[-1]
    assert double.wire.autopilot.mode == "RTL"


@pytest.mark.full
def test_a_uav_that_runs_in_circles_tells_where_and_its_vehicle_is_sent_home(
    start: type[Part],
    family: Callable,
    double: Double,
    tmp_path: Path,
    wait_until: Callable[..., None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "planted").mkdir()
    (tmp_path / "planted" / "sitecustomize.py").write_text(IN_CIRCLES)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "planted"))
    mission, _, _ = end(signal.SIGUSR2, start, family, double, tmp_path, wait_until, 10.0)
    assert mission.ended() == 1
    assert mission.says("in in_circles")
    why = "the uav was silent for 3 s", "the uav has ended"  # which comes first, the keeper's 3 s or our 10 s
    assert any(mission.says(f"The keeper sends the vehicle home: {each}") for each in why)
    assert mission.err[-1] == "error: the uav has said nothing for 10 s (--patience S waits longer)\n"


@pytest.mark.full
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_keeper_that_dies_or_hangs_is_replaced_and_the_search_goes_on(
    start: type[Part],
    family: Callable,
    tmp_path: Path,
    wait_until: Callable[..., None],
    number: signal.Signals,
) -> None:
    slow = "2"  # times count by the clock of the vehicle
    with Double("ardupilot", settings=Settings(ready_s=5.0), speedup=float(slow)) as double:
        mission = start(
            "sitl",
            "fly",
            "--vehicle",
            double.url,
            *WORDS,
            "--speedup",
            slow,
            "--patience",
            "60",
            cwd=tmp_path,
        )
        mission.comes_to("step   0/300")
        uav = family(mission.process.pid)["uav"]
        keeper = keeper_of(uav)
        os.kill(keeper, number)
        wait_until(lambda: keeper_of(uav) not in (0, keeper))
        assert mission.says("its keeper has ended; it is tried again")
        targets = double.wire.autopilot.targets
        wait_until(lambda: double.wire.autopilot.targets > targets + 2)
        assert double.wire.autopilot.mode == "GUIDED"
        keeper = keeper_of(uav)
        mission.process.send_signal(signal.SIGINT)
        assert mission.ended() == 130
        assert double.wire.autopilot.mode == "RTL"
        wait_until(lambda: not Path(f"/proc/{keeper}").exists())
