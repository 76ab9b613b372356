"""Protects the service of missions, fences and rally points: uploads and downloads, over bad links too; a
failed one changes nothing.
"""

import math
import random
import struct
from itertools import pairwise

import pytest
from pymavlink.dialects.v20 import common as mavlink

from link.bus.px4 import MissionCurrent
from link.modes import Mode
from plume.geodesy import to_global
from sitl.autopilot.protocol import MavlinkProtocol
from sitl.autopilot.telemetry import Snapshot, Telemetry
from tests.ground.tlog.flights import ACCEPTED, CONFIG, DENIED, NAN, REJECTED, hovering, on_the_ground

STATION, OTHER = (255, 190), (245, 190)
# MAV_MISSION_RESULT
OK, ERROR, BAD_FRAME, UNSUPPORTED, NO_SPACE, INVALID, PARAM_1, PARAM_5, PARAM_7, SEQUENCE, REFUSED = (
    0,
    1,
    2,
    3,
    4,
    5,
    6,
    10,
    12,
    13,
    14,
)
MISSION, FENCE, RALLY, ALL = 0, 1, 2, 255
RELATIVE = 6
VERTEX_IN, CIRCLE_IN, POINT = 5001, 5003, 5100


def e7(north, east):
    lat, lon = to_global(CONFIG.home_lat_deg, CONFIG.home_lon_deg, north, east)
    return round(lat * 1e7), round(lon * 1e7)


def waypoint(north, east, up=5.0, command=16, p1=0.0, frame=RELATIVE):
    """The fields of an item, behind its sequence number and before its type."""
    return (frame, command, 0, 1, p1, 0.0, 0.0, NAN, *e7(north, east), up)


def corner(north, east, of=4, command=VERTEX_IN):
    return waypoint(north, east, 0.0, command, of)


PLANS = {
    MISSION: [waypoint(5.0, 5.0 + n) for n in range(12)],
    FENCE: [
        corner(0, 0),
        corner(0, 20),
        corner(20, 20),
        corner(20, 0),
        waypoint(10.0, 10.0, 0.0, CIRCLE_IN, 20.0),
    ],
    RALLY: [waypoint(3.0, 4.0, 5.0, POINT), waypoint(20.0, 6.0, 5.0, POINT)],
}


class Wire:
    """A vehicle and its clients under a clock of their own; every message is packed and parsed, and may be
    lost.
    """

    def __init__(self, vehicle=None, loss=0.0, seed=0):
        self.vehicle = vehicle or hovering()
        self.real_s = 1000.0
        self.protocol = MavlinkProtocol(self.vehicle, lambda: self.real_s)
        self.links = {STATION: self.telemetry(), OTHER: self.telemetry()}
        self.loss, self.random = loss, random.Random(seed)
        self.inbox = {STATION: [], OTHER: []}

    def telemetry(self):
        return Telemetry(lambda t: Snapshot(self.vehicle.config, self.vehicle.state(t), (1.0, 0.0), None))

    def lost(self):
        return self.random.random() < self.loss

    def send(self, message, sender=STATION):
        """Send a message of a client; its answers, and what is due, go to the inboxes."""
        packed = message.pack(mavlink.MAVLink(None, *sender))
        if not self.lost():
            decoded = mavlink.MAVLink(None).decode(bytearray(packed))
            self.deliver(self.protocol.receive(decoded, self.vehicle.now_s, self.links[sender]), sender)

    def wait(self, seconds):
        self.real_s += seconds
        for sender, link in self.links.items():
            self.deliver(self.protocol.due(link), sender)

    def deliver(self, messages, receiver):
        for message in messages:
            packed = message.pack(mavlink.MAVLink(None, 1, 1))
            if not self.lost():
                self.inbox[receiver].append(mavlink.MAVLink(None).decode(bytearray(packed)))

    def read(self, receiver=STATION):
        messages, self.inbox[receiver] = self.inbox[receiver], []
        return messages

    def ask(self, message, sender=STATION):
        """Send a message; returns its answers without the texts."""
        self.send(message, sender)
        return [answer for answer in self.read(sender) if answer.get_type() != "STATUSTEXT"]

    def texts(self, receiver=STATION):
        return "".join(message.text for message in self.read(receiver) if message.get_type() == "STATUSTEXT")


