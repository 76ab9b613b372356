"""Protects the launcher's watch over a mission from waiting for ever for what is lost."""

import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from pymavlink.dialects.v20 import common as mavlink

from link.bus.keys import BELIEF, DEPARTURE, HEALTH, LEAVE_OUT, MAVLINK_OUT, STOP
from link.bus.mavlink import Codec, unpack
from link.bus.messages import Departure, Health, LeaveOut, RoundReading, Stop
from link.bus.session import Arrival
from sitl.launch import launcher as module
from sitl.launch.disturbances import Disturbances
from sitl.launch.launcher import MissionWatch
from sitl.launch.mission import Launch, RealVehicle
from sitl.launch.processes import Ended, LogLine, MissionFailed
from sitl.launch.watchdog import Watchdog
from sitl.script.script import Kill, Script
from tests.fuzz.services import QuietBus
from tests.sitl.launch.test_trace import belief

PATIENCE_S = 40.0


class FallsSilent(QuietBus):
    """A bus with its own time: after what arrives at once nothing more comes."""

    connected = True
    now_s = 0.0
    land_at_s = math.inf
    landed: Arrival | None = None
    """When the vehicle lands, and what then arrives."""

    def receive(self, timeout_s: float | None = None) -> Any:
        if self._arrivals:
            return self._arrivals.pop(0)
        assert timeout_s
        self.now_s += timeout_s
        if self.now_s >= self.land_at_s:
            self.land_at_s = math.inf
            return self.landed
        assert self.now_s < 1000.0, "it waits for ever"
        return None

    def expiry(self) -> str:
        return ""


def watch(
    bus: FallsSilent,
    monkeypatch: pytest.MonkeyPatch,
    mission: Launch | None = None,
    events: Sequence[Kill] = (),
    processes: Any = None,
    parts: Sequence[str] = (),
) -> MissionWatch:
    """The watch over a mission of one move, in the bus's time."""
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: bus.now_s))
    progress: Any = SimpleNamespace(wait=lambda _: None, say=lambda _: None, show=lambda *_: None)
    watchdog = Watchdog(parts, PATIENCE_S, 0.0, progress.say)
    disturbances = Disturbances(events, processes, {}, watchdog, progress.say, *[lambda *_: None] * 2)
    held = Script(seed=7).changed({"agent.budget": 1, "vehicle.after_stop": "hold"})
    mission = mission or Launch(script=held, patience_s=PATIENCE_S)
    return MissionWatch(mission, bus, progress, watchdog, disturbances, "tcp/127.0.0.1:1", None)


