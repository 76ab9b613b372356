"""What a launcher is to fly, what cannot be flown, and the command lines of the services that fly it."""

import itertools
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from aircraft.payload.options import SIMULATED
from aircraft.search.events import OfVehicle
from link.cli import BadInput, numbers
from plume.problem import PAPER
from plume.problems.fleet import ALONE, Fleet
from plume.randomness import derived_seed
from plume.scenario import AS_MODELLED, Scenario
from sitl.launch.watchdog import PATIENCE_S
from sitl.script.options import ORIGIN_WANTED
from sitl.script.script import (
    AgentPart,
    Cut,
    EstimatorPart,
    Exclude,
    Expectation,
    Kill,
    Late,
    Lawnmower,
    Script,
    Waypoints,
)
from sitl.uav.options import LATE_IN_A_MOVING_WORLD, at_own_home, longest_wait_s

# Expectations that need the source's true position.
TRUTH_NEEDED: frozenset[Expectation] = frozenset({"located", "not located", "false stop"})
PAYLOAD = "payload"
# Real time for which a round waits for one of several vehicles that might have come, s; at most this part of
# the time after which the others go home because no waypoint comes.
OVERDUE_S, OF_SILENCE = 20.0, 2 / 3
USUAL = {"estimator": EstimatorPart(), "agent": AgentPart()}


@dataclass(frozen=True, kw_only=True)
class RealVehicle:
    """A real autopilot, or those of several that search together, and what measures on each."""

    urls: Sequence[str]
    payload: str = SIMULATED  # the gas sensor, in the form of --payload
    payload_arguments: Sequence[str] = ()  # the arguments that say which plume a simulated one reads
    wait_s: float = math.inf  # real time in which the services that run elsewhere have to be there


@dataclass(frozen=True, kw_only=True)
class Launch:
    """What to fly, and with what."""

    script: Script
    instance: int = 0
    sysid: int | None = None  # MAVLink system id; None: that of the instance, or of the real autopilot
    # The script's file and the flags that change it: the uav reads them itself.
    uav_arguments: Sequence[str] = ()
    listen: str = "tcp/127.0.0.1:0"  # of the router
    # A router elsewhere, whose estimator and agent fly the mission; None: all are started here.
    connect: str | None = None
    secure: Path | None = None  # the folder of certificates; None: nothing is secured
    real: RealVehicle | None = None  # None: the simulated vehicle
    record: Path | None = None  # the MCAP file to record to
    log_level: str = "warning"
    origin: tuple[float, float] | None = None  # of the area of several vehicles, where one is chosen, degrees
    patience_s: float = PATIENCE_S  # real time after which a silent part counts as hung

    @property
    def system(self) -> int | None:
        """The MAVLink system id of the vehicle, or of the first of several, which the others' follow.

        None: that of a real autopilot alone, which nobody knows yet.
        """
        return self.sysid or (None if self.real and not self.numbers else self.instance + 1)

    @cached_property
    def fleet(self) -> Fleet:
        """The vehicles that search together."""
        return self.script.together()

    @property
    def numbers(self) -> Sequence[int]:
        """The numbers of several vehicles that search together; empty for one alone."""
        return numbers(self.fleet.vehicles)

    @property
    def uavs(self) -> list[str]:
        """The names of the parts that fly: `uav`, or `uav/1`, `uav/2` and so on."""
        return [f"uav/{number}" for number in self.numbers] or ["uav"]

    @property
    def stands(self) -> dict[int, tuple[float, float]]:
        """Where each of several takes off, (x, y) m from home, by its number; a real one at its own home."""
        world, real = self.script.simulated(), len(self.real_uavs)
        starts = self.fleet.starts(world.start, world.seed, world.problem.ground)
        return {number: (0.0, 0.0) if number <= real else starts[number - 1] for number in self.numbers}

    @property
    def late(self) -> Sequence[int]:
        """The numbers of those that the script starts when the others have begun."""
        return [event.vehicle for event in self.script.events if isinstance(event, Late)]

    @property
    def real_uavs(self) -> dict[str, str]:
        """The parts that fly a real autopilot, and the URL of each: of several vehicles the first ones."""
        return dict(zip(self.uavs, self.real.urls if self.real else (), strict=False))

    @property
    def payloads(self) -> dict[str, str]:
        """The parts that measure on a real autopilot, and for which part: `payload`, or `payload/1`."""
        return {part.replace("uav", PAYLOAD): part for part in self.real_uavs}

    @property
    def home(self) -> tuple[float, float]:
        """Latitude and longitude of the simulated vehicle's home, degrees."""
        config = at_own_home(self.script.vehicle_config(self.instance + 1), self.instance)
        return config.home_lat_deg, config.home_lon_deg

    @property
    def truth(self) -> Scenario | None:
        """The scenario as it truly is; None where a real sensor measures a real plume."""
        simulated = self.real is None or self.real.payload == SIMULATED
        return self.script.simulated().truth if simulated else None

    @property
    def namespace(self) -> str:
        """The key prefix of the vehicle, or of the search by several."""
        return f"{'search' if self.numbers else 'uav'}/{self.instance + 1}"


