"""How near the vehicles of a search come to each other, from take-off to landing, with faults.

    python -m benchmarks.apart                        # the table of docs/fleet.md, from results/
    python -m benchmarks.apart --fly --missions 500   # flies what the rows lack, and adds them

Four vehicles, from each formation in turn. Their rounds are a rollout's; simulated vehicles then fly them,
and every LOOK_S their distances are measured. One vehicle has a fault on its way to a place: it is late for
each leg, holds for a while, or leaves the search: it returns, lands where it is, or hovers and then returns.
In further missions one joins late.
"""

import argparse
import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec

from agent.trials.evaluate import FIRST_TEST_SEED
from agent.trials.rollout import NOBODY_LATE, mission
from aircraft.together import AT_START_M, Berth
from benchmarks.rows import append, read
from link import cli
from link.modes import Mode
from link.terminal import tell
from plume.problems.fleet import FORMATIONS, Fleet, Place
from plume.randomness import keyed
from sitl.autopilot.config import VehicleConfig
from sitl.autopilot.vehicle import Vehicle
from sitl.uav.options import at_own_stand

ROWS = Path("results/apart/missions.csv")
VEHICLES, BUDGET, PARTICLES, SEPARATION_M = 4, 60, 300, 3.0
LOOK_S = 0.05  # between two looks
PAUSE_S, HOVER_S = 15.0, 30.0  # how long one is held, and hovers until its silence sends it home
LATEST_S, REACTION_S = 10.0, 0.5  # most that one is late for a leg, and that a stop takes to be heard
STAYS = ("none", "late", "held")
FAULTS = (*STAYS, "returns", "lands", "hovers")
JOINS, JOINING_FROM = "joins late", 50_000  # and from which of the test seeds on one does


class Searched(msgspec.Struct, frozen=True):
    """A row: one search, and the least distances in it, m; infinite where there were none."""

    fault: str
    seed: int
    formation: str
    rounds: int
    searching_m: float  # of two that search, take-off included
    left_m: float  # of one that has left, from any
    home_m: float  # of two on their way home


class Sky:
    """The vehicles in the air, on one clock."""

    def __init__(self, starts: Sequence[Place]) -> None:
        self.vehicles = [
            Vehicle(at_own_stand(VehicleConfig(), Berth(start, [*{*starts} - {start}], SEPARATION_M)))
            for start in starts
        ]
        self.now_s = 0.0
        self.left: set[int] = set()  # vehicles that have left the search, from 0
        self.least_m = {"searching": math.inf, "left": math.inf, "home": math.inf}
        self.phase = "searching"

    def passes(self, seconds: float) -> None:
        """Let time pass."""
        for _ in range(math.ceil(seconds / LOOK_S)):
            self.now_s += LOOK_S
            for vehicle in self.vehicles:
                vehicle.catch_up(self.now_s)
            places = [vehicle.state(self.now_s).position for vehicle in self.vehicles]
            for one, other in itertools.combinations(range(len(places)), 2):
                phase = "left" if {one, other} & self.left else self.phase
                self.least_m[phase] = min(self.least_m[phase], math.dist(places[one], places[other]))

    def stands_still(self, vehicles: Sequence[int]) -> None:
        """Let time pass until these have come to rest."""
        while any(self.vehicles[each].moving for each in vehicles):
            self.passes(LOOK_S)

    def take_off(self, vehicles: Sequence[int]) -> None:
        """Let these take off, and wait."""
        for vehicle in vehicles:
            self.vehicles[vehicle].arm(self.now_s)
            self.vehicles[vehicle].take_off(self.now_s)
        self.passes(4.0)

    def goes(self, vehicle: int, place: Place) -> None:
        """Send one to its next place, (x, y) m."""
        craft, (x, y) = self.vehicles[vehicle], place
        craft.is_searched = True  # it need not stream
        craft.setpoint(self.now_s, (y, x, -craft.config.takeoff_altitude_m), answers=True)
        craft.set_mode(self.now_s, Mode.OFFBOARD)

    def changes(self, vehicle: int, mode: Mode) -> None:
        """Change one's mode."""
        self.vehicles[vehicle].set_mode(self.now_s, mode)


