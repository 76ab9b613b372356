"""Mission scripts: one YAML file defines what is flown, which faults occur, and which outcome is expected."""

import math
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from aircraft.search.events import (
    Count,
    Hold,
    Land,
    OfVehicle,
    OnBoard,
    Radians,
    Resume,
    Return,
    ScriptEvent,
    Wind,
    WindSpeed,
    happens_to,
)
from aircraft.search.search import AfterStop
from link.cli import BadInput, did_you_mean
from plume.geodesy import HOME
from plume.parameters import LIMITS, MOST
from plume.problem import FARTHEST_M, PAPER, Place, Problem
from plume.problems.fleet import FARTHEST_APART_M, MOST_VEHICLES, Fleet
from plume.problems.names import check as check_problem
from plume.problems.names import sensor_text
from plume.randomness import MAX_SEED
from plume.scenario import AREA_M, AS_MODELLED, BUDGET_STEPS, SEPARATION_M, STEP_M, Scenario, draw
from plume.sensors import names as sensor
from plume.worlds.names import check
from plume.worlds.world import World
from sitl.autopilot.config import STREAM_S, VehicleConfig
from sitl.script.typed_yaml import Document


def _limits(name: str) -> Meta:
    low, high = LIMITS[name]
    return Meta(ge=low, le=high)


def _says(name: str, words: str, unit: str) -> Meta:
    """Return a description of a release's parameter."""
    low, high = LIMITS[name]
    return Meta(description=f"{words}, a number from {low:g} up to {high:.12g}, {unit}")


Rate = Annotated[float, _limits("q")]
Diffusivity = Annotated[float, _limits("d")]
Lifetime = Annotated[float, _limits("tau")]
Height = Annotated[float, _limits("z")]
Positive = Annotated[float, Meta(gt=0, le=MOST)]
Seconds = Annotated[float, Meta(ge=0, le=MOST)]
# The fields of a problem that a script has in another place, too, and where.
SAME = {
    "sensor": "sensor",
    "world": "world",
    "budget": "agent.budget",
    "step_m": "agent.step_m",
    "stop": "estimator.stop",
    "altitude_m": "vehicle.takeoff_altitude_m",
}
# The agent receives them in one command-line argument, which the system limits to 128 kB.
MOST_WAYPOINTS = 1000
OLD_WORDS = {"pause": "hold", "abort": "return"}  # what older scripts call these events
Expectation = Literal[
    "ceased",
    "not ceased",
    "located",
    "not located",
    "outside",
    "false stop",
    "warned",
    "landed",
    "returned home",
]


