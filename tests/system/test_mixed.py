"""Protects a search by several vehicles of which some are real autopilots, whose place doubles take: their
places come to one plane, they keep apart, and what happens to one is no matter of the others.
"""

import json
import math
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from link.bus.keys import READING, vehicle_of
from link.bus.mavlink import unpack_reading
from link.record.reader import read
from plume.geodesy import HOME
from plume.problems.fleet import Fleet
from plume.scenario import draw
from scene.follow.history import histories_of
from tests.autopilots.settings import Settings
from tests.autopilots.wire import Double
from tests.system.conftest import Part
from tests.system.live import run_sitl
from tests.system.test_fleet import processes_of

FAST = 2.0  # a busy machine does not keep up with more: links are lost
SEED = 4
ORIGIN = f"{HOME[0]},{HOME[1]},488,0"
"""Where the EKFs of both doubles have their origin, so that their true places are those of the area."""
SEARCH = ("--from", "corners", "--seed", str(SEED), "--particles", "100", "--json", "--trace")
REAL = ("--speedup", f"{FAST:g}", "--wind", "2,90")
STARTS = Fleet(2, "corners").starts(draw(SEED).start, SEED)
HOMES = ((1.2, -0.7, 0.3), (31.0, 30.0, 0.5))
"""North, east, down of the area's origin, m: each beside the corner where it starts."""


@contextmanager
def doubles(*homes: tuple[float, float, float]) -> Iterator[list[Double]]:
    """ArduCopters, systems 1, 2 and so on, ready to fly 12 s after their boot.

    They wait for a minute on the ground, armed: faster than real time their usual 10 s are short.
    """
    with ExitStack() as stack:
        yield [
            stack.enter_context(
                Double(
                    "ardupilot",
                    settings=Settings(
                        instance=number, ready_s=12.0, home=home, parameters=(("DISARM_DELAY", 60.0),)
                    ),
                    speedup=FAST,
                )
            )
            for number, home in enumerate(homes)
        ]


class Chase:
    """Looks where two doubles truly are, m, all the time until they return."""

    def __init__(self, those: list[Double]) -> None:
        self._autopilots = [double.wire.autopilot for double in those]
        self.nearest_m = math.inf
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def _run(self) -> None:
        while not self._ended.wait(0.005):
            if any(autopilot.mode == "RTL" for autopilot in self._autopilots):
                return
            places = [tuple(autopilot.body.position) for autopilot in self._autopilots]
            self.nearest_m = min(self.nearest_m, math.dist(*places))

    def __enter__(self) -> "Chase":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()


def readings(record: Path) -> dict[int, list[tuple[float, float]]]:
    """Where each vehicle has read, (x, y) m."""
    places: dict[int, list[tuple[float, float]]] = {}
    for entry in read(record).entries:
        if entry.key.endswith(READING.name):
            place = unpack_reading(entry.payload).position
            mine = places.setdefault(int(vehicle_of(entry.key)), [])
            mine += [place] * (place not in mine)
    return places


def verified(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], record: Path) -> dict:
    status, out, err = run_sitl(
        monkeypatch, capsys, "replay", str(record), "--verify", "--speedup", "0", "--json"
    )
    assert status == 0, err
    return json.loads(out[-1])


