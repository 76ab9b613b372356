"""The source of a replay: a recording of the bus with the recorded answers, or a log of others."""

import argparse
import math
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, NamedTuple

import msgspec

from ground.findings.assumed import UNTOLD_RATE
from ground.logs import survey
from ground.logs.table import is_table
from ground.replay import settings, verify
from ground.replay.turns import Turns
from ground.replay.verify import Answer, Rules
from ground.tlog import flight
from ground.tlog.flight import LoggedFlight
from link.bus.keys import HEALTH, MAVLINK_OUT, READING, row_name, vehicle_of
from link.bus.mavlink import BadFrame, nearest, unpack_reading
from link.cli import MOST_VEHICLES, BadInput
from link.record.reader import RecordError, is_record, read
from link.record.record import Entry
from plume.problem import PAPER, Problem, in_area, square
from plume.scenario import AS_MODELLED
from plume.sensors import names as sensor
from sitl.script import script

# The keys that a vehicle publishes on, by their names in a log.
VEHICLE_KEYS = {
    READING.name: READING,
    MAVLINK_OUT.name: MAVLINK_OUT,
    HEALTH.named("uav"): HEALTH,
}
# The service that sends each kind of answer.
SERVICES = {"belief": "estimator", "stop": "estimator", "waypoint": "agent"}
# Flags for reading a log of others, those of an autopilot's only, those of a table only, and flags for its
# estimator.
READING_FLAGS = ("sysid", "gas", "wind", "every", "origin", "area", "plume", "columns", "background", "ray")
OF_AUTOPILOTS, OF_TABLES = ("sysid", "gas", "plume"), ("columns", "ray")
FILTER_FLAGS = (
    "particles",
    "assume",
    "threshold",
    "stop",
    "prior",
    "stop_on",
    "margin",
    "rate",
    "diffusivity",
    "lifetime",
    "sensor",
    "seed",
)
# Of a sensor of which only the noise in clean air is known: readings are wrong by this share of the gas.
SENSOR_NOISE = 0.3

FIRST_VEHICLE = "uav/1"  # the namespace of the first vehicle
OVERTAKE_NS = 500_000_000  # largest time by which messages overtake each other on their way into a log, ns


class Source(NamedTuple):
    """What is replayed, and the services to start."""

    path: Path
    entries: list[Entry]  # the vehicle's messages in the order of publication
    # The recorded answers of the services; empty for an autopilot's log.
    then: Mapping[tuple[int, str], Answer]
    parts: Mapping[str, list[str]]  # the services to start, with their command lines
    namespace: str
    recorded: bool  # True: a recording of the bus. False: an autopilot's log.
    # Why a service cannot be started as the record says, one line each.
    unfit: Mapping[str, str] = MappingProxyType({})
    # The log has all answers to readings up to this time; if it was cut off or damaged, later ones may lack
    # some.
    sure_ms: float = math.inf
    sure_ns: float = math.inf  # up to this time of publication it lacks nothing
    damaged: bool = False  # whether pieces of it are missing
    slowest_s: float = 0.0  # the longest recorded answer time
    budget: float = math.inf  # the agent's step budget
    truth: tuple[float, float] | None = None  # true location of the source, m; None if unknown
    world: str = AS_MODELLED  # how the truth differs from what the estimator was told; as modelled if unknown
    problem: Problem = PAPER  # where the search flew
    notes: tuple[str, ...] = ()  # remarks on the log, one line each
    home: tuple[float, float] | None = None  # latitude and longitude of a log's home, degrees
    # Vehicles that searched together. Keys of the last one have their plain names in `entries`: its reading
    # is the last of a round, which the services answer.
    vehicles: int = 1
    turns: Turns = Turns()  # the rounds of a search that vehicles have left or joined late

    def time_of(self, entry: Entry) -> int | None:
        """Return the time of a reading that the services answer, ms, as of its answers."""
        return _time_of(entry, self.turns)

    @property
    def about(self) -> dict[str, Any]:
        """What the record of a replay says of itself."""
        return {
            "namespace": self.namespace,
            "parts": dict(self.parts),
            "problem": msgspec.to_builtins(self.problem),
            "mission": {"about": f"replay of {self.path.name}"},
            **({"fleet": {"vehicles": self.vehicles}} if self.vehicles > 1 else {}),
            "log": {"file": self.path.name, "notes": self.notes},
        }


class _Release(msgspec.Struct, frozen=True):
    source: tuple[float, float] | None = None


class _Mission(msgspec.Struct, frozen=True):
    world: str = AS_MODELLED


class _Fleet(msgspec.Struct, frozen=True):
    vehicles: Annotated[int, msgspec.Meta(ge=1, le=MOST_VEHICLES)] = 1


