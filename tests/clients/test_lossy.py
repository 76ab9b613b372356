"""Protects every service that takes several messages against a radio that loses 5% of the frames in both
directions.
"""

import json
import math
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest
from pymavlink.dialects.v20 import development as mavlink

from tests.clients.installed import HERE, free_udp_port, python_of
from tests.clients.lossy import LossyLink
from tests.clients.qgroundcontrol import FENCE, MISSION, RALLY, QGroundControl, same, waypoint

pytestmark = pytest.mark.full

COMMANDS = (
    (mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, mavlink.MAV_RESULT_ACCEPTED),
    (mavlink.MAV_CMD_PREFLIGHT_CALIBRATION, mavlink.MAV_RESULT_UNSUPPORTED),
)


@pytest.fixture
def lossy(vehicle: Callable[..., int]) -> Iterator[Callable[..., tuple[LossyLink, QGroundControl]]]:
    """Start a vehicle, a station, and a link between them that loses many frames."""
    with ExitStack() as up:

        def begin(seed: int, lost: float) -> tuple[LossyLink, QGroundControl]:
            station = up.enter_context(QGroundControl())
            link = up.enter_context(LossyLink(station.port, seed, lost))
            vehicle(port=link.port)
            station.until("HEARTBEAT")
            return link, station

        yield begin


def test_no_item_is_lost_of_a_mission_a_fence_and_rally_points(
    lossy: Callable[..., tuple[LossyLink, QGroundControl]],
) -> None:
    link, station = lossy(seed=1, lost=0.05)
    commands = {
        MISSION: mavlink.MAV_CMD_NAV_WAYPOINT,
        FENCE: mavlink.MAV_CMD_NAV_FENCE_CIRCLE_INCLUSION,
        RALLY: 5100,
    }
    for kind, command in commands.items():
        angles = [2 * math.pi * number / 20 for number in range(20)]
        plan = [
            waypoint(
                command, 12 + 8 * math.cos(a), 12 + 8 * math.sin(a), 6, p1=60.0 if kind == FENCE else 0.0
            )
            for a in angles
        ]
        assert station.upload(kind, plan) == mavlink.MAV_MISSION_ACCEPTED
        assert same(station.download(kind), plan)
        assert station.clear(kind) == mavlink.MAV_MISSION_ACCEPTED
    lost = sum(link.lost[way, kind] for way in ("up", "down") for kind in (*range(39, 48), 51, 73))
    assert lost >= 5


def test_every_command_is_answered_and_every_parameter_arrives(
    lossy: Callable[..., tuple[LossyLink, QGroundControl]],
) -> None:
    link, station = lossy(seed=2, lost=0.05)
    for command, result in COMMANDS * 15:
        assert station.command(command) == result
    for height_m in (5.5, 6.5, 7.5, 8.5):
        assert station.set_parameter("MIS_TAKEOFF_ALT", height_m) == height_m
    parameters = station.parameters()
    assert parameters.computed == parameters.checksum
    assert parameters.values["MIS_TAKEOFF_ALT"] == 8.5
    assert sum(link.lost.values()) >= 3


def test_the_clock_is_still_told(lossy: Callable[..., tuple[LossyLink, QGroundControl]]) -> None:
    _, station = lossy(seed=3, lost=0.05)
    for number in range(1, 31):
        asked = mavlink.MAVLink_timesync_message(0, number * 1_000_000)
        told = station.repeated(
            asked, lambda m, n=number: m.get_type() == "TIMESYNC" and m.ts1 == n * 1_000_000, 0.2
        )
        assert told.tc1 > 0


def test_mavsdk_4_transfers_plans_and_parameters(vehicle: Callable[..., int]) -> None:
    python, client = python_of("mavsdk4"), free_udp_port()
    with LossyLink(client, seed=4) as link:
        vehicle(port=link.port)
        ended = subprocess.run(
            [python, str(HERE / "mavsdk4.py"), str(client), "lossy"],
            capture_output=True,
            text=True,
            check=False,
            timeout=300,
        )
    assert ended.returncode == 0, ended.stderr
    seen = json.loads(ended.stdout)
    assert seen["loaded"] == seen["sent"]
    assert seen["after the clear"] == []
    assert (seen["set"], seen["value"], seen["altitudes"], seen["arm"]) == ("ok", 8.0, [8.0, 12.0], "ok")
    assert seen["all"]["MPC_Z_VEL_MAX_DN"] == 1.5
    assert seen["files"] == "FILE_DOES_NOT_EXIST"
