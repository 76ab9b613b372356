"""Protects that a ground station plans a flight: it uploads fence, rally points and mission over UDP,
flies it, and is told of it.
"""

import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from pymavlink import mavutil, mavwp
from pymavlink.dialects.v20 import common as mavlink

from link.modes import Mode
from plume.geodesy import to_global
from sitl.autopilot.config import VehicleConfig

HOME = VehicleConfig()


class Station:
    """A ground station that plans: pymavlink's mission list, as MAVProxy uses it, and its sequence of
    messages.
    """

    def __init__(self) -> None:
        self.link = mavutil.mavlink_connection("udpin:127.0.0.1:0", source_system=255, source_component=190)

    def until(self, *kinds: str, holds: Callable[[Any], bool] = lambda _: True) -> Any:
        """Return the first message of a kind that holds; fails if none comes within a minute."""
        while message := self.link.recv_match(type=list(kinds), blocking=True, timeout=400):
            if holds(message):
                return message
        raise AssertionError(f"no such {kinds} within a minute")

    def ask(
        self, send: Callable[[], object], *kinds: str, holds: Callable[[Any], bool] = lambda _: True
    ) -> Any:
        """Send a request until it is answered, as stations do: UDP loses datagrams where the machine is
        busy.
        """
        for _ in range(30):
            send()
            ends = time.monotonic() + 2.0
            while (left := ends - time.monotonic()) > 0.0:
                message = self.link.recv_match(type=list(kinds), blocking=True, timeout=left)
                if message and holds(message):
                    return message
        raise AssertionError(f"no {kinds} within a minute")

    def item(
        self, command: int, north: float, east: float, up: float, p1: float = 0.0, frame: int = 6
    ) -> Any:
        lat, lon = to_global(HOME.home_lat_deg, HOME.home_lon_deg, north, east)
        return mavlink.MAVLink_mission_item_int_message(
            1, 1, 0, frame, command, 0, 1, p1, 0, 0, float("nan"), round(lat * 1e7), round(lon * 1e7), up
        )

    def upload(self, kind: int, *items: Any) -> int:
        """Upload a list; returns the MAV_MISSION_RESULT."""
        loader = mavwp.MAVWPLoader()
        for each in items:
            each.mission_type = kind
            loader.add(each)
        answer = self.ask(
            lambda: self.link.mav.mission_count_send(1, 1, loader.count(), kind),
            "MISSION_REQUEST_INT",
            "MISSION_ACK",
        )
        while answer.get_type() != "MISSION_ACK":
            item = loader.wp(answer.seq)
            answer = self.ask(
                lambda item=item: self.link.mav.send(item), "MISSION_REQUEST_INT", "MISSION_ACK"
            )  # type: ignore[misc]
        return int(answer.type)

    def download(self, kind: int) -> list[tuple[int, int, int, float]]:
        """Return (command, latitude, longitude, altitude) of each item."""
        items = []
        for seq in range(
            self.ask(lambda: self.link.mav.mission_request_list_send(1, 1, kind), "MISSION_COUNT").count
        ):
            got = self.ask(
                lambda seq=seq: self.link.mav.mission_request_int_send(1, 1, seq, kind),  # type: ignore[misc]
                "MISSION_ITEM_INT",
                holds=lambda item, seq=seq: item.seq == seq,  # type: ignore[misc]
            )
            items.append((got.command, got.x, got.y, got.z))
        self.link.mav.mission_ack_send(1, 1, 0, kind)
        return items

    def command(self, number: int, *params: float) -> int:
        """Send a command; returns its MAV_RESULT."""
        filled = (*params, *[0] * (7 - len(params)))
        ask = lambda: self.link.mav.command_long_send(1, 1, number, 0, *filled)  # noqa: E731
        return int(self.ask(ask, "COMMAND_ACK", holds=lambda ack: ack.command == number).result)