def check_payload(script: Script, payload: str) -> None:
    """Raise BadInput if a script cannot be flown with the gas sensor of a real vehicle."""
    if payload == SIMULATED:
        return
    real = f"--payload {payload}"
    if script.world != AS_MODELLED:
        raise BadInput(f"--world: {script.world!r} is not allowed with {real}: its plume is real")
    release = script.scenario
    for name in release.__struct_fields__:
        if name != "start" and getattr(release, name) is not None:
            raise BadInput(
                f"MISSION: scenario.{name} is not allowed with {real}: its plume is real; "
                "what the estimator assumes is in its own part"
            )
    for judged in sorted(TRUTH_NEEDED & {*script.expectations}):
        raise BadInput(
            f"MISSION: expect: {judged!r} is not allowed with {real}: nobody knows where the source is"
        )


def check_connect(script: Script, given: Collection[str]) -> None:
    """Raise BadInput if a script cannot be flown with services that run elsewhere.

    `given`: fields set by flags, such as agent.policy.
    """
    for part, usual in USUAL.items():
        chosen = getattr(script, part)
        for field in sorted(chosen.__struct_fields__):
            name = f"{part}.{field}"
            changed = name in given or getattr(chosen, field) != getattr(usual, field)
            if changed and name != "agent.budget":  # the launcher uses the budget, too: it ends the mission
                raise BadInput(
                    f"--connect: {name} cannot be chosen: the {part} runs elsewhere, with its own flags"
                )
    for number, event in enumerate(script.events):
        if isinstance(event, Kill | Cut | Waypoints | Lawnmower):
            raise BadInput(
                f"--connect: events[{number}], {event.__struct_config__.tag}, cannot happen: "
                "it needs parts that this command starts"
            )


def estimator_arguments(mission: Launch) -> list[str]:
    """Return the estimator's flags: what it assumes, and a seed of its own.

    The mission's seed would reveal the source. With a real plume it assumes what the script says, and its own
    defaults for the rest.
    """
    script, part = mission.script, mission.script.estimator
    release = script.release() if mission.truth else None
    q, d, tau = (release.q, release.d, release.tau) if release else (None, None, None)
    flags: dict[str, Any] = {
        "--problem": _told(script),
        "--particles": part.particles,
        "--assume": part.assume,
        "--stop": part.criterion,
        "--sensor": script.sensor,
        "--stop-on": part.stop_on,
        "--margin": part.margin_m,
        "--rate": part.rate or q,
        "--diffusivity": part.diffusivity or d,
        "--lifetime": part.lifetime or tau,
        "--seed": derived_seed(script.seed, "estimator"),
        "--sysid": mission.system,
        "--vehicles": mission.fleet.vehicles if mission.numbers else None,
        "--overdue": _overdue_s(mission) if mission.numbers else None,
        "--doubted": part.doubted if mission.numbers else None,
        "--prior": [f"{name}={prior}" if prior else name for name, prior in part.prior.items()],
    }
    return _words(flags)


def _overdue_s(mission: Launch) -> float:
    """Return the real time for which a round waits for a vehicle: less than the others wait for the agent."""
    script = mission.script
    leg_s = longest_wait_s(script.vehicle_config(1), script.simulated().sensor)
    waits_s = min(OVERDUE_S, OF_SILENCE * script.vehicle.silence_s)
    return round(waits_s + (leg_s / script.speedup if script.speedup else 0.0), 1)


def agent_arguments(mission: Launch) -> list[str]:
    """Return the agent's flags."""
    script, agent, scripted = mission.script, mission.script.agent, mission.script.scripted()
    flags: dict[str, Any] = {
        "--problem": _told(script),
        "--policy": None if agent.policy == "none" else agent.policy,
        "--budget": script.budget,
        "--headings": agent.headings,
        "--step": agent.step_m,
        "--measurements": agent.measurements,
        "--seed": derived_seed(script.seed, "agent"),
        "--sysid": mission.system,
        "--separation": mission.fleet.separation_m if mission.numbers else None,
        "--waypoints": [_path(scripted, step) for step in sorted(scripted) if step - 1 not in scripted],
    }
    return _words(flags)


