"""What is read from files: records, telemetry logs, mission scripts, bundles and rows of results. Each
decoder has one exception.
"""

import gzip
import io
import json
import struct
import tempfile
import zipfile
from functools import cache
from pathlib import Path

import msgspec
import numpy as np
import onnx
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata
from mcap.writer import MCAP0_MAGIC
from onnx import TensorProto, helper, numpy_helper

from agent import bundle
from agent.observation import SCHEMAS
from agent.planning.moves import Headings
from agent.trials.evaluate import read_csv
from agent.trials.figures import MissionRow
from ground.logs.survey import read as read_survey
from ground.tlog.flight import read as read_flight
from ground.tlog.frames import STAMP
from ground.view.wire import Sent, packed
from link.bus.mavlink import unpack_reading
from link.cli import BadInput
from link.record.reader import RecordError
from link.record.reader import read as read_record
from scene.follow.history import history_of
from scene.scene import Scene
from sitl.script.script import load, shipped
from tests.fuzz.mutants import as_sent
from tests.fuzz.services import BETWEEN, recorded
from tests.ground.logs.flights import Plume
from tests.ground.logs.flights import gasflux as write_gasflux
from tests.ground.logs.flights import skyhub as write_skyhub
from tests.ground.tlog.onboard_logs import Dataflash, ULog, flown, flown_by_px4

SHARED_MEMORY = Path("/dev/shm")
KEPT = tempfile.TemporaryDirectory(prefix="fuzz-", dir=SHARED_MEMORY if SHARED_MEMORY.is_dir() else None)
"""In memory where the system has that: each input is written to a file. It goes with the process."""
FOLDER = Path(KEPT.name)
LONGEST = 2000
"""Characters of a refusal."""


def written(name: str, data: bytes) -> Path:
    """A file with these bytes."""
    path = FOLDER / name
    path.write_bytes(data)
    return path


def _is_one_line(error: Exception, begin: str = "") -> None:
    text = str(error)
    assert text.startswith(begin)
    assert text
    assert len(text.splitlines()) == 1
    assert len(text) < LONGEST


def shows(scene: Scene) -> None:
    """A scene can be sent to the page."""
    packed(scene, Sent(), 1, 1, truth=True)


# ---- records ----


def _record(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())


@cache
def record_seeds() -> list[bytes]:
    """Return small records of real messages: in plain chunks, whose bytes can be changed, and in one
    packed with zstd.
    """
    import zstandard

    said = recorded("greedy-gaussian")
    about = {
        "format": "1",
        "seed": "3",
        "policy": "greedy",
        "budget": "300",
        "namespace": "uav/1",
        "mission": json.dumps(
            {"events": [{"do": "wind", "step": 2, "u": 2.0}, {"do": "wind", "time_s": 9.5, "phi": 1.0}]}
        ),
        "scenario": json.dumps(
            {
                "source": [12.0, 14.0],
                "q": 300.0,
                "u": 2.0,
                "phi": 1.0,
                "d": 4.0,
                "tau": 10.0,
                "start": [1.0, 2.0],
            }
        ),
    }
    topics = (
        "reading",
        "belief",
        "belief/particles",
        "mavlink/out",
        "mavlink/in",
        "agdc/stop",
        "health/uav",
        "health/uav/malformed",
    )
    channels = [Channel(number, topic, "", {}, 0) for number, topic in enumerate(topics)]
    belief, _, particles = said["belief"][2].partition(BETWEEN)
    timed = b',"simulation_s":1.5}'
    bodies = [
        said["reading"][0],
        belief[:-1] + timed,
        particles[:120],
        said["mavlink/out"][0],
        said["waypoint"][0],
        said["agdc/stop"][0][:-1] + timed,
        next(said[key][0] for key in said if key.startswith("health/"))[:-1] + timed,
        b'{"reason":"r","payload":"AAAA"' + timed,
    ]
    numbers = (0, 1, 1, 2, 3, 4, 5, 6)
    messages = [
        Message(channel, 5, body, 5, number)
        for channel, (body, number) in enumerate(zip(bodies, numbers, strict=True))
    ]
    inside = _record(*channels, *messages)
    head = MCAP0_MAGIC + _record(Metadata("plumeward", about))
    frame = zstandard.ZstdCompressor().compress(inside)
    return [
        head + _record(Chunk("", inside, 0, 0, 0, len(inside))),
        head + _record(*(part for pair in zip(channels, messages, strict=True) for part in pair)),
        head + _record(Chunk("zstd", frame, 0, 0, 0, len(inside))),
    ]


