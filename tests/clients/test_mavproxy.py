"""Protects the vehicle against MAVProxy: what its users type works, and what the vehicle lacks is refused
on their console.
"""

import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from pathlib import Path

import pytest

from tests.clients.installed import python_of

pytestmark = pytest.mark.full

MODULES = "arm,cmdlong,fence,ftp,log,misc,mode,param,rally,wp"
FASTEST = (30, 32, 33)
"""The messages that come most often. At the speed-up of a test MAVProxy, which is Python, could not read
them all on a busy machine.
"""
HEAD = "QGC WPL 110"
# Rows as MAVProxy saves them: number, current, frame, command, four parameters, latitude, longitude,
# altitude, autocontinue.
HOME = "0	1	0	16	0	0	0	0	47.397742	8.545594	488.000000	1"
WAYPOINTS = (
    "1	0	3	22	0	0	0	0	47.397742	8.545594	5.000000	1",
    "2	0	3	16	0	0	0	0	47.397842	8.545694	6.000000	1",
    "3	0	3	16	0	0	0	0	47.397892	8.545794	7.000000	1",
)
FENCE = (
    "0	0	3	5001	4	0	0	0	47.397472	8.545195	0.000000	1",
    "1	0	3	5001	4	0	0	0	47.397472	8.546391	0.000000	1",
    "2	0	3	5001	4	0	0	0	47.398282	8.546391	0.000000	1",
    "3	0	3	5001	4	0	0	0	47.398282	8.545195	0.000000	1",
)
RALLY = ("0	0	3	5100	0	0	0	0	47.397842	8.545694	6.000000	1",)


