"""Protects the doubles on sockets: TCP and UDP, speed-up, clients that come and go, the process."""

import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import pytest
from pymavlink import mavutil

from tests.autopilots.settings import Settings
from tests.autopilots.wire import Double


def hear(link: Any, kind: str, timeout_s: float = 20.0) -> Any:
    """The next message of a type; fails if none comes."""
    message = link.recv_match(type=kind, blocking=True, timeout=timeout_s)
    assert message is not None, f"no {kind} within {timeout_s:g} s"
    return message


@pytest.mark.parametrize(
    ("kind", "listen", "autopilot"), [("ardupilot", "tcp:127.0.0.1:0", 3), ("px4", "tcp:127.0.0.1:0", 12)]
)
def test_a_client_over_tcp_may_come_again(kind: str, listen: str, autopilot: int) -> None:
    with Double(kind, listen, speedup=10) as double:
        for _ in range(2):
            link = mavutil.mavlink_connection(double.url, source_system=1, source_component=191)
            assert hear(link, "HEARTBEAT").autopilot == autopilot
            link.close()


def test_udp_answers_whoever_spoke() -> None:
    with Double("ardupilot", "udpin:127.0.0.1:0", speedup=10) as double:
        link = mavutil.mavlink_connection(double.url, source_system=1, source_component=191)
        link.mav.heartbeat_send(18, 8, 0, 0, 4)
        assert hear(link, "HEARTBEAT").get_srcSystem() == 1
        link.mav.command_long_send(1, 1, 511, 0, 30, 100000, 0, 0, 0, 0, 0)
        assert hear(link, "COMMAND_ACK").result == 0
        assert hear(link, "ATTITUDE")
        link.close()


def test_px4_speaks_from_14580_to_14540_plus_its_instance() -> None:
    instance = 37
    link = mavutil.mavlink_connection(
        f"udpin:127.0.0.1:{14540 + instance}", source_system=1, source_component=191
    )
    with Double("px4", "udp", Settings(instance=instance), speedup=10) as double:
        assert double.url == f"udpin:127.0.0.1:{14540 + instance}"
        assert hear(link, "HEARTBEAT").get_srcSystem() == instance + 1
        assert {port for _, port in link.clients} == {14580 + instance}
    link.close()


def test_the_clock_of_the_messages_is_simulation_time() -> None:
    with Double("px4", speedup=20) as double:
        link = mavutil.mavlink_connection(double.url, source_system=1, source_component=191)
        first = hear(link, "ATTITUDE").time_boot_ms
        heartbeats = 0
        while True:
            message = link.recv_match(type=["HEARTBEAT", "ATTITUDE"], blocking=True, timeout=20)
            if message.get_type() == "HEARTBEAT":
                heartbeats += 1
            elif message.time_boot_ms >= first + 10_000:
                break
        assert 9 <= heartbeats <= 11
        link.close()


def test_a_flight_over_tcp_with_5_percent_of_the_frames_lost_needs_retries_alone() -> None:
    """Arm, take off and step 3 m north; every message is sent until its effect is seen."""
    with Double("ardupilot", settings=Settings(ready_s=5.0, faults=("drop:5",)), speedup=20) as double:
        link = mavutil.mavlink_connection(double.url, source_system=1, source_component=191)
        seen: dict[str, Any] = {}

        def until(send: Callable[[], None], holds: Callable[[], bool]) -> None:
            deadline, again = time.monotonic() + 40.0, 0.0
            while not holds():
                assert time.monotonic() < deadline
                if time.monotonic() > again:
                    send()
                    again = time.monotonic() + 0.3
                if message := link.recv_match(blocking=True, timeout=0.1):
                    seen[message.get_type()] = message

        def command(number: int, *values: float) -> Callable[[], None]:
            return lambda: link.mav.command_long_send(1, 1, number, 0, *values, *[0] * (7 - len(values)))

        until(command(511, 32, 50000), lambda: "LOCAL_POSITION_NED" in seen)
        until(command(176, 1, 4), lambda: seen["HEARTBEAT"].custom_mode == 4)
        until(command(400, 1), lambda: bool(seen["HEARTBEAT"].base_mode & 128))
        until(command(22, 0, 0, 0, 0, 0, 0, 5), lambda: seen["LOCAL_POSITION_NED"].z < -5.0)
        until(
            lambda: link.mav.set_position_target_local_ned_send(
                0, 1, 1, 1, 0x0DF8, 4.2, -0.7, -5.4, 0, 0, 0, 0, 0, 0, 0, 0
            ),
            lambda: abs(seen["LOCAL_POSITION_NED"].x - 4.2) < 0.2,
        )
        until(command(20), lambda: not seen["HEARTBEAT"].base_mode & 128)
        link.close()


def test_garbage_does_not_stop_it(wait_until: Callable[..., None]) -> None:
    with Double("ardupilot", speedup=10) as double:
        link = mavutil.mavlink_connection(double.url, source_system=1, source_component=191)
        link.write(b"\xfd\x09\x00 garbage \xfe\xfe\xfd" * 50)
        link.write(bytes(300))
        link.mav.command_long_send(1, 1, 511, 0, 30, 100000, 0, 0, 0, 0, 0)
        assert hear(link, "COMMAND_ACK").result == 0
        link.close()


def test_as_a_process_it_prints_where_it_listens() -> None:
    command = [
        sys.executable,
        "-m",
        "tests.autopilots",
        "ardupilot",
        "--listen",
        "tcp:127.0.0.1:0",
        "--speedup",
        "10",
        "--fault",
        "drop:5",
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        link = mavutil.mavlink_connection(
            process.stdout.readline().strip(), source_system=1, source_component=191
        )
        assert hear(link, "HEARTBEAT").get_srcComponent() == 1
        link.close()
        process.terminate()


@pytest.mark.parametrize("arguments", [("--listen", "smoke"), ("--fault", "gone"), ("--speedup", "0")])
def test_wrong_arguments_are_refused_with_one_line(arguments: tuple[str, ...]) -> None:
    command = [sys.executable, "-m", "tests.autopilots", "px4", "--listen", "tcp:127.0.0.1:0", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=400)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