def count(n, kind=MISSION):
    return mavlink.MAVLink_mission_count_message(1, 1, n, kind)


def item(seq, fields, kind=MISSION):
    return mavlink.MAVLink_mission_item_int_message(1, 1, seq, *fields, kind)


def upload(wire, plan, kind=MISSION, sender=STATION):
    """Upload as a station does: answer requests, say the count again after a silence. Returns the
    MISSION_ACK's type.
    """
    wire.send(count(len(plan), kind), sender)
    for _ in range(200):
        for message in wire.read(sender):
            if message.get_type() == "MISSION_REQUEST_INT":
                wire.send(item(message.seq, plan[message.seq], kind), sender)
            elif message.get_type() == "MISSION_ACK":
                assert message.mission_type == kind
                return message.type
        wire.wait(0.1)
        if (
            wire.protocol.plans.next_s() == math.inf and not wire.inbox[sender]
        ):  # the count or the acknowledgement was lost
            wire.send(
                item(len(plan) - 1, plan[-1], kind) if wire_has(wire, plan, kind) else count(len(plan), kind),
                sender,
            )
    raise AssertionError("no MISSION_ACK within 20 s")


def wire_has(wire, plan, kind):
    held = {
        MISSION: wire.vehicle.mission.number,
        FENCE: wire.vehicle.config.fence.number,
        RALLY: wire.vehicle.config.rally.number,
    }
    return held[kind] != 0


def download(wire, kind=MISSION, sender=STATION, tries=20):
    """Download as a station does: each request again after a silence. Returns the items' fields."""

    def until(message, holds):
        for _ in range(tries):
            wire.send(message, sender)
            for answer in wire.read(sender):
                if holds(answer):
                    return answer
        raise AssertionError("no answer")

    total = until(
        mavlink.MAVLink_mission_request_list_message(1, 1, kind), lambda m: m.get_type() == "MISSION_COUNT"
    ).count
    fields = []
    for seq in range(total):
        request = mavlink.MAVLink_mission_request_int_message(1, 1, seq, kind)
        got = until(request, lambda m, seq=seq: m.get_type() == "MISSION_ITEM_INT" and m.seq == seq)
        fields.append(
            (
                got.frame,
                got.command,
                0,
                got.autocontinue,
                got.param1,
                got.param2,
                got.param3,
                got.param4,
                got.x,
                got.y,
                got.z,
            )
        )
    return fields


def same(plan, other):
    return repr([tuple(map(float, row)) for row in plan]) == repr(
        [tuple(map(float, row)) for row in other]
    )  # NaN is NaN


# ---- refusals ----


def test_a_vehicle_begins_without_missions_fences_and_rally_points():
    wire = Wire()
    for kind in PLANS:
        (answer,) = wire.ask(mavlink.MAVLink_mission_request_list_message(1, 1, kind))
        assert (answer.get_type(), answer.count, answer.mission_type, answer.target_system) == (
            "MISSION_COUNT",
            0,
            kind,
            255,
        )
        (answer,) = wire.ask(mavlink.MAVLink_mission_request_int_message(1, 1, 0, kind))
        assert (answer.get_type(), answer.type, answer.mission_type) == ("MISSION_ACK", SEQUENCE, kind)