def fly(seed: int) -> Searched:
    """Fly one seed."""
    number = seed - FIRST_TEST_SEED
    fault = FAULTS[number % len(FAULTS)] if number < JOINING_FROM else JOINS
    formation = list(FORMATIONS)[number // len(FAULTS) % len(FORMATIONS)]
    rng = keyed(seed, "apart")
    faulty, at = int(rng.integers(VEHICLES)), int(rng.integers(1, 11))
    planned = _rounds(seed, formation, None)
    happens = at < len(planned)
    joining = _joining(seed, formation, faulty, at, planned[0][faulty]) if fault == JOINS else None
    leaves = fault not in (*STAYS, JOINS) and happens
    flown = _rounds(seed, formation, (faulty + 1, at)) if leaves else planned
    if joining:
        flown = _rounds(seed, formation, None, {faulty + 1: joining})
    sky = Sky([planned[0][vehicle] for vehicle in range(VEHICLES)])
    sky.take_off([*flown[0]])
    hovers_until_s = math.inf
    for step, places in enumerate(flown):
        wanted = dict(places)
        if leaves and step == at:
            wanted[faulty] = planned[at][faulty]  # it was sent there before it left
        late_s = float(rng.uniform(0.0, LATEST_S)) if fault == "late" else 0.0
        for vehicle, place in wanted.items():
            if not (vehicle == faulty and (late_s or (joining and step == joining[1]))):
                sky.goes(vehicle, place)
        if joining and step == joining[1]:  # it takes off while they fly
            sky.take_off([faulty])
            sky.goes(faulty, wanted[faulty])
        if late_s:
            sky.passes(late_s)
            sky.goes(faulty, wanted[faulty])
        if happens and step == at and fault not in ("none", "late", JOINS):
            sky.passes(float(rng.uniform(0.0, 1.0)))
            _happens(sky, fault, faulty, wanted[faulty])
            hovers_until_s = sky.now_s + HOVER_S if fault == "hovers" else math.inf
        sky.stands_still(list(places))
        if sky.now_s >= hovers_until_s:
            sky.changes(faulty, Mode.RETURN)
            hovers_until_s = math.inf
    sky.phase = "home"
    for vehicle in rng.permutation(VEHICLES).tolist():
        sky.passes(float(rng.uniform(0.0, REACTION_S / VEHICLES)))
        if vehicle not in sky.left or fault == "hovers":
            sky.changes(vehicle, Mode.RETURN)
    while any(vehicle.armed for vehicle in sky.vehicles):
        sky.passes(1.0)
    return Searched(fault, seed, formation, len(flown), *(round(least, 3) for least in sky.least_m.values()))


def _happens(sky: Sky, fault: str, vehicle: int, place: Place) -> None:
    if fault == "held":
        sky.changes(vehicle, Mode.HOLD)
        sky.passes(PAUSE_S)
        sky.goes(vehicle, place)
    else:
        sky.left.add(vehicle)
        sky.changes(vehicle, {"returns": Mode.RETURN, "lands": Mode.LAND, "hovers": Mode.HOLD}[fault])


def _joining(seed: int, formation: str, vehicle: int, since: int, stand: Place) -> tuple[int, int]:
    """Return when a vehicle, from 0, asks to join, and its first round: the one after that in which all are
    clear of its stand.
    """
    never = BUDGET + 1
    flown = _rounds(seed, formation, None, {vehicle + 1: (since, never)})
    clear_m = SEPARATION_M + AT_START_M
    for step, places in enumerate(flown):
        if step >= since and all(math.dist(stand, place) >= clear_m for place in places.values()):
            return since, step + 1
    return since, never


def _rounds(
    seed: int,
    formation: str,
    leaving: tuple[int, int] | None,
    joining: Mapping[int, tuple[int, int]] = NOBODY_LATE,
) -> list[dict[int, Place]]:
    """Return where each vehicle, from 0, takes its reading in each round.

    leaving: the number of one that leaves, and the first round without it.  joining: as of `mission`.
    """
    flown = mission(
        seed, "homing", PARTICLES, 0.5, BUDGET, fleet=Fleet(VEHICLES, formation, SEPARATION_M),
        leaving=dict([leaving] if leaving else []), joining=joining, assume="field",
    )  # fmt: skip
    return [{each.vehicle - 1: each.position for each in step.readings} for step in flown.steps]


def table(rows: Sequence[Searched]) -> str:
    """Return the table, as Markdown."""
    lines = [
        "| fault of one of four | missions | two that search: least, m | below 3 m, missions "
        "| one that has left: least, m | below 3 m, missions | on the way home: least, m "
        "| below 3 m, missions |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for fault in (*FAULTS, JOINS):
        own = [row for row in rows if row.fault == fault]
        cells = [fault, str(len(own))]
        for least in ([getattr(row, f"{phase}_m") for row in own] for phase in ("searching", "left", "home")):
            there = [value for value in least if math.isfinite(value)]
            near = sum(value < SEPARATION_M - 1e-3 for value in there)
            cells += [f"{min(there):.2f}", str(near)] if there else ["", ""]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Fly what is missing, if wanted, and print the table."""
    parser = cli.Parser(prog="python -m benchmarks.apart", description=__doc__ and __doc__.splitlines()[0])
    parser.add_argument("--fly", action="store_true", help="fly what the rows lack")
    parser.add_argument(
        "--missions", type=cli.whole(1, 100_000), default=500, metavar="N", help="of all faults"
    )
    args: argparse.Namespace = parser.parse_args()
    rows = read(ROWS, Searched)
    if args.fly:
        known = {row.seed for row in rows}
        numbers = *range(args.missions), *range(JOINING_FROM, JOINING_FROM + args.missions // len(FAULTS))
        for seed in (FIRST_TEST_SEED + number for number in numbers):
            if seed not in known:
                rows.append(fly(seed))
                append(rows[-1:], ROWS)
        tell(f"{args.missions} missions")
    print(table(rows))


if __name__ == "__main__":
    cli.run(main)
