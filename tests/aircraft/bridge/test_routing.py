"""Protects routing: tables worked by hand after MAVLink's rules, and that no frame goes round in a loop."""

from typing import Any
from zlib import crc32

import pytest
from pymavlink.dialects.v20 import common as mavlink

from aircraft.bridge.routing import (
    BUS,
    DUPLICATE,
    DUPLICATE_S,
    ELSEWHERE,
    MOST_HEARD,
    MOST_REMEMBERED,
    MOVES_AFTER_S,
    UNHEARD,
    WITH_KEY,
    Route,
    Routes,
)
from link.bus.frames import Frame, frame_at

QGC, MAVSDK, DRONE, GIMBAL, COMPANION = (255, 190), (245, 190), (1, 1), (1, 154), (1, 191)
A, B, C = 1, 2, 3
"""Links to endpoints."""


def said(message: Any, sender: tuple[int, int]) -> Frame:
    frame = frame_at(bytes(message.pack(mavlink.MAVLink(None, *sender))))
    assert frame
    return frame


class Net:
    """Routes with a false clock; each frame differs from all others, as sequence numbers make it."""

    def __init__(self, *links: int) -> None:
        self.routes = Routes()
        for link in links:
            self.routes.join(link)
        self.now_s = 0.0
        self.number = 0

    def says(self, sender, link, to=(0, 0), *, autopilot=False, out=False, brought=False, data=b"") -> Route:
        self.number += 1
        number = crc32(data) if data else self.number
        message = (
            mavlink.MAVLink_heartbeat_message(2, 12, 0, number, 3, 3)
            if autopilot
            else mavlink.MAVLink_ping_message(number, 0, *to)
        )
        return self.routes.route(said(message, sender), link, self.now_s, out=out, brought=brought)


def bus_vehicle() -> Net:
    """Two stations on A and B, a companion on C, the drone on the bus; all have been heard."""
    net = Net(A, B, C)
    net.says(DRONE, BUS, autopilot=True, out=True)
    net.says(QGC, A)
    net.says(MAVSDK, B)
    net.says(COMPANION, C)
    return net


@pytest.mark.parametrize(
    ("sender", "link", "to", "goes_to"),
    [
        (QGC, A, (0, 0), (BUS, B, C)),
        (QGC, A, (1, 1), (BUS,)),
        (QGC, A, (1, 0), (BUS, C)),  # every link on which the system has been heard
        (QGC, A, (1, 191), (C,)),
        (QGC, A, (245, 190), (B,)),
        (QGC, A, (245, 0), (B,)),
        (QGC, A, (255, 190), ()),  # it is where it came from
        (COMPANION, C, (1, 1), (BUS,)),
        (COMPANION, C, (255, 190), (A,)),
        (DRONE, BUS, (255, 190), (A,)),
        (DRONE, BUS, (1, 191), (C,)),
        (DRONE, BUS, (0, 0), (A, B, C)),
    ],
)
def test_a_message_goes_where_its_target_has_been_heard_and_not_back(sender, link, to, goes_to) -> None:
    assert bus_vehicle().says(sender, link, to, out=link == BUS) == Route(goes_to, link == BUS)


@pytest.mark.parametrize("to", [(2, 1), (2, 0), (1, 100)])
def test_a_message_for_someone_unheard_goes_nowhere_and_is_counted(to) -> None:
    assert bus_vehicle().says(QGC, A, to) == Route(dropped=UNHEARD)


def test_who_has_been_heard_once_is_reached_from_then_on() -> None:
    net = Net(A, B)
    assert net.says(QGC, A, DRONE).dropped == UNHEARD
    net.says(DRONE, B)
    assert net.says(QGC, A, DRONE).links == (B,)


def test_a_real_autopilots_frames_are_the_vehicles_output_and_commands_reach_it() -> None:
    net = Net(A, B)
    assert net.says(DRONE, A, autopilot=True) == Route((BUS, B), vehicle=True)
    assert net.says(GIMBAL, A) == Route((BUS, B), vehicle=True)  # the whole system behind that link
    assert net.says(COMPANION, BUS, DRONE) == Route((A,))  # a companion on the bus, from mavlink/in
    assert net.says(QGC, B, DRONE) == Route((A,))
    assert net.says(QGC, B) == Route((BUS, A))


def test_all_that_a_vehicle_says_is_on_the_bus_also_what_is_for_one_station() -> None:
    net = Net(A, B)
    net.says(DRONE, A, autopilot=True)
    net.says(QGC, B)
    assert net.says(DRONE, A, QGC) == Route((BUS, B), vehicle=True)
    assert net.says(DRONE, A, (9, 9)) == Route((BUS,), vehicle=True)