@pytest.fixture
def station(start: Callable) -> Iterator[Station]:
    """A station at a vehicle alone, 5 times as fast as real time."""
    station = Station()
    start("sitl", "uav", "--out", f"udpout:127.0.0.1:{station.link.port.getsockname()[1]}", "--speedup", "5")
    station.link.wait_heartbeat(timeout=400)
    for message_id in (
        30,
        33,
    ):  # ATTITUDE and GLOBAL_POSITION_INT make up most of the telemetry: a slow reader loses some
        station.command(511, message_id, -1)
    yield station
    station.link.close()


def test_a_station_plans_and_flies_a_mission_with_a_fence_and_a_rally_point(station: Station) -> None:
    fence = [station.item(5001, north, east, 0.0, 4) for north, east in ((0, 0), (0, 25), (25, 25), (25, 0))]
    rally = [station.item(5100, 12.0, 10.0, 5.0)]
    mission = [
        station.item(22, 0.0, 0.0, 5.0),
        station.item(16, 10.0, 0.0, 5.0, 2.0),
        station.item(16, 10.0, 10.0, 6.0),
        station.item(20, 0.0, 0.0, 0.0, frame=2),
    ]
    assert [station.upload(kind, *items) for kind, items in ((1, fence), (2, rally), (0, mission))] == [
        0,
        0,
        0,
    ]
    assert station.download(0) == [(item.command, item.x, item.y, item.z) for item in mission]
    assert (
        station.upload(0, station.item(16, 10.0, 27.0, 5.0)) == 10
    )  # outside the fence: MAV_MISSION_INVALID_PARAM5_X
    assert len(station.download(0)) == 4  # the old mission stays
    assert station.command(300, 0.0) == 0  # MISSION_START: it arms
    station.until(
        "HEARTBEAT", holds=lambda beat: beat.custom_mode == Mode.MISSION.custom_mode and beat.base_mode & 128
    )
    for seq in range(3):  # the return home is another mode's
        station.until("MISSION_ITEM_REACHED", holds=lambda item, seq=seq: item.seq == seq)
    station.until("HEARTBEAT", holds=lambda beat: beat.custom_mode == Mode.RETURN.custom_mode)
    station.until("HEARTBEAT", holds=lambda beat: not beat.base_mode & 128)
    landed = station.until("LOCAL_POSITION_NED")
    assert (landed.x, landed.y, landed.z) == pytest.approx((12.0, 10.0, 0.0), abs=0.02)  # the rally point
    assert station.until("MISSION_CURRENT").mission_state == 5  # complete


def test_a_station_pauses_a_mission_and_resumes_it_and_clears_it(station: Station) -> None:
    assert station.upload(0, station.item(22, 0.0, 0.0, 5.0), station.item(16, 20.0, 0.0, 5.0)) == 0
    assert station.command(176, 1, *Mode.MISSION.value) == 0
    assert station.command(400, 1) == 0  # arming in mission mode starts it
    station.until("LOCAL_POSITION_NED", holds=lambda at: at.x > 2.0)
    assert station.command(193, 0) == 0
    station.until("HEARTBEAT", holds=lambda beat: beat.custom_mode == Mode.HOLD.custom_mode)
    assert station.until("MISSION_CURRENT", holds=lambda now: now.mission_state == 4).seq == 1
    assert station.command(193, 1) == 0
    station.until("MISSION_ITEM_REACHED", holds=lambda item: item.seq == 1)
    station.until("STATUSTEXT", holds=lambda said: said.text == "Mission finished")
    assert station.ask(lambda: station.link.mav.mission_clear_all_send(1, 1, 255), "MISSION_ACK").type == 0
    assert station.command(300, 0) != 0
    station.until("STATUSTEXT", holds=lambda said: "no mission on board" in said.text)


def test_an_upload_that_is_left_alone_is_asked_for_again_and_given_up(station: Station) -> None:
    station.link.mav.mission_count_send(1, 1, 3, 0)
    assert [station.until("MISSION_REQUEST_INT").seq for _ in range(4)] == [0, 0, 0, 0]
    station.until("STATUSTEXT", holds=lambda said: said.text == "Mission upload given up: no item 0 for 5 s")
    assert station.download(0) == []