def uav_arguments(mission: Launch) -> dict[str, list[str]]:
    """Return the flags of each uav, by its part's name, beside those that all parts have."""
    fleet, instance, system = mission.fleet, mission.instance, mission.sysid
    together = (
        {}
        if fleet == ALONE
        else {"--vehicles": fleet.vehicles, "--from": fleet.formation, "--separation": fleet.separation_m}
    )
    flags: list[dict[str, Any]] = [{"-I": instance, **together}]
    if mission.numbers:
        flags = [
            {"-I": instance + k, **together, "--number": k + 1, "--sysid": system and system + k}
            for k in range(fleet.vehicles)
        ]
    real, arguments = mission.real_uavs, {}
    for part, own in zip(mission.uavs, flags, strict=True):
        # A simulated one beside a real one has no wait of its own: it takes off when all are there.
        shared = [word for word in mission.uav_arguments if part in real or not word.startswith("--wait=")]
        arguments[part] = [*shared, *_words({"--vehicle": real.get(part)} | own)]
    return arguments


def check_fleet(
    script: Script, fleet: Fleet, given: Mapping[str, Any], origin: tuple[float, float] | None = None
) -> None:
    """Raise BadInput if a script cannot be flown by several vehicles.

    given: the flags that stand on the command line.  origin: of the area, latitude and longitude, degrees.
    """
    for number, event in enumerate(script.events):
        if fleet.vehicles == 1 and isinstance(event, Exclude | Late):
            raise BadInput(
                f"MISSION: events[{number}], {event.__struct_config__.tag}, cannot happen: one vehicle "
                "flies; wanted --vehicles, or fleet.vehicles, of 2 or more"
            )
        if isinstance(event, OfVehicle | Exclude | Late) and event.vehicle and event.vehicle > fleet.vehicles:
            raise BadInput(
                f"MISSION: events[{number}].vehicle: {event.vehicle} is not allowed; "
                f"wanted 1 to {fleet.vehicles}, as many fly"
            )
    _check_late(script, fleet, real=len(given.get("vehicle", ())))
    _check_real(fleet, given, origin)
    if fleet.vehicles == 1:
        return
    for number, event in enumerate(script.events):
        tag = event.__struct_config__.tag
        if isinstance(event, Waypoints | Lawnmower):
            raise BadInput(f"--vehicles: events[{number}], {tag}, cannot happen: it is for one vehicle")
        if isinstance(event, Kill | Cut) and event.part == "uav":
            raise BadInput(f"--vehicles: events[{number}], {tag} uav, cannot happen: there are several")


def _check_late(script: Script, fleet: Fleet, real: int) -> None:
    """Raise BadInput if vehicles cannot join as the script says.

    real: how many are real, the first ones.
    """
    late: set[int] = set()
    for number, event in enumerate(script.events):
        if not isinstance(event, Late):
            continue
        where = f"MISSION: events[{number}], join of vehicle {event.vehicle}, cannot happen"
        if event.vehicle in late:
            raise BadInput(f"{where} twice")
        late.add(event.vehicle)
        if len(late) == fleet.vehicles:
            raise BadInput(f"{where}: nobody would begin; wanted one at least that does not join late")
        if event.vehicle > real and not script.simulated().is_steady:
            raise BadInput(f"{where}: {LATE_IN_A_MOVING_WORLD}")


def _check_real(fleet: Fleet, given: Mapping[str, Any], origin: tuple[float, float] | None) -> None:
    """Raise BadInput if real autopilots cannot fly with a fleet."""
    urls, payload = given.get("vehicle", ()), given.get("payload", SIMULATED)
    if len(urls) > fleet.vehicles:
        raise BadInput(
            f"--vehicle: {len(urls)} are given, and {fleet.vehicles} would fly; wanted --vehicles {len(urls)}"
        )
    if urls and fleet.vehicles > 1 and origin is None:
        raise BadInput(f"--home: wanted with --vehicle and --vehicles: {ORIGIN_WANTED}")
    if not urls and "wind" in given:
        raise BadInput("--wind: only with --vehicle; the simulated vehicle's wind is the mission's")
    if len(set(urls)) < len(urls):
        raise BadInput("--vehicle: the same URL twice; wanted one for each real vehicle")
    if fleet.vehicles > 1 and urls and payload != SIMULATED:
        raise BadInput(
            f"--payload: {payload} is not allowed with --vehicles; wanted {SIMULATED}, or the parts of each "
            "real vehicle started by themselves, with --number"
        )


def _told(script: Script) -> str | None:
    """Return what the services are told of the problem, in the form of --problem; None: it is the paper's."""
    told = script.problem.told
    return None if told == PAPER else told.text


def _path(scripted: Mapping[int, tuple[float, float]], start: int) -> str:
    """Format the waypoints from a step up to the first gap for the agent's --waypoints."""
    points = [scripted[step] for step in itertools.takewhile(scripted.__contains__, itertools.count(start))]
    # 9 digits tell one float32 from the next
    return f"{start}:" + ";".join(f"{x:.9g},{y:.9g}" for x, y in points)


def _words(flags: Mapping[str, Any]) -> list[str]:
    pairs = [
        (flag, str(each))
        for flag, value in flags.items()
        for each in (value if isinstance(value, list) else [value])
        if each is not None
    ]
    return list(itertools.chain(*pairs))
