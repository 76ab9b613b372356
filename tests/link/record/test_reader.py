"""Protects the reading of records: unknown formats are named; strange, hostile or growing files neither
hang nor exhaust memory.
"""

import io
import os
import random
import tracemalloc
from pathlib import Path
from typing import Any

import lz4.frame
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Message, Metadata
from mcap.writer import MCAP0_MAGIC, CompressionType
from mcap.writer import Writer as OthersWriter

from link.bus.mavlink import Codec, waypoint_message
from link.record import reader
from link.record.reader import RecordError, read
from link.record.record import Entry, SimulationClock
from link.record.writer import Writer
from tests.link.record.test_record import ABOUT, ENTRIES, written

GOLDEN = Path(__file__).parents[2] / "golden" / "greedy-gaussian.mcap"


def refused(path: Path) -> str:
    with pytest.raises(RecordError) as error:
        read(path)
    assert "\n" not in str(error.value)
    return str(error.value)


def as_record(*records: Any) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())


def packed_anew(log: Path, compression: CompressionType) -> bytes:
    """The same record as another tool writes it, in one chunk."""
    out = io.BytesIO()
    writer = OthersWriter(out, compression=compression)
    writer.start()
    with log.open("rb") as file:
        others = make_reader(file)
        for metadata in others.iter_metadata():
            writer.add_metadata(metadata.name, metadata.metadata)
        channels: dict[int, int] = {}
        for _, channel, message in others.iter_messages():
            if channel.id not in channels:
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, 0)
            writer.add_message(
                channels[channel.id], message.log_time, message.data, message.publish_time, message.sequence
            )
    writer.finish()
    return out.getvalue()


# ---- formats ----


def test_a_record_says_its_format_beside_what_the_run_was(tmp_path: Path) -> None:
    log = written(tmp_path / "run.mcap")
    with log.open("rb") as file:
        (metadata,) = make_reader(file).iter_metadata()
    assert metadata.metadata["format"] == "2"
    assert read(log).about == ABOUT


def test_a_record_without_a_format_is_read(tmp_path: Path) -> None:
    with GOLDEN.open("rb") as file:
        (metadata,) = make_reader(file).iter_metadata()
    golden = read(GOLDEN)
    assert golden.complete
    assert set(golden.about) == set(metadata.metadata) - {"format"}
    assert {entry.key for entry in golden.entries} >= {"reading", "belief", "waypoint"}


def test_in_a_record_of_an_older_format_the_agents_setpoints_among_the_commands_are_its_waypoints(
    tmp_path: Path,
) -> None:
    """Until format 1 they were sent on mavlink/in. A setpoint of somebody else, or in a newer record, is
    none.
    """
    theirs, pilots = (
        ENTRIES[4]._replace(key="mavlink/in"),
        Codec(255, 190).pack(waypoint_message(1, 3000, (4.0, 4.5), 5.0)),
    )
    entries = [*ENTRIES[:2], theirs, theirs._replace(payload=pilots)]
    log = written(tmp_path / "run.mcap", entries)
    assert [entry.key for entry in read(log).entries][2:] == ["mavlink/in", "mavlink/in"]
    format_is = b"\6\0\0\0format\1\0\0\0"
    log.write_bytes(log.read_bytes().replace(format_is + b"2", format_is + b"1"))
    assert read(log).entries == [*ENTRIES[:2], ENTRIES[4], entries[3]]


@pytest.mark.parametrize(
    ("written_as", "told"), [("3", "3"), ("-1", "-1"), ('"other"', "other"), ("[1]", "[1]")]
)
def test_a_record_of_another_format_is_refused_by_name(tmp_path: Path, written_as: str, told: str) -> None:
    log = tmp_path / "newer.mcap"
    whole = written(log).read_bytes()
    newer = as_record(Metadata("plumeward", {"seed": "3", "format": written_as}))
    log.write_bytes(MCAP0_MAGIC + newer + whole[len(MCAP0_MAGIC) :])
    assert (
        refused(log)
        == f"{log} has record format {told} of another plumeward version; readable formats: 0, 1, 2"
    )


# ---- missing files, and files of other kinds ----


