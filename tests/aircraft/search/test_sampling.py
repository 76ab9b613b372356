"""Protects the hover for a reading: it is taken when the dwell is over, if the vehicle has stayed."""

from dataclasses import dataclass, field
from typing import Any

from aircraft.aircraft import Measured
from aircraft.search.events import Timeline
from aircraft.search.sampling import Sampling
from aircraft.search.search import Answers
from aircraft.state import Arrived
from link.bus.log import Log
from link.bus.tally import Tally

DWELL_S = 5.0


@dataclass
class Craft:
    now_s: float = 0.0
    moving: bool = False

    def still(self, arrived: Arrived) -> Arrived:
        return arrived


@dataclass
class Flight:
    """A vehicle that stands in for one, its search, its clients and its sensor."""

    vehicle: Craft = field(default_factory=Craft)
    answers: Answers = field(default_factory=Answers)
    measures: bool = True
    wants_answers: bool = False
    dwell_s: float = DWELL_S
    taken: list[tuple[float, int]] = field(default_factory=list)

    def measured(self, _time_boot_ms: int, _gas: float) -> None: ...

    def measure(self, arrived: Arrived, _time_boot_ms: int, number: int) -> Measured:
        self.taken.append((self.vehicle.now_s, number))
        return Measured(arrived, 0.5, (1.0, 0.0))


def flying() -> tuple[Flight, Sampling, Timeline]:
    flight: Any = Flight()
    timeline = Timeline([], lambda _: None)
    return (
        flight,
        Sampling(flight, flight, flight, timeline, None, Log("uav", "uav/1", Tally(), "error")),
        timeline,
    )


def at(time_s: float, flight: Flight, timeline: Timeline) -> None:
    flight.vehicle.now_s = time_s
    timeline.go_on(time_s)


def test_a_reading_is_taken_when_the_dwell_is_over() -> None:
    flight, sampling, timeline = flying()
    sampling.arrived(Arrived(0.0, (3.0, 4.0, -5.0)))
    at(4.9, flight, timeline)
    assert flight.taken == []
    at(5.0, flight, timeline)
    at(20.0, flight, timeline)
    assert flight.taken == [(5.0, 0)]


def test_a_vehicle_that_a_pilot_takes_away_meanwhile_takes_none() -> None:
    flight, sampling, timeline = flying()
    sampling.arrived(Arrived(0.0, (3.0, 4.0, -5.0)))
    flight.vehicle.moving = True
    at(5.0, flight, timeline)
    assert flight.taken == []


def test_a_vehicle_that_comes_anew_meanwhile_hovers_anew() -> None:
    flight, sampling, timeline = flying()
    sampling.arrived(Arrived(0.0, (3.0, 4.0, -5.0)))
    at(3.0, flight, timeline)
    sampling.arrived(Arrived(3.0, (6.0, 4.0, -5.0)))
    at(5.0, flight, timeline)
    assert flight.taken == []
    at(8.0, flight, timeline)
    assert flight.taken == [(8.0, 0)]