def record(data: bytes) -> None:
    """A record is read up to its damage or refused, and what was read can be followed and shown."""
    path = written("fuzzed.mcap", data)
    try:
        recording = read_record(path)
    except RecordError as error:
        _is_one_line(error)
        return
    history = history_of(recording)
    shows(history.at())
    shows(history.at(history.time_s / 2))


# ---- telemetry logs ----


@cache
def tlog_seeds() -> list[bytes]:
    from pymavlink.dialects.v20 import common as mavlink

    began_us = 1_700_000_000_000_000
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)

    def log(*times_s: float) -> bytes:
        data = b""
        for time_s in times_s:
            boot_ms = round(1000 * time_s)
            for message in (
                mavlink.MAVLink_heartbeat_message(2, 12, 128, 0, 4, 3),
                mavlink.MAVLink_local_position_ned_message(boot_ms, time_s, 2.0, -5.0, 0, 0, 0),
                mavlink.MAVLink_global_position_int_message(
                    boot_ms, 473977420 + boot_ms, 85455940, 493000, 5000, 0, 0, 0, 0
                ),
                mavlink.MAVLink_wind_cov_message(boot_ms * 1000, 1.0, 1.0, 0, 0, 0, 0, 0, 0),
                mavlink.MAVLink_named_value_float_message(boot_ms, b"gas", 0.5),
            ):
                data += struct.pack(">Q", began_us + boot_ms * 1000) + message.pack(mav)
        return data

    return [log(0.0, 1.0, 2.0), log(1.0, 2.0, 9.0, 1.5, 2.5), log(1.0)]


def tlog(data: bytes) -> None:
    """A log is read as a flight or refused."""
    try:
        flight = read_flight(written("fuzzed.tlog", as_sent(data, STAMP)))
    except BadInput as error:
        _is_one_line(error)
    else:
        assert flight.entries
        assert all(len(note.splitlines()) == 1 for note in flight.notes)


@cache
def dataflash_seeds() -> list[bytes]:
    return [flown().data[:5000], Dataflash().data]


@cache
def ulog_seeds() -> list[bytes]:
    return [flown_by_px4().data[:3000], ULog().data]


def onboard(data: bytes) -> None:
    """An on-board log is read as a flight or refused."""
    try:
        flight = read_flight(written("fuzzed.bin", data))
    except BadInput as error:
        _is_one_line(error)
    else:
        assert all(len(note.splitlines()) == 1 for note in flight.notes)


# ---- tables of flights of others ----


@cache
def table_seeds() -> list[bytes]:
    """Return short tables: both presets, one with semicolons and decimal commas, one in UTF-16."""
    flights = [
        "\n".join(write(FOLDER / "seed.csv", Plume()).read_text().splitlines()[:12])
        for write in (write_gasflux, write_skyhub)
    ]
    commas = flights[0].replace(",", ";").replace(".", ",")
    return [text.encode() for text in (*flights, commas)] + [flights[0].encode("utf-16")]


def table(data: bytes) -> None:
    """A table is read as a flight or refused."""
    try:
        flight = read_survey(written("fuzzed.csv", data))
    except BadInput as error:
        _is_one_line(error)
    else:
        assert flight.entries
        assert all(len(note.splitlines()) == 1 for note in flight.notes)
        readings = [unpack_reading(entry.payload) for entry in flight.entries if entry.key == "reading"]
        assert readings
        times = [reading.time_boot_ms for reading in readings]
        assert times == sorted(set(times))
        assert all(0 <= value <= flight.area_m for reading in readings for value in reading.position)


# ---- mission scripts ----


@cache
def script_seeds() -> list[bytes]:
    """Return short scripts, with all kinds of events among them; reading a long one takes long."""
    seeds = [
        b"seed: 3\nagent: {policy: homing}\nexpect: [located, returned home]\n",
        b"seed: 2\nevents:\n  - {step: 2, do: lose, readings: 3}\n  - {time_s: 6, do: wind, u: 1e0}\nexpect: "
        b"located\n",
        b"release: {source: [12.0, 9.5], q: 300}\nsensor: gaussian:0.3,0.2\nworld: as-modelled\nbudget: 40\n",
        b"a: &a [1, 2]\nb: *a\nc: {<<: {d: 1}}\n",
        b"events:\n  - {step: 0, do: lawnmower, low: [1, 1], high: [9, 9], spacing: 2}\nagent: {policy: "
        b"none}\n",
    ]
    root = Path(__file__).parents[2] / "missions"
    return seeds + [text for name in shipped() if len(text := (root / f"{name}.yaml").read_bytes()) < 300]


