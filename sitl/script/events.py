"""The events of mission scripts that happen beside the vehicle: scripted waypoints, and parts that fail."""

import math
from collections.abc import Sequence
from typing import Annotated, Literal

from msgspec import Meta

from aircraft.search.events import ScriptEvent
from plume.parameters import LIMITS, MOST
from plume.scenario import AREA_M, STEP_M


def _limits(name: str) -> Meta:
    low, high = LIMITS[name]
    return Meta(ge=low, le=high)


Rate = Annotated[float, _limits("q")]
Diffusivity = Annotated[float, _limits("d")]
Lifetime = Annotated[float, _limits("tau")]
Height = Annotated[float, _limits("z")]
Positive = Annotated[float, Meta(gt=0, le=MOST)]
Seconds = Annotated[float, Meta(ge=0, le=MOST)]
Coordinate = Annotated[float, Meta(ge=0, le=AREA_M)]
Point = tuple[Coordinate, Coordinate]
# The agent receives them in one command-line argument, which the system limits to 128 kB.
MOST_WAYPOINTS = 1000


class Waypoints(ScriptEvent, frozen=True, tag="waypoints"):
    """Waypoints that replace the agent's, one per reading; the first answers this step's reading."""

    points: Annotated[list[Point], Meta(min_length=1)]

    def path(self) -> list[Point]:
        """Return the waypoints, (x, y) in m."""
        return self.points


class Lawnmower(ScriptEvent, frozen=True, tag="lawnmower"):
    """Waypoints that replace the agent's: rows west to east and back, a rectangle from south to north."""

    low: Point = (0.0, 0.0)
    high: Point = (AREA_M, AREA_M)
    spacing_m: Annotated[
        float, Meta(ge=0.1, le=MOST, description="a number from 0.1: distance between two rows, m")
    ] = 5.0
    step_m: Annotated[
        float, Meta(ge=0.1, le=MOST, description="a number from 0.1: distance between two readings, m")
    ] = STEP_M

    def path(self) -> list[Point]:
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
    restart_after_s: Annotated[Seconds, Meta(description="a number from 0: real time, s")] = 0.0


class Cut(ScriptEvent, frozen=True, tag="cut"):
    """The link between a part and the router carries nothing for a while; neither end is notified."""

    part: Literal["uav", "estimator", "agent"]
    for_s: Annotated[float, Meta(gt=0, le=600, description="a number above 0 up to 600: real time, s")]


OLD_WORDS = {"pause": "hold", "abort": "return"}  # what older scripts call these events


def _steps(low: float, high: float, step: float) -> Sequence[float]:
    count = math.ceil((high - low) / step - 1e-9)
    return [min(low + number * step, high) for number in range(count)] + [high]