def test_a_companion_with_the_vehicles_system_id_is_not_the_vehicle() -> None:
    net = Net(A, B)
    net.says(DRONE, A, autopilot=True)
    assert net.says(COMPANION, B) == Route((BUS, A))
    assert net.says(COMPANION, B, DRONE) == Route((A,))


def test_a_station_behind_the_vehicles_own_link_is_not_the_vehicle() -> None:
    net = Net(A, B)
    net.says(DRONE, A, autopilot=True)
    assert net.says(QGC, A) == Route((BUS, B))


def test_the_strength_of_the_radio_on_a_vehicles_link_is_the_vehicles_output() -> None:
    net, radio = Net(A, B), said(mavlink.MAVLink_radio_status_message(180, 170, 90, 40, 38, 0, 0), (51, 68))
    assert net.routes.route(radio, A, 0.0) == Route((BUS, B))
    net.says(DRONE, A, autopilot=True)
    assert net.routes.route(radio, A, 1.0) == Route((BUS, B), vehicle=True)
    assert net.routes.route(radio, B, 2.0) == Route((BUS, A))


def test_two_vehicles_and_two_stations_are_kept_apart() -> None:
    net = Net(A, B, C)
    net.says(DRONE, BUS, autopilot=True, out=True)
    assert net.says((2, 1), C, autopilot=True) == Route((BUS, A, B), vehicle=True)
    net.says(QGC, A)
    net.says(MAVSDK, B)
    assert net.says(QGC, A, (1, 1)) == Route((BUS,))
    assert net.says(QGC, A, (2, 1)) == Route((C,))
    assert net.says((2, 1), C, MAVSDK) == Route((BUS, B), vehicle=True)
    assert net.says((1, 1), BUS, QGC, out=True) == Route((A,), vehicle=True)


def test_the_same_frame_on_another_link_is_a_duplicate_until_it_is_old() -> None:
    net = Net(A, B)
    assert net.says(QGC, A, data=b"beat").links == (BUS, B)
    assert net.says(QGC, B, data=b"beat") == Route(dropped=DUPLICATE)
    assert net.says(QGC, BUS, data=b"beat") == Route(dropped=DUPLICATE)
    assert net.says(QGC, A, data=b"beat") == Route(dropped=DUPLICATE)  # it goes round already
    net.now_s += DUPLICATE_S
    assert net.says(QGC, B, data=b"beat").links == (BUS, A)


def test_a_sender_may_repeat_itself_on_its_own_link() -> None:
    net = Net(A, B)
    for _ in range(1000):
        assert net.says(QGC, A, data=b"always the same").links == (BUS, B)


def test_an_endpoint_that_echoes_changes_no_route() -> None:
    net = bus_vehicle()
    net.says(DRONE, BUS, autopilot=True, out=True, data=b"beat")
    assert net.says(DRONE, B, autopilot=True, data=b"beat") == Route(dropped=DUPLICATE)
    assert net.says(QGC, A, DRONE) == Route((BUS,))


def test_a_vehicle_that_comes_around_a_slow_loop_is_dropped() -> None:
    net = Net(A, B)
    net.says(DRONE, BUS, autopilot=True, out=True, data=b"beat")
    net.now_s += 2 * DUPLICATE_S  # so late that it is no duplicate any more
    assert net.says(DRONE, A, autopilot=True, data=b"beat") == Route(dropped=ELSEWHERE)
    assert net.says(DRONE, A) == Route(dropped=ELSEWHERE)
    assert net.says(QGC, B, DRONE) == Route((BUS,))


def test_a_copy_that_overtakes_its_frame_does_not_take_its_place() -> None:
    net = Net(A, B)
    net.says(DRONE, BUS, autopilot=True, out=True)
    assert net.says(DRONE, A, autopilot=True, data=b"beat") == Route(dropped=ELSEWHERE)
    assert net.says(DRONE, BUS, autopilot=True, out=True, data=b"beat") == Route((A, B), vehicle=True)
    assert net.says(DRONE, B, autopilot=True, data=b"beat") == Route(dropped=DUPLICATE)


def test_a_vehicle_may_move_to_another_link_when_its_own_is_silent() -> None:
    net = Net(A, B)
    net.says(DRONE, A, autopilot=True)
    net.now_s = MOVES_AFTER_S - 0.01
    assert net.says(DRONE, B, autopilot=True) == Route(dropped=ELSEWHERE)
    net.now_s = MOVES_AFTER_S
    assert net.says(DRONE, B, autopilot=True) == Route((BUS, A), vehicle=True)