class ScenarioPart(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The gas release; the seed draws every field that is left out."""

    source: Annotated[
        Place | None,
        Meta(description="(x, y) m, x east, y north; up to an area's side beyond the problem's area"),
    ] = None
    q: Annotated[Rate | None, _says("q", "release rate", "g/s")] = None
    u: Annotated[WindSpeed | None, _says("u", "wind speed", "m/s")] = None
    phi: Annotated[
        Radians | None,
        Meta(description="direction the wind comes from, counter-clockwise from east, rad, -2π to 2π"),
    ] = None
    d: Annotated[Diffusivity | None, _says("d", "effective diffusivity", "m²/s")] = None
    tau: Annotated[Lifetime | None, _says("tau", "lifetime of the gas", "s")] = None
    start: Annotated[
        Place | None, Meta(description="where the search begins: (x, y) m in the problem's area")
    ] = None
    height: Annotated[Height | None, _says("z", "height of the source above the search plane", "m")] = None


class VehiclePart(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The simulated multirotor and its autopilot."""

    home_lat_deg: Annotated[float, Meta(ge=-90, le=90)] = VehicleConfig.home_lat_deg
    home_lon_deg: Annotated[float, Meta(ge=-180, le=180)] = VehicleConfig.home_lon_deg
    home_alt_m: Annotated[float, Meta(ge=-10_000, le=10_000)] = VehicleConfig.home_alt_m
    home_heading_deg: Annotated[float, Meta(ge=-360, le=360)] = VehicleConfig.home_heading_deg
    speed_mps: Positive = VehicleConfig.speed_mps
    climb_mps: Positive = VehicleConfig.climb_mps
    descent_mps: Positive = VehicleConfig.descent_mps
    accel_mps2: Positive = VehicleConfig.accel_mps2
    takeoff_altitude_m: Annotated[float, Meta(gt=0, le=VehicleConfig.ceiling_m)] = (
        VehicleConfig.takeoff_altitude_m
    )
    return_altitude_m: Annotated[float, Meta(gt=0, le=VehicleConfig.ceiling_m)] = (
        VehicleConfig.return_altitude_m
    )
    endurance_s: Annotated[
        float, Meta(gt=0, description="flight time of the battery, a number above 0, s")
    ] = VehicleConfig.endurance_s
    silence_s: Annotated[
        float,
        Meta(gt=0, description="real time without a waypoint before the return home, a number above 0, s"),
    ] = VehicleConfig.silence_s
    strict: Annotated[
        bool, Meta(description="OFFBOARD as in PX4: setpoints at 2 Hz or more, lost after 1 s of real time")
    ] = False
    after_stop: Annotated[
        AfterStop, Meta(description="what follows the search: return home and land, land, or hold until told")
    ] = "return"


class FleetPart(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Vehicles that search together, with one belief and one stop."""

    vehicles: Annotated[
        int, Meta(ge=1, le=MOST_VEHICLES, description=f"a whole number from 1 to {MOST_VEHICLES}: how many")
    ] = 1
    formation: Annotated[
        Literal["point", "edge", "corners"], Meta(description="where they start, as --from")
    ] = "point"
    separation_m: Annotated[
        float,
        Meta(
            ge=0,
            le=FARTHEST_APART_M,
            description=f"a number from 0 up to {FARTHEST_APART_M:g}: least distance between their ways, m",
        ),
    ] = SEPARATION_M


class EstimatorPart(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The particle filter, what it knows beforehand, and when it may stop."""

    particles: Annotated[int, Meta(ge=10, le=1_000_000)] = 1000
    assume: Annotated[
        Literal["field", "paper"], Meta(description="what is taken to be known, as --assume")
    ] = "field"
    threshold_m: Annotated[
        Annotated[float, Meta(gt=0, le=100)] | None,
        Meta(description="spread of a stop, a number above 0 up to 100, m: short for stop"),
    ] = None
    stop: Annotated[
        str | None, Meta(description="the stop criterion, in the format of --stop; default: spread:0.5")
    ] = None
    prior: Annotated[
        dict[str, str], Meta(description="priors by name, in the format of --prior: {q: 'gamma:2,150'}")
    ] = {}
    margin_m: Annotated[
        Annotated[float, Meta(ge=0, le=100_000)] | None,
        Meta(description="how far beyond the area's edges the source may be, as --margin, m"),
    ] = None
    stop_on: Annotated[
        str, Meta(description="what must be known before a stop, in the format of --stop-on")
    ] = "location"
    rate: Annotated[
        Rate | None, _says("q", "release rate assumed by the estimator, by default the scenario's", "g/s")
    ] = None
    doubted: Annotated[
        Literal["name", "leave-out"],
        Meta(description="what happens to a vehicle whose sensor seems to lie, as --doubted"),
    ] = "name"
    diffusivity: Annotated[
        Diffusivity | None,
        _says("d", "diffusivity assumed by the estimator, by default the scenario's", "m²/s"),
    ] = None
    lifetime: Annotated[
        Lifetime | None, _says("tau", "lifetime assumed by the estimator, by default the scenario's", "s")
    ] = None

    def __post_init__(self) -> None:
        if self.threshold_m is not None and self.stop is not None:
            raise ValueError("wanted at most one of threshold_m and stop")

    @property
    def criterion(self) -> str:
        """The stop criterion, in the format of --stop."""
        return self.stop or f"spread:{self.threshold_m or 0.5!r}"


class AgentPart(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The planner that chooses waypoints, and its step budget."""

    policy: Annotated[
        str, Meta(description="a policy's name or a bundle; none: only the scripted waypoints are flown")
    ] = "homing"
    budget: Count = BUDGET_STEPS
    headings: Literal[4, 8] | None = None
    step_m: Annotated[float, Meta(gt=0, le=FARTHEST_M)] | None = None
    measurements: Annotated[int, Meta(ge=1, le=10_000)] | None = None


# ---- events beside the vehicle: scripted waypoints, and parts that fail ----


class Waypoints(ScriptEvent, frozen=True, tag="waypoints"):
    """Waypoints that replace the agent's, one per reading; the first answers this step's reading."""

    points: Annotated[list[Place], Meta(min_length=1, description="a list of one place [x, y] or more, m")]

    def path(self) -> list[Place]:
        """Return the waypoints, (x, y) in m."""
        return self.points


class Lawnmower(ScriptEvent, frozen=True, tag="lawnmower"):
    """Waypoints that replace the agent's: rows west to east and back, a rectangle from south to north."""

    low: Place = (0.0, 0.0)
    high: Place = (AREA_M, AREA_M)
    spacing_m: Annotated[
        float,
        Meta(ge=0.1, le=MOST, description=f"a number from 0.1 up to {MOST:g}: distance between two rows, m"),
    ] = 5.0
    step_m: Annotated[
        float,
        Meta(
            ge=0.1, le=MOST, description=f"a number from 0.1 up to {MOST:g}: distance between two readings, m"
        ),
    ] = STEP_M

    def path(self) -> list[Place]:
        """Return the waypoints, (x, y) in m.

        Rows end on the rectangle's edges, and the last row lies on its north edge.
        """
        xs, ys = (
            _steps(low, high, step)
            for low, high, step in zip(self.low, self.high, (self.step_m, self.spacing_m), strict=True)
        )
        return [(x, y) for row, y in enumerate(ys) for x in (xs if row % 2 == 0 else xs[::-1])]


class Kill(ScriptEvent, frozen=True, tag="kill"):
    """A part is killed (SIGKILL) and restarted."""

    part: Literal["estimator", "agent", "router"]
    restart_after_s: Annotated[Seconds, Meta(description=f"a number from 0 up to {MOST:g}: real time, s")] = (
        0.0
    )


class Exclude(ScriptEvent, frozen=True, tag="leave-out"):
    """The operator lets a vehicle leave the search by several, and its readings are forgotten."""

    vehicle: Annotated[
        int,
        Meta(
            ge=1, le=64, description="a whole number from 1: the vehicle, of several, that leaves the search"
        ),
    ]


class Late(ScriptEvent, frozen=True, tag="join"):
    """A vehicle is started now, and joins the search that the others have begun without it."""

    vehicle: Annotated[
        int, Meta(ge=1, le=64, description="a whole number from 1: the vehicle, of several, that joins")
    ]


class Cut(ScriptEvent, frozen=True, tag="cut"):
    """The link between a part and the router carries nothing for a while; neither end is notified."""

    part: Literal["uav", "estimator", "agent"]
    for_s: Annotated[float, Meta(gt=0, le=600, description="a number above 0 up to 600: real time, s")]


def _steps(low: float, high: float, step: float) -> Sequence[float]:
    count = math.ceil((high - low) / step - 1e-9)
    return [min(low + number * step, high) for number in range(count)] + [high]


# ---- the whole ----


class Script(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One mission."""

    about: Annotated[str, Meta(description="what the mission demonstrates")] = ""
    seed: Annotated[
        int,
        Meta(ge=0, le=MAX_SEED, description="a whole number from 0: seed of the scenario and of all noise"),
    ] = 1
    speedup: Annotated[
        float,
        Meta(ge=0, le=1000, description="a number from 0 up to 1000: 1 real time, 0 as fast as possible"),
    ] = 10.0
    problem: Annotated[
        Problem, Meta(description="what is searched, where and from what knowledge; default: Table 1's")
    ] = PAPER
    scenario: ScenarioPart = ScenarioPart()
    vehicle: VehiclePart = VehiclePart()
    fleet: FleetPart = FleetPart()
    sensor: Annotated[
        str,
        Meta(description="a name of `plumeward list sensors`, with optional numbers: 'threshold:0.5,0.3'"),
    ] = "gaussian"
    world: Annotated[
        str,
        Meta(
            description="a world in the format of --world, a name of `plumeward list worlds`: how the gas "
            "moves, and how the truth differs from what the estimator is told"
        ),
    ] = AS_MODELLED
    estimator: EstimatorPart = EstimatorPart()
    agent: AgentPart = AgentPart()
    events: list[OnBoard | Waypoints | Lawnmower | Exclude | Late | Kill | Cut] = []
    expect: Annotated[
        Expectation | list[Expectation],
        Meta(description="what must hold at the end; decides the exit status"),
    ] = []

    def release(self) -> Scenario:
        """Return the scenario that the estimator is told: the fields given, the others drawn by the seed."""
        given = {
            name: value for name, value in msgspec.structs.asdict(self.scenario).items() if value is not None
        }
        return msgspec.structs.replace(draw(self.seed, self.problem), **given)

    def together(self) -> Fleet:
        """Return the vehicles that fly it. Raises ValueError, with the field, if they cannot start so."""
        part = self.fleet
        return Fleet(part.vehicles, part.formation, part.separation_m).within(self.problem)

    def simulated(self) -> World:
        """Return the simulated world of the mission; it holds the truth."""
        return World(self.release(), self.seed, sensor.parse(self.sensor), self.world, self.problem)

    def vehicle_config(self, sysid: int) -> VehicleConfig:
        """Return the vehicle's configuration; a companion's silence becomes simulation time.

        At speed-up 0 a waiting vehicle runs in real time, so the factor is 1. PX4's simulations stretch
        their times likewise.
        """
        fields = msgspec.structs.asdict(self.vehicle)
        del fields["after_stop"], fields["strict"]
        factor = self.speedup or 1.0
        fields["silence_s"] *= factor
        fields["area"] = self.problem.ground
        if home := self.problem.home:
            fields["home_meant"] = home
            if (self.vehicle.home_lat_deg, self.vehicle.home_lon_deg) == HOME:
                fields["home_lat_deg"], fields["home_lon_deg"] = home
        return VehicleConfig(
            sysid=sysid, stream_s=STREAM_S * factor if self.vehicle.strict else math.inf, **fields
        )

    @property
    def expectations(self) -> list[Expectation]:
        """The expectations, as a list."""
        return [self.expect] if isinstance(self.expect, str) else self.expect

    def scripted(self) -> dict[int, Place]:
        """Return the scripted waypoints, by the step of the reading that each answers."""
        return {
            step: point
            for event in self.events
            if isinstance(event, Waypoints | Lawnmower) and event.step is not None
            for step, point in enumerate(event.path(), start=event.step)
        }

    @property
    def budget(self) -> int:
        """The greatest number of moves; without a policy, at most the number of scripted waypoints."""
        return (
            min(self.agent.budget, max(self.scripted()) + 1)
            if self.agent.policy == "none"
            else self.agent.budget
        )

    def changed(self, changes: Mapping[str, Any]) -> "Script":
        """Return a copy with fields replaced, such as {"seed": 2, "agent.policy": "homing"}.

        What both the problem and another field say, such as its sensor, is replaced in both; a new problem
        brings its own. Raises ValueError where the problem does not allow it.
        """
        script = self
        changes = {**(_of_problem(changes["problem"]) if "problem" in changes else {}), **changes}
        if changes.get("estimator.threshold_m") is not None:
            changes["estimator.stop"] = None  # it is the short form
        for name, value in sorted(changes.items(), key=lambda change: change[1] is not None):
            part, _, field = name.rpartition(".")
            if part:
                value = msgspec.structs.replace(getattr(script, part), **{field: value})
            script = msgspec.structs.replace(script, **{part or field: value})
        said: dict[str, Any] = {"dwell_s": None} if "sensor" in changes else {}
        for field, name in SAME.items():
            if name in changes and changes[name] is not None:
                said[field] = changes[name]
        if changes.get("estimator.threshold_m") is not None:
            said["stop"] = script.estimator.criterion
        return msgspec.structs.replace(script, problem=script.problem.changed(**said)) if said else script


def _of_problem(problem: Problem) -> dict[str, Any]:
    """Return the fields of a script that say the same as a problem."""
    return {
        "sensor": sensor_text(problem),
        "world": problem.world,
        "agent.budget": problem.budget,
        "agent.step_m": None if problem.step_m == PAPER.step_m else problem.step_m,
        "estimator.threshold_m": None,
        "estimator.stop": None if problem.stop == PAPER.stop else problem.stop,
        "vehicle.takeoff_altitude_m": problem.altitude_m,
    }


def shipped() -> dict[str, Path]:
    """Return the shipped missions by name; a wheel has them inside this package, a checkout beside it."""
    folders = [parent / "missions" for parent in Path(__file__).parents[1:3]]
    return {path.stem: path for folder in folders for path in sorted(folder.glob("*.yaml"))}


def find(mission: str | Path) -> Path:
    """Return the path of a mission: a file of this name, else the shipped mission of this name.

    Raises BadInput if there is neither.
    """
    missions, name = shipped(), str(mission).removesuffix(".yaml")
    if not os.path.isfile(mission) and name in missions:
        return missions[name]
    try:
        os.stat(mission)
    except FileNotFoundError:
        near = did_you_mean(name, missions)
        raise BadInput(
            f"{mission}: no such file and no shipped mission{f'{near} Wanted' if near else '; wanted'} "
            f"a mission script, or one of {', '.join(missions)}"
        ) from None
    except OSError as error:
        raise BadInput(f"{mission}: {error.strerror}") from None
    return Path(mission)


def load(mission: str | Path) -> Script:
    """Read a mission script, or a shipped one by its name.

    Raises BadInput with file, line, field and what is allowed, in one line.
    """
    document = Document(find(mission))
    if old := _renamed(document.value):
        _warn(
            f"{document.path}: "
            + ", ".join(f"{word!r} is an old word, read as {OLD_WORDS[word]!r}" for word in old)
        )
    script = _agreed(document, document.to(Script))
    checks: dict[str, Callable[[str], object]] = {"sensor": sensor.parse, "world": check}
    for field, parse in checks.items():
        try:
            parse(getattr(script, field))
        except ValueError as error:
            raise document.error([field], str(error)) from None
    check_places(document, script)
    taken: dict[int, int] = {}
    for number, event in enumerate(script.events):
        _check(document, number, event)
        if isinstance(event, Waypoints | Lawnmower) and event.step is not None:
            for step in range(event.step, event.step + len(event.path())):
                if (other := taken.setdefault(step, number)) != number:
                    raise document.error(
                        ["events", number],
                        f"events[{other}] already has a waypoint for step {step}; wanted one per step",
                    )
    if len(taken) > MOST_WAYPOINTS:
        raise document.error(
            ["events"],
            f"{len(taken):,} scripted waypoints are not allowed; wanted {MOST_WAYPOINTS:,} at most",
        )
    if script.agent.policy == "none" and (not taken or max(taken) >= len(taken)):
        raise document.error(
            ["agent", "policy"],
            "'none' is not allowed; wanted a policy, or scripted waypoints from step 0 on without a gap",
        )
    for number, event in enumerate(script.events):
        if wrong := _alone(script, event):
            _warn(f"{document.path}: events[{number}]: {wrong}")
    return script


def _agreed(document: Document, script: Script) -> Script:
    """Return a script whose problem and other fields say the same; the others come first. Raises BadInput."""
    names = [*SAME.values(), "estimator.threshold_m"]
    written = {name: _at(script, name) for name in names if document.given(name) is not None}
    for name, value in written.items():
        try:
            script.changed({name: value})
        except ValueError as error:
            raise document.error(name.split("."), str(error).partition(": ")[2]) from None
    try:
        check_problem(script.problem)
    except ValueError as error:
        raise document.error(["problem"], str(error)) from None
    return script.changed({"problem": script.problem, **written})


def _at(script: Script, name: str) -> Any:
    part, _, field = name.rpartition(".")
    return getattr(getattr(script, part) if part else script, field)


def check_places(document: Document, script: Script) -> None:
    """Refuse places that are not in the problem's area. Raises BadInput."""
    area, obstacles = script.problem.area, script.problem.ground.obstacles
    start, source = script.scenario.start, script.scenario.source
    if start and not area.holds(start):
        raise document.error(
            ["scenario", "start"], f"{list(start)} is not allowed; wanted (x, y) m in {area.text}"
        )
    if start and obstacles and not obstacles.may_begin(np.array(start)):
        raise document.error(
            ["scenario", "start"],
            f"{list(start)} is not allowed; wanted (x, y) m clear of the problem's keep_out, as is the line "
            "from home",
        )
    (width_m, height_m), (x, y) = area.size_m, source or area.low
    if not (abs(x - area.low[0] - width_m / 2) <= 1.5 * width_m) or not (
        abs(y - area.low[1] - height_m / 2) <= 1.5 * height_m
    ):
        raise document.error(
            ["scenario", "source"],
            f"{[x, y]} is not allowed; wanted (x, y) m, up to an area's side beyond {area.text}",
        )
    for number, event in enumerate(script.events):
        if not isinstance(event, Waypoints | Lawnmower):
            continue
        before = None
        for at, place in enumerate(event.path()):
            field = ["points", at] if isinstance(event, Waypoints) else ["high"]
            if obstacles and obstacles.cross(np.array([before or place, place])):
                raise document.error(
                    ["events", number, *field],
                    f"the way to {list(place)} is not allowed; wanted ways that cross no keep_out",
                )
            before = place
            if not area.holds(place):
                raise document.error(
                    ["events", number, *field],
                    f"{list(place)} is not allowed; wanted places in the area, {area.text}",
                )


def _renamed(value: Any) -> list[str]:
    """Give the events of a script's value the names of today. Returns the old ones that it had."""
    events = value.get("events") if isinstance(value, dict) else None
    named = (
        [event for event in events if isinstance(event, dict) and isinstance(event.get("do"), str)]
        if isinstance(events, list)
        else []
    )
    old = [word for word in OLD_WORDS if any(event["do"] == word for event in named)]
    for event in named:
        event["do"] = OLD_WORDS.get(event["do"], event["do"])
    return old


@cache
def _warn(line: str) -> None:
    """Print a warning, once: a command may read its script more than once."""
    print(f"warning: {line}", file=sys.stderr)


def _check(document: Document, number: int, event: ScriptEvent) -> None:
    """Check what depends on more than one field. Raises BadInput."""
    field: list[str | int] = ["events", number]
    match event:
        case Wind(u=None, phi=None):
            raise document.error(field, "no change is given; wanted u, phi or both")
        case Waypoints(step=None) | Lawnmower(step=None):
            raise document.error(
                [*field, "time_s"], "not allowed for waypoints, which answer readings; wanted step"
            )
        case Lawnmower(low=low, high=high) if not (low[0] < high[0] and low[1] < high[1]):
            raise document.error(
                [*field, "high"],
                f"{list(high)} is not allowed; wanted a corner north-east of low, {list(low)}",
            )


def _alone(script: Script, event: object) -> str:
    """Return what a hold or a resume lacks, in words; empty if nothing, or if it is neither.

    The resumes with after_s belong to the holds in their order.
    """
    if not isinstance(event, Hold | Resume):
        return ""
    lacks = []
    for number in [event.vehicle] if event.vehicle else range(1, script.fleet.vehicles + 1):
        those = [each for each in script.events if isinstance(each, OfVehicle) and happens_to(each, number)]
        holds = [each for each in those if isinstance(each, Hold)]
        after = [each for each in those if isinstance(each, Resume) and each.after_s is not None]
        timed = [
            each for each in those if isinstance(each, Resume | Return | Land) and each.time_s is not None
        ]
        if isinstance(event, Hold):
            lacks.append(not timed and _place(event, holds) >= len(after))
        else:
            lacks.append(event.after_s is not None and _place(event, after) >= len(holds))
    if isinstance(event, Hold):
        return "no resume follows this hold: it lasts until an operator ends it" if any(lacks) else ""
    return "there is no hold from which this resume counts: it does not happen" if all(lacks) else ""


def _place(one: object, those: Sequence[object]) -> int:
    """Return the place of an object in a list that has it; two that are equal are two."""
    return next((number for number, each in enumerate(those) if each is one), 0)