class _About(msgspec.Struct, frozen=True):
    """The fields used of a recording's own description."""

    fleet: _Fleet = _Fleet()

    parts: dict[str, list[str]] = {}
    namespace: Annotated[str, msgspec.Meta(pattern=r"\A[\w.-]+(/[\w.-]+)*\Z", max_length=200)] = FIRST_VEHICLE
    budget: int | None = None
    scenario: _Release = _Release()
    mission: _Mission = _Mission()
    problem: Problem = PAPER


def recording(path: Path, bundle: str | None = None) -> Source:
    """Read a recording of the bus; raises BadInput and RecordError. `bundle`: the file of its policy."""
    log = read(path)
    try:
        told = msgspec.convert(log.about, _About)
    except msgspec.ValidationError as error:
        raise BadInput(f"{path}: its description cannot be used: {error}") from None
    if bundle and not settings.flew_a_bundle(told.parts.get("agent", [])):
        raise BadInput(f"--policy: {bundle!r} is not allowed with {path}: its agent flew no bundle")
    parts, unfit = {}, {}
    for service, words in told.parts.items():
        if service in SERVICES.values():
            try:
                parts[service] = settings.words(service, words, bundle if service == "agent" else None)
            except ValueError as error:
                hint = (
                    "; name the bundle with --policy"
                    if service == "agent" and settings.flew_a_bundle(words)
                    else ""
                )
                unfit[service] = f"{path} starts its {service} with {error}, which a record may not do{hint}"
    note = ""
    sure_ms = sure_ns = math.inf
    turns = Turns.of(log.entries[: log.damage[0].before] if log.damage else log.entries)
    changes = bool(turns.roll)
    entries = turns.named(log.entries) if changes else _as_the_last_one_says(log.entries, told.fleet.vehicles)
    sound = entries[: log.damage[0].before] if log.damage else entries
    then = verify.said(sound, turns.placed)
    asked: dict[int, int] = {}  # by the time of a reading, when it was published first
    for entry in sound:
        if entry.key == READING.name and (time_ms := _time_of(entry, turns)) is not None:
            asked.setdefault(time_ms, entry.published_ns)
    if not log.complete:
        end_s = max((entry.simulation_s for entry in sound), default=0.0)
        note = f"{path} is cut off: replayed up to its end at {end_s:.2f} s"
        if log.damage:
            note = f"warning: {path} {log.shortcoming}; --verify compares up to {end_s:.2f} s"
        sure_ns = max((entry.published_ns for entry in sound), default=0)
        sure_ms = max((time for time, ns in asked.items() if ns <= sure_ns - OVERTAKE_NS), default=-1)
    flown = sorted(
        (entry for entry in entries if row_name(entry.key) in VEHICLE_KEYS),
        key=lambda entry: entry.published_ns,
    )
    return Source(
        path,
        turns.in_order(flown) if changes else _in_rounds(flown, told.fleet.vehicles),
        then,
        parts,
        told.namespace,
        recorded=True,
        unfit=unfit,
        sure_ms=sure_ms,
        sure_ns=sure_ns,
        damaged=bool(log.damage),
        slowest_s=max(
            (each.published_ns - asked.get(each.time_ms, each.published_ns) for each in then.values()),
            default=0,
        )
        / 1e9,
        budget=math.inf if told.budget is None else told.budget,
        truth=told.scenario.source,
        world=told.mission.world,
        problem=told.problem,
        notes=(note,) if note else (),
        vehicles=told.fleet.vehicles,
        turns=turns,
    )


def _as_the_last_one_says(entries: list[Entry], vehicles: int) -> list[Entry]:
    """Return messages with the plain names for the keys of the last one of several vehicles."""
    if vehicles == 1:
        return entries
    return [
        entry._replace(key=row_name(entry.key)) if vehicle_of(entry.key) == str(vehicles) else entry
        for entry in entries
    ]


def _in_rounds(entries: list[Entry], vehicles: int) -> list[Entry]:
    """Return messages so that the last vehicle's reading of each round comes after those of the others."""
    if vehicles == 1:
        return entries
    read: dict[str, set[int | None]] = {str(number): set() for number in range(1, vehicles)}
    own: set[int | None] = set()
    ordered: list[Entry] = []
    held: list[tuple[int, Entry]] = []  # with the number of their round, from 1
    for entry in entries:
        if row_name(entry.key) != READING.name:
            ordered.append(entry)
            continue
        if entry.key == READING.name:
            own.add(reading_time(entry))
            held.append((len(own), entry))
        else:
            read.setdefault(vehicle_of(entry.key), set()).add(reading_time(entry))
            ordered.append(entry)
        whole = min(map(len, read.values()))
        ordered += [each for number, each in held if number <= whole]
        held = [(number, each) for number, each in held if number > whole]
    return ordered + [entry for _, entry in held]