def test_a_vehicle_whose_link_is_lost_may_return_on_another_at_once() -> None:
    net = Net(A, B)
    net.says(DRONE, A, autopilot=True)
    net.says(QGC, B)
    net.routes.leave(A)
    assert net.says(QGC, B, DRONE) == Route(dropped=UNHEARD)
    net.routes.join(C)
    assert net.says(DRONE, C, autopilot=True) == Route((BUS, B), vehicle=True)
    assert net.says(QGC, B, DRONE) == Route((C,))


def test_two_bridges_around_a_loop_end_a_frame_whichever_way_they_heard_the_vehicle_first() -> None:
    """Both are on one bus and joined by a wire. The vehicle is on the bus, but the second bridge hears it
    on the wire first.
    """
    one, two = Net(A), Net(A)
    two.says(DRONE, A, autopilot=True)
    copies = 0
    for beat in range(20):
        data = f"beat {beat}".encode()
        going = [("one", BUS, False), ("two", BUS, False)] if beat else [("one", BUS, False)]
        while going:
            name, link, brought = going.pop(0)
            net, other = (one, "two") if name == "one" else (two, "one")
            route = net.says(DRONE, link, autopilot=True, out=link == BUS, brought=brought, data=data)
            going += [(other, A, False) if to == A else (other, BUS, True) for to in route.links]
            copies += BUS in route.links
            net.now_s += 0.3  # a busy machine: a frame is forgotten before it has been around twice
            assert copies <= 1, (
                "the second bridge brings the vehicle back to the bus before it has heard it there"
            )


def test_what_another_bridge_brings_is_heard_on_the_bus_and_belongs_there() -> None:
    net = Net(A, B)
    assert net.says(DRONE, BUS, autopilot=True, out=True, brought=True) == Route((A, B), vehicle=True)
    assert net.says(QGC, A, DRONE) == Route((BUS,))
    assert net.says(DRONE, B, autopilot=True) == Route(dropped=ELSEWHERE)


def test_ground_stations_may_share_an_id() -> None:
    net = bus_vehicle()
    assert net.says(QGC, B).links == (BUS, A, C)
    assert net.says(QGC, A).links == (BUS, B, C)
    assert net.says(DRONE, BUS, QGC, out=True).links == (A, B)


@pytest.mark.full
@pytest.mark.slow
def test_forged_ids_and_floods_fill_no_memory() -> None:
    net = Net(A, B)
    for number in range(40_000):
        net.says((number % 250 + 1, number // 250 % 250 + 1), A)
    assert len(net.routes.heard[A]) == MOST_HEARD
    assert len(net.routes.remembered) == MOST_REMEMBERED


def storm(links_of: dict[str, dict[int, str]], start: tuple[str, str], delay_s: float) -> int:
    """Send one frame into a network of bridges; returns how many frames are carried in 20 s, at most
    10,000.

    links_of: the segment that each link of each bridge joins. What a bridge sends on a segment reaches all
    others there after delay_s.
    """
    nets = {name: Net(*(link for link in links if link != BUS)) for name, links in links_of.items()}
    sender, first = start
    carried, waiting = 0, [(0.0, sender, first)]
    while waiting and carried < 10_000:
        waiting.sort(key=lambda item: item[0])
        now_s, by, segment = waiting.pop(0)
        if now_s > 20:
            break
        carried += 1
        for name, links in links_of.items():
            for link in (link for link, joined in links.items() if joined == segment and name != by):
                nets[name].now_s = now_s
                route = nets[name].says(QGC, link, data=b"beat")
                waiting += [(now_s + delay_s, name, links[other]) for other in route.links]
    return carried


@pytest.mark.parametrize("delay_s", [0.001, 0.1])
def test_two_bridges_between_the_same_two_points_carry_a_frame_once_each(delay_s: float) -> None:
    bridges = {"one": {BUS: "bus", A: "wire"}, "two": {BUS: "bus", A: "wire"}}
    assert (
        storm(bridges, ("station", "bus"), delay_s) == 3
    )  # the frame itself, and one copy by each bridge on the wire


def test_a_ring_of_three_bridges_does_not_storm() -> None:
    bridges = {"one": {BUS: "x", A: "y"}, "two": {BUS: "y", A: "z"}, "three": {BUS: "z", A: "x"}}
    assert storm(bridges, ("station", "x"), 0.01) <= 6


def test_a_key_goes_nowhere_and_its_sender_is_not_learned_from_it() -> None:
    net = bus_vehicle()
    for link, to in ((A, (0, 0)), (A, (1, 1)), (BUS, (255, 190))):
        setup = mavlink.MAVLink_setup_signing_message(*to, [link] * 32, 0)
        assert net.routes.route(said(setup, (9, 9)), link, 0.0) == Route(dropped=WITH_KEY)
    assert net.says(QGC, A, to=(9, 9)) == Route(dropped=UNHEARD)
