"""The events of mission scripts: what goes wrong, what the operator does, and scripted waypoints."""

import math
from collections.abc import Sequence
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from plume.parameters import LIMITS, MOST
from plume.scenario import AREA_M, STEP_M


def _limits(name: str) -> Meta:
    low, high = LIMITS[name]
    return Meta(ge=low, le=high)


Rate = Annotated[float, _limits("q")]
WindSpeed = Annotated[float, _limits("u")]
Diffusivity = Annotated[float, _limits("d")]
Lifetime = Annotated[float, _limits("tau")]
Height = Annotated[float, _limits("z")]
Positive = Annotated[float, Meta(gt=0)]
Seconds = Annotated[float, Meta(ge=0)]
Coordinate = Annotated[float, Meta(ge=0, le=AREA_M)]
Point = tuple[Coordinate, Coordinate]
Count = Annotated[int, Meta(ge=1, le=1_000_000)]
StepNumber = Annotated[
    int, Meta(ge=0, description="a whole number from 0: number of the reading, 0 at the start")
]
TimeS = Annotated[float, Meta(ge=0, description="a number from 0: simulation time, s")]
Radians = Annotated[float, Meta(ge=-2 * math.pi, le=2 * math.pi)]
MOST_WAYPOINTS = 1000
"""The agent receives them in one command-line argument, which the system limits to 128 kB."""


class ScriptEvent(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="do", omit_defaults=True
):
    """An event that happens at a reading (`step`) or at a simulation time (`time_s`)."""

    step: StepNumber | None = None
    time_s: TimeS | None = None

    def __post_init__(self) -> None:
        """Require exactly one of step and time_s."""
        if (self.step is None) == (self.time_s is None):
            raise ValueError("wanted exactly one of step and time_s")


class Wind(ScriptEvent, frozen=True, tag="wind"):
    """The wind changes its direction or speed, and the plume with it, from this reading on."""

    u: WindSpeed | None = None
    phi: Radians | None = None


class Dropout(ScriptEvent, frozen=True, tag="dropout"):
    """The sensor gives no value (NaN); the vehicle waits and tries again every second."""

    for_s: Annotated[float, Meta(gt=0, description="a number above 0: simulation time, s")]


class Stuck(ScriptEvent, frozen=True, tag="stuck"):
    """The sensor repeats its last value."""

    readings: Count


class Spike(ScriptEvent, frozen=True, tag="spike"):
    """A number is added to the sensor's readings."""

    gas: Annotated[
        float,
        Meta(
            ge=-MOST,
            le=MOST,
            description=f"a number up to ±{MOST:g} that is added to the reading, in the sensor's unit",
        ),
    ]
    readings: Count = 1


class Duplicate(ScriptEvent, frozen=True, tag="duplicate"):
    """Each reading is published `copies` more times."""

    readings: Count
    copies: Annotated[int, Meta(ge=1, le=100)] = 1


class Delay(ScriptEvent, frozen=True, tag="delay"):
    """Readings arrive late."""

    readings: Count
    by_s: Annotated[float, Meta(gt=0, le=60, description="a number above 0 up to 60: real time, s")]


class Lose(ScriptEvent, frozen=True, tag="lose"):
    """Each reading is lost `times` times on its way; the vehicle publishes it again until it is answered."""

    readings: Count
    times: Annotated[int, Meta(ge=1, le=100)] = 1


class Hold(ScriptEvent, frozen=True, tag="hold"):
    """The operator makes the vehicle hold its position."""


class Resume(ScriptEvent, frozen=True, tag="resume"):
    """The operator resumes the search; `after_s` counts from the last hold."""

    after_s: TimeS | None = None

    def __post_init__(self) -> None:
        """Require exactly one of time_s and after_s."""
        if self.step is not None or (self.time_s is None) == (self.after_s is None):
            raise ValueError(
                "wanted exactly one of time_s and after_s, and no step: a vehicle that holds takes no steps"
            )


class Return(ScriptEvent, frozen=True, tag="return"):
    """The operator calls the vehicle home, where it lands."""


class Land(ScriptEvent, frozen=True, tag="land"):
    """The operator makes the vehicle land where it is."""


class Waypoints(ScriptEvent, frozen=True, tag="waypoints"):
    """Waypoints that replace the agent's, one per reading; the first answers this step's reading."""

    points: Annotated[list[Point], Meta(min_length=1)]

    def path(self) -> list[Point]:
        """Return the waypoints, (x, y) in m."""
        return self.points


class Lawnmower(ScriptEvent, frozen=True, tag="lawnmower"):
    """Waypoints that replace the agent's: rows west to east and back, from the south to the north edge of
    a rectangle.
    """

    low: Point = (0.0, 0.0)
    high: Point = (AREA_M, AREA_M)
    spacing_m: Annotated[
        float, Meta(ge=0.1, description="a number from 0.1: distance between two rows, m")
    ] = 5.0
    step_m: Annotated[
        float, Meta(ge=0.1, description="a number from 0.1: distance between two readings, m")
    ] = STEP_M

    def path(self) -> list[Point]:
        """Return the waypoints, (x, y) in m; rows end on the rectangle's edges, and the last row lies on
        its north edge.
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


OnBoard = Wind | Dropout | Stuck | Spike | Duplicate | Delay | Lose | Hold | Resume | Return | Land
"""Events that the UAV service carries out."""
OLD_WORDS = {"pause": "hold", "abort": "return"}
"""What older scripts call these events."""


def _steps(low: float, high: float, step: float) -> Sequence[float]:
    count = math.ceil((high - low) / step - 1e-9)
    return [min(low + number * step, high) for number in range(count)] + [high]
