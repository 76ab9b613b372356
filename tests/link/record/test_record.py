"""Protects records: they read back byte for byte, other readers can read them, and a truncated file reads
up to the cut.
"""

import contextlib
import io
import json
import math
import struct
from pathlib import Path

import jsonschema
import msgspec
import numpy as np
import pytest
from mcap.reader import make_reader
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as mavlink

from link.bus.mavlink import Codec, Reading, pack_reading, waypoint_message
from link.bus.messages import Health, Stop, pack_particles
from link.record.reader import RecordError, read
from link.record.record import Entry
from link.record.writer import Writer
from tests.ground.desk.test_summary import belief

BEGAN = 1_700_000_000_000_000_000
ABOUT = {"seed": 3, "policy": "homing", "mission": {"about": "a test", "events": []}, "text": "3"}
ATTITUDE = mavlink.MAVLink_attitude_message(2500, 0.1, math.nan, 0.3, 0.0, 0.0, 0.0)
PARTICLES = pack_particles(np.arange(30, dtype=np.float32).reshape(10, 3))
OTHERS_JSON = (
    b'{ "service" : "agent", "state": "ready", "step": 1, "compute_s": 0, "uptime_s": 1, "refused": {} }\n'
)
UAV, AGENT = Codec(1, 1), Codec(1, 191)

ENTRIES = [
    Entry(
        "mavlink/out", BEGAN, 2.5, UAV.pack(ATTITUDE, mavlink.MAVLink_heartbeat_message(2, 12, 157, 0, 4, 3))
    ),
    Entry("reading", BEGAN + 10, 3.0, pack_reading(UAV, Reading(3000, (3.25, 4.5), 5.0, (2.0, -1.0), 0.75))),
    Entry("belief", BEGAN + 20, 1.0, belief(0), PARTICLES),
    Entry(
        "agdc/stop",
        BEGAN + 30,
        4.0,
        msgspec.json.encode(Stop(4000, 3, (14.0, 12.0), (0.09, 0.0, 0.04), 0.36, 0.5)),
    ),
    Entry("waypoint", BEGAN + 40, 3.0, AGENT.pack(waypoint_message(1, 3000, (4.0, 4.5), 5.0))),
    Entry(
        "health/uav",
        BEGAN + 50,
        3.0,
        msgspec.json.encode(Health("uav", "searching", 4, 0.5, 1.5, {"late": 2})),
    ),
    Entry("health/agent", BEGAN + 60, 3.0, OTHERS_JSON),
    Entry("belief", BEGAN + 70, 3.0, b"no JSON \xff", b"odd"),
    Entry("reading", BEGAN + 80, 3.0, b"noise"),
    Entry("mavlink/in", BEGAN + 90, 3.0, b""),
]


def written(path: Path, entries: list[Entry] = ENTRIES, flush_each: bool = False) -> Path:
    writer = Writer(path, ABOUT)
    for entry in entries:
        writer.write(entry, entry.published_ns + 5)
        if flush_each:
            writer.flush()
    writer.close()
    return path


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return written(tmp_path / "run.mcap")


def test_every_message_is_read_back_byte_for_byte_with_its_times(log: Path) -> None:
    recording = read(log)
    assert recording.complete
    assert recording.entries == ENTRIES
    assert recording.about == ABOUT


def test_the_mcap_library_reads_it_with_publish_and_log_times_and_index(log: Path) -> None:
    with log.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics.message_count == sum(summary.statistics.channel_message_counts.values())
        assert summary.chunk_indexes[0].compression == "zstd"
        (metadata,) = reader.iter_metadata()
        assert metadata.metadata["seed"] == "3"
        assert json.loads(metadata.metadata["mission"]) == ABOUT["mission"]
        raw = [
            (message.publish_time, message.log_time, message.data)
            for _, channel, message in reader.iter_messages(topics="mavlink/out")
        ]
    assert raw == [(BEGAN, BEGAN + 5, ENTRIES[0].payload)]


def topics(log: Path) -> dict[str, list[tuple[dict, dict]]]:
    """(schema, message) of each JSON message by topic, as a viewer gets them."""
    found: dict[str, list[tuple[dict, dict]]] = {}
    with log.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            if channel.message_encoding == "json":
                assert schema is not None
                assert schema.encoding == "jsonschema"
                found.setdefault(channel.topic, []).append(
                    (json.loads(schema.data), json.loads(message.data))
                )
    return found


def test_json_carries_the_simulation_time_and_keeps_to_its_schema(log: Path) -> None:
    found = topics(log)
    assert {
        "belief",
        "agdc/stop",
        "health/uav",
        "health/agent",
        "reading/decoded",
        "mavlink/out/ATTITUDE",
        "mavlink/out/HEARTBEAT",
    } < set(found)
    for messages in found.values():
        for schema, message in messages:
            jsonschema.Draft202012Validator(schema, format_checker=None).validate(message)
            assert schema["type"] == "object"
            assert "$ref" not in json.dumps(schema)  # viewers do not follow references
    assert [message["simulation_s"] for _, message in found["agdc/stop"]] == [4.0]