def test_a_mission_whose_last_belief_is_lost_fails_when_patience_ends(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stop = Stop(1000, 1, (7.0, 8.0), (1.0, 0.0, 1.0), 0.4, 0.5)
    bus = FallsSilent(
        Arrival(BELIEF, msgspec.json.encode(belief(0)), b""),
        Arrival(STOP, msgspec.json.encode(stop), b""),
    )
    with pytest.raises(
        MissionFailed, match=r"^the estimator has declared the stop, but its last belief was not received$"
    ):
        watch(bus, monkeypatch).until_the_end()
    assert PATIENCE_S <= bus.now_s <= PATIENCE_S + 2.0


EXPIRED = "the certificate uav/1/agent expired on 2026-11-29"


class Expires(FallsSilent):
    """A bus whose own certificate has expired: its link is closed."""

    connected = False

    def expiry(self) -> str:
        return EXPIRED


@pytest.mark.parametrize(
    ("part", "why"),
    [
        ("agent", f"the agent has said nothing for 40 s (--patience S waits longer): {EXPIRED}"),
        ("estimator", "the agent has said nothing for 40 s (--patience S waits longer)"),
    ],
)
def test_a_part_that_falls_silent_as_its_certificate_expires_has_that_in_the_missions_last_line(
    monkeypatch: pytest.MonkeyPatch, part: str, why: str
) -> None:
    said = Health("agent", "searching", step=0, compute_s=0.0, uptime_s=9.0, refused={})
    bus = FallsSilent(
        Arrival(HEALTH, msgspec.json.encode(said), b"", name="agent"),
        LogLine(part, f"{part}: warning: {EXPIRED}", "warning"),
        LogLine("agent", "agent: warning: waits for the router", "warning"),
    )
    with pytest.raises(MissionFailed) as failed:
        watch(bus, monkeypatch, parts=["agent"]).until_the_end()
    assert str(failed.value) == why


def test_a_mission_whose_own_certificate_expires_says_so_and_not_that_the_router_is_silent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bus = Expires()
    with pytest.raises(MissionFailed, match=f"^{EXPIRED}$"):
        watch(bus, monkeypatch, parts=["router"]).until_the_end()


def test_a_mission_whose_last_compute_times_are_lost_ends_with_its_outcome(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bus = FallsSilent(*(Arrival(BELIEF, msgspec.json.encode(belief(step)), b"") for step in (0, 1)))
    flown = watch(bus, monkeypatch).until_the_end()
    assert (len(flown.trace), flown.outcome.search_time_s) == (2, 0.0)
    assert PATIENCE_S <= bus.now_s <= PATIENCE_S + 2.0


def test_a_real_vehicle_has_returned_home_where_home_is_and_not_its_estimators_origin(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Home lies 30 m north of the origin and 4 m below it, and the autopilot is system 32; it lands 0.2 m
    from home, 0.3 m too high.
    """
    copter = Codec(32, 1)
    beat = mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, 1, 6, 3, 3)
    origin = mavlink.MAVLink_gps_global_origin_message(473977419, 85455938, 488_000)
    home = mavlink.MAVLink_home_position_message(
        473977419 + 2698, 85455938, 484_000, *[0.0] * 3, [1.0, 0.0, 0.0, 0.0], *[0.0] * 3
    )
    state = mavlink.MAVLink_extended_sys_state_message(0, mavlink.MAV_LANDED_STATE_ON_GROUND)
    place = mavlink.MAVLink_local_position_ned_message(1000, 30.0, 0.2, 3.7, 0.0, 0.0, 0.0)
    landed = Health("uav", "landed", step=1, compute_s=0.0, uptime_s=9.0, refused={}, system=32)
    script = Script(seed=7, expect="returned home").changed({"agent.budget": 1})
    mission = Launch(script=script, patience_s=PATIENCE_S, real=RealVehicle(urls=["tcp:127.0.0.1:5760"]))
    for said, home_again in (
        (copter.pack(beat, origin, home, state, place), True),
        (Codec(33, 1).pack(beat, state, place), False),
    ):
        bus = FallsSilent(
            *(Arrival(BELIEF, msgspec.json.encode(belief(step)), b"") for step in (0, 1)),
            Arrival(HEALTH, msgspec.json.encode(landed), b"", name="uav"),
            Arrival(MAVLINK_OUT, said, b""),
        )
        assert watch(bus, monkeypatch, mission).until_the_end().expectations == {"returned home": home_again}


def test_a_vehicle_whose_budget_is_spent_is_sent_home_by_its_own_id_and_a_real_one_by_its_search(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    script = Script(seed=7).changed({"agent.budget": 1})
    for url, system, told in ((None, 1, (1, 1)), ("tcp:127.0.0.1:5760", 32, (32, 191))):
        flying, landed = (
            msgspec.json.encode(
                Health("uav", state, step=1, compute_s=0.0, uptime_s=uptime_s, refused={}, system=system)
            )
            for state, uptime_s in (("searching", 9.0), ("landed", 10.0))
        )
        bus = FallsSilent(
            Arrival(HEALTH, flying, b"", name="uav"),
            *(Arrival(BELIEF, msgspec.json.encode(belief(step)), b"") for step in (0, 1)),
        )
        bus.land_at_s, bus.landed = 50.0, Arrival(HEALTH, landed, b"", name="uav")
        real = RealVehicle(urls=[url]) if url else None
        watch(bus, monkeypatch, Launch(script=script, patience_s=PATIENCE_S, real=real)).until_the_end()
        orders = {
            (it.target_system, it.target_component, it.command)
            for _, payload, _ in bus.published
            for it in unpack(payload)
        }
        assert orders == {(*told, mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH)}


def test_a_mission_that_a_pilot_has_ended_says_who_and_how(monkeypatch: pytest.MonkeyPatch) -> None:
    how = "ended by the pilot: RTL by a radio or a ground station"
    landed = Health("uav", "landed", 0, 0.0, 0.0, {}, (how,))
    bus = FallsSilent(
        Arrival(BELIEF, msgspec.json.encode(belief(0)), b""),
        Arrival(HEALTH, msgspec.json.encode(landed), b"", name="uav"),
    )
    with pytest.raises(MissionFailed, match=f"^{how}$"):
        watch(bus, monkeypatch).until_the_end()


def test_the_times_of_a_script_count_from_the_start_however_long_a_real_autopilot_has_been_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """At the mission's ten-fold speed 30 s are 3 s of real time."""
    first = msgspec.structs.replace(belief(0), time_boot_ms=7_200_000)
    bus = FallsSilent(Arrival(BELIEF, msgspec.json.encode(first), b""))

    def kill(part: str) -> None:
        raise MissionFailed(f"{part} killed")

    mission = Launch(script=Script(seed=7), real=RealVehicle(urls=["tcp:127.0.0.1:5760"]))
    event = Kill(part="agent", time_s=30.0)
    with pytest.raises(MissionFailed, match="agent killed"):
        watch(bus, monkeypatch, mission, [event], SimpleNamespace(kill=kill)).until_the_end()
    assert 3.0 <= bus.now_s <= 3.0 + 2.0


def of_round(step: int, *vehicles: int) -> Arrival:
    """A belief after the readings of these vehicles."""
    readings = [
        RoundReading(number, number, 1000 * step, (float(step), 2.0), 5.0, step / 4) for number in vehicles
    ]
    return Arrival(BELIEF, msgspec.json.encode(msgspec.structs.replace(belief(step), readings=readings)), b"")


def of_vehicle(number: int, state: str) -> Arrival:
    said = Health("uav", state, step=1, compute_s=0.0, uptime_s=9.0, refused={})
    return Arrival(HEALTH, msgspec.json.encode(said), b"", name=f"uav/{number}/health/uav")


def departure(reason: str) -> Arrival:
    return Arrival(DEPARTURE, msgspec.json.encode(Departure(2, 1, reason)), b"")


DIES = Ended("uav/2", 1, "error: link lost for 100 s")


@pytest.mark.parametrize(
    ("items", "reason"),
    [
        (
            [departure("no reading for 12 s: link lost"), of_round(1, 1), of_vehicle(1, "landed"), DIES],
            "no reading for 12 s: link lost",
        ),
        (
            [DIES, departure("gone from the bus for 12 s"), of_round(1, 1), of_vehicle(1, "landed")],
            "link lost for 100 s",
        ),
    ],
    ids=["after it has left", "and leaves by that"],
)
def test_one_of_several_that_dies_takes_no_outcome_with_it_which_says_why_it_left(
    monkeypatch: pytest.MonkeyPatch, items: list[Any], reason: str
) -> None:
    """Also when the last one that searched has landed before."""
    script = Script(seed=7).changed({"agent.budget": 1, "fleet.vehicles": 2})
    bus = FallsSilent(of_round(0, 1, 2), *items)
    flown = watch(bus, monkeypatch, Launch(script=script, patience_s=PATIENCE_S)).until_the_end()
    assert flown.outcome.steps == 1
    assert [(left.vehicle, left.step, left.reason) for left in flown.outcome.left] == [(2, 1, reason)]


@pytest.mark.parametrize(
    ("ends", "reason"),
    [
        (DIES, "link lost for 100 s"),
        (Ended("uav/2", 1, "error: " + 300 * "x"), 200 * "x"),
        (Ended("uav/2", -9, "error: link lost for 100 s"), "was killed by signal 9"),
        (Ended("uav/2", 1, "uav/2: warning: link lost"), "exited with status 1"),
    ],
    ids=["with words", "with long words", "killed", "without words"],
)
def test_one_of_several_that_ends_on_the_ground_leaves_for_the_reason_that_it_gives(
    monkeypatch: pytest.MonkeyPatch, ends: Ended, reason: str
) -> None:
    script = Script(seed=7).changed({"agent.budget": 1, "fleet.vehicles": 2})
    bus = FallsSilent(
        of_vehicle(1, "standby"),
        of_vehicle(2, "standby"),
        ends,
        of_round(0, 1),
        of_round(1, 1),
        of_vehicle(1, "landed"),
    )
    watch(bus, monkeypatch, Launch(script=script, patience_s=PATIENCE_S)).until_the_end()
    (order,) = [message for key, message, _ in bus.published if key is LEAVE_OUT]
    assert msgspec.json.decode(order, type=LeaveOut) == LeaveOut(2, reason)
