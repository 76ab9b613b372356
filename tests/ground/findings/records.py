"""Records for the tests of findings: golden ones, changed where a test says so."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import msgspec
from mcap.reader import make_reader
from mcap.writer import Writer as McapWriter

from ground.findings.figures import Findings, findings_of
from ground.findings.flight import flight_of
from link.bus.messages import Belief
from link.record.reader import read
from link.record.record import Entry
from link.record.writer import Writer

GOLDEN = Path(__file__).parents[2] / "golden"
FOUND = GOLDEN / "homing-gaussian-field.mcap"


def findings(path: Path = FOUND) -> Findings:
    flight = flight_of(path)
    assert flight
    return findings_of(flight)


def rewritten(
    path: Path,
    change: Callable[[Entry], Entry | None] = lambda entry: entry,
    about: Mapping[str, Any] | None = None,
    record: Path = FOUND,
) -> Path:
    """Write a copy of a record with entries changed (None: removed), and with another description."""
    recording = read(record)
    writer = Writer(path, dict(recording.about if about is None else about))
    for entry in filter(None, map(change, recording.entries)):
        writer.write(entry, entry.published_ns)
    writer.close()
    return path


def believing(change: Callable[[Belief], Belief]) -> Callable[[Entry], Entry]:
    """Change the last beliefs of a record: those that have ceased."""

    def changed(entry: Entry) -> Entry:
        if entry.key != "belief":
            return entry
        said = msgspec.json.decode(entry.payload, type=Belief)
        return entry._replace(payload=msgspec.json.encode(change(said)))

    return changed


def of_format(path: Path, written: int | None, record: Path = FOUND) -> Path:
    """Write a copy of a record as an older version did: with its format number, None for none, and with the
    agent's setpoints on mavlink/in.
    """
    with record.open("rb") as source, path.open("wb") as target:
        reader, writer = make_reader(source), McapWriter(target)
        writer.start()
        summary = reader.get_summary()
        assert summary
        channels: dict[int, int] = {}
        schemas = {0: 0} | {
            schema.id: writer.register_schema(schema.name, schema.encoding, schema.data)
            for schema in summary.schemas.values()
        }
        for metadata in reader.iter_metadata():
            told = {name: text for name, text in metadata.metadata.items() if name != "format"}
            if written is not None:
                told["format"] = str(written)
            writer.add_metadata(metadata.name, told)
        for _, channel, message in reader.iter_messages():
            topic = (
                channel.topic.replace("waypoint", "mavlink/in", 1)
                if channel.topic == "waypoint"
                else channel.topic
            )
            if channel.id not in channels:
                channels[channel.id] = writer.register_channel(
                    topic, channel.message_encoding, schemas[channel.schema_id], channel.metadata
                )
            writer.add_message(
                channels[channel.id], message.log_time, message.data, message.publish_time, message.sequence
            )
        writer.finish()
    return path
