"""Events of a mission on board, and when: faults of sensor and radio, the operator's words, the wind."""

import heapq
import itertools
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Annotated

import msgspec
from msgspec import Meta

from plume.parameters import LIMITS, MOST

WindSpeed = Annotated[float, Meta(ge=LIMITS["u"][0], le=LIMITS["u"][1])]
Count = Annotated[int, Meta(ge=1, le=1_000_000)]
StepNumber = Annotated[
    int, Meta(ge=0, description="a whole number from 0: number of the reading, 0 at the start")
]
TimeS = Annotated[
    float, Meta(ge=0, le=MOST, description=f"a number from 0 up to {MOST:g}: simulation time, s")
]
VehicleNumber = Annotated[
    int,
    Meta(
        ge=1,
        le=64,
        description="a whole number from 1: the vehicle on which it happens, of several; by default on each",
    ),
]
Radians = Annotated[float, Meta(ge=-2 * math.pi, le=2 * math.pi)]


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


class OfVehicle(ScriptEvent, frozen=True, kw_only=True):
    """An event that may happen to one of several vehicles alone."""

    vehicle: VehicleNumber | None = None


class Dropout(OfVehicle, frozen=True, tag="dropout"):
    """The sensor gives no value (NaN); the vehicle waits and tries again every second."""

    for_s: Annotated[
        float, Meta(gt=0, le=MOST, description=f"a number above 0 up to {MOST:g}: simulation time, s")
    ]


class Stuck(OfVehicle, frozen=True, tag="stuck"):
    """The sensor repeats its last value."""

    readings: Count


class Spike(OfVehicle, frozen=True, tag="spike"):
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


class Duplicate(OfVehicle, frozen=True, tag="duplicate"):
    """Each reading is published `copies` more times."""

    readings: Count
    copies: Annotated[int, Meta(ge=1, le=100)] = 1


class Delay(OfVehicle, frozen=True, tag="delay"):
    """Readings arrive late."""

    readings: Count
    by_s: Annotated[float, Meta(gt=0, le=60, description="a number above 0 up to 60: real time, s")]


class Lose(OfVehicle, frozen=True, tag="lose"):
    """Each reading is lost `times` times on its way; the vehicle publishes it again until it is answered."""

    readings: Count
    times: Annotated[int, Meta(ge=1, le=100)] = 1


class Hold(OfVehicle, frozen=True, tag="hold"):
    """The operator makes the vehicle hold its position."""


class Resume(OfVehicle, frozen=True, tag="resume"):
    """The operator resumes the search; `after_s` counts from the last hold."""

    after_s: TimeS | None = None

    def __post_init__(self) -> None:
        """Require exactly one of time_s and after_s."""
        if self.step is not None or (self.time_s is None) == (self.after_s is None):
            raise ValueError(
                "wanted exactly one of time_s and after_s, and no step: a vehicle that holds takes no steps"
            )


class Return(OfVehicle, frozen=True, tag="return"):
    """The operator calls the vehicle home, where it lands."""


class Land(OfVehicle, frozen=True, tag="land"):
    """The operator makes the vehicle land where it is."""


# Events that the UAV service carries out
OnBoard = Wind | Dropout | Stuck | Spike | Duplicate | Delay | Lose | Hold | Resume | Return | Land


def words(event: OnBoard) -> str:
    """Return an event as its vehicle tells it when it happens."""
    fields = msgspec.structs.asdict(event).items()
    said = [f"{name} {value:.6g}" for name, value in fields if value is not None]
    return f"Script: {event.__struct_config__.tag} {' '.join(said)}"


def happens_to(event: OnBoard, number: int) -> bool:
    """Whether an event happens on board of a vehicle of this number."""
    return not isinstance(event, OfVehicle) or event.vehicle in (None, number)


# Operator events: they happen after the reading of their step, all others before it
BY_OPERATOR = (Hold, Return, Land)


class Timeline:
    """What is still to happen. Times are simulation time in s."""

    def __init__(self, events: Sequence[OnBoard], perform: Callable[[OnBoard], object]) -> None:
        """Take the events, and what carries one out. Simultaneous ones happen in this order."""
        self._perform = perform
        self._order = itertools.count()
        self._timed: list[tuple[float, int, Callable[[], object]]] = []
        self._stepped = [event for event in events if event.step is not None]
        self._after_hold_s = [
            event.after_s for event in events if isinstance(event, Resume) and event.after_s is not None
        ]
        for event in events:
            if event.time_s is not None:
                self.at(event.time_s, partial(perform, event))

    def at(self, time_s: float, action: Callable[[], object]) -> None:
        """Let something happen at a time."""
        heapq.heappush(self._timed, (time_s, next(self._order), action))

    def next_s(self) -> float | None:
        """Return the time of what happens next; None if nothing has a time."""
        return self._timed[0][0] if self._timed else None

    def go_on(self, now_s: float) -> None:
        """Let the next thing happen, if its time has come."""
        if self._timed and self._timed[0][0] <= now_s:
            heapq.heappop(self._timed)[2]()

    def reach(self, step: int, *, by_operator: bool) -> None:
        """Perform the events of a step, once: the operator's follow its reading, all others precede it."""
        due = [e for e in self._stepped if e.step == step and isinstance(e, BY_OPERATOR) is by_operator]
        for event in due:
            self._stepped.remove(event)
            self._perform(event)

    def join(self, step: int) -> None:
        """Begin with a step: of the events before it only the wind has happened."""
        for event in [event for event in self._stepped if (event.step or 0) < step]:
            self._stepped.remove(event)
            if isinstance(event, Wind):
                self._perform(event)

    def held(self, now_s: float) -> None:
        """The operator has held the vehicle: the next resume with `after_s` counts from now."""
        if self._after_hold_s:
            due_s = now_s + self._after_hold_s.pop(0)
            self.at(due_s, partial(self._perform, Resume(time_s=due_s)))
