"""Protects the replay: a log in place of the vehicle gets the same answers bit for bit, and any difference
is found and named.
"""

import json
import math
import os
import signal
import struct
import subprocess
import sys
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from ground.tlog import flight
from link.bus.mavlink import split, unpack_reading
from link.record.reader import read
from link.record.record import Entry
from link.record.writer import Writer
from plume.outcome import UNITS
from tests.golden.__main__ import path as golden
from tests.system.live import Services, run_sitl
from tests.system.stranger import Stranger

STEP = 7
"""The reading whose answers are tampered with."""


def said(log: Path, key: str) -> list[dict[str, Any]]:
    """The JSON messages of a key in a log, each repeated message once."""
    messages = [json.loads(entry.payload) for entry in read(log).entries if entry.key == key]
    return list({message["time_boot_ms"]: message for message in messages}.values())


def waypoints(log: Path) -> dict[int, Any]:
    """The waypoints in a log, by the time of the reading that each answers."""
    frames = [
        m
        for entry in read(log).entries
        if entry.key == "waypoint"
        for m in mavlink.MAVLink(None).parse_buffer(entry.payload)
    ]
    return {m.time_boot_ms: m for m in frames if m.get_type() == "SET_POSITION_TARGET_LOCAL_NED"}


def rewritten(
    log: Path,
    path: Path,
    change: Callable[[Entry], Entry | None] = lambda entry: entry,
    about: Mapping[str, Any] | None = None,
    flush_every: int = 1_000_000,
) -> Path:
    """Write a copy of a log with entries changed (None: removed), and with another description of itself."""
    recording = read(log)
    writer = Writer(path, dict(recording.about if about is None else about))
    for number, entry in enumerate(
        filter(None, map(change, sorted(recording.entries, key=lambda entry: entry.published_ns))), start=1
    ):
        writer.write(entry, entry.published_ns)
        if number % flush_every == 0:
            writer.flush()
    writer.close()
    return path


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The record of one mission up to its stop, and its .tlog beside it. What a busy machine had it say
    again is left out.
    """
    ends_s = max(
        entry.simulation_s for entry in read(golden("infotaxis-gaussian")).entries if entry.key == "reading"
    )
    heard: set[bytes] = set()

    def once(entry: Entry) -> Entry | None:
        again = entry.key in ("reading", "belief") and entry.payload in heard
        heard.add(entry.payload)
        return None if again or entry.simulation_s > ends_s else entry

    return rewritten(golden("infotaxis-gaussian"), tmp_path_factory.mktemp("recorded") / "flown.mcap", once)


def with_flag(log: Path, part: str, flag: str, value: str) -> dict[str, Any]:
    """A log's description of itself with another value for a flag of a service."""
    about = read(log).about
    words = list(about["parts"][part])
    words[words.index(flag) + 1] = value
    return {**about, "parts": {**about["parts"], part: words}}


def json_changed(key: str, step: int, **changes: object) -> Callable[[Entry], Entry]:
    def change(entry: Entry) -> Entry:
        if entry.key != key or json.loads(entry.payload)["step"] != step:
            return entry
        return entry._replace(payload=json.dumps({**json.loads(entry.payload), **changes}).encode())

    return change


def from_the_first_reading(log: Path) -> tuple[str, str]:
    """Flags that skip the vehicle's messages on the ground."""
    entries = read(log).entries
    first = next(entry for entry in entries if entry.key == "reading")
    return "--from", repr(first.simulation_s - entries[0].simulation_s - 0.001)


def services_of(log: Path, start: Callable, router: str) -> dict[str, Any]:
    """Start the services of a log on a router."""
    parts = read(log).about["parts"]
    return {part: start(part, "--connect", router, *words) for part, words in parts.items()}