def test_a_pipe_a_folder_and_a_device_are_refused_without_being_opened(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe.mcap"
    os.mkfifo(pipe)  # opening it would wait for a writer
    for path, kind in ((pipe, "pipe"), (tmp_path, "folder"), (Path("/dev/zero"), "device")):
        assert refused(path) == f"{path} is a {kind}; wanted a file"


def test_an_empty_file_is_called_empty(tmp_path: Path) -> None:
    (tmp_path / "run.mcap").write_bytes(b"")
    assert refused(tmp_path / "run.mcap") == f"{tmp_path / 'run.mcap'} is empty"


@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_record_that_another_tool_packed_anew_is_read(tmp_path: Path, compression: CompressionType) -> None:
    log = written(tmp_path / "run.mcap", flush_each=True)
    anew = tmp_path / "anew.mcap"
    anew.write_bytes(packed_anew(log, compression))
    assert read(anew) == read(log)


# ---- truncated and damaged files ----


def test_a_record_that_is_still_being_written_is_read_up_to_its_last_flush(tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    writer = Writer(log, ABOUT)
    for count, entry in enumerate(ENTRIES):
        recording = read(log)
        assert (recording.about, recording.entries, recording.complete) == (ABOUT, ENTRIES[:count], False)
        writer.write(entry, entry.published_ns)
        assert read(log).entries == ENTRIES[:count]
        writer.flush()
    writer.close()
    assert read(log).complete


def test_what_the_run_was_is_known_whole_or_not_at_all(tmp_path: Path) -> None:
    whole = written(tmp_path / "run.mcap").read_bytes()
    cut = tmp_path / "cut.mcap"
    told = []
    for length in range(8, len(whole)):
        cut.write_bytes(whole[:length])
        told.append(read(cut).about)
        if told[-1]:
            break
    assert told[:-1] == [{}] * (len(told) - 1)
    assert told[-1] == ABOUT


@pytest.mark.parametrize("number", [b"nan", b"inf", b"-1e999"])
def test_a_time_that_is_no_number_is_damage(tmp_path: Path, number: bytes) -> None:
    log = tmp_path / "run.mcap"
    writer = OthersWriter(str(log))
    writer.start()
    writer.add_message(
        writer.register_channel("health/uav", "json", 0), 1, b'{"uptime_s":1,"simulation_s":%s}' % number, 1
    )
    writer.finish()
    assert (read(log).entries, read(log).complete) == ([], False)


def test_bytes_behind_the_end_are_damage(tmp_path: Path) -> None:
    log = written(tmp_path / "run.mcap")
    log.write_bytes(log.read_bytes() + b"more")
    assert (read(log).entries, read(log).complete) == (ENTRIES, False)


def test_a_chunk_that_is_there_twice_gives_its_messages_twice(tmp_path: Path) -> None:
    log = written(tmp_path / "run.mcap", ENTRIES[:3])
    whole = log.read_bytes()
    begin = whole.index(b"\x06")
    while True:  # the opcode of a chunk, and what that says of its length fits the record behind it, an index
        length = int.from_bytes(whole[begin + 1 : begin + 9], "little")
        if length < len(whole) and whole[begin + 9 + length : begin + 10 + length] == b"\x07":
            break
        begin = whole.index(b"\x06", begin + 1)
    chunk = whole[begin : begin + 9 + length]
    log.write_bytes(whole[:begin] + chunk + whole[begin:])
    assert read(log).entries == [*ENTRIES[:3], *ENTRIES[:3]]


# ---- damaged in the middle ----

EACH = [
    Entry("health/agent", 10 * number, float(number), b'{"uptime_s":%d}' % number) for number in range(40)
]


def chunks(whole: bytes) -> list[tuple[int, int]]:
    """Where each chunk begins and ends, as the index at the end of the file has it."""
    summary = make_reader(io.BytesIO(whole)).get_summary()
    assert summary is not None
    return [
        (index.chunk_start_offset, index.chunk_start_offset + index.chunk_length)
        for index in summary.chunk_indexes
    ]


def damaged(log: Path, at: int, count: int = 16) -> Path:
    """Overwrite bytes of a file."""
    whole = bytearray(log.read_bytes())
    whole[at : at + count] = bytes(byte ^ 0xA5 for byte in whole[at : at + count])
    log.write_bytes(whole)
    return log


@pytest.mark.parametrize(
    "offset", [0, 1, 17, 25, 33, 37, 41, 49, 60], ids=lambda offset: f"{offset} bytes into a chunk"
)
def test_sixteen_damaged_bytes_cost_the_messages_of_their_chunk_and_no_others(
    tmp_path: Path, offset: int
) -> None:
    log = written(tmp_path / "run.mcap", EACH, flush_each=True)
    begin, end = chunks(log.read_bytes())[20]
    recording = read(damaged(log, begin + offset))
    assert recording.entries == [*EACH[:20], *EACH[21:]]
    assert not recording.complete
    (place,) = recording.damage
    assert (place.at, place.after_s, place.before) == (begin, 19.0, 20)
    assert (
        end - begin <= place.size <= end - begin + 100
    )  # with the index of the chunk, if its own length is not known
    assert (
        recording.shortcoming
        == f"is damaged, and lacks {place.size} bytes at byte {begin:,}, after 19.00 s of simulation"
    )


def test_damage_anywhere_costs_the_chunks_that_it_touches_and_no_others(tmp_path: Path) -> None:
    log = written(tmp_path / "run.mcap", EACH, flush_each=True)
    whole = log.read_bytes()
    places = chunks(whole)
    for at in range(places[0][0] - 8, places[-1][1], 61):
        log.write_bytes(whole)
        touched = [number for number, (begin, end) in enumerate(places) if at < end and begin < at + 16]
        entries = read(damaged(log, at)).entries
        assert [entry for number, entry in enumerate(EACH) if number not in touched] == [
            it for it in entries if it not in (EACH[n] for n in touched)
        ]


def test_a_chunk_whose_channels_are_lost_with_another_is_read_by_those_at_the_end(tmp_path: Path) -> None:
    log = written(tmp_path / "run.mcap", EACH, flush_each=True)
    begin, _ = chunks(log.read_bytes())[0]
    assert read(damaged(log, begin + 60)).entries == EACH[1:]


def test_what_is_damaged_and_cut_off_is_read_up_to_its_end(tmp_path: Path) -> None:
    log = written(tmp_path / "run.mcap", EACH, flush_each=True)
    places = chunks(log.read_bytes())
    log.write_bytes(log.read_bytes()[: places[30][0] + 20])
    recording = read(damaged(log, places[10][0] + 3))
    assert recording.entries == [*EACH[:10], *EACH[11:30]]
    assert [place.before for place in recording.damage] == [10]


def test_a_record_that_claims_to_be_longer_hides_no_chunk_behind_it(tmp_path: Path) -> None:
    log = written(tmp_path / "run.mcap", EACH, flush_each=True)
    whole = bytearray(log.read_bytes())
    (_, index), (_, end) = chunks(bytes(whole))[5:7]
    assert whole[index] == 7
    whole[index + 1 : index + 9] = (end - index - 9 + 5).to_bytes(
        8, "little"
    )  # it ends within the index of the next chunk
    log.write_bytes(whole)
    assert read(log).entries == EACH
    assert [place.before for place in read(log).damage] == [6]


def test_many_places_are_told_by_their_number(tmp_path: Path) -> None:
    log = written(tmp_path / "run.mcap", EACH, flush_each=True)
    for begin, _ in chunks(log.read_bytes())[1:39:2]:
        damaged(log, begin + 60)
    recording = read(log)
    assert recording.entries == [EACH[0], *EACH[2::2], EACH[39]]
    assert recording.shortcoming.endswith("after 4.00 s of simulation; and 16 more places")


# ---- hostile files ----

FAR_TOO_MUCH = 5_000_000_000_000
CLAIMS_TERABYTES = b"\x28\xb5\x2f\xfd\xc0\x58" + FAR_TOO_MUCH.to_bytes(8, "little") + b"\x01\x00\x00"
"""A zstd frame by RFC 8878: its magic, a header whose content size has 8 bytes, and a last block without
content.
"""
ZEROS = bytes(60_000_000)


@pytest.mark.parametrize(
    ("compression", "claimed", "data"),
    [
        ("zstd", FAR_TOO_MUCH, zstandard.compress(b"little")),
        ("zstd", 100, CLAIMS_TERABYTES),
        ("zstd", 100, zstandard.compress(ZEROS)),
        ("lz4", 100, lz4.frame.compress(ZEROS)),
        ("none that is known", 100, b"little"),
        ("", 100, b"little"),
    ],
    ids=["the chunk claims", "the frame claims", "zstd unpacks", "lz4 unpacks", "unknown", "plain"],
)
def test_a_chunk_that_comes_to_far_too_much_ends_the_record(
    tmp_path: Path, compression: str, claimed: int, data: bytes
) -> None:
    log = written(tmp_path / "run.mcap", ENTRIES[:2], flush_each=True)
    bomb = as_record(Chunk(compression, data, 0, 0, 1, claimed))
    whole = log.read_bytes()
    end = whole.rindex(b"\x0f" + (4).to_bytes(8, "little"))  # the end of the data; all before it is whole
    log.write_bytes(whole[:end] + bomb + whole[end:])
    tracemalloc.start()
    try:
        recording = read(log)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert (recording.entries, recording.complete) == (ENTRIES[:2], False)
    assert peak < 20_000_000


def test_a_record_that_would_fill_the_memory_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reader, "LARGEST_RECORD", 1 << 20)
    log = tmp_path / "run.mcap"
    beliefs = [
        Entry("belief", number, 0.0, b"", random.Random(number).randbytes(5_000) * 20) for number in range(11)
    ]
    written(log, beliefs[:10])
    assert len(read(log).entries) == 10
    written(log, beliefs)
    assert log.stat().st_size < 100_000
    assert (
        refused(log)
        == f"{log} holds more than 0.000976562 GiB of messages; cut out a part of it with `mcap filter`"
    )


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
def test_a_small_file_that_unpacks_without_end_is_refused_before_it_fills_the_memory(
    tmp_path: Path, compression: CompressionType
) -> None:
    pack = {CompressionType.ZSTD: zstandard.compress, CompressionType.LZ4: lz4.frame.compress}[compression]
    name = compression.name.lower()
    mebibyte = as_record(Channel(0, "mavlink/out", "", {}, 0), Message(0, 5, bytes(1 << 20), 5, 0))
    chunk = as_record(Chunk(name, pack(mebibyte), 0, 0, 0, len(mebibyte)))
    (tmp_path / "run.mcap").write_bytes(MCAP0_MAGIC + chunk * 100)
    assert (tmp_path / "run.mcap").stat().st_size < 500_000
    tracemalloc.start()
    try:
        line = refused(tmp_path / "run.mcap")
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert (
        line
        == f"{tmp_path / 'run.mcap'} unpacks to more than 100 times its size: damaged, or made to exhaust "
        "memory"
    )
    assert peak < 60_000_000


def test_a_length_that_no_computer_can_hold_is_damage(tmp_path: Path) -> None:
    strange = b"\x60" + (2**64 - 1).to_bytes(8, "little")  # a record of an unknown kind
    whole = written(tmp_path / "run.mcap").read_bytes()
    damaged = whole[: whole.rindex(b"\x0f" + (4).to_bytes(8, "little"))] + as_record(
        Chunk("", strange, 0, 0, 0, len(strange))
    )
    (tmp_path / "run.mcap").write_bytes(damaged)
    assert (read(tmp_path / "run.mcap").entries, read(tmp_path / "run.mcap").complete) == (ENTRIES, False)


def test_json_that_is_nested_without_end_stops_neither_the_recorder_nor_the_reader(tmp_path: Path) -> None:
    nested = b'{"a":' + b"[" * 100_000 + b"]" * 100_000 + b',"time_boot_ms":5}'
    clock = SimulationClock()
    entries = [
        Entry(key, 7, clock.time_s(key, nested, 7), nested) for key in ("belief", "agdc/stop", "health/uav")
    ]
    assert read(written(tmp_path / "run.mcap", entries)).entries == entries