BAD = {
    "unknown command": (MISSION, waypoint(1, 1, command=31000), UNSUPPORTED),
    "a fence's command in a mission": (MISSION, waypoint(1, 1, command=VERTEX_IN), UNSUPPORTED),
    "unknown frame": (MISSION, waypoint(1, 1, frame=8), BAD_FRAME),
    "no position": (MISSION, (*waypoint(1, 1)[:8], 0x7FFFFFFF, 0x7FFFFFFF, 5.0), PARAM_5),
    "no altitude": (MISSION, waypoint(1, 1, up=NAN), PARAM_7),
    "outside the area": (MISSION, waypoint(31, 1), PARAM_5),
    "above the ceiling": (MISSION, waypoint(1, 1, up=121), PARAM_7),
    "two vertices": (FENCE, corner(0, 0, of=2), PARAM_1),
    "an unfinished polygon": (FENCE, corner(0, 0, of=4), PARAM_1),
    "a circle without a radius": (FENCE, waypoint(1, 1, command=CIRCLE_IN, p1=0.0), PARAM_1),
    "a fence without home": (FENCE, waypoint(20, 20, command=CIRCLE_IN, p1=5.0), REFUSED),
    "a rally point outside the area": (RALLY, waypoint(31, 1, command=POINT), PARAM_5),
    "a waypoint as a rally point": (RALLY, waypoint(1, 1), UNSUPPORTED),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_item_is_refused_with_its_reason_and_the_old_list_stays(name):
    kind, bad, result = BAD[name]
    wire = Wire()
    assert upload(wire, PLANS[kind], kind) == OK
    wire.send(count(1, kind))
    wire.read()
    wire.send(item(0, bad, kind))
    ack, *texts = wire.read()
    assert (ack.get_type(), ack.type, ack.mission_type) == ("MISSION_ACK", result, kind)
    assert "refused" in "".join(text.text for text in texts)
    assert same(download(wire, kind), PLANS[kind])
    assert wire.protocol.plans.next_s() == math.inf


@pytest.mark.parametrize(("kind", "most"), [(MISSION, 2000), (FENCE, 64), (RALLY, 32)])
def test_a_huge_count_is_refused(kind, most):
    wire = Wire()
    (ack,) = wire.ask(count(most + 1, kind))
    assert ack.type == NO_SPACE
    (request,) = wire.ask(count(most, kind))
    assert request.get_type() == "MISSION_REQUEST_INT"


def test_lists_of_other_types_and_parts_of_lists_are_refused():
    wire = Wire()
    for message, result in (
        (count(2, 3), INVALID),
        (mavlink.MAVLink_mission_request_list_message(1, 1, ALL), INVALID),
        (mavlink.MAVLink_mission_clear_all_message(1, 1, 9), INVALID),
        (mavlink.MAVLink_mission_write_partial_list_message(1, 1, 0, 1), UNSUPPORTED),
        (mavlink.MAVLink_mission_request_partial_list_message(1, 1, 0, 1), UNSUPPORTED),
        (item(0, waypoint(1, 1)), ERROR),  # no upload is under way
        (mavlink.MAVLink_mission_set_current_message(1, 1, 0), SEQUENCE),
    ):
        (ack,) = wire.ask(message)
        assert (ack.get_type(), ack.type) == ("MISSION_ACK", result)


def test_a_fence_that_a_flying_vehicle_is_outside_of_is_refused():
    wire = Wire()
    wire.vehicle.go_to(wire.vehicle.now_s, (20.0, 20.0, -5.0))
    wire.vehicle.advance(60.0)
    assert upload(wire, [waypoint(0, 0, command=CIRCLE_IN, p1=5.0)], FENCE) == REFUSED
    assert wire.vehicle.config.fence.shapes == ()


# ---- uploads ----


@pytest.mark.parametrize("kind", PLANS)
def test_what_is_uploaded_comes_back_bit_for_bit(kind):
    wire = Wire()
    assert upload(wire, PLANS[kind], kind) == OK
    assert same(download(wire, kind), PLANS[kind])


def test_an_upload_changes_nothing_until_it_is_whole():
    wire = Wire()
    upload(wire, PLANS[MISSION])
    wire.send(count(2))
    wire.send(item(0, waypoint(9, 9)))
    assert same(download(wire), PLANS[MISSION])
    assert wire.vehicle.mission.steps[0].north_east == pytest.approx((5.0, 5.0), abs=0.02)
    wire.send(item(1, waypoint(9, 8)))
    assert len(download(wire)) == len(wire.vehicle.mission.steps) == 2


def test_a_missing_item_is_asked_for_again_in_real_time_until_the_vehicle_gives_up():
    wire = Wire()
    wire.send(count(3))
    wire.read()
    asked = []
    for _ in range(600):
        wire.wait(0.01)
        asked += [
            (round(wire.real_s - 1000.0, 2), m) for m in wire.read() if m.get_type() == "MISSION_REQUEST_INT"
        ]
    assert {message.seq for _, message in asked} == {0}
    times = [at for at, _ in asked]
    assert all(
        b - a == pytest.approx(0.25, abs=0.011) for a, b in pairwise([0.0, *times])
    )  # PX4's retry timeout
    assert times[-1] == pytest.approx(5.0, abs=0.3)  # PX4's action timeout
    (ack,) = wire.ask(item(0, waypoint(1, 1)))
    assert ack.type == ERROR


def test_giving_up_is_told_and_the_next_upload_is_taken():
    wire = Wire()
    wire.send(count(3))
    wire.wait(5.1)
    assert wire.texts() == "Mission upload given up: no item 0 for 5 s"
    assert upload(wire, PLANS[MISSION], sender=OTHER) == OK


def test_the_request_is_repeated_over_the_link_of_the_upload_only():
    wire = Wire()
    wire.send(count(3))
    wire.send(count(2), OTHER)
    wire.read(OTHER)
    wire.wait(0.3)
    assert [m.get_type() for m in wire.read(OTHER)] == []
    assert [m.seq for m in wire.read() if m.get_type() == "MISSION_REQUEST_INT"] == [0, 0]


def test_a_second_client_is_refused_during_an_upload():
    wire = Wire()
    wire.send(count(12))
    (ack,) = wire.ask(count(2), OTHER)
    assert (ack.type, ack.target_system) == (ERROR, OTHER[0])
    (ack,) = wire.ask(item(0, waypoint(9, 9)), OTHER)
    assert ack.type == ERROR
    (ack,) = wire.ask(mavlink.MAVLink_mission_clear_all_message(1, 1, ALL), OTHER)
    assert ack.type == ERROR
    wire.read()
    wire.wait(0.3)
    for _ in PLANS[MISSION]:
        (request,) = (m for m in wire.read() if m.get_type() == "MISSION_REQUEST_INT")
        wire.send(item(request.seq, PLANS[MISSION][request.seq]))
    assert wire.read()[0].type == OK
    assert upload(wire, [waypoint(9, 9)], sender=OTHER) == OK


def test_a_second_client_with_the_same_ids_on_another_link_is_refused_too():
    wire = Wire()
    wire.send(count(2))
    wire.links[STATION], first = wire.telemetry(), wire.links[STATION]
    wire.read()
    (ack,) = wire.ask(count(1))
    assert ack.type == ERROR
    wire.links[STATION] = first
    assert [m.seq for m in wire.ask(item(0, waypoint(1, 1)))] == [1]


def test_duplicates_change_nothing():
    wire = Wire()
    first = wire.ask(count(2))
    assert [m.seq for m in wire.ask(count(2))] == [m.seq for m in first] == [0]  # a repeated count
    assert [m.seq for m in wire.ask(item(0, waypoint(1, 1)))] == [1]
    assert wire.ask(item(0, waypoint(1, 1))) == []  # or each would double the requests from then on
    assert [m.type for m in wire.ask(item(1, waypoint(2, 2)))] == [OK]
    assert [m.type for m in wire.ask(item(1, waypoint(2, 2)))] == [OK]  # its acknowledgement was lost
    assert [m.type for m in wire.ask(item(1, waypoint(2, 3)))] == [ERROR]  # that is another one
    assert len(wire.vehicle.mission.steps) == 2


def test_a_count_in_mid_upload_begins_anew():
    wire = Wire()
    wire.send(count(12))
    wire.send(item(0, PLANS[MISSION][0]))
    wire.read()
    assert upload(wire, [waypoint(1, 1)]) == OK
    assert len(wire.vehicle.mission.steps) == 1


def test_an_item_out_of_sequence_is_dropped_and_the_right_one_asked_for_again():
    wire = Wire()
    wire.send(count(3))
    wire.read()
    assert wire.ask(item(2, waypoint(1, 1))) == []
    wire.wait(0.3)
    assert [m.seq for m in wire.read()] == [0]
    (ack,) = wire.ask(item(3, waypoint(1, 1)))  # there can be no such item
    assert ack.type == SEQUENCE
    assert wire.protocol.plans.next_s() == math.inf


def test_a_client_may_cancel_its_upload():
    wire = Wire()
    wire.send(count(3))
    wire.send(mavlink.MAVLink_mission_ack_message(1, 1, 15, MISSION))  # MAV_MISSION_OPERATION_CANCELLED
    wire.read()
    wire.wait(1.0)
    assert wire.read() == []
    assert upload(wire, PLANS[MISSION], sender=OTHER) == OK


def test_an_old_client_with_float_items_uploads_and_downloads():
    wire = Wire()
    lat, lon = (value / 1e7 for value in e7(5.0, 6.0))
    wire.send(count(2))
    wire.send(mavlink.MAVLink_mission_item_message(1, 1, 0, 3, 16, 1, 1, 2.0, 0.0, 0.0, NAN, lat, lon, 5.0))
    _, request = wire.read()
    assert (request.get_type(), request.seq) == ("MISSION_REQUEST", 1)
    (ack,) = wire.ask(mavlink.MAVLink_mission_item_message(1, 1, 1, 2, 20, 0, 1, 0, 0, 0, 0, 0, 0, 0))
    assert ack.type == OK
    (got,) = wire.ask(mavlink.MAVLink_mission_request_message(1, 1, 0))
    assert (got.get_type(), got.command, got.param1, got.z) == ("MISSION_ITEM", 16, 2.0, 5.0)
    assert (got.x, got.y) == pytest.approx(
        (lat, lon), abs=1e-5
    )  # float32 knows latitudes to half a metre only


def test_a_client_that_does_not_know_the_int_request_is_asked_the_old_way():
    wire = Wire()
    wire.send(count(1))
    (_, request) = (
        wire.send(mavlink.MAVLink_mission_ack_message(1, 1, UNSUPPORTED, MISSION)),
        *wire.read()[-1:],
    )
    assert request.get_type() == "MISSION_REQUEST"


@pytest.mark.parametrize("kind", [*PLANS, ALL])
def test_lists_are_cleared_by_type_or_all_at_once(kind):
    wire = Wire()
    for each, plan in PLANS.items():
        upload(wire, plan, each)
    (ack,) = wire.ask(mavlink.MAVLink_mission_clear_all_message(1, 1, kind))
    assert (ack.type, ack.mission_type) == (OK, kind)
    assert {each for each in PLANS if download(wire, each)} == (set() if kind == ALL else set(PLANS) - {kind})
    assert bool(wire.vehicle.mission.steps) == (kind in (FENCE, RALLY))
    assert bool(wire.vehicle.config.fence.shapes) == (kind in (MISSION, RALLY))
    assert bool(wire.vehicle.config.rally.places) == (kind in (MISSION, FENCE))


def test_a_fence_whose_corner_is_home_holds_home():
    wire = Wire(on_the_ground())
    assert upload(wire, PLANS[FENCE][:4], FENCE) == OK
    wire.vehicle.arm(0.0)
    assert wire.vehicle.take_off(0.0).accepted


def test_a_waypoint_outside_the_fence_is_refused_with_its_reason():
    wire = Wire()
    upload(wire, PLANS[FENCE], FENCE)
    wire.send(count(1))
    wire.send(item(0, waypoint(10, 25)))
    assert "Mission refused: item 0: " in (said := wire.texts())
    assert said.endswith("is outside the fence")


# ---- bad links ----


@pytest.mark.parametrize("kind", PLANS)
def test_over_a_link_that_loses_5_percent_both_ways_every_transfer_succeeds(kind):
    for seed in range(40):
        wire = Wire(loss=0.05, seed=seed)
        assert upload(wire, PLANS[kind], kind) == OK
        assert same(download(wire, kind), PLANS[kind])


def test_two_clients_take_turns_over_bad_links():
    for seed in range(20):
        wire = Wire(loss=0.05, seed=seed)
        assert upload(wire, PLANS[MISSION]) == OK
        assert same(download(wire, sender=OTHER), PLANS[MISSION])
        assert upload(wire, PLANS[RALLY], RALLY, OTHER) == OK
        assert same(download(wire, RALLY), PLANS[RALLY])


# ---- commands, and what is told ----


def command(number, *params):
    return mavlink.MAVLink_command_long_message(1, 1, number, 0, *params, *[0.0] * (7 - len(params)))


def result(wire, message):
    (ack,) = (answer for answer in wire.ask(message) if answer.get_type() == "COMMAND_ACK")
    return ack.result


def mission_current(wire):
    """(seq, total, state, mode, ids of mission, fence and rally points) as the bytes of MISSION_CURRENT
    say them.
    """
    current = wire.telemetry().build(MissionCurrent.id, wire.vehicle.now_s)
    payload = bytes(current.pack(mavlink.MAVLink(None, 1, 1)))[10:-2].ljust(18, b"\0")
    return MissionCurrent.unpacker.unpack(payload)


def test_a_mission_is_started_paused_and_resumed_by_command():
    wire = Wire(on_the_ground())
    assert result(wire, command(300, -1.0)) == REJECTED
    upload(wire, PLANS[MISSION])
    assert result(wire, command(300, 99.0)) == DENIED
    assert result(wire, command(300, 1.0)) == ACCEPTED  # from its second item on; it arms
    state = wire.vehicle.state(0.0)
    assert (state.mode, state.armed, state.mission.seq) == (Mode.MISSION, True, 1)
    wire.vehicle.advance(2.0)
    assert result(wire, command(193, 0.0)) == ACCEPTED
    assert wire.vehicle.state(2.0).mode is Mode.HOLD
    assert result(wire, command(193, 1.0)) == ACCEPTED
    assert wire.vehicle.state(2.0).mode is Mode.MISSION
    assert result(wire, command(193, 2.0)) == DENIED
    assert result(wire, command(224, 4.0)) == ACCEPTED
    assert wire.vehicle.state(2.0).mission.seq == 4
    assert result(wire, command(176, 1.0, 4.0, 3.0)) == ACCEPTED  # hold
    assert result(wire, command(176, 1.0, 4.0, 4.0)) == ACCEPTED  # mission
    assert wire.vehicle.state(2.0).mode is Mode.MISSION


def test_the_mission_that_is_there_already_is_flown_on():
    wire = Wire(on_the_ground())
    upload(wire, PLANS[MISSION])
    result(wire, command(300, 0.0))
    wire.vehicle.advance(12.0)
    before = wire.vehicle.state(12.0).mission.seq
    assert before > 0
    assert upload(wire, PLANS[MISSION]) == OK
    assert wire.vehicle.state(12.0).mission.seq == before


def test_mission_current_says_how_far_it_is_and_which_lists_there_are():
    wire = Wire(on_the_ground())
    assert mission_current(wire) == (0, 0xFFFF, 1, 2, 0, 0, 0)  # no mission
    for kind, plan in PLANS.items():
        upload(wire, plan, kind)
    seq, total, state, mode, *ids = mission_current(wire)
    assert (seq, total, state, mode) == (0, 12, 2, 2)  # not started
    assert len(set(ids)) == 3
    assert 0 not in ids
    (answer,) = wire.ask(mavlink.MAVLink_mission_set_current_message(1, 1, 3))
    assert (answer.get_type(), answer.seq, answer.total) == ("MISSION_CURRENT", 3, 12)
    result(wire, command(300, -1.0))
    assert mission_current(wire)[:4] == (3, 12, 3, 1)  # active, in mission mode


def test_the_id_of_a_list_is_px4s_checksum():
    wire = Wire()
    upload(wire, PLANS[RALLY], RALLY)
    # CRC-32 as PX4 computes it: reflected, from 0, not inverted; over frame, command, autocontinue and the
    # seven parameters.
    crc = 0
    for fields in PLANS[RALLY]:
        frame, number, _, goes_on, *params = fields
        for byte in struct.pack("<BHB4fiif", frame, number, goes_on, *params):
            crc ^= byte
            for _ in range(8):
                crc = crc >> 1 ^ (0xEDB88320 if crc & 1 else 0)
    assert mission_current(wire)[6] == crc


def test_the_fence_status_counts_breaches():
    wire = Wire()
    upload(wire, [waypoint(0, 0, command=CIRCLE_IN, p1=14.2)], FENCE)
    assert wire.vehicle.go_to(10.0, (10.0, 10.0, -5.0)).accepted
    wire.vehicle.advance(40.0)
    status = wire.telemetry().build(162, 40.0)
    assert (status.breach_status, status.breach_count, status.breach_type) == (0, 0, 0)


def test_the_fences_action_is_a_parameter_of_integers():
    wire = Wire()

    def set_action(value):
        (packed,) = struct.unpack("<f", struct.pack("<i", value))
        (told,) = wire.ask(mavlink.MAVLink_param_set_message(1, 1, b"GF_ACTION", packed, 6))
        return struct.unpack("<i", struct.pack("<f", told.param_value))[0]

    assert [set_action(value) for value in (3, 6, -1)] == [3, 3, 3]
    assert wire.vehicle.config.fence_action == 3
