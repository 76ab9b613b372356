"""Protects the vehicle against MAVSDK 4, which speaks MAVLink itself: flights, missions, parameters, and
what is refused.
"""

import json
import subprocess
from collections.abc import Callable

import pytest

from tests.clients.installed import HERE, python_of

pytestmark = pytest.mark.full


@pytest.fixture
def mavsdk(vehicle: Callable[..., int]) -> Callable[..., dict]:
    """Start a vehicle and do a scenario of mavsdk4.py; returns what it saw."""

    def play(scenario: str, *words: str) -> dict:
        python = python_of("mavsdk4")
        ended = subprocess.run(
            [python, str(HERE / "mavsdk4.py"), str(vehicle(*words)), scenario],
            capture_output=True,
            text=True,
            check=False,
            timeout=300,
        )
        assert ended.returncode == 0, ended.stderr
        return json.loads(ended.stdout)

    return play


def test_mavsdk_4_arms_takes_off_flies_setpoints_of_position_and_velocity_and_lands(
    mavsdk: Callable[..., dict],
) -> None:
    seen = mavsdk("fly", "--speedup", "4")
    assert seen["disarm in the air"] == "COMMAND_DENIED"
    assert seen["velocity"] == pytest.approx([2.0, 0.0, 0.0], abs=0.1)


def test_mavsdk_4_flies_a_mission_and_is_told_its_progress(mavsdk: Callable[..., dict]) -> None:
    seen = mavsdk("fly_a_mission", "--speedup", "6")
    assert max(seen["nearest_m"]) < 1.0
    assert seen["landed"] == pytest.approx([4, 10, 0], abs=0.2)
    assert seen["finished"]
    assert seen["progress"] == [0, 1, 2, 3, 4, 5]


def test_mavsdk_4_reads_back_the_mission_fence_and_rally_points_that_it_sent(
    mavsdk: Callable[..., dict],
) -> None:
    seen = mavsdk("plan")
    assert seen["loaded"] == seen["sent"]
    assert seen["after the clear"] == []


def test_mavsdk_4_reads_and_sets_parameters(mavsdk: Callable[..., dict]) -> None:
    seen = mavsdk("configure")
    assert (seen["all"]["MPC_Z_VEL_MAX_DN"], seen["all"]["SYS_AUTOSTART"]) == (1.5, 4001)
    assert (seen["set"], seen["value"], seen["altitudes"]) == ("ok", 8.0, [8.0, 12.0])
    assert "ok" not in (seen["too high"], seen["unknown"], seen["wrong type"])


def test_mavsdk_4_is_refused_at_once_what_the_vehicle_lacks(mavsdk: Callable[..., dict]) -> None:
    seen = mavsdk("ask")
    assert seen["version"] == [1, 15]
    assert seen["uid"].startswith(b"plumeward".hex())
    assert seen["answers"]["logs"] == "NO_LOGFILES"
    assert (seen["answers"]["reboot"], seen["answers"]["servo"]) == ("UNSUPPORTED", "UNSUPPORTED")
    assert seen["answers"]["metadata"] == "NOT_AVAILABLE"
    assert seen["answers"]["files"] == "FILE_DOES_NOT_EXIST"
    assert seen["seconds"] < 4  # not one request waited for the end of its patience
