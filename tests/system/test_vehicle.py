"""Protects whole missions on a real autopilot, of which a double takes the place: flown, recorded,
replayed, and ended in mid-air.
"""

import json
import math
import re
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest

from aircraft.search.options import parse_wind
from ground.tlog import flight as tlog
from link.bus.mavlink import split, unpack, unpack_reading
from link.record.reader import read
from link.record.record import Entry
from plume.scenario import draw
from tests.autopilots.settings import Settings
from tests.autopilots.wire import Double
from tests.system.conftest import Part
from tests.system.live import run_sitl
from tests.system.wires import SerialWire

SPEEDUP = 2.0
"""With more, a busy machine keeps an autopilot waiting for so long that links are lost and motors stop."""
PATIENT = (("COM_OF_LOSS_T", 10.0),)
"""PX4 wants setpoints all the time: so late may its companion be on a busy machine, s of simulation time."""
DRAG = (("EK3_DRAG_MCOEF", 0.1),)
"""With a model of its drag an ArduCopter estimates the wind."""
SEED = 7
SHORT = ("--seed", str(SEED), "--particles", "100", "--budget", "2", "--json", "--trace")


@pytest.fixture
def ardupilot() -> Iterator[Double]:
    """An ArduCopter over TCP, system 32, ready to fly 12 s after its boot, that says it feels a wind of 2
    m/s from the east.
    """
    with Double(
        "ardupilot",
        settings=Settings(instance=31, ready_s=12.0, wind=(90.0, 2.0), parameters=DRAG),
        speedup=SPEEDUP,
    ) as double:
        yield double


@pytest.fixture
def px4() -> Iterator[Double]:
    """A PX4 over UDP that says nothing about the wind."""
    with Double("px4", "udpin:127.0.0.1:0", Settings(ready_s=12.0, parameters=PATIENT), SPEEDUP) as double:
        yield double


def replayed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], record: Path) -> dict:
    status, out, err = run_sitl(
        monkeypatch, capsys, "replay", str(record), "--verify", "--speedup", "0", "--json"
    )
    assert status == 0, err
    return json.loads(out[-1])


def by_hand(x: float, y: float, wind: tuple[float, float]) -> float:
    """The mean concentration of the mission's plume, Vergassola et al. 2007, eq. (S5), g/m³."""
    s = draw(SEED)
    east, north, u = x - s.source[0], y - s.source[1], math.hypot(*wind)
    r = math.hypot(east, north)
    decay = math.sqrt(s.d * s.tau / (1 + u * u * s.tau / (4 * s.d)))
    return (
        s.q / (4 * math.pi * s.d * r) * math.exp(-r / decay - (east * wind[0] + north * wind[1]) / (2 * s.d))
    )


