"""Protects the small services: time, modes, and proper refusals of files, logs and what is not simulated.
Never silence.
"""

import struct

import pytest
from pymavlink.dialects.v20 import common as mavlink

from sitl.autopilot.commands import COMMANDS
from sitl.autopilot.protocol import MavlinkProtocol
from sitl.autopilot.services import REFUSED, REFUSED_ONCE
from sitl.autopilot.telemetry import Snapshot, Telemetry
from tests.ground.tlog.flights import ACCEPTED, DENIED, UNSUPPORTED, hovering

STATION = (255, 190)


def ask(message, vehicle=None, at_s=10.0, protocol=None):
    """Send a message from a station; returns the answers, packed and parsed as on the wire."""
    vehicle = vehicle or hovering()
    telemetry = Telemetry(lambda t: Snapshot(vehicle.config, vehicle.state(t), (1.0, 0.0), None))
    decoded = mavlink.MAVLink(None).decode(bytearray(message.pack(mavlink.MAVLink(None, *STATION))))
    answers = (protocol or MavlinkProtocol(vehicle)).receive(decoded, at_s, telemetry)
    return [mavlink.MAVLink(None).decode(bytearray(m.pack(mavlink.MAVLink(None, 1, 1)))) for m in answers]


def command(number, p1=0.0, p2=0.0):
    return mavlink.MAVLink_command_long_message(1, 1, number, 0, p1, p2, 0.0, 0.0, 0.0, 0.0, 0.0)


def number(message):
    """The number of a message that the dialect does not know."""
    return int.from_bytes(message.get_msgbuf()[7:10], "little")


def payload(message):
    """The payload of a message that the dialect does not know, with the zeros that MAVLink 2 leaves out."""
    return bytes(message.get_msgbuf())[10:-2].ljust(64, b"\0")


# ---- time ----


def test_timesync_answers_with_the_simulations_time_and_the_askers():
    (answer,) = ask(mavlink.MAVLink_timesync_message(0, 123_456_789), at_s=10.25)
    assert (answer.tc1, answer.ts1) == (10_250_000_000, 123_456_789)
    assert ask(mavlink.MAVLink_timesync_message(5, 123)) == []  # an answer to someone


def test_a_ping_comes_back_to_the_asker_only():
    (answer,) = ask(mavlink.MAVLink_ping_message(77, 3, 0, 0))
    assert (answer.time_usec, answer.seq, answer.target_system, answer.target_component) == (77, 3, *STATION)
    assert ask(mavlink.MAVLink_ping_message(77, 3, 1, 1)) == []  # an answer to a ping of ours


# ---- requested messages ----


@pytest.mark.parametrize(
    "message", [command(512, 300.0), command(519)], ids=["REQUEST_MESSAGE", "REQUEST_PROTOCOL_VERSION"]
)
def test_the_protocol_version_is_mavlink_2(message):
    ack, version = ask(message)
    assert (ack.result, number(version)) == (ACCEPTED, 300)
    assert struct.unpack("<HHH", payload(version)[:6]) == (200, 100, 200)


def test_all_modes_are_listed_or_one_by_its_number():
    ack, *modes = ask(command(512, 435.0, 0.0))
    rows = [struct.unpack("<IIBBB35s", payload(mode)[:46]) for mode in modes]
    assert ack.result == ACCEPTED
    # PX4's numbers: main mode << 16 | sub mode << 24. Standard modes: 8 take-off, 6 mission, 5 safe recovery,
    # 7 land.
    assert [
        (custom, index, standard, name.rstrip(b"\0")) for custom, _, _, index, standard, name in rows
    ] == [
        (4 << 16 | 2 << 24, 1, 8, b"Takeoff"),
        (4 << 16 | 3 << 24, 2, 0, b"Hold"),
        (4 << 16 | 4 << 24, 3, 6, b"Mission"),
        (4 << 16 | 5 << 24, 4, 5, b"Return"),
        (4 << 16 | 6 << 24, 5, 7, b"Land"),
        (6 << 16, 6, 0, b"Offboard"),
    ]
    assert {count for _, _, count, _, _, _ in rows} == {6}
    ack, one = ask(command(512, 435.0, 3.0))
    assert payload(one) == payload(modes[2])
    assert [m.result for m in ask(command(512, 435.0, 7.0))] == [UNSUPPORTED]


def test_the_current_mode_and_the_monitor_come_on_request():
    _, current = ask(command(512, 436.0))
    assert struct.unpack("<IIB", payload(current)[:9]) == (4 << 16 | 3 << 24, 4 << 16 | 3 << 24, 0)
    assert [number(m) for m in ask(command(512, 437.0))] == [77, 437]


def test_the_origin_comes_on_request_and_as_a_stream_once_it_is_asked_for():
    """The local frame begins at home: a companion that subtracts one from the other gets zero."""
    _, home = ask(command(512, 242.0))
    ack, origin = ask(command(512, 49.0))
    assert ack.result == ACCEPTED
    assert (
        (origin.latitude, origin.longitude, origin.altitude)
        == (home.latitude, home.longitude, home.altitude)
        != (0, 0, 0)
    )
    vehicle = hovering()
    telemetry = Telemetry(lambda t: Snapshot(vehicle.config, vehicle.state(t), (1.0, 0.0), None), 10.0)
    assert "GPS_GLOBAL_ORIGIN" not in {m.get_type() for m in telemetry.due(10.0)}
    assert telemetry.set_interval(49, 1e6, 10.0).accepted
    assert "GPS_GLOBAL_ORIGIN" in {m.get_type() for m in telemetry.due(11.0)}