class MavProxy:
    """MAVProxy at a port, and what it has printed."""

    def __init__(self, port: int, folder: Path, wait_until: Callable, modules: str = MODULES) -> None:
        self.folder = folder
        self.said: list[str] = []
        self.wait_until = wait_until
        python = python_of("mavproxy")
        words = (f"--master=udpin:127.0.0.1:{port}", "--no-state", f"--default-modules={modules}")
        self.process = subprocess.Popen(
            [python, "-u", str(Path(python).with_name("mavproxy.py")), *words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            bufsize=1,
            cwd=folder,
            env={"HOME": str(folder), "PATH": "/usr/bin:/bin"},
        )
        self.reader = threading.Thread(target=self.read)
        self.reader.start()

    def read(self) -> None:
        assert self.process.stdout
        self.said.extend(iter(self.process.stdout.readline, ""))

    def type(self, line: str, *answers: str) -> None:
        """Type a line and wait until all of these were printed after it."""
        before = len(self.said)
        assert self.process.stdin
        self.process.stdin.write(f"{line}\n")
        for answer in answers:
            self.until(answer, before)

    def repeat(self, line: str, answer: str) -> None:
        """Type a line every second until this is printed after it."""
        before = len(self.said)
        for _ in range(20):
            self.type(line)
            with suppress(AssertionError):
                return self.wait_until(lambda: any(answer in each for each in self.said[before:]), 1)
        self.until(answer, before)

    def until(self, text: str, before: int = 0) -> None:
        try:
            self.wait_until(lambda: any(text in line for line in self.said[before:]))
        except AssertionError:
            pytest.fail(f"MAVProxy did not say {text!r}; it said:\n{''.join(self.said[before:])}")

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        self.reader.join()
        for pipe in (self.process.stdin, self.process.stdout):
            assert pipe
            pipe.close()


@pytest.fixture
def mavproxy(
    vehicle: Callable[..., int], tmp_path: Path, wait_until: Callable
) -> Iterator[Callable[..., MavProxy]]:
    """Start a vehicle and MAVProxy, and wait until that has read the parameters, as it does first."""
    opened: list[MavProxy] = []

    def begin(*words: str) -> MavProxy:
        python_of("mavproxy")
        opened.append(MavProxy(vehicle(*words), tmp_path, wait_until))
        opened[0].until("parameters")
        for message_id in FASTEST:
            opened[0].type(f"long SET_MESSAGE_INTERVAL {message_id} 500000")
        return opened[0]

    yield begin
    for each in opened:
        each.close()


def rows(path: Path) -> list[list[float]]:
    """The numbers of a file of waypoints, in any format."""
    head, *lines = path.read_text().splitlines()
    assert head == HEAD
    return [[float(word) for word in line.split()] for line in lines]


def test_mavproxy_reads_and_sets_parameters_and_shows_why_one_is_refused(
    mavproxy: Callable[..., MavProxy],
) -> None:
    station = mavproxy()
    station.type("param set MIS_TAKEOFF_ALT 7")
    station.repeat("param fetch MIS_TAKEOFF_ALT", "MIS_TAKEOFF_ALT = 7.0")  # what is set waits in a queue
    station.type(
        "param set MIS_TAKEOFF_ALT 1000", "allowed is 0.5 to 80 m", "Failed to set MIS_TAKEOFF_ALT to 1000"
    )
    station.type("param show MIS_TAKEOFF_ALT", "MIS_TAKEOFF_ALT  7.0")
    station.type("param fetch", "Requested parameter list", "Received ")


def test_what_mavproxy_loads_it_lists_again(mavproxy: Callable[..., MavProxy]) -> None:
    station = mavproxy()
    for kind, lines in (("wp", (HOME, *WAYPOINTS)), ("fence", FENCE), ("rally", RALLY)):
        sent, got = station.folder / f"{kind}.txt", station.folder / f"{kind}-saved.txt"
        sent.write_text("\n".join((HEAD, *lines, "")))
        station.repeat(
            f"{kind} load {sent.name}", f"Sent all {len(lines)} "
        )  # a list that is asked for earlier would end the upload
        station.repeat(f"{kind} list", f"Requesting {len(lines)} ")
        station.type(f"{kind} save {got.name}", f"Saved {len(lines)} ")
        assert rows(got) == rows(sent)


def test_mavproxy_takes_off_flies_where_it_is_guided_and_returns(mavproxy: Callable[..., MavProxy]) -> None:
    station = mavproxy("--speedup", "4")
    station.type("arm throttle", "ARMED")
    station.type("takeoff 494")  # above sea: PX4 takes it so, and home lies at 488 m
    station.repeat("alt", "Altitude:  6.0")
    station.type("guided 47.397842 8.545694 7")
    station.repeat("alt", "Altitude:  7.0")
    station.type("long DO_SET_MODE 1 4 5")  # `mode RTL` fails in MAVProxy 1.8.75 with any PX4
    station.until("DISARMED")


def test_mavproxy_flies_a_mission(mavproxy: Callable[..., MavProxy]) -> None:
    station = mavproxy("--speedup", "4")
    (station.folder / "sent.txt").write_text("\n".join((HEAD, HOME, *WAYPOINTS, "")))
    station.repeat("wp load sent.txt", "MISSION_ACK: TYPE_MISSION: ACCEPTED")
    station.type("arm throttle", "ARMED")
    station.type("long MISSION_START", "Mode MISSION")
    for number in (1, 2, 3):
        station.until(f"waypoint {number}\n")
    station.until("Mission finished")


def test_mavproxy_shows_what_the_vehicle_lacks(mavproxy: Callable[..., MavProxy]) -> None:
    station = mavproxy()
    station.type("ftp list", "Listing /")
    station.type("log list", "No logs")
    station.type("reboot", "COMMAND_ACK: PREFLIGHT_REBOOT_SHUTDOWN: UNSUPPORTED")
    station.type("disarm", "COMMAND_ACK: COMPONENT_ARM_DISARM: ACCEPTED")


def test_mavproxy_commands_a_vehicle_that_signs_with_its_passphrase_only(
    vehicle: Callable[..., int], tmp_path: Path, wait_until: Callable
) -> None:
    python_of("mavproxy")
    (tmp_path / "fleet.key").write_text("correct-horse\n")
    port = vehicle("--sign", str(tmp_path / "fleet.key"))
    with closing(MavProxy(port, tmp_path, wait_until, f"{MODULES},signing")) as station:
        station.until("Detected vehicle 1:1")
        station.type("arm throttle")
        station.type("signing key wrong-horse", "Setup signing key")
        station.type("arm throttle")
        station.type("signing key correct-horse", "Setup signing key")
        station.repeat("param fetch MIS_TAKEOFF_ALT", "MIS_TAKEOFF_ALT = 5.0")
        assert not any("ARMED" in line for line in station.said)
        station.type("arm throttle", "ARMED")
        station.type("signing setup wrong-horse", "Signing setup refused: no keys over a link")