class Verify:
    """Replays logs with --verify to fresh services."""

    def __init__(
        self, router: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        self._router, self._monkeypatch, self._capsys = router, monkeypatch, capsys

    def _replay(self, log: Path, *flags: str) -> tuple[int, list[str], dict[str, Any]]:
        with Services(self._monkeypatch, self._router) as services:
            services.start(read(log).about["parts"])
            chosen = ("--verify", "--speedup", "0", "--json", "--connect", self._router, *flags)
            status, out, err = run_sitl(self._monkeypatch, self._capsys, "replay", str(log), *chosen)
        assert [line.split(": ")[0] for line in err].count("verified" if status == 0 else "differs") == 1, err
        return status, err, json.loads(out[-1])

    def passes(self, log: Path, *flags: str) -> tuple[list[str], dict[str, Any]]:
        """Expect success; returns the lines for people and the JSON."""
        status, err, result = self._replay(log, *flags)
        assert (status, result["verified"], result["difference"]) == (0, True, None), err[-2:]
        return err, result

    def fails(self, log: Path, *flags: str) -> tuple[str, dict[str, Any]]:
        """Expect a difference; returns the lines for people and the JSON."""
        status, err, result = self._replay(log, *flags)
        assert (status, result["verified"]) == (1, False)
        return next(line for line in err if line.startswith("differs: ")).removeprefix("differs: "), result[
            "difference"
        ]


@pytest.fixture
def verify(router: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Verify:
    return Verify(router, monkeypatch, capsys)


@pytest.fixture
def refusal(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Run `replay arguments`, which must be refused; returns the one error line."""

    def refused(*arguments: str) -> str:
        status, out, err = run_sitl(monkeypatch, capsys, "replay", *arguments)
        assert (status, out, len(err)) == (2, [], 1), err
        return err[0]

    return refused


class TestVerify:
    """`replay --verify`."""

    @pytest.mark.parametrize("speedup", ["0", pytest.param("3", marks=pytest.mark.full)])
    def test_a_recorded_mission_says_the_same_again_at_any_pace(self, start, log: Path, speedup: str) -> None:
        replay = start("sitl", "replay", str(log), "--verify", "--speedup", speedup, "--json")
        assert replay.ended() == 0
        beliefs, stops = said(log, "belief"), said(log, "agdc/stop")
        assert beliefs[-1]["ceased"]
        assert len(stops) == 1
        steps = len(beliefs) - 1
        assert replay.err[-2:] == [
            "assumed  paper, stop spread:0.5\n",
            f"verified: {steps + 1} beliefs, 1 stop, {steps} waypoints\n",
        ]
        source = read(log).about["scenario"]["source"]
        assert json.loads(replay.out[-1]) == {
            "verified": True,
            "beliefs": steps + 1,
            "stops": 1,
            "waypoints": steps,
            "difference": None,
            "ceased": True,
            "estimate": stops[0]["estimate"],
            "spread_m": stops[0]["spread"],
            "error_m": pytest.approx(math.dist(stops[0]["estimate"], source), rel=1e-12),
            "assume": "paper",
            "stop": "spread:0.5",
            "world": "as-modelled",
            "outside_share": 0.0,
            "intermittency": {},
            "advised_dwell_s": None,
            "latitude_deg": pytest.approx(47.3979, abs=5e-4),
            "longitude_deg": pytest.approx(8.5458, abs=5e-4),
            "covariance_m2": beliefs[-1]["covariance"],
            "rate_gs": beliefs[-1]["rate"],
            "rate_interval_gs": None,  # paper takes it to be known
            "units": dict(UNITS),
        }

    def test_a_changed_field_of_a_belief_is_named_with_both_values(
        self, verify: Verify, log: Path, tmp_path: Path
    ) -> None:
        belief = said(log, "belief")[STEP]
        x, y = belief["mean"]
        tampered = rewritten(
            log, tmp_path / "tampered.mcap", json_changed("belief", STEP, mean=[x, y + 0.25])
        )
        text, found = verify.fails(tampered)
        time_s = belief["time_boot_ms"] / 1000
        assert text == f"belief at {time_s:.2f} s (step {STEP}): mean[1] was {y + 0.25!r}, is {y!r}"
        assert found == {
            "key": "belief",
            "time_s": time_s,
            "step": STEP,
            "field": "mean[1]",
            "was": y + 0.25,
            "is": y,
        }
        verify.passes(tampered, "--ignore", "belief.mean")
        err, _ = verify.passes(tampered, "--tolerance", "0.26")
        assert "waypoints (within 0.26)" in err[-1]

    def test_one_bit_of_one_particle_is_found(self, verify: Verify, log: Path, tmp_path: Path) -> None:
        def is_it(entry: Entry) -> bool:
            return entry.key == "belief" and json.loads(entry.payload)["step"] == STEP

        def change(entry: Entry) -> Entry:
            cloud = bytearray(entry.attachment)
            if is_it(entry):
                cloud[12 * 30 + 4] ^= 1  # a byte of the 31st particle's y
            return entry._replace(attachment=bytes(cloud))

        tampered = rewritten(log, tmp_path / "tampered.mcap", change)
        text, found = verify.fails(tampered)
        assert f"(step {STEP}): particles[30][1] was " in text
        clouds = [
            next(entry.attachment for entry in read(path).entries if is_it(entry)) for path in (tampered, log)
        ]
        assert [struct.pack("<f", found[side]) for side in ("was", "is")] == [
            cloud[364:368] for cloud in clouds
        ]
        verify.passes(tampered, "--ignore", "particles")

    def test_a_changed_stop_is_found(self, verify: Verify, log: Path, tmp_path: Path) -> None:
        (stop,) = said(log, "agdc/stop")
        tampered = rewritten(
            log, tmp_path / "tampered.mcap", json_changed("agdc/stop", stop["step"], spread=0.125)
        )
        time_s, step = stop["time_boot_ms"] / 1000, stop["step"]
        assert (
            verify.fails(tampered)[0]
            == f"stop at {time_s:.2f} s (step {step}): spread was 0.125, is {stop['spread']!r}"
        )

    def test_a_stop_that_was_not_there_then_is_found(self, verify: Verify, log: Path, tmp_path: Path) -> None:
        (stop,) = said(log, "agdc/stop")
        text, found = verify.fails(
            rewritten(
                log, tmp_path / "tampered.mcap", lambda entry: None if entry.key == "agdc/stop" else entry
            )
        )
        assert f"(step {stop['step']}): it was none, is estimate [" in text
        assert (found["key"], found["was"], found["is"]) == (
            "agdc/stop",
            None,
            {"estimate": stop["estimate"]},
        )

    def test_a_changed_waypoint_is_found(self, verify: Verify, log: Path, tmp_path: Path) -> None:
        time_boot_ms = said(log, "belief")[STEP]["time_boot_ms"]
        north = waypoints(log)[time_boot_ms].x

        def change(entry: Entry) -> Entry:
            if entry.key != "waypoint":
                return entry
            (message,) = mavlink.MAVLink(None).parse_buffer(entry.payload)
            if message.time_boot_ms != time_boot_ms:
                return entry
            message.x = north + 0.5
            return entry._replace(
                payload=bytes(message.pack(mavlink.MAVLink(None, srcSystem=1, srcComponent=191)))
            )

        text, found = verify.fails(rewritten(log, tmp_path / "tampered.mcap", change))
        assert text.startswith(f"waypoint at {time_boot_ms / 1000:.2f} s (step {STEP}): x was ")
        assert (found["was"], found["is"]) == (pytest.approx(north + 0.5), pytest.approx(north))

    @pytest.mark.parametrize(
        ("part", "flag", "value", "kinds"),
        [
            (
                "estimator",
                "--seed",
                "5",
                ("belief at ", "waypoint at "),
            ),  # both of one reading: the smaller may come first
            (
                "estimator",
                "--stop",
                "spread:2.0",
                ("stop at ", "belief at "),
            ),  # both of one reading, in either order
            ("agent", "--seed", "5", ("waypoint at ",)),
        ],
    )
    def test_services_that_are_not_what_they_were_are_found_out(
        self,
        verify: Verify,
        log: Path,
        tmp_path: Path,
        part: str,
        flag: str,
        value: str,
        kinds: tuple[str, ...],
    ) -> None:
        text, _ = verify.fails(
            rewritten(log, tmp_path / "changed.mcap", about=with_flag(log, part, flag, value))
        )
        assert text.startswith(kinds)

    def test_an_answer_that_does_not_come_any_more_is_a_difference(
        self, verify: Verify, log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("ground.replay.player.ANSWER_TIMEOUT_S", 1.0)
        changed = rewritten(
            log, tmp_path / "changed.mcap", about=with_flag(log, "agent", "--budget", str(STEP))
        )
        text, found = verify.fails(changed)
        assert found["time_s"] == said(log, "belief")[STEP]["time_boot_ms"] / 1000
        assert text.startswith(f"waypoint at {found['time_s']:.2f} s (step {STEP}): it was x ")
        assert text.endswith(", is none")

    def test_a_log_that_was_cut_off_verifies_up_to_where_it_ends(
        self, verify: Verify, log: Path, tmp_path: Path
    ) -> None:
        whole = rewritten(log, tmp_path / "whole.mcap", flush_every=20).read_bytes()
        cut = tmp_path / "cut.mcap"
        cut.write_bytes(whole[: len(whole) // 2])
        err, result = verify.passes(cut)
        assert f"replay: {cut} is cut off: replayed up to its end at " in "".join(err)
        readings = {
            mavlink.MAVLink(None).parse_buffer(entry.payload)[0].time_boot_ms
            for entry in read(cut).entries
            if entry.key == "reading"
        }
        answered = {belief["time_boot_ms"] for belief in said(cut, "belief")} & readings
        assert 0 < len(readings) < len(said(log, "belief"))
        # Readings whose answer was cut off are not waited for.
        assert len(answered) <= result["beliefs"] <= len(readings)

    @pytest.mark.full
    def test_a_mission_whose_services_crashed_is_answered_as_if_they_had_not(
        self, verify: Verify, tmp_path: Path
    ) -> None:
        flown = tmp_path / "crashed.mcap"
        script = str(Path(__file__).parents[2] / "missions" / "crashing-services.yaml")
        # Few particles: large beliefs may be lost to the recorder, cut off by the kill or in the burst after
        # the restart.
        mission = [
            sys.executable,
            "-m",
            "sitl",
            "fly",
            script,
            "--particles",
            "300",
            "--speedup",
            "0",
            "--record",
            str(flown),
        ]
        subprocess.run(mission, check=True, cwd=tmp_path, timeout=400, capture_output=True)
        _, result = verify.passes(flown)
        assert result["beliefs"] == len(said(flown, "belief"))

    def test_it_verifies_a_part_from_the_beginning(self, verify: Verify, log: Path) -> None:
        end_s = said(log, "belief")[STEP]["time_boot_ms"] / 1000 - read(log).entries[0].simulation_s
        err, _ = verify.passes(log, "--to", repr(end_s + 0.001))
        assert err[-1] == f"verified: {STEP + 1} beliefs, 0 stops, {STEP + 1} waypoints"


class TestReplay:
    """`replay` without `--verify`."""

    @pytest.mark.full
    def test_a_part_of_the_flight_is_a_search_of_its_own(self, start, log: Path) -> None:
        times_s = [
            belief["time_boot_ms"] / 1000 - read(log).entries[0].simulation_s
            for belief in said(log, "belief")
        ]
        part = ("--from", repr(times_s[4] - 0.001), "--to", repr(times_s[10] + 0.001))
        replay = start("sitl", "replay", str(log), "--speedup", "0", "--json", *part)
        assert replay.ended() == 0
        result = json.loads(replay.out[-1])
        assert (result["verified"], result["beliefs"], result["waypoints"], result["stops"]) == (
            None,
            7,
            7,
            0,
        )

    @pytest.mark.full
    def test_it_keeps_the_recorded_pace(self, start, log: Path) -> None:
        entries = [entry for entry in read(log).entries if entry.key == "reading"]
        took_s = (entries[-1].published_ns - entries[0].published_ns) / 1e9
        replay = start(
            "sitl", "replay", str(log), *from_the_first_reading(log), "--speedup", repr(took_s / 3)
        )
        assert replay.ended() == 0
        said_s = float(next(line for line in replay.out if line.startswith("replayed in ")).split()[2])
        assert said_s > 3

    def test_it_ends_when_a_service_of_its_own_is_killed(
        self, start, family, wait_until: Callable, log: Path
    ) -> None:
        replay = start("sitl", "replay", str(log), *from_the_first_reading(log), "--speedup", "0.01")
        wait_until(lambda: replay.says("step   0"))
        pids = family(replay.process.pid)
        assert sorted(pids) == ["agent", "estimator", "router"]
        os.kill(pids["estimator"], signal.SIGKILL)
        assert replay.ended() == 1
        assert replay.err[-1].startswith("error: estimator was killed by signal 9; its last words: ")
        assert not any(Path(f"/proc/{pid}").exists() for pid in pids.values())

    def test_ctrl_c_ends_all_of_it_and_leaves_nothing(
        self, start, family, wait_until: Callable, log: Path
    ) -> None:
        replay = start("sitl", "replay", str(log), *from_the_first_reading(log), "--speedup", "0.01")
        wait_until(lambda: replay.says("step   0"))
        pids = family(replay.process.pid)
        replay.process.send_signal(signal.SIGINT)
        assert replay.ended() == 130
        assert replay.err[-1] == "interrupted\n"
        assert not any(Path(f"/proc/{pid}").exists() for pid in pids.values())

    @pytest.mark.full
    def test_a_loop_verifies_each_round_until_it_is_interrupted(
        self, start, wait_until: Callable, log: Path
    ) -> None:
        replay = start("sitl", "replay", str(log), "--speedup", "0", "--loop", "--verify")
        wait_until(lambda: sum(line.startswith("verified: ") for line in replay.out) >= 2)
        replay.process.send_signal(signal.SIGINT)
        assert replay.ended() == 130

    def test_a_loop_ends_with_the_first_difference(self, start, log: Path, tmp_path: Path) -> None:
        tampered = rewritten(log, tmp_path / "tampered.mcap", json_changed("belief", 0, spread=1.0))
        replay = start("sitl", "replay", str(tampered), "--speedup", "0", "--loop", "--verify")
        assert replay.ended() == 1
        assert sum(line.startswith("differs: ") for line in replay.out) == 1


class TestOnAnotherBus:
    """`replay --connect`."""

    @pytest.mark.full
    def test_it_waits_for_the_services_and_a_restarted_one_catches_up_to_the_same_bits(
        self, start, router: str, wait_until: Callable, log: Path
    ) -> None:
        replay = start("sitl", "replay", str(log), "--connect", router, "--verify", "--speedup", "0.3")
        wait_until(lambda: replay.says("waiting for agent and estimator on uav/1"))
        running = services_of(log, start, router)
        wait_until(lambda: replay.says("step  10"))
        for service in running.values():
            service.kill()
        services_of(log, start, router)
        assert replay.ended() == 0, "".join(replay.err)
        assert replay.out[-1].startswith("verified: ")

    @pytest.mark.full
    def test_a_service_that_stays_away_is_named(
        self,
        start,
        router: str,
        log: Path,
        monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        for wait in ("ANSWER_TIMEOUT_S", "RETURN_TIMEOUT_S"):
            monkeypatch.setattr(f"ground.replay.player.{wait}", 1.0)
        running = services_of(log, start, router)
        with Stranger(router) as viewer, ThreadPoolExecutor() as pool:
            beliefs = viewer.subscribe("belief")
            pool.submit(lambda: beliefs.get(timeout=300) and running["estimator"].kill())
            replay = ("replay", str(log), "--connect", router, "--speedup", "1", "--verify")
            status, out, err = run_sitl(monkeypatch, capsys, *replay)
        assert status == 1
        assert "waiting for estimator on uav/1" in err
        assert any(line.endswith(": the estimator is gone") for line in err)
        assert any(line.endswith(", is none") for line in out)

    def test_an_estimator_for_another_number_of_vehicles_is_found_out_at_once(
        self,
        start,
        router: str,
        log: Path,
        monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        start("estimator", "--connect", router, "--namespace", "uav/1", "--vehicles", "2")
        status, _, err = run_sitl(monkeypatch, capsys, "replay", str(log), "--connect", router)
        assert (status, err[-1]) == (
            1,
            "error: the estimator on uav/1 is for 2 vehicles, and 1 would fly: start it without --vehicles",
        )

    def test_listeners_get_what_the_vehicle_published_to_the_last_byte(
        self, start, router: str, log: Path
    ) -> None:
        with Stranger(router) as viewer:
            heard = {key: viewer.subscribe(key) for key in ("reading", "mavlink/out", "health/uav")}
            services_of(log, start, router)
            assert start("sitl", "replay", str(log), "--connect", router, "--speedup", "1").ended() == 0
            got = {
                key: [samples.get().payload.to_bytes() for _ in range(samples.qsize())]
                for key, samples in heard.items()
            }
        entries = read(log).entries
        published = {key: [entry.payload for entry in entries if entry.key == key] for key in heard}
        assert list(dict.fromkeys(got["reading"])) == list(dict.fromkeys(published["reading"]))
        assert got["health/uav"] == published["health/uav"]
        remaining = iter(published["mavlink/out"])
        assert all(
            payload in remaining for payload in got["mavlink/out"]
        )  # in order; frames may be dropped if the reader is slow
        assert len(got["mavlink/out"]) > 0.9 * len(published["mavlink/out"])

    def test_an_estimator_that_knows_the_flight_already_is_found_out(
        self, router: str, log: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        replay = ("replay", str(log), "--connect", router, "--speedup", "0", "--verify")
        with Services(monkeypatch, router) as services:
            services.start(read(log).about["parts"])
            assert run_sitl(monkeypatch, capsys, *replay)[0] == 0
            monkeypatch.setattr("ground.replay.player.ANSWER_TIMEOUT_S", 1.0)  # no answer will come
            status, out, err = run_sitl(monkeypatch, capsys, *replay)
        assert status == 1
        assert any("restart it" in line for line in err)
        assert any(line.startswith("differs: belief at ") and line.endswith(", is none") for line in out)


class TestAutopilotLog:
    """`replay` of a .tlog."""

    def test_the_tlog_of_a_mission_gives_the_estimate_of_the_mission(self, start, log: Path) -> None:
        words = read(log).about["parts"]["estimator"]
        told = words[: words.index("--sysid")] + words[words.index("--sysid") + 2 :]
        flown = log.with_suffix(".tlog")
        replay = start(
            "sitl", "replay", str(flown), "--speedup", "0", "--origin", "0,0", "--area", "30", *told, "--json"
        )
        assert replay.ended() == 0, "".join(replay.err)
        (stop,) = said(log, "agdc/stop")
        result = json.loads(replay.out[-1])
        assert result["estimate"] == stop["estimate"]
        assert (result["verified"], result["ceased"], result["waypoints"]) == (None, True, 0)
        assert result["beliefs"] == stop["step"] + 1
        assert replay.says("replay: flown.tlog: ")  # what was read of it
        assert replay.says(f"{result['beliefs']} readings, ceased at step {stop['step']}")

    def test_what_a_ground_station_heard_of_a_mission_gives_its_readings(
        self, log: Path, tmp_path: Path
    ) -> None:
        """Each value is said 10 times a second, until there is another. Positions at rest, 30 times a
        second, are those of the readings.
        """
        entries = sorted(read(log).entries, key=lambda entry: entry.published_ns)
        mission = [unpack_reading(entry.payload) for entry in entries if entry.key == "reading"]
        heard = tmp_path / "heard.tlog"
        frames = [
            (entry.published_ns // 1000).to_bytes(8) + frame.data
            for entry in entries
            if entry.key == "mavlink/out"
            for frame in split(entry.payload)
        ]
        heard.write_bytes(b"".join(frames))
        again = [
            unpack_reading(entry.payload) for entry in flight.read(heard).entries if entry.key == "reading"
        ]
        assert [(each.time_boot_ms, each.gas, each.wind) for each in again] == [
            (each.time_boot_ms, each.gas, each.wind) for each in mission
        ]
        assert (
            max(math.dist(one.position, other.position) for one, other in zip(again, mission, strict=True))
            < 0.002
        )

    def test_a_simulated_plume_over_a_flown_path_tells_its_error(
        self, start, log: Path, tmp_path: Path
    ) -> None:
        mission = tmp_path / "plume.yaml"
        mission.write_text("scenario: {source: [17, 16], q: 400, u: 2, phi: 0.5, d: 3, tau: 12}\n")
        flown = log.with_suffix(".tlog")
        replay = start(
            "sitl", "replay", str(flown), "--speedup", "0", "--plume", str(mission), "--to", "30", "--json"
        )
        assert replay.ended() == 0, "".join(replay.err)
        result = json.loads(replay.out[-1])
        assert result["error_m"] == pytest.approx(math.dist(result["estimate"], (17, 16)))
        assert replay.says("source   (17.00, 16.00), error ")
        assert 10 < result["beliefs"] < 35

    @pytest.mark.parametrize(
        ("flags", "words"),
        [
            (["--verify"], "error: --verify: not allowed with "),
            (
                ["--connect", "tcp/127.0.0.1:1", "--particles", "1000"],
                "error: --particles: not allowed with --connect: ",
            ),
            (
                ["--wind", "3"],
                "python -m sitl replay: error: --wind: '3' is not allowed; wanted SPEED,FROM, two numbers",
            ),
            (["--gas", "methane"], "error: system 1 sent no methane; "),
            (["--plume", "none.yaml"], "error: none.yaml"),
            (["--sysid", "9"], "error: "),
        ],
    )
    def test_what_cannot_be_done_with_it_is_one_line(
        self, refusal: Callable[..., str], log: Path, flags: list[str], words: str
    ) -> None:
        assert refusal(str(log.with_suffix(".tlog")), *flags).startswith(words)

    def test_flags_that_the_estimator_refuses_are_told_as_it_tells_them(
        self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], log: Path
    ) -> None:
        status, _, err = run_sitl(
            monkeypatch, capsys, "replay", str(log.with_suffix(".tlog")), "--prior", "q=often"
        )
        assert status == 2
        assert err[-1].startswith("error: --prior: ")


class TestBadInput:
    """One line, status 2."""

    @pytest.mark.parametrize(
        ("flags", "words"),
        [
            (
                ["--verify", "--ignore", "gas"],
                "error: --ignore: 'gas' is not allowed; wanted stop, belief, waypoint, ",
            ),
            (
                ["--verify", "--ignore", "belief.speed"],
                "error: --ignore: 'belief.speed' is not allowed; belief has time_boot_ms, ",
            ),
            (
                ["--verify", "--from", "5"],
                "error: --from: 5 is not allowed with --verify; wanted 0: a belief depends on ",
            ),
            (["--ignore", "belief"], "error: --ignore: only allowed with --verify"),
            (["--tolerance", "1"], "error: --tolerance: only allowed with --verify"),
            (["--verify", "--to", "0.5"], "error: --verify: no belief, stop or waypoint in "),
            (
                ["--verify", *("--ignore", "belief", "--ignore", "stop", "--ignore", "waypoint")],
                "error: --verify: no belief, stop or ",
            ),
            (["--from", "1e6"], "error: --from: no message of "),
            (["--from", "5", "--to", "4"], "error: --to: 4 is not allowed; wanted at least --from, 5"),
            (["--connect", "tcp/127.0.0.1:1", "--loop"], "error: --loop: not allowed with --connect: "),
            (
                ["--speedup", "-1"],
                "python -m sitl replay: error: --speedup: '-1' is not allowed; wanted a number from 0 up to "
                "1000",
            ),
            (["--particles", "1000"], "error: --particles: not allowed with "),
            (["--plume", "mission.yaml"], "error: --plume: not allowed with "),
        ],
    )
    def test_flags(self, refusal: Callable[..., str], log: Path, flags: list[str], words: str) -> None:
        assert refusal(str(log), *flags).startswith(words)

    def test_logs(self, refusal: Callable[..., str], tmp_path: Path) -> None:
        assert (
            refusal(str(tmp_path / "none.mcap")) == f"error: {tmp_path}/none.mcap: No such file or directory"
        )
        (tmp_path / "noise.mcap").write_bytes(b"noise")
        assert "noise.mcap" in refusal(str(tmp_path / "noise.mcap"))
        Writer(tmp_path / "empty.mcap", {"seed": 1}).close()
        assert refusal(str(tmp_path / "empty.mcap")).endswith("empty.mcap: it has no messages of a vehicle")

    def test_a_log_that_does_not_say_how_it_was_flown(
        self, start, refusal: Callable[..., str], log: Path, tmp_path: Path
    ) -> None:
        anonymous = rewritten(log, tmp_path / "anonymous.mcap", about={})
        assert refusal(str(anonymous), "--verify") == (
            f"error: {anonymous} does not say how its agent was started; start one and give --connect, or "
            "give --ignore waypoint"
        )
        replay = start("sitl", "replay", str(anonymous), "--speedup", "0", "--json")
        assert replay.ended() == 0
        assert replay.says("warning: ")
        assert json.loads(replay.out[-1])["beliefs"] == 0

    def test_a_log_with_command_lines_that_no_service_takes(
        self, start, refusal: Callable[..., str], log: Path, tmp_path: Path
    ) -> None:
        foreign = rewritten(
            log, tmp_path / "foreign.mcap", about=with_flag(log, "agent", "--policy", "clairvoyance")
        )
        replay = start("sitl", "replay", str(foreign), "--speedup", "0")
        assert replay.ended() == 2
        assert replay.err[-1].startswith("error: --policy: ")
        assert "'clairvoyance' is not allowed" in replay.err[-1]
        broken = rewritten(log, tmp_path / "broken.mcap", about={"parts": "all"})
        assert "broken.mcap: its description cannot be used: " in refusal(str(broken))

    def test_a_record_runs_no_command_of_its_own(self, start, log: Path, tmp_path: Path) -> None:
        (precious := tmp_path / "precious.csv").write_text("kept")
        words = ["evaluate", "--policy", "greedy", "--scenarios", "1", "--missions", str(precious), "--force"]
        about = read(log).about
        hostile = rewritten(
            log, tmp_path / "hostile.mcap", about={**about, "parts": {**about["parts"], "agent": words}}
        )
        replay = start("sitl", "replay", str(hostile), "--speedup", "0")
        assert replay.ended() == 0
        assert replay.says(
            f"warning: {hostile} starts its agent with 'evaluate', which a record may not do: replayed "
            "without it"
        )
        assert precious.read_text() == "kept"
