"""Protects each service alone, tested by a client written from docs/bus.md: answers, repeats, and inputs
that must not stop it.
"""

import json
import math
import queue
import socket
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import zenoh
from pymavlink.dialects.v20 import common as mavlink

from plume.dispersion import concentration
from plume.sensors.sensor import Gaussian
from sitl.autopilot.telemetry import STREAMS
from tests.system.stranger import Stranger, belief, messages, nothing_more, particles
from tests.system.wires import SerialWire, free_port

WAIT_S = 60.0


@pytest.fixture
def stranger(router: str) -> Iterator[Stranger]:
    with Stranger(router) as client:
        yield client


def get(samples: "queue.SimpleQueue[zenoh.Sample]") -> zenoh.Sample:
    return samples.get(timeout=WAIT_S)


class TestEstimator:
    """`python -m estimator`."""

    @pytest.fixture
    def estimator(self, start, router: str, stranger: Stranger, wait_until: Callable):
        part = start(
            "estimator", "--connect", router, "--assume", "paper", "--particles", "200", "--threshold", "4"
        )
        wait_until(lambda: part.says("ready"))
        return part

    def test_it_answers_each_reading_with_one_belief_of_the_same_time(
        self, estimator, stranger: Stranger
    ) -> None:
        beliefs, publish = stranger.subscribe("belief"), stranger.publisher("reading")
        for step, time_boot_ms in enumerate((1000, 2150, 3300)):
            publish(stranger.reading(time_boot_ms, north=4.0 + step))
            sample = get(beliefs)
            said = belief(sample)
            assert (said["time_boot_ms"], said["step"]) == (time_boot_ms, step)
            assert (said["position"], said["wind"], said["gas"]) == ([3.0, 4.0 + step], [2.0, 1.0], 0.5)
            cloud = particles(sample)
            assert len(cloud) == 200
            assert sum(weight for _, _, weight in cloud) == pytest.approx(1.0, abs=1e-5)
            mean_x = sum(x * weight for x, _, weight in cloud)
            assert said["mean"][0] == pytest.approx(mean_x, abs=1e-4)
        assert nothing_more(beliefs)

    def test_a_repeated_reading_gets_the_same_belief_again_to_the_last_bit(
        self, estimator, stranger: Stranger
    ) -> None:
        beliefs, publish = stranger.subscribe("belief"), stranger.publisher("reading")
        frames = stranger.reading(1000)
        answers = []
        for _ in range(3):
            publish(frames)
            sample = get(beliefs)
            answers.append((sample.payload.to_bytes(), sample.attachment.to_bytes()))
        assert answers[0] == answers[1] == answers[2]

    def test_what_it_refuses_leaves_the_belief_as_it_was_and_is_named(
        self, estimator, stranger: Stranger, wait_until: Callable
    ) -> None:
        beliefs, publish = stranger.subscribe("belief"), stranger.publisher("reading")
        health = stranger.subscribe("health/estimator")
        publish(stranger.reading(5000))
        before = get(beliefs)
        for bad in (
            stranger.reading(6000, gas=math.nan),
            stranger.reading(6000, gas=math.inf),
            stranger.reading(6000, north=30.5),
            stranger.reading(6000, east=-0.5),
            stranger.reading(6000, gas=1e30),
            stranger.reading(6000, gas=-150.0),
            stranger.reading(6000, system=2),
            stranger.reading(5000, gas=0.7),
            stranger.reading(4000),
            stranger.reading(6000)[:-3],
            b"noise",
            b"",
        ):
            publish(bad)
        publish(stranger.reading(5000))
        after = get(beliefs)
        assert (after.payload.to_bytes(), after.attachment.to_bytes()) == (
            before.payload.to_bytes(),
            before.attachment.to_bytes(),
        )
        for words in (
            "gas is not finite",
            "(3.0, 30.5) is outside the area [0, 30] x [0, 30] m",
            "time_boot_ms 4000 is before 5000",
            "malformed frame",
            "is absurd; allowed is -106.1",
            "a reading of system 2; this is the estimator of system 1",
            "5000 again, with other values",
        ):
            wait_until(
                lambda words=words: any(
                    "level=warning" in line and "refused reading: " in line and words in line
                    for line in estimator.err
                )
            )
        counted: dict = {}
        while not counted.get("repeated"):
            counted = json.loads(get(health).payload.to_bytes())["refused"]
        expected = {
            "malformed": 3,
            "not finite": 2,
            "outside": 2,
            "absurd": 2,
            "other vehicle": 1,
            "conflicting": 1,
            "late": 1,
            "repeated": 1,
        }
        assert counted == expected
        publish(stranger.reading(6000))
        assert belief(get(beliefs))["step"] == 1

    def test_it_announces_one_stop_before_the_belief_that_has_ceased(
        self, estimator, stranger: Stranger
    ) -> None:
        beliefs, stops, publish = (
            stranger.subscribe("belief"),
            stranger.subscribe("agdc/stop"),
            stranger.publisher("reading"),
        )
        said: dict = {"ceased": False}
        step, rng = 0, np.random.default_rng(3)
        while not said["ceased"]:
            place = (
                4.0 + 1.5 * step,
                5.0 + 1.5 * step,
            )  # towards the source at (19, 20), as the estimator is told of it
            gas = concentration(place, (19.0, 20.0), (2.0, 1.0), rate=300.0, diffusivity=4.5, lifetime=10.0)
            read = float(Gaussian().measure(gas, rng))
            publish(stranger.reading(1000 * (step + 1), north=place[1], east=place[0], gas=read))
            said = belief(get(beliefs))
            claimed = (
                said["spread"] < 4 and said["p_value"] >= 1e-4 and said["step"] >= 2 and said["evidence"] >= 5
            )
            assert said["ceased"] == claimed
            step += 1
        stop = json.loads(get(stops).payload.to_bytes())
        assert (stop["step"], stop["estimate"], stop["threshold"]) == (said["step"], said["mean"], 4.0)
        publish(stranger.reading(1000 * (step + 1), gas=20.0))
        assert belief(get(beliefs))["step"] == step
        assert nothing_more(stops)

    def test_it_warns_while_the_readings_do_not_fit_its_model(
        self, estimator, stranger: Stranger, wait_until: Callable
    ) -> None:
        """A sensor that reports about 3 g/m³ everywhere, which no source can cause."""
        beliefs, health, publish = (
            stranger.subscribe("belief"),
            stranger.subscribe("health/estimator"),
            stranger.publisher("reading"),
        )
        said = {"p_value": 1.0}
        for step in range(60):
            publish(
                stranger.reading(
                    1000 * (step + 1),
                    north=1.0 + step % 10 * 2.5,
                    east=1.0 + step // 10 * 4.5,
                    gas=3.0 + step / 256,
                )
            )
            said = belief(get(beliefs))
        assert said["p_value"] < 1e-4
        wait_until(lambda: estimator.says("the readings do not fit the model (p = "))
        warnings: list = []
        while not any("do not fit the model" in each for each in warnings):
            warnings = json.loads(get(health).payload.to_bytes())["warnings"]

    def test_it_does_not_claim_a_find_from_a_sensor_that_is_stuck(
        self, estimator, stranger: Stranger, wait_until: Callable
    ) -> None:
        beliefs, stops, publish = (
            stranger.subscribe("belief"),
            stranger.subscribe("agdc/stop"),
            stranger.publisher("reading"),
        )
        said = {"spread": 30.0}
        step = 0
        while said["spread"] > 3.9:
            publish(
                stranger.reading(1000 * (step + 1), north=10.0 + step % 7, east=10.0 + step // 7, gas=0.5)
            )
            said = belief(get(beliefs))
            step += 1
        assert (said["ceased"], said["p_value"]) == (False, 0.0)
        wait_until(lambda: estimator.says("is the sensor stuck"))
        assert nothing_more(stops)


class TestAgent:
    """`python -m agent`."""

    SUMMARY: ClassVar[dict] = {
        "time_boot_ms": 1000,
        "step": 0,
        "position": [10.0, 12.0],
        "altitude_m": 5.0,
        "gas": 0.5,
        "wind": [2.0, 1.0],
        "rate": 300.0,
        "diffusivity": 4.5,
        "lifetime": 10.0,
        "z": 5.0,
        "sensor": "gaussian",
        "unknowns": ["x", "y"],
        "means": [15.0, 15.0],
        "stds": [2.0, 2.0],
        "mean": [15.0, 15.0],
        "covariance": [4.0, 0.0, 4.0],
        "spread": 2.8,
        "effective_sample_size": 3.0,
        "p_value": 0.5,
        "ceased": False,
    }

    @pytest.fixture
    def agent(self, start, router: str, stranger: Stranger, wait_until: Callable):
        part = start("agent", "--connect", router, "--policy", "infotaxis", "--budget", "5")
        wait_until(lambda: part.says("ready"))
        return part

    def publish(self, stranger: Stranger) -> Callable[..., None]:
        publish = stranger.publisher("belief")
        cloud = b"".join(
            struct.pack("<3f", x, y, 0.25)
            for x, y in ((14.0, 14.0), (15.0, 16.0), (16.0, 14.0), (15.0, 15.0))
        )

        def put(attachment: bytes = cloud, **changes: object) -> None:
            publish(json.dumps({**self.SUMMARY, **changes}), attachment=attachment)

        return put

    def test_it_answers_each_belief_with_one_waypoint_a_metre_on(self, agent, stranger: Stranger) -> None:
        waypoints, put = stranger.subscribe("waypoint"), self.publish(stranger)
        for step in range(3):
            put(time_boot_ms=1000 + step, step=step)
            m = messages(get(waypoints))["SET_POSITION_TARGET_LOCAL_NED"]
            assert (m.time_boot_ms, m.z) == (1000 + step, -5.0)
            assert math.dist((m.y, m.x), (10.0, 12.0)) == 1.0
        assert nothing_more(waypoints)

    def test_a_repeated_belief_gets_the_same_waypoint_again_and_an_older_one_none(
        self, agent, stranger: Stranger
    ) -> None:
        waypoints, put = stranger.subscribe("waypoint"), self.publish(stranger)
        put(time_boot_ms=2000, step=1)
        first = messages(get(waypoints))["SET_POSITION_TARGET_LOCAL_NED"]
        put(time_boot_ms=1000, step=0)
        put(time_boot_ms=2000, step=1)
        second = messages(get(waypoints))["SET_POSITION_TARGET_LOCAL_NED"]
        assert (
            (first.time_boot_ms, first.x, first.y)
            == (second.time_boot_ms, second.x, second.y)
            == (2000, first.x, first.y)
        )
        assert nothing_more(waypoints)

    def test_it_stays_silent_when_the_search_has_ceased_or_the_budget_is_spent(
        self, agent, stranger: Stranger
    ) -> None:
        waypoints, put = stranger.subscribe("waypoint"), self.publish(stranger)
        put(ceased=True)
        put(time_boot_ms=6000, step=5)
        assert nothing_more(waypoints)

    def test_it_says_once_in_log_and_health_that_the_search_has_ceased(
        self, agent, stranger: Stranger, wait_until: Callable
    ) -> None:
        healths, publish = stranger.subscribe("health/agent"), stranger.publisher("agdc/stop")
        publish(b"noise")
        wait_until(lambda: agent.says("refused agdc/stop"))
        for _ in range(2):
            publish(
                json.dumps(
                    {
                        "time_boot_ms": 9000,
                        "step": 7,
                        "estimate": [23.5, 24.25],
                        "covariance": [0.1, 0.0, 0.1],
                        "spread": 0.45,
                        "threshold": 0.5,
                    }
                )
            )
        wait_until(lambda: json.loads(get(healths).payload.to_bytes())["ceased"])
        wait_until(lambda: agent.says("the search has ceased"))
        said = [line for line in agent.err if "ceased" in line]
        assert len(said) == 1
        assert "the search has ceased at step 7: source at (23.50, 24.25) m, spread 0.45 m" in said[0]

    def test_it_survives_what_is_no_belief(self, agent, stranger: Stranger, wait_until: Callable) -> None:
        waypoints, put = stranger.subscribe("waypoint"), self.publish(stranger)
        for attachment, changes, words in (
            (b"123", {}, "the particle array has 3 bytes"),
            (b"\x00\x00\xc0\x7f" * 3, {}, "NaN"),
            (b"", {"step": -3}, "Expected `int` >= 0"),
            (b"", {"mean": "north"}, "Expected `array`"),
            (
                b"\x00\x00\x80\x3f" * 3,
                {"unknowns": ["a", "b"]},
                "unknowns 'a b' are not distinct names of x y z q u phi d tau",
            ),
            (b"\x00\x00\x80\x3f" * 3, {"unknowns": ["x", "x"]}, "unknowns 'x x' are not"),
            (b"\x00\x00\x80\x3f" * 3, {"means": []}, "0 means and 2 stds of 2 unknowns"),
            (b"\x00\x00\x80\x3f" * 3, {"position": [1e308, 5.0]}, "is outside the area [0, 30] x [0, 30] m"),
        ):
            put(attachment, **changes)
            wait_until(lambda words=words: agent.says(words))
        assert agent.says('event="refused belief: ')
        put()
        assert messages(get(waypoints))["SET_POSITION_TARGET_LOCAL_NED"].time_boot_ms == 1000


class TestUav:
    """`python -m sitl uav`, with a stranger for both estimator and agent."""

    @pytest.fixture
    def uav(self, start, router: str, stranger: Stranger, wait_until: Callable):
        part = start("sitl", "uav", "--connect", router, "--seed", "1", "--speedup", "0")
        wait_until(lambda: stranger.has_service("uav"))
        return part

    def begin(self, stranger: Stranger) -> "queue.SimpleQueue[zenoh.Sample]":
        readings = stranger.subscribe("reading")
        stranger.announce("health/estimator", "health/agent")
        return readings

    def test_it_waits_on_the_ground_until_estimator_and_agent_are_there(
        self, uav, stranger: Stranger
    ) -> None:
        readings = stranger.subscribe("reading")
        assert nothing_more(readings)
        readings = self.begin(stranger)
        first = messages(get(readings))
        assert set(first) == {"LOCAL_POSITION_NED", "WIND_COV", "NAMED_VALUE_FLOAT"}

    def test_it_flies_each_waypoint_to_the_last_bit_and_takes_one_reading_there(
        self, uav, stranger: Stranger
    ) -> None:
        readings, publish = self.begin(stranger), stranger.publisher("waypoint")
        place = messages(get(readings))["LOCAL_POSITION_NED"]
        for _ in range(5):
            time_boot_ms, north, east = place.time_boot_ms, place.x + 1.0, place.y
            publish(stranger.waypoint(time_boot_ms, north, east))
            while place.time_boot_ms == time_boot_ms:  # unanswered readings are repeated
                place = messages(get(readings))["LOCAL_POSITION_NED"]
            assert place.time_boot_ms > time_boot_ms
            assert (place.x, place.y, place.z) == (pytest.approx(north, abs=1e-6), east, -5.0)

    def test_late_and_doubled_waypoints_change_nothing(self, uav, stranger: Stranger) -> None:
        readings, publish = self.begin(stranger), stranger.publisher("waypoint")
        start = messages(get(readings))["LOCAL_POSITION_NED"]
        publish(stranger.waypoint(start.time_boot_ms, 10.0, 10.0))
        publish(stranger.waypoint(start.time_boot_ms, 20.0, 20.0))
        seen = {start.time_boot_ms}
        while (place := messages(get(readings))["LOCAL_POSITION_NED"]).time_boot_ms in seen:
            pass
        assert (place.x, place.y) == (10.0, 10.0)
        publish(stranger.waypoint(start.time_boot_ms, 25.0, 25.0))
        publish(stranger.waypoint(place.time_boot_ms, 11.0, 10.0))
        while (after := messages(get(readings))["LOCAL_POSITION_NED"]).time_boot_ms == place.time_boot_ms:
            pass
        assert (after.x, after.y) == (11.0, 10.0)

    def test_an_unanswered_reading_is_published_again_as_it_was(self, uav, stranger: Stranger) -> None:
        readings = self.begin(stranger)
        assert (
            get(readings).payload.to_bytes()
            == get(readings).payload.to_bytes()
            == get(readings).payload.to_bytes()
        )

    def test_a_waypoint_outside_the_area_and_noise_are_refused_with_a_reason_and_survived(
        self, uav, stranger: Stranger, wait_until: Callable
    ) -> None:
        readings, publish, out = (
            self.begin(stranger),
            stranger.publisher("waypoint"),
            stranger.subscribe("mavlink/out"),
        )
        start = messages(get(readings))["LOCAL_POSITION_NED"]
        publish(b"noise")
        publish(stranger.waypoint(start.time_boot_ms, math.nan, 10.0))
        publish(stranger.waypoint(start.time_boot_ms, 10.0, 31.0))
        wait_until(lambda: uav.says("refused waypoint: malformed frame"))
        wait_until(
            lambda: uav.says("Waypoint refused: (31.0, 10.0) m is outside the area [0, 30] x [0, 30] m")
        )
        text = ""
        while "outside the area" not in text:
            frames = mavlink.MAVLink(None).parse_buffer(get(out).payload.to_bytes())
            text += "".join(m.text for m in frames if m.get_type() == "STATUSTEXT")
        publish(stranger.waypoint(start.time_boot_ms, 10.0, 30.0))
        while (place := messages(get(readings))["LOCAL_POSITION_NED"]).time_boot_ms == start.time_boot_ms:
            pass
        assert (place.x, place.y) == (10.0, 30.0)

    def test_what_is_on_the_waypoint_key_and_is_no_answer_is_refused_with_a_reason_counted_and_does_nothing(
        self, uav, stranger: Stranger, wait_until: Callable
    ) -> None:
        readings, publish, health = (
            self.begin(stranger),
            stranger.publisher("waypoint"),
            stranger.subscribe("health/uav"),
        )
        start = messages(get(readings))["LOCAL_POSITION_NED"]
        waypoint = stranger.waypoint(start.time_boot_ms, 20.0, 20.0)
        disarm = mavlink.MAVLink_command_long_message(1, 1, 400, 0, 0.0, 21196.0, 0, 0, 0, 0, 0)
        publish(bytes(disarm.pack(mavlink.MAVLink(None, srcSystem=255, srcComponent=190))))
        publish(waypoint + waypoint)
        publish(stranger.waypoint(start.time_boot_ms, 20.0, 20.0, system=2))
        publish(stranger.waypoint(start.time_boot_ms + 1, 20.0, 20.0))
        for words in (
            "refused waypoint: message 76; wanted one SET_POSITION_TARGET_LOCAL_NED (84)",
            "refused waypoint: 2 frames; wanted one SET_POSITION_TARGET_LOCAL_NED (84)",
            "refused waypoint: a waypoint for 2/1; this is 1/1",
            f"Waypoint refused: no reading was taken at {start.time_boot_ms + 1} ms",
        ):
            wait_until(lambda words=words: uav.says(words))
        counts = {"malformed": 2, "other vehicle": 1, "waypoint": 1}
        wait_until(lambda: json.loads(get(health).payload.to_bytes())["refused"] == counts)
        publish(stranger.waypoint(start.time_boot_ms, 10.0, 10.0))
        while (place := messages(get(readings))["LOCAL_POSITION_NED"]).time_boot_ms == start.time_boot_ms:
            pass
        assert (place.x, place.y, place.z) == (10.0, 10.0, -5.0)  # it still flies
        assert not uav.says("disarmed")

    def test_a_setpoint_with_the_time_of_the_awaited_reading_steers_no_search_over_udp_nor_on_mavlink_in(
        self, start, router: str, stranger: Stranger, wait_until: Callable
    ) -> None:
        port = free_port(socket.SOCK_DGRAM)
        start(
            "sitl",
            "uav",
            "--connect",
            router,
            "--seed",
            "1",
            "--speedup",
            "0",
            "--out",
            f"udpin:127.0.0.1:{port}",
        )
        wait_until(lambda: stranger.has_service("uav"))
        readings, health = self.begin(stranger), stranger.subscribe("health/uav")
        start_at = messages(get(readings))["LOCAL_POSITION_NED"]
        astray = stranger.waypoint(start_at.time_boot_ms, 29.0, 29.0)
        stranger.publisher("mavlink/in")(astray)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
            peer.sendto(astray, ("127.0.0.1", port))
        wait_until(lambda: json.loads(get(health).payload.to_bytes())["refused"] == {"waypoint": 2})
        stranger.publisher("waypoint")(stranger.waypoint(start_at.time_boot_ms, 10.0, 10.0))
        while (place := messages(get(readings))["LOCAL_POSITION_NED"]).time_boot_ms == start_at.time_boot_ms:
            pass
        assert (place.x, place.y) == (10.0, 10.0)

    def test_who_takes_the_vehicle_is_named_by_how_it_came_whatever_ids_are_forged(
        self, uav, stranger: Stranger, wait_until: Callable
    ) -> None:
        readings, publish = self.begin(stranger), stranger.publisher("mavlink/in")
        get(readings)
        forged = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        hold = mavlink.MAVLink_command_long_message(1, 1, 176, 0, 1.0, 4.0, 3.0, 0, 0, 0, 0)
        publish(bytes(hold.pack(forged)))
        wait_until(lambda: uav.says("Search gives way: HOLD by 255/190 on the bus"))
        stop = mavlink.MAVLink_command_long_message(1, 1, 400, 0, 0.0, 21196.0, 0, 0, 0, 0, 0)
        publish(bytes(stop.pack(forged)), attachment=b"bridge")
        wait_until(lambda: uav.says("disarmed by 255/190 through a bridge"))

    def test_it_survives_a_client_that_turns_all_streams_off(self, uav, stranger: Stranger) -> None:
        publish = stranger.publisher("mavlink/in")
        out = stranger.subscribe("mavlink/out")
        streamed = [stream.message_id for stream in STREAMS]
        for message_id in streamed:
            publish(
                stranger.frames(
                    mavlink.MAVLink_command_long_message(1, 1, 511, 0, message_id, -1.0, 0, 0, 0, 0, 0)
                )
            )
        results: list[int] = []
        while len(results) < len(streamed):
            frames = mavlink.MAVLink(None).parse_buffer(get(out).payload.to_bytes())
            results += [m.result for m in frames if m.get_type() == "COMMAND_ACK"]
        assert sorted(results) == [0] * (len(streamed) - 1) + [2]  # HEARTBEAT stays on: denied
        while messages(get(out)).keys() != {"HEARTBEAT"}:
            pass
        publish(stranger.frames(mavlink.MAVLink_command_long_message(1, 1, 512, 0, 242, 0, 0, 0, 0, 0, 0)))
        while not messages(get(out)).keys() & {"COMMAND_ACK", "HOME_POSITION"}:
            pass

    def test_it_streams_its_telemetry_while_it_waits(self, uav, stranger: Stranger) -> None:
        out = stranger.subscribe("mavlink/out")
        wanted = {
            "HEARTBEAT",
            "SYS_STATUS",
            "GPS_RAW_INT",
            "GLOBAL_POSITION_INT",
            "LOCAL_POSITION_NED",
            "ATTITUDE",
            "VFR_HUD",
            "BATTERY_STATUS",
            "HOME_POSITION",
            "EXTENDED_SYS_STATE",
            "WIND_COV",
        }
        seen: set[str] = set()
        while not wanted <= seen:
            seen |= set(messages(get(out)))


class TestPayload:
    """`python -m sitl payload`."""

    @staticmethod
    def question(
        stranger: Stranger,
        time_boot_ms: int,
        number: int,
        north: float = 4.0,
        east: float = 3.0,
        west_mps: float = 0.0,
    ) -> bytes:
        wind = [
            mavlink.MAVLink_wind_cov_message(
                time_boot_ms * 1000, 0.0, -west_mps, 0.0, 0.0, 0.0, math.nan, 0.0, 0.0
            )
        ]
        return stranger.frames(
            mavlink.MAVLink_local_position_ned_message(time_boot_ms, north, east, -5.0, 0.0, 0.0, 0.0),
            *wind * bool(west_mps),
            mavlink.MAVLink_named_value_int_message(time_boot_ms, b"sample", number),
        )

    def test_it_answers_questions_for_the_plume_and_repeats_what_was_lost_and_another_one_answers_alike(
        self, start, router: str, stranger: Stranger, wait_until: Callable
    ) -> None:
        part = start("sitl", "payload", "--connect", router, "--seed", "7")
        wait_until(lambda: part.says("ready"))
        answers, publish = stranger.subscribe("payload/out"), stranger.publisher("payload/in")
        heard = []
        for number, west_mps in enumerate((0.0, 2.0, 3.0)):
            publish(self.question(stranger, 1000 + number, number, west_mps=west_mps))
            heard.append(messages(get(answers)))
            assert heard[-1]["NAMED_VALUE_FLOAT"].time_boot_ms == 1000 + number
            if west_mps:  # it blows as the vehicle says: the air moves west
                assert (heard[-1]["WIND_COV"].wind_x, heard[-1]["WIND_COV"].wind_y) == (0.0, -west_mps)
        again = self.question(stranger, 1002, 2, west_mps=3.0)
        for payload in (b"noise", again[:-1], again, again):
            publish(payload)
        assert [messages(get(answers))["NAMED_VALUE_FLOAT"].value for _ in range(2)] == [
            heard[-1]["NAMED_VALUE_FLOAT"].value
        ] * 2
        assert nothing_more(answers)
        assert stranger.has_service("payload")
        part.kill()
        wait_until(lambda: not stranger.has_service("payload"))
        start("sitl", "payload", "--connect", router, "--seed", "7")
        publish = stranger.publisher("payload/in")
        publish(self.question(stranger, 5000, 1, west_mps=2.0))  # the same reading at another time
        assert messages(get(answers))["NAMED_VALUE_FLOAT"].value == heard[1]["NAMED_VALUE_FLOAT"].value

    def test_a_sensor_on_a_serial_line_is_asked_and_one_that_is_not_there_has_no_value(
        self, start, router: str, stranger: Stranger, wait_until: Callable, tmp_path: Path
    ) -> None:
        part = start(
            "sitl", "payload", "--connect", router, "--payload", f"serial:{tmp_path / 'sensor'}:9600"
        )
        wait_until(lambda: part.says("ready"))
        assert part.says("No such file or directory; it is tried again")
        answers, publish = stranger.subscribe("payload/out"), stranger.publisher("payload/in")
        publish(self.question(stranger, 1000, 0))
        assert math.isnan(messages(get(answers))["NAMED_VALUE_FLOAT"].value)
        with SerialWire(tmp_path / "sensor") as sensor:
            publish(self.question(stranger, 2000, 0))

            def answered() -> bool:
                sensor.say(b"warming up\n0.75\n")
                return not answers.empty()

            wait_until(answered)
            value = messages(get(answers))
            assert value["NAMED_VALUE_FLOAT"].time_boot_ms == 2000
            assert value["NAMED_VALUE_FLOAT"].value == 0.75
            assert "WIND_COV" not in value