def script(data: bytes) -> None:
    """A script is read or refused in one line that names the file."""
    path = written("fuzzed.yaml", data)
    try:
        load(path)
    except BadInput as error:
        _is_one_line(error, f"{path}:")


# ---- bundles ----


def _page() -> bytes:
    page = bundle.Page(
        1,
        "by hand",
        "paper",
        SCHEMAS["paper"].version,
        5,
        Headings(4),
        3,
        {"a": [1]},
        [bundle.CurvePoint(1, 0.5, 0.5, None)],
        {},
    )
    return msgspec.json.encode(page)


@cache
def graph_seeds() -> list[bytes]:
    """Return small graphs: of a bundle, and with what a hostile one might use."""

    def port(name: str, *shape: int) -> onnx.ValueInfoProto:
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)

    def of(nodes: list[onnx.NodeProto], functions: list[onnx.FunctionProto] | None = None) -> bytes:
        weights = [
            numpy_helper.from_array(np.ones(shape, np.float32), name)
            for name, shape in (("w", (3, 5)), ("v", (4, 3)), ("c", (4,)))
        ]
        graph = helper.make_graph(nodes, "g", [port("o", 1, 5)], [port("s", 1, 4)], weights)
        imports = [helper.make_opsetid("", 17)]
        return bytes(
            helper.make_model(
                graph, opset_imports=imports, ir_version=8, functions=functions or []
            ).SerializeToString()
        )

    node = helper.make_node
    shipped_one = [
        node("Gemm", ["o", "w"], ["h"], transB=1),
        node("Tanh", ["h"], ["t"]),
        node("Gemm", ["t", "v", "c"], ["s"], transB=1),
    ]
    body = helper.make_graph([], "b", [], [])
    return [
        of(shipped_one),
        of([node("Gemm", ["o", "w"], ["h"], transA=1), node("ConstantOfShape", ["h"], ["s"])]),
        of([node("Loop", ["", "", "o"], ["s"], body=body), *shipped_one]),
        of(
            shipped_one,
            [
                helper.make_function(
                    "", "Relu", ["x"], ["y"], [node("Tanh", ["x"], ["y"])], [helper.make_opsetid("", 17)]
                )
            ],
        ),
    ]


def _zipped(page: bytes, graph: bytes, method: int = zipfile.ZIP_STORED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as members:
        for name, part in ((bundle.PAGE, page), (bundle.GRAPH, graph)):
            members.writestr(zipfile.ZipInfo(name), part, method)
    return file.getvalue()


def _loads(data: bytes) -> None:
    try:
        loaded = bundle.load(written("fuzzed.zip", data))
    except bundle.BundleError as error:
        _is_one_line(error)
    else:
        assert loaded.said(np.full(loaded.page.observation, 0.5, np.float32)).shape == (
            1,
            loaded.page.move.outputs,
        )


def bundle_seeds() -> list[bytes]:
    return [
        _zipped(_page(), graph_seeds()[0], method) for method in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
    ]


def graph(data: bytes) -> None:
    """A graph is refused in one line, or decides."""
    _loads(_zipped(_page(), data))


def page_of_bundle(data: bytes) -> None:
    """A page is refused in one line, or fits its graph."""
    _loads(_zipped(data, graph_seeds()[0]))


def page_of_bundle_seeds() -> list[bytes]:
    return [_page()]


def zipped(data: bytes) -> None:
    """A zip file is refused in one line, or is a bundle."""
    _loads(data)


# ---- rows of results ----


@cache
def rows_seeds() -> list[bytes]:
    results = Path(__file__).parents[2] / "results"
    with gzip.open(next(iter(sorted(results.glob("*.csv.gz")))), "rb") as file:
        plain = b"".join(file.readlines()[:4])
    return [b"\0" + plain, b"\1" + gzip.compress(plain, mtime=0)]


def rows(data: bytes) -> None:
    """Rows of missions are read or refused."""
    path = written("fuzzed.csv.gz" if data[:1] == b"\1" else "fuzzed.csv", data[1:])
    try:
        assert all(isinstance(row, MissionRow) for row in read_csv(path))
    except ValueError as error:
        _is_one_line(error, f"{path}: line ")
