"""Protects QGroundControl's slider over UDP: MAV_CMD_NAV_TAKEOFF first, and arming once it is
acknowledged, as to a PX4 vehicle.
"""

import math
from collections.abc import Callable, Iterator

import pytest
from pymavlink import mavutil

from link.modes import Mode

TAKEOFF, ARM, ARMED = 22, 400, 128


@pytest.fixture
def station() -> Iterator:
    link = mavutil.mavlink_connection("udpin:127.0.0.1:0", source_system=255, source_component=190)
    yield link
    link.close()


def until(station, kind: str, holds: Callable):
    while message := station.recv_match(type=kind, blocking=True, timeout=400):
        if holds(message):
            return message
    raise AssertionError(f"no such {kind} within a minute")


def command(station, number: int, *params: float) -> int:
    for _ in range(10):  # as QGroundControl repeats it: a datagram may be lost
        station.mav.command_long_send(1, 1, number, 0, *params, *[0] * (7 - len(params)))
        if ack := station.recv_match(
            type="COMMAND_ACK", condition=f"COMMAND_ACK.command == {number}", blocking=True, timeout=3
        ):
            return ack.result
    raise AssertionError(f"no answer to command {number}")


def slide(station) -> float:
    """Slide to a take-off by 10 m: QGroundControl sends the altitude above the sea and waits for the
    acknowledgement. Returns it.
    """
    altitude_m = until(station, "GLOBAL_POSITION_INT", lambda _: True).alt / 1000 + 10.0
    assert command(station, TAKEOFF, -1, 0, 0, math.nan, math.nan, math.nan, altitude_m) == 0
    return altitude_m


def test_the_slider_of_qgroundcontrol_takes_off(start, station) -> None:
    start("sitl", "uav", "--out", f"udpout:127.0.0.1:{station.port.getsockname()[1]}", "--speedup", "2")
    altitude_m = slide(station)
    waits = until(station, "HEARTBEAT", lambda _: True)
    assert (waits.custom_mode, waits.base_mode & ARMED) == (Mode.TAKEOFF.custom_mode, 0)
    assert command(station, ARM, 1) == 0
    until(
        station,
        "HEARTBEAT",
        lambda beat: beat.base_mode & ARMED and beat.custom_mode == Mode.TAKEOFF.custom_mode,
    )
    until(station, "HEARTBEAT", lambda beat: beat.custom_mode == Mode.HOLD.custom_mode)
    assert until(station, "GLOBAL_POSITION_INT", lambda _: True).alt / 1000 == pytest.approx(
        altitude_m, abs=0.01
    )


def test_a_slider_that_is_not_followed_by_arming_is_given_up(start, station) -> None:
    start("sitl", "uav", "--out", f"udpout:127.0.0.1:{station.port.getsockname()[1]}", "--speedup", "20")
    slide(station)
    until(station, "STATUSTEXT", lambda said: said.text == "Take-off given up: not armed for 10 s")
    still = until(station, "HEARTBEAT", lambda beat: beat.custom_mode == Mode.HOLD.custom_mode)
    assert not still.base_mode & ARMED