@pytest.mark.full
def test_a_real_autopilot_and_a_simulated_vehicle_search_together_and_their_record_verifies(
    start: type[Part], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with doubles(HOMES[0]) as (double,):
        words = (
            "--vehicles",
            "2",
            "--vehicle",
            double.url,
            "--home",
            ORIGIN,
            *REAL,
            *SEARCH,
            "--budget",
            "3",
        )
        flight = start("sitl", "fly", *words, "--record", "mixed.mcap", cwd=tmp_path)
        assert flight.ended() == 0, "".join(flight.err)
        assert not double.wire.autopilot.armed  # it has landed at home
    said = json.loads(flight.out[-1])
    assert (said["ceased"], said["steps"]) == (False, 3)
    places = readings(tmp_path / "mixed.mcap")
    assert [len(places[number]) for number in (1, 2)] == [4, 4], "".join(flight.err)
    for number, began in enumerate(STARTS, 1):
        assert math.dist(places[number][0], began) < 0.4
    again = verified(monkeypatch, capsys, tmp_path / "mixed.mcap")
    assert (again["verified"], again["beliefs"], again["waypoints"]) == (True, 4, 3)


@pytest.mark.full
def test_two_real_autopilots_from_homes_of_their_own_search_one_area_and_keep_apart(
    start: type[Part], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with doubles(*HOMES) as those, Chase(those) as chase:
        urls = [word for double in those for word in ("--vehicle", double.url)]
        words = ("--vehicles", "2", *urls, "--home", ORIGIN, *REAL, *SEARCH, "--budget", "12")
        flight = start("sitl", "fly", *words, "--record", "two.mcap", cwd=tmp_path)
        assert flight.ended() == 0, "".join(flight.err)
        for double, home in zip(those, HOMES, strict=True):
            autopilot = double.wire.autopilot
            assert not autopilot.armed
            assert math.dist(autopilot.body.position[:2], home[:2]) < 0.5
    assert 3.0 - 0.3 < chase.nearest_m < 40.0  # the last 0.3 m to a waypoint count as arrived
    places = readings(tmp_path / "two.mcap")
    for number, began in enumerate(STARTS, 1):
        assert math.dist(places[number][0], began) < 0.4
    for history, mine in zip(histories_of(read(tmp_path / "two.mcap")), (places[1], places[2]), strict=True):
        track = history.at().track  # by its telemetry, which is in a frame of its own
        for place in mine:
            assert min(math.dist(place, at[:2]) for at in track) < 0.5
    assert verified(monkeypatch, capsys, tmp_path / "two.mcap")["verified"]


@pytest.mark.full
def test_a_real_vehicle_flies_on_when_the_simulated_one_beside_it_is_killed(
    start: type[Part], tmp_path: Path, wait_until: Callable[..., None]
) -> None:
    with doubles(HOMES[0]) as (double,):
        words = (
            *("--vehicles", "2", "--vehicle", double.url, "--home", ORIGIN, *REAL, *SEARCH),
            *("--budget", "60", "--silence", "15"),
        )
        flight = start("sitl", "fly", *words, "--no-record", cwd=tmp_path)
        flight.comes_to("step   0")
        os.kill(processes_of(flight)["2"], signal.SIGKILL)
        wait_until(lambda: flight.says("uav/2 has left the search"))
        assert double.wire.autopilot.armed
        assert flight.ended() == 0, "".join(flight.err)
        assert not double.wire.autopilot.armed
    said = json.loads(flight.out[-1])
    assert [left["vehicle"] for left in said["left"]] == [2]


@pytest.mark.parametrize(
    ("flags", "reason"),
    [
        (
            ("--vehicle", "tcp:127.0.0.1:1", "--vehicle", "tcp:127.0.0.1:2"),
            "--vehicle: 2 are given, and 1 would fly; wanted --vehicles 2",
        ),
        (
            ("--vehicles", "2", "--vehicle", "tcp:127.0.0.1:1"),
            "--home: wanted with --vehicle and --vehicles: LAT,LON,ALT,HEADING, of which the first two are ",
        ),
        (
            (
                *("--vehicles", "2", "--vehicle", "tcp:127.0.0.1:1", "--vehicle", "tcp:127.0.0.1:1"),
                *("--home", ORIGIN),
            ),
            "--vehicle: the same URL twice; wanted one for each real vehicle",
        ),
        (
            (
                *("--vehicles", "2", "--vehicle", "tcp:127.0.0.1:1", "--home", ORIGIN),
                *("--payload", "serial:/dev/ttyUSB0"),
            ),
            "--payload: serial:/dev/ttyUSB0 is not allowed with --vehicles; wanted simulated, or ",
        ),
        (("--vehicles", "2", "--wind", "2,90"), "--wind: only with --vehicle; "),
    ],
)
def test_what_cannot_fly_together_is_refused_in_one_line_before_anything_starts(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], flags: tuple[str, ...], reason: str
) -> None:
    status, _, err = run_sitl(monkeypatch, capsys, "fly", *flags)
    assert status == 2
    assert reason in err[-1]
