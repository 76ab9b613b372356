"""Protects the input of a replay: a log that cannot be played gives one clear line before anything starts."""

import os
import re
from argparse import Namespace
from pathlib import Path

import pytest

from ground.replay.source import find
from link.bus.mavlink import Codec, Reading, pack_reading
from link.cli import BadInput
from link.record.record import Entry
from link.record.writer import Writer
from tests.link.record.test_record import written

FLAGS = {
    "connect": None,
    "ignore": [],
    "tolerance": 0.0,
    "verify": False,
    "loop": False,
    "from_s": 0.0,
    "to_s": 9e9,
    "namespace": None,
    "policy": None,
    "record": None,
    "given": {},
}


def refused(path: Path) -> str:
    with pytest.raises(BadInput) as error:
        find(Namespace(log=path, **FLAGS))
    assert "\n" not in str(error.value)
    return str(error.value)


def test_a_record_of_a_newer_format_is_refused_by_name(tmp_path: Path) -> None:
    log = written(tmp_path / "run.mcap")
    assert find(Namespace(log=log, **FLAGS))[0].entries
    log.write_bytes(log.read_bytes().replace(b"format\x01\x00\x00\x002", b"format\x01\x00\x00\x003"))
    assert (
        refused(log) == f"{log} has record format 3 of another plumeward version; readable formats: 0, 1, 2"
    )


def test_a_pipe_and_an_empty_file_are_refused_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "empty.mcap").write_bytes(b"")
    assert refused(tmp_path / "pipe") == f"{tmp_path / 'pipe'} is a pipe; wanted a file"
    assert refused(tmp_path / "empty.mcap").endswith(" is empty")


def test_json_that_is_nested_without_end_answers_nothing(tmp_path: Path) -> None:
    nested = b'{"a":' + b"[" * 100_000 + b"]" * 100_000 + b',"time_boot_ms":3000}'
    writer = Writer(tmp_path / "run.mcap", {})
    for entry in (
        Entry("health/uav", 1, 1.0, b"{}"),
        Entry("belief", 2, 1.0, nested),
        Entry("agdc/stop", 3, 1.0, nested),
    ):
        writer.write(entry, entry.published_ns)
    writer.close()
    source, _ = find(Namespace(log=tmp_path / "run.mcap", **FLAGS))
    assert source.then == {}


def told(folder: Path, **about: object) -> Path:
    """A record with a reading's vehicle and a belief, which describes itself so."""
    writer = Writer(folder / "run.mcap", about)
    for entry in (Entry("health/uav", 1, 1.0, b"{}"), Entry("belief", 2, 1.0, b'{"time_boot_ms":0}')):
        writer.write(entry, entry.published_ns)
    writer.close()
    return folder / "run.mcap"


def test_a_service_that_a_record_starts_with_more_than_settings_is_not_started(tmp_path: Path) -> None:
    log = told(tmp_path, parts={"estimator": ["--seed", "1"], "agent": ["evaluate", "--missions", "x.csv"]})
    source, _ = find(Namespace(log=log, **FLAGS))
    assert source.parts == {"estimator": ["--seed", "1", "--assume", "paper"]}
    assert source.notes == (
        f"warning: {log} starts its agent with 'x.csv', which a record may not do: replayed without it",
    )


def test_a_record_names_no_file_of_a_policy_but_its_user_does(tmp_path: Path) -> None:
    log = told(tmp_path, parts={"agent": ["--policy", "theirs.zip", "--seed", "3"]})
    source, _ = find(Namespace(log=log, **FLAGS))
    assert source.parts == {}
    assert source.notes[0].endswith(
        "with '--policy theirs.zip', which a record may not do; name the bundle with --policy: replayed "
        "without it"
    )
    assert find(Namespace(log=log, **FLAGS | {"policy": "mine.zip"}))[0].parts == {
        "agent": ["--seed", "3", "--policy", "mine.zip"]
    }


def test_a_bundle_for_a_record_that_flew_none_is_refused(tmp_path: Path) -> None:
    log = told(tmp_path, parts={"agent": ["--policy", "homing"]})
    with pytest.raises(BadInput, match="its agent flew no bundle"):
        find(Namespace(log=log, **FLAGS | {"policy": "mine.zip"}))


def test_a_record_does_not_choose_among_the_vehicles_of_a_users_bus(tmp_path: Path) -> None:
    log = told(tmp_path, namespace="uav/2")
    assert find(Namespace(log=log, **FLAGS))[0].namespace == "uav/2"
    there = FLAGS | {"connect": "tcp/127.0.0.1:1"}
    assert find(Namespace(log=log, **there))[0].namespace == "uav/1"
    assert find(Namespace(log=log, **there | {"namespace": "uav/2"}))[0].namespace == "uav/2"
    assert "its description cannot be used" in refused(told(tmp_path, namespace="uav/*"))


def test_behind_a_damaged_place_nothing_is_compared_but_all_is_replayed(tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    writer = Writer(log, {})
    for number in range(9):
        reading = pack_reading(Codec(1, 1), Reading(1000 * number, (3.0, 4.0), 5.0, (2.0, -1.0), 0.5))
        writer.write(Entry("reading", 10**9 * number, float(number), reading), 10**9 * number)
        belief = b'{"time_boot_ms":%d,"step":%d}' % (1000 * number, number)
        writer.write(Entry("belief", 10**9 * number + 5, float(number), belief), 10**9 * number + 5)
        writer.flush()
    writer.close()
    whole = bytearray(log.read_bytes())
    chunks = [match.start() for match in re.finditer(b"zstd", whole)]
    whole[chunks[4] + 20 : chunks[4] + 36] = bytes(16)  # the fifth
    log.write_bytes(whole)
    replayed, _ = find(Namespace(log=log, **FLAGS))
    assert [entry.simulation_s for entry in replayed.entries] == [0.0, 1.0, 2.0, 3.0, 5.0, 6.0, 7.0, 8.0]
    assert replayed.damaged
    assert "is damaged, and lacks " in replayed.notes[0]
    assert "--verify compares up to 3.00 s" in replayed.notes[0]
    verified, _ = find(
        Namespace(
            log=log, **FLAGS | {"verify": True, "ignore": ["belief.p_value"], "connect": "tcp/127.0.0.1:1"}
        )
    )
    assert [entry.simulation_s for entry in verified.entries] == [0.0, 1.0, 2.0, 3.0]
    assert sorted(verified.then) == [(time, "belief") for time in (0, 1000, 2000, 3000)]
