"""Protects the messages that pymavlink's common dialect lacks: their bytes are those that stations expect,
and records hold them.
"""

import json

import jsonschema
import pytest
from pymavlink.dialects.v20 import common, development

from link.bus.frames import fields_of
from link.bus.mavlink import split
from link.bus.px4 import (
    ADDED,
    AvailableModes,
    AvailableModesMonitor,
    CurrentMode,
    MissionCurrent,
    ProtocolVersion,
)
from link.record.decoded import decode, message_schema

SENDER = {"srcSystem": 1, "srcComponent": 1}


def test_their_checksums_begin_with_the_bytes_of_mavlinks_c_library() -> None:
    assert {number: kind.crc_extra for number, kind in ADDED.items()} == {
        300: 217,
        435: 134,
        436: 193,
        437: 30,
        42: 28,
        168: 1,
        193: 71,
    }


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        (
            AvailableModes(
                custom_mode=7,
                properties=2,
                number_modes=5,
                mode_index=1,
                standard_mode=8,
                mode_name=b"Takeoff",
            ),
            development.MAVLink_available_modes_message(5, 1, 8, 7, 2, b"Takeoff"),
        ),
        (
            CurrentMode(custom_mode=7, intended_custom_mode=9, standard_mode=5),
            development.MAVLink_current_mode_message(5, 7, 9),
        ),
        (AvailableModesMonitor(seq=3), development.MAVLink_available_modes_monitor_message(3)),
    ],
)
def test_they_are_packed_as_by_the_dialect_that_has_them(ours, theirs) -> None:
    packed = ours.pack(common.MAVLink(None, **SENDER))
    assert packed == theirs.pack(development.MAVLink(None, **SENDER))
    assert json.loads(next(decode(packed))[1])["system"] == 1


def test_a_record_holds_them_with_their_fields() -> None:
    version = ProtocolVersion(
        version=200, min_version=100, max_version=200, spec_version_hash=[1] * 8, library_version_hash=[0] * 8
    )
    packed = version.pack(common.MAVLink(None, **SENDER))
    (frame,) = split(packed)
    assert fields_of(frame)["max_version"] == 200
    ((_, decoded),) = decode(packed)
    fields = {**json.loads(decoded), "simulation_s": 1.5}
    jsonschema.validate(fields, message_schema("PROTOCOL_VERSION"))
    assert fields["spec_version_hash"] == [1] * 8


def test_the_fields_that_were_added_to_a_message_later_are_read_by_those_that_know_them() -> None:
    ours = MissionCurrent(
        seq=3, total=12, mission_state=4, mission_mode=2, mission_id=7, fence_id=8, rally_points_id=9
    )
    packed = ours.pack(common.MAVLink(None, **SENDER))
    known = common.MAVLink(None).decode(bytearray(packed))
    assert (known.seq, known.total, known.mission_state, known.mission_mode) == (3, 12, 4, 2)
    # Extensions keep the order of the definition: 2 + 2 + 1 + 1 bytes, then the three ids.
    assert packed[10 + 6 : -2] == (7).to_bytes(4, "little") + (8).to_bytes(4, "little") + (9).to_bytes(
        4, "little"
    ).rstrip(b"\0")
    assert json.loads(next(decode(packed))[1])["rally_points_id"] == 9