def test_a_mission_on_ardupilot_reads_the_plume_where_it_reports_to_be_in_the_wind_that_it_reports_and_replays(
    start: type[Part],
    ardupilot: Double,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = ("--sensor", "gaussian:0,0.000001", "--record", "flight.mcap")  # a sensor with next to no noise
    flight = start(
        "sitl", "fly", "--vehicle", ardupilot.url, "--speedup", f"{SPEEDUP:g}", *SHORT, *words, cwd=tmp_path
    )
    assert flight.ended() == 0, "".join(flight.err)
    said = json.loads(flight.out[-1])
    assert (said["ceased"], said["steps"], said["located"]) == (False, 2, False)
    assert said["source"] == pytest.approx(draw(SEED).source)
    for step in said["trace"]:
        assert step["reading"] == pytest.approx(by_hand(*step["position"], (2.0, 0.0)), rel=1e-4, abs=1e-4)
    assert math.dist(said["trace"][0]["position"], draw(SEED).start) < 0.5
    assert not ardupilot.wire.autopilot.armed  # it has landed at home
    record = read(tmp_path / "flight.mcap")
    about = record.about
    assert (about["vehicle"], about["payload"]) == (ardupilot.url, "simulated")
    assert not any("--sysid" in words for words in about["parts"].values())
    shows_the_autopilot_as_it_was(record.entries, ardupilot)
    mission = dict.fromkeys(
        unpack_reading(entry.payload)
        for entry in read(tmp_path / "flight.mcap").entries
        if entry.key == "reading"
    )
    again = [
        unpack_reading(entry.payload)
        for entry in tlog.read(tmp_path / "flight.tlog").entries
        if entry.key == "reading"
    ]
    assert again == [*mission]
    verified = replayed(monkeypatch, capsys, tmp_path / "flight.mcap")
    assert (verified["verified"], verified["beliefs"], verified["waypoints"]) == (True, 3, 2)
    assert verified["estimate"] == said["estimate"]


def shows_the_autopilot_as_it_was(entries: list[Entry], double: Double) -> None:
    """The record has the autopilot's own frames, and readings by its clock where it said to be then."""
    frames = [f.data for entry in entries if entry.key == "mavlink/out" for f in split(entry.payload)]
    own = [frame for frame in frames if frame[6] == 1]
    assert len(own) > 100
    assert {(frame[5], frame[6]) for frame in frames} == {(32, 1), (32, 191)}
    assert set(own) <= set(double.wire.said)
    kinds = [(message.get_type(), message) for frame in double.wire.said for message in unpack(frame)]
    places = {
        said.time_boot_ms: (said.x, said.y, said.z) for kind, said in kinds if kind == "LOCAL_POSITION_NED"
    }
    readings = {entry.payload: entry for entry in entries if entry.key == "reading"}
    for entry in readings.values():
        place, _, _ = unpack(entry.payload)
        assert (place.get_srcSystem(), place.get_srcComponent()) == (32, 191), (
            "the autopilot did not say it: it is in another frame"
        )
        there = (
            at + home
            for at, home in zip((place.x, place.y, place.z), double.wire.autopilot.settings.home, strict=True)
        )
        assert math.dist(there, places[place.time_boot_ms]) < 0.02, (
            "home is told in 1e-7 degrees, which are 0.01 m"
        )
        assert entry.simulation_s == place.time_boot_ms / 1000
    gas = [
        (said.time_boot_ms, said.name)
        for frame in frames
        for said in unpack(frame)
        if said.get_type() == "NAMED_VALUE_FLOAT"
    ]
    assert gas == [(unpack_reading(payload).time_boot_ms, "gas") for payload in readings]
    systems = [msgspec.json.decode(entry.payload)["system"] for entry in entries if entry.key == "health/uav"]
    assert [*dict.fromkeys(systems)] == [0, 32]
    assert {unpack(entry.payload)[0].target_system for entry in entries if entry.key == "waypoint"} == {32}


@pytest.mark.full
def test_a_mission_on_px4_with_a_sensor_on_a_serial_line_claims_nothing_about_a_source_that_nobody_knows(
    start: type[Part],
    px4: Double,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    wait_until: Callable[..., None],
) -> None:
    sensor = f"serial:{tmp_path / 'sensor'}:9600"
    with SerialWire(tmp_path / "sensor") as wire:
        words = ("--payload", sensor, "--wind", "2.5,270", "--record", "flight.mcap")
        flight = start(
            "sitl", "fly", "--vehicle", px4.url, "--speedup", f"{SPEEDUP:g}", *SHORT, *words, cwd=tmp_path
        )

        def over() -> bool:
            wire.say(b"0.25\n")
            return flight.process.poll() is not None

        wait_until(over)
    assert flight.ended() == 0, "".join(flight.err)
    said = json.loads(flight.out[-1])
    assert [said[name] for name in ("located", "error_m", "source", "scenario")] == [None] * 4
    assert [step["reading"] for step in said["trace"]] == [0.25] * 3
    entries = read(tmp_path / "flight.mcap").entries
    assert {unpack_reading(entry.payload).wind for entry in entries if entry.key == "reading"} == {
        parse_wind("2.5,270")
    }
    assert not any(line.startswith("source") for line in flight.err)
    about = read(tmp_path / "flight.mcap").about
    assert "scenario" not in about
    assert about["payload"] == sensor
    estimator = about["parts"]["estimator"]
    assert not {"--rate", "--diffusivity", "--lifetime"} & set(estimator)  # nobody knows them
    assert replayed(monkeypatch, capsys, tmp_path / "flight.mcap")["verified"]
    for words in (("log",), ("draw", "--out", str(tmp_path / "flight.svg"))):
        status, _, err = run_sitl(monkeypatch, capsys, words[0], str(tmp_path / "flight.mcap"), *words[1:])
        assert status == 0, err
    (summary,) = (tmp_path / "runs").glob("*.json")
    assert json.loads(summary.read_text())["outcome"]["source"] is None


def test_ctrl_c_in_mid_air_sends_the_vehicle_home_before_the_parts_end(
    start: type[Part], ardupilot: Double, tmp_path: Path, wait_until: Callable[..., None]
) -> None:
    flight = start(
        "sitl",
        "fly",
        "--vehicle",
        ardupilot.url,
        "--speedup",
        f"{SPEEDUP:g}",
        *SHORT,
        "--budget",
        "300",
        "--no-record",
        cwd=tmp_path,
    )
    flight.comes_to("step   0/300")
    flight.process.send_signal(signal.SIGINT)
    assert flight.ended() == 130
    autopilot = ardupilot.wire.autopilot
    wait_until(lambda: not autopilot.armed)
    assert not flight.says("hangs and is killed")
    assert flight.says("interrupted")
    assert flight.says("uav: warning: The vehicle is told to return home")
    assert flight.says("Check: battery: ok, 100%"), "shown whatever the level of the log"


@pytest.mark.full
def test_without_a_simulator_it_ends_when_the_wait_is_over_and_says_what_was_missing(
    start: type[Part], tmp_path: Path
) -> None:
    words = ("--particles", "100", "--no-record", "--wait", "5")
    flight = start("sitl", "fly", "--vehicle", "tcp:127.0.0.1:1", *words, cwd=tmp_path)
    assert flight.ended() == 1
    # A busy machine may not have got round to ask there.
    missing = "no HEARTBEAT at tcp:127.0.0.1:1 \\((Connection refused|not yet connected)"
    assert re.search(f"the search has not begun in 5 s \\(--wait\\): {missing}", flight.err[-1])
    assert flight.says("Check: vehicle: not ok, no HEARTBEAT")
    assert not [*tmp_path.iterdir()]


@pytest.mark.full
def test_a_vehicle_that_is_not_ready_keeps_the_mission_waiting_and_the_reason_is_shown(
    start: type[Part], tmp_path: Path, wait_until: Callable[..., None]
) -> None:
    with Double("ardupilot", settings=Settings(ready_s=100_000.0), speedup=SPEEDUP) as double:
        words = ("--patience", "5", "--no-record")  # shorter than the wait
        flight = start(
            "sitl", "fly", "--vehicle", double.url, "--speedup", f"{SPEEDUP:g}", *SHORT, *words, cwd=tmp_path
        )
        wait_until(lambda: flight.says("Waiting for the autopilot"))
        began = double.wire.autopilot.now_s
        wait_until(lambda: double.wire.autopilot.now_s - began > 7 * SPEEDUP)
        assert flight.process.poll() is None
        flight.process.send_signal(signal.SIGINT)
        assert flight.ended() == 130
        assert not double.wire.autopilot.armed


REFUSED = {
    (
        "--payload",
        "simulated",
    ): "--payload: only with --vehicle; the simulated vehicle has a sensor of its own",
    (
        "--vehicle",
        "tcp:127.0.0.1",
    ): "--vehicle: 'tcp:127.0.0.1' is not a MAVLink endpoint; wanted udpin:HOST:PORT, ",
    (
        "--vehicle",
        "tcp:127.0.0.1:9",
        "--payload",
        "serial",
    ): "--payload: 'serial' is not allowed; wanted serial:PATH[:BAUD]",
    ("--vehicle", "tcp:127.0.0.1:9", "--speedup", "0"): "--speedup: 0 is not allowed with --vehicle; wanted ",
    ("--vehicle", "tcp:127.0.0.1:9", "--home", "1,2,3,4"): "--home: not with --vehicle: ",
    ("--vehicle", "tcp:127.0.0.1:9", "--strict"): "--strict: not with --vehicle: ",
    ("--wind", "3,270"): "--wind: only with --vehicle; the simulated vehicle's wind is the mission's",
    ("--wait", "5"): "--wait: only with --vehicle; the simulated vehicle is there at once",
    (
        "--vehicle",
        "tcp:127.0.0.1:9",
        "--wait",
        "0",
    ): "--wait: '0' is not allowed; wanted a number above 0 up to inf",
    (
        "--vehicle",
        "tcp:127.0.0.1:9",
        "--wait",
        "soon",
    ): "--wait: 'soon' is not allowed; wanted a number above 0 up to inf",
    (
        "--vehicle",
        "tcp:127.0.0.1:9",
        "--wind",
        "fast",
    ): "--wind: 'fast' is not allowed; wanted SPEED,FROM: m/s from 0 to 100, and ",
    ("wind-shift", "--vehicle", "tcp:127.0.0.1:9"): "MISSION: a wind event is not allowed with --vehicle: ",
    (
        "flat-battery",
        "--vehicle",
        "tcp:127.0.0.1:9",
    ): "MISSION: vehicle.endurance_s is not allowed with --vehicle: ",
    (
        "--vehicle",
        "tcp:127.0.0.1:9",
        "--payload",
        "serial:/x",
        "--world",
        "wind-10",
    ): "--world: 'wind-10' is not allowed with --payload ",
    ("default-release", "--vehicle", "tcp:127.0.0.1:9", "--payload", "serial:/dev/x"): "MISSION: ",
}


@pytest.mark.parametrize("words", REFUSED, ids=" ".join)
def test_what_cannot_be_flown_is_refused_in_one_line_before_anything_starts(
    words: tuple[str, ...],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    status, out, err = run_sitl(monkeypatch, capsys, "fly", *words)
    assert (status, out, len(err)) == (2, [], 1)
    assert f"error: {REFUSED[words]}" in err[0]
    assert not [*tmp_path.iterdir()]