@pytest.mark.parametrize(
    "message",
    [command(510, 30.0), command(512, 244.0, 30.0)],
    ids=["GET_MESSAGE_INTERVAL", "REQUEST_MESSAGE"],
)
def test_the_interval_of_a_message_is_told(message):
    ack, interval = ask(message)
    assert (ack.result, interval.message_id, interval.interval_us) == (ACCEPTED, 30, 10_000)


@pytest.mark.parametrize(("number", "interval_us"), [(331.0, -1), (27.0, 0)])
def test_an_interval_of_minus_one_is_off_and_of_0_unknown(number, interval_us):
    assert ask(command(510, number))[1].interval_us == interval_us


def test_the_heartbeat_stays_on_and_the_client_is_told():
    ack, *told = ask(command(511, 0.0, -1.0))
    assert ack.result == DENIED
    assert "".join(m.text for m in told) == "Interval refused: HEARTBEAT has at most 1000000 us and stays on"


@pytest.mark.parametrize("message_id", [397.0, 395.0, 259.0, 261.0, 280.0])
def test_metadata_cameras_gimbals_and_storage_are_unsupported(message_id):
    assert [m.result for m in ask(command(512, message_id))] == [UNSUPPORTED]


@pytest.mark.parametrize("number", sorted(mavlink.enums["MAV_CMD"]))
def test_every_command_is_obeyed_as_the_page_says_or_unsupported(number):
    (ack,) = (m for m in ask(command(number, 1.0)) if m.get_type() == "COMMAND_ACK")
    assert ack.command == number
    assert (ack.result == UNSUPPORTED) == (number not in COMMANDS) or number in (
        511,
        512,
    )  # these two: of message 1 here


# ---- what there is not ----


def ftp(opcode, data=b"", number=7, session=0):
    header = struct.pack("<HBBBBBBI", number, session, opcode, len(data), 0, 0, 0, 0)
    return mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, (header + data).ljust(251, b"\0"))


@pytest.mark.parametrize(
    ("opcode", "error"),
    [
        (1, 4),
        (3, 10),
        (4, 10),
        (5, 4),
        (6, 9),
        (7, 4),
        (8, 10),
        (9, 9),
        (10, 10),
        (11, 9),
        (12, 10),
        (13, 10),
        (14, 10),
        (15, 4),
        (99, 7),
    ],
)
def test_a_request_for_files_gets_a_nak_with_its_error(opcode, error):
    (answer,) = ask(ftp(opcode, b"/etc/extras.txt"))
    number, session, said, size, asked, _, _, _ = struct.unpack("<HBBBBBBI", bytes(answer.payload[:12]))
    assert (number, session, said, size, asked, answer.payload[12]) == (8, 0, 129, 1, opcode, error)
    assert (answer.target_system, answer.target_component) == STATION


def test_to_reset_sessions_is_acknowledged_numbers_wrap_and_answers_are_not_answered():
    (answer,) = ask(ftp(2, number=0xFFFF))
    assert struct.unpack("<HBBB", bytes(answer.payload[:5])) == (0, 0, 128, 0)
    assert ask(ftp(128)) == ask(ftp(129)) == []


def test_there_are_no_logs():
    (entry,) = ask(mavlink.MAVLink_log_request_list_message(1, 1, 0, 0xFFFF))
    assert (entry.get_type(), entry.num_logs) == ("LOG_ENTRY", 0)
    (data,) = ask(mavlink.MAVLink_log_request_data_message(1, 1, 4, 90, 1000))
    assert (data.get_type(), data.id, data.ofs, data.count) == ("LOG_DATA", 4, 90, 0)
    (told,) = ask(mavlink.MAVLink_log_erase_message(1, 1))
    assert told.text == "Logs not erased: none on board"
    assert ask(mavlink.MAVLink_log_request_end_message(1, 1)) == []  # there is no download to end


def test_an_old_station_is_told_once_how_rates_are_set():
    vehicle = hovering()
    protocol = MavlinkProtocol(vehicle)
    asked = mavlink.MAVLink_request_data_stream_message(1, 1, 0, 4, 1)
    answers = [ask(asked, vehicle, 10.0 + 15.0 * n, protocol) for n in range(3)]
    assert (
        "".join(m.text for m in answers[0]) == "Data streams refused: MAV_CMD_SET_MESSAGE_INTERVAL sets rates"
    )
    assert answers[1:] == [[], []]


def empty(kind):
    """A message of this type to the vehicle, or to all if it is a ping; all other fields are 0."""
    message = next(message for message in mavlink.mavlink_map.values() if message.msgname == kind)
    lengths, target = (
        dict(zip(message.ordered_fieldnames, message.array_lengths, strict=True)),
        int(kind != "PING"),
    )
    given = {"target_system": target, "target_component": target, "target": target}
    values = []
    for name, form in zip(message.fieldnames, message.fieldtypes, strict=True):
        values.append(given.get(name, b"" if form == "char" else [0] * lengths[name] if lengths[name] else 0))
    return message(*values)


@pytest.mark.parametrize(
    "kind", sorted({*MavlinkProtocol(hovering()).services, *REFUSED, *REFUSED_ONCE} - {"MISSION_ACK"})
)
def test_every_request_gets_an_answer(kind):
    assert ask(empty(kind)) != []


@pytest.mark.parametrize("kind", sorted(REFUSED))
def test_what_is_not_simulated_is_refused_in_words_once_a_second(kind):
    vehicle = hovering()
    protocol = MavlinkProtocol(vehicle)
    told = [ask(empty(kind), vehicle, 10.0 + n / 20.0, protocol) for n in range(40)]
    texts = [m for answers in told for m in answers]
    assert {m.get_type() for m in texts} == {"STATUSTEXT"}
    assert "".join(m.text for m in texts) == 2 * REFUSED[kind]
    assert protocol.refused == {}  # no waypoint was refused
