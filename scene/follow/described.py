"""What a run's own description tells beforehand: its truth, its budget, and how its wind turns."""

import math
import re
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec
from msgspec import Meta

from plume.problem import FARTHEST_M, PAPER, Problem, in_area, square
from plume.scenario import Scenario
from plume.walls.buildings import MOST_BUILDINGS, read
from scene.scene import Backdrop, Point, Release

Outlines = tuple[tuple[Point, ...], ...]
BUILDINGS = re.compile(r"(?:^|\+)walls:(?:[^+]*,)?file=([^,+]+)")  # the file of a world with buildings


class WindTurn(NamedTuple):
    """A change of the true wind, and of the whole plume with it, by a mission script."""

    step: int | None  # the reading from which on it counts; None if it is the time that counts
    time_s: float
    u: float | None  # its new speed, m/s; None: as before
    phi: float | None  # the direction it comes from now, rad; None: as before

    def counts(self, step: int, time_s: float) -> bool:
        """Whether it has come, after the belief of a step at a time."""
        return time_s >= self.time_s if self.step is None else step >= self.step

    def turned(self, release: Release) -> Release:
        """Return a release in the wind after the turn."""
        u = math.hypot(*release.wind) if self.u is None else self.u
        phi = math.atan2(release.wind[1], release.wind[0]) if self.phi is None else self.phi
        return replace(release, wind=(u * math.cos(phi), u * math.sin(phi)))


def backdrop_of(about: dict[str, Any], vehicle: str = "") -> tuple[Backdrop, int | None]:
    """Return the backdrop and the budget, from a run's own description.

    What it does not tell, or not in this version, is left out.
    """
    release = None
    with suppress(KeyError, msgspec.ValidationError):
        release = Release.of(msgspec.convert(about["scenario"], Scenario))
    policy, budget, problem = about.get("policy"), about.get("budget"), problem_of(about)
    backdrop = Backdrop(
        vehicle or str(about.get("namespace", "vehicle")),
        title=f"{policy}, seed {about.get('seed')}" if policy is not None else "",
        release=release,
        area=problem.area,
        walls=(*_walls(about), *problem.keep_out),
        fence=problem.keep_in or (),
    )
    return backdrop, budget if isinstance(budget, int) else None


def problem_of(about: dict[str, Any]) -> Problem:
    """Return the problem of a run; the paper's if its description does not tell."""
    with suppress(KeyError, msgspec.ValidationError):
        return msgspec.convert(about["problem"], Problem)
    with suppress(KeyError, TypeError, ValueError):  # records of replays, before there were problems
        return in_area(square(float(about["area_m"])))
    return PAPER


def outlines(world: str) -> Outlines:
    """Return the outlines of the buildings of a world, rounded to a centimetre; none if it has none.

    It reads the file that the world names: not for a world of a record, which may come from a stranger.
    """
    walled = BUILDINGS.search(world)
    with suppress(ValueError):
        return tuple(
            tuple((round(x, 2), round(y, 2)) for x, y in each.footprint)
            for each in (read(walled[1]).buildings if walled else ())
        )
    return ()


def _walls(about: dict[str, Any]) -> Outlines:
    """Return the outlines of the buildings of a run's world: those that its description has.

    One without them names an example that ships; a file of this machine is not read.
    """
    if "walls" in about:
        with suppress(msgspec.ValidationError):
            told: Outlines = msgspec.convert(
                about["walls"], Annotated[Outlines, Meta(max_length=MOST_BUILDINGS)]
            )
            if all(len(outline) >= 3 and _is_near(outline) for outline in told):
                return told
        return ()
    mission = about.get("mission")
    world = mission.get("world") if isinstance(mission, dict) else None
    if not isinstance(world, str) or not (walled := BUILDINGS.search(world)):
        return ()
    ships = re.fullmatch(r"[\w-]+", walled[1]) and not Path(walled[1]).exists()
    return outlines(world) if ships else ()


def _is_near(outline: tuple[Point, ...]) -> bool:
    return all(abs(part) <= FARTHEST_M for corner in outline for part in corner)


def turns_of(about: dict[str, Any]) -> list[WindTurn] | None:
    """Return the changes of the wind that a run's mission script has.

    One that is not as scripts have it is left out. None if the plume blew with the wind that a real vehicle
    reported.
    """
    if "vehicle" in about:
        return None
    mission = about.get("mission")
    turns = []
    for event in (mission.get("events") if isinstance(mission, dict) else None) or ():
        if isinstance(event, dict) and event.get("do") == "wind":
            said = event.get("step"), event.get("time_s") or 0.0, event.get("u"), event.get("phi")
            if all(math.isfinite(value) for value in said if isinstance(value, float)):
                with suppress(msgspec.ValidationError):
                    turns.append(msgspec.convert(said, WindTurn))
    return turns