def autopilot_log(path: Path, chosen: Mapping[str, Any], filtering: Mapping[str, Any]) -> Source:
    """Read an autopilot's log as the flags `chosen` say; raises BadInput.

    It is for an estimator with the flags `filtering`.
    """
    world = script.load(chosen["plume"]).simulated() if "plume" in chosen else None
    flown = flight.read(
        path,
        system=chosen.get("sysid"),
        gas=chosen.get("gas", "gas"),
        wind=chosen.get("wind"),
        every_s=chosen.get("every"),
        origin=chosen.get("origin"),
        area_m=chosen.get("area"),
        plume=world,
        background=chosen.get("background"),
    )
    known: dict[str, Any] = {}
    if world:
        told = world.scenario
        known = {
            "rate": told.q,
            "diffusivity": told.d,
            "lifetime": told.tau,
            "sensor": sensor.text(world.sensor),
        }
    source = _logged(path, flown, {**known, **filtering})
    return source._replace(truth=world.truth.source, world=world.name) if world else source


def table(path: Path, chosen: Mapping[str, Any], filtering: Mapping[str, Any]) -> Source:
    """Read a table of positions, gas and wind as the flags `chosen` say; raises BadInput.

    It is for an estimator with the flags `filtering`.
    """
    flown = survey.read(
        path,
        columns=chosen.get("columns"),
        wind=chosen.get("wind"),
        every_s=chosen.get("every"),
        background=chosen.get("background"),
        ray_m=chosen.get("ray"),
        origin=chosen.get("origin"),
        area_m=chosen.get("area"),
    )
    return _logged(path, flown, filtering)


def _logged(path: Path, flown: LoggedFlight, filtering: Mapping[str, Any]) -> Source:
    """Return a logged flight for an estimator with the flags `filtering`."""
    notes = list(flown.notes)
    # With the assumption: a record without one is an older one.
    chosen = {"assume": "field", **filtering, **_sensing(flown, filtering, notes)}
    estimator = settings.as_words({**chosen, "sysid": flown.system, "area": flown.area_m})
    lat, lon = flown.origin.lat_deg, flown.origin.lon_deg
    return Source(
        path,
        flown.entries,
        {},
        {"estimator": estimator},
        f"uav/{flown.system}",
        False,
        problem=_problem(flown),
        notes=tuple(notes),
        home=None if lat is None or lon is None else (lat, lon),
    )


def _sensing(flown: LoggedFlight, filtering: Mapping[str, Any], notes: list[str]) -> dict[str, Any]:
    """Return flags for an estimator of gas in a unit that was named, unless `filtering` has them."""
    chosen: dict[str, Any] = {}
    if flown.sensed and "sensor" not in filtering:
        noise, ray_m = flown.sensed
        kind = f"tdlas:{SENSOR_NOISE},{noise:.4g},ray={ray_m:g},dwell=0"
        chosen["sensor"] = kind if ray_m else f"gaussian:{SENSOR_NOISE},{noise:.4g}"
        notes.append(f"sensor: {chosen['sensor']}, with the noise of this flight; --sensor says another")
    given = filtering.get("prior", [])
    if flown.sensed and "rate" not in filtering and not any(prior.startswith("q=") for prior in given):
        chosen["prior"] = [UNTOLD_RATE, *given]
        notes.append("rate: unknown, 1 kg/h within a factor of 7.4; --rate Q says it to a factor of 2")
    return chosen


def _problem(flown: LoggedFlight) -> Problem:
    """Return the problem of a log: to search the square about its flight. Raises BadInput."""
    try:
        return in_area(square(flown.area_m))
    except ValueError as error:
        raise BadInput(f"--area: {error}") from None


def find(args: argparse.Namespace) -> tuple[Source, Rules | None]:
    """Return the source that a command line asks for, and the rules of --verify; raises BadInput."""
    chosen = {name: args.given[name] for name in READING_FLAGS if name in args.given}
    filtering = {name: args.given[name] for name in FILTER_FLAGS if name in args.given}
    try:
        recorded = is_record(args.log)
        _refuse(args, recorded, chosen, filtering)
        if recorded:
            source = recording(args.log, args.policy)
        else:
            read = table if is_table(args.log) or "columns" in chosen else autopilot_log
            source = read(args.log, chosen, filtering)
    except RecordError as error:
        raise BadInput(str(error)) from None
    if not source.entries:
        raise BadInput(f"{args.log}: it has no messages of a vehicle")
    # A record does not choose among the vehicles of a user's bus.
    usual = FIRST_VEHICLE if args.connect else source.namespace
    source = source._replace(namespace=args.namespace or usual, entries=_cut(source.entries, args))
    if args.verify:  # what follows a gap depends on what is missing
        source = source._replace(
            entries=[entry for entry in source.entries if entry.published_ns <= source.sure_ns]
        )
    rules = _rules(args, source) if args.verify else None
    return (source if args.connect else _with_services(source, rules)), rules