def test_what_is_decoded_is_what_flew(log: Path) -> None:
    found = topics(log)
    attitude = found["mavlink/out/ATTITUDE"][0][1]
    assert (attitude["time_boot_ms"], attitude["roll"], attitude["simulation_s"]) == (
        2500,
        pytest.approx(0.1),
        2.5,
    )
    assert attitude.get("pitch") is None  # NaN, which JSON cannot express
    sample = found["reading/decoded"][0][1]
    assert [sample[name] for name in ("x", "y", "altitude_m", "wind_x", "wind_y", "gas")] == [
        3.25,
        4.5,
        5.0,
        2.0,
        -1.0,
        0.75,
    ]
    waypoint = found["waypoint/SET_POSITION_TARGET_LOCAL_NED"][0][1]
    assert [waypoint[name] for name in ("x", "y", "z", "time_boot_ms", "component")] == [
        4.5,
        4.0,
        -5.0,
        3000,
        191,
    ]


def test_the_tlog_is_a_time_and_a_frame_again_and_again(log: Path) -> None:
    data, frames, times = log.with_suffix(".tlog").read_bytes(), b"", []
    while data:
        (time_us,) = struct.unpack(">Q", data[:8])
        length = 12 + data[9]  # MAVLink 2, not signed: ten bytes before the payload, two behind it
        times.append(time_us)
        frames += data[8 : 8 + length]
        data = data[8 + length :]
    assert frames == ENTRIES[0].payload + ENTRIES[1].payload + ENTRIES[4].payload
    assert times == sorted(times)
    assert times[0] == BEGAN // 1000


def test_pymavlinks_own_reader_reads_the_tlog(log: Path) -> None:
    reader = mavutil.mavlink_connection(str(log.with_suffix(".tlog")), dialect="common")
    kinds = []
    while (message := reader.recv_match()) is not None:
        kinds.append(message.get_type())
    assert kinds == [
        "ATTITUDE",
        "HEARTBEAT",
        "LOCAL_POSITION_NED",
        "WIND_COV",
        "NAMED_VALUE_FLOAT",
        "SET_POSITION_TARGET_LOCAL_NED",
    ]


def test_frames_that_overtook_each_other_are_in_order_in_the_tlog(tmp_path: Path) -> None:
    late = [ENTRIES[1], ENTRIES[0]]  # received in this order, published in the other
    log = written(tmp_path / "run.mcap", late)
    data = log.with_suffix(".tlog").read_bytes()
    assert data[8 : 8 + 12 + data[9]] in ENTRIES[0].payload


@pytest.mark.slow
@pytest.mark.parametrize("flush_each", [False, pytest.param(True, marks=pytest.mark.full)])
def test_a_file_cut_off_anywhere_reads_up_to_its_last_flush(tmp_path: Path, flush_each: bool) -> None:
    whole = written(tmp_path / "run.mcap", flush_each=flush_each).read_bytes()
    cut, counts = tmp_path / "cut.mcap", []
    for length in range(8, len(whole), 7):
        cut.write_bytes(whole[:length])
        recording = read(cut)
        assert not recording.complete
        assert recording.entries == ENTRIES[: len(recording.entries)]
        counts.append(len(recording.entries))
    assert counts == sorted(counts)
    assert counts[-1] == len(ENTRIES)
    assert len(set(counts)) == (len(ENTRIES) + 1 if flush_each else 2)


@pytest.mark.full
@pytest.mark.slow
def test_damage_never_raises_anything_but_a_record_error(tmp_path: Path) -> None:
    whole = bytearray(written(tmp_path / "run.mcap", flush_each=True).read_bytes())
    damaged = tmp_path / "damaged.mcap"
    for at in range(0, len(whole), 11):
        whole[at] ^= 0x5A
        damaged.write_bytes(whole)
        with contextlib.suppress(RecordError):
            assert len(read(damaged).entries) <= len(ENTRIES)
        whole[at] ^= 0x5A


def test_what_is_no_log_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "text").write_text("hello")
    (tmp_path / "empty").write_bytes(b"")
    foreign = io.BytesIO()
    from mcap.writer import Writer as Foreign

    other = Foreign(foreign)
    other.start()
    other.add_message(other.register_channel("camera", "json", 0), 1, b"{}", 1)
    other.finish()
    (tmp_path / "foreign.mcap").write_bytes(foreign.getvalue())
    for name in ("text", "empty", "foreign.mcap", "none", "."):
        with pytest.raises(RecordError) as error:
            read(tmp_path / name)
        assert str(error.value).startswith(str(tmp_path))
        assert "\n" not in str(error.value)
