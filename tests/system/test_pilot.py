"""Protects that a pilot with a ground station always wins over a whole running mission, and that the
mission always ends.
"""

from collections.abc import Callable, Iterator

import pytest
from pymavlink import mavutil

from link.modes import Mode

ARM, SET_MODE, RETURN = 400, 176, 20


class Pilot:
    """A ground station: pymavlink, as MAVProxy uses it."""

    def __init__(self) -> None:
        self.link = mavutil.mavlink_connection("udpin:127.0.0.1:0", source_system=255, source_component=190)

    def until(self, kind: str, holds: Callable[[object], bool]) -> object:
        """Return the first message of a kind that holds; fails if none comes within a minute."""
        while message := self.link.recv_match(type=kind, blocking=True, timeout=400):
            if holds(message):
                return message
        raise AssertionError(f"no such {kind} within a minute")

    def until_mode(self, mode: Mode) -> None:
        self.until("HEARTBEAT", lambda beat: beat.custom_mode == mode.custom_mode)  # type: ignore[attr-defined]

    def command(self, number: int, *params: float) -> int:
        """Send a command; returns its MAV_RESULT."""
        self.link.mav.command_long_send(1, 1, number, 0, *params, *[0] * (7 - len(params)))
        return self.until("COMMAND_ACK", lambda ack: ack.command == number).result  # type: ignore[attr-defined, no-any-return]

    def change(self, mode: Mode) -> int:
        return self.command(SET_MODE, 1, *mode.value)


@pytest.fixture
def pilot() -> Iterator[Pilot]:
    pilot = Pilot()
    yield pilot
    pilot.link.close()


@pytest.fixture
def fly(start, tmp_path, pilot: Pilot) -> Callable:
    port = pilot.link.port.getsockname()[1]
    return lambda *words: start(
        "sitl",
        "fly",
        "--no-record",
        "--seed",
        "11",
        "--speedup",
        "8",
        "--out",
        f"udpout:127.0.0.1:{port}",
        *words,
        cwd=tmp_path,
    )


def test_a_pilot_holds_during_take_off_and_later_gives_the_search_back(
    fly: Callable, pilot: Pilot, wait_until: Callable
) -> None:
    mission = fly()
    pilot.until_mode(Mode.TAKEOFF)
    assert pilot.change(Mode.HOLD) == 0
    where = f"127.0.0.1:{pilot.link.port.getsockname()[1]}"
    wait_until(lambda: mission.says(f"Search gives way: HOLD by 255/190 at {where}"))
    for _ in range(3):  # the next heartbeats, three simulated seconds
        assert pilot.until("HEARTBEAT", lambda _: True).custom_mode == Mode.HOLD.custom_mode  # type: ignore[attr-defined]
    assert not mission.says("step   0")
    assert pilot.change(Mode.OFFBOARD) == 0
    pilot.until("STATUSTEXT", lambda said: said.text.startswith("Source found at (17.30, 21.77)"))  # type: ignore[attr-defined]
    pilot.until("HEARTBEAT", lambda beat: not beat.base_mode & 128)  # type: ignore[attr-defined]
    assert mission.ended() == 0


@pytest.mark.parametrize(
    ("when", "how"),
    [
        pytest.param(
            when,
            how,
            id=f"{name}-{when.name}",
            marks=() if (when, name) == (Mode.OFFBOARD, "land") else pytest.mark.full,
        )
        for when in (Mode.TAKEOFF, Mode.OFFBOARD)
        for name, how in {"land": Mode.LAND, "return": Mode.RETURN, "motors off": None}.items()
    ],
)
def test_a_mission_that_a_pilot_ends_is_over(
    fly: Callable, pilot: Pilot, when: Mode, how: Mode | None
) -> None:
    mission = fly("--speedup", "20")
    pilot.until_mode(when)
    pilot.until("LOCAL_POSITION_NED", lambda at: at.z < -0.5)  # type: ignore[attr-defined]
    assert (pilot.change(how) if how else pilot.command(ARM, 0, 21196)) == 0
    assert mission.ended() == 1
    assert f"error: ended by the pilot: {how.name if how else 'disarmed'} by 255/190 at " in mission.err[-1]