def _time_of(entry: Entry, turns: Turns) -> int | None:
    closing = turns.by_reading.get(entry.payload)
    return closing.time_ms if closing else reading_time(entry)


def reading_time(entry: Entry) -> int | None:
    """The time of a reading, ms, which goes on where time_boot_ms wraps; None if no estimator accepts it."""
    try:
        return nearest(round(1000 * entry.simulation_s), unpack_reading(entry.payload).time_boot_ms)
    except BadFrame:
        return None


def _refuse(
    args: argparse.Namespace, recorded: bool, chosen: Mapping[str, Any], filtering: Mapping[str, Any]
) -> None:
    """Raise BadInput on a flag that would have no effect here."""
    flags = {name: f"--{name.replace('_', '-')}" for name in (*chosen, *filtering)}
    tabular = is_table(args.log) or "columns" in chosen
    rules = [
        *(
            (recorded, f"{flag}: not allowed with {args.log}: a recording has its own settings")
            for flag in flags.values()
        ),
        *(
            (
                not recorded and name in (OF_AUTOPILOTS if tabular else OF_TABLES),
                f"{flag}: not allowed with {args.log}: it is {'a table' if tabular else 'no table (.csv)'}",
            )
            for name, flag in flags.items()
        ),
        *(
            (
                args.connect,
                f"{flags[name]}: not allowed with --connect: the estimator there has its own settings",
            )
            for name in filtering
        ),
        (
            args.policy and (args.connect or not recorded),
            "--policy: only allowed where the agent of a recording is started",
        ),
        (args.ignore and not args.verify, "--ignore: only allowed with --verify"),
        (args.tolerance and not args.verify, "--tolerance: only allowed with --verify"),
        (
            args.loop and args.connect,
            "--loop: not allowed with --connect: an estimator accepts the same readings only once",
        ),
        (
            args.record and (recorded or args.connect or args.loop),
            f"--record: only allowed with one replay of a log of others, on a router of its own, not with "
            f"{'--connect' if args.connect else '--loop' if args.loop else args.log}",
        ),
        (
            args.verify and not recorded,
            f"--verify: not allowed with {args.log}: an autopilot's log holds no answers to compare with",
        ),
        (
            args.verify and args.from_s,
            f"--from: {args.from_s:g} is not allowed with --verify; wanted 0: a belief depends on all "
            "readings before it",
        ),
        (
            args.from_s > args.to_s,
            f"--to: {args.to_s:g} is not allowed; wanted at least --from, {args.from_s:g}",
        ),
    ]
    for broken, text in rules:
        if broken:
            raise BadInput(text)


def _cut(entries: list[Entry], args: argparse.Namespace) -> list[Entry]:
    first_s = entries[0].simulation_s
    within = [entry for entry in entries if args.from_s <= entry.simulation_s - first_s <= args.to_s]
    if not within:
        long_s = max(entry.simulation_s for entry in entries) - first_s
        raise BadInput(
            f"--from: no message of {args.log} is between {args.from_s:g} and {args.to_s:g} s; it is "
            f"{long_s:.1f} s long"
        )
    return within


def _rules(args: argparse.Namespace, source: Source) -> Rules:
    rules = Rules(verify.ignored(args.ignore, source.then.values()), args.tolerance)
    published = {source.time_of(entry) for entry in source.entries if entry.key == READING.name}
    if not any(time in published and kind not in rules.ignored for time, kind in source.then):
        raise BadInput(
            f"--verify: no belief, stop or waypoint in {args.log} answers a replayed reading: nothing to "
            "compare"
        )
    return rules


def _with_services(source: Source, rules: Rules | None) -> Source:
    """Add a note for each recorded service that cannot be started.

    Raises BadInput if its answers are to be compared.
    """
    notes = list(source.notes)
    for service in sorted(
        ({SERVICES[kind] for _, kind in source.then} | set(source.unfit)) - set(source.parts)
    ):
        text = source.unfit.get(service, f"{source.path} does not say how its {service} was started")
        kinds = [kind for kind in SERVICES if SERVICES[kind] == service]
        if rules and not rules.ignored.issuperset(kinds):
            raise BadInput(
                f"{text}; start one and give --connect, or give "
                f"{' '.join(f'--ignore {kind}' for kind in kinds)}"
            )
        notes.append(f"warning: {text}: replayed without it")
    return source._replace(notes=tuple(notes))
