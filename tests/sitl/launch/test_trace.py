"""Protects the trace that the launcher hears: late and lost beliefs, and readings that tell of those that
were lost.
"""

import math

from msgspec.structs import replace

from link.bus.mavlink import Codec, Reading, pack_reading, unpack_reading
from link.bus.messages import Belief
from plume.outcome import TracePoint
from sitl.launch.heard import HeardTrace

VEHICLE = Codec(1, 1)


def reading(step: int, codec: Codec = VEHICLE) -> bytes:
    """The reading of a step: at 1000 ms times the step, at (step, 2), gas a quarter of the step."""
    return pack_reading(codec, Reading(1000 * step, (float(step), 2.0), 5.0, (1.0, 2.0), step / 4))


def belief(step: int, number: int | None = None) -> Belief:
    """The belief after the reading of a step; `number`: which belief of the estimator it is, if it has
    refused readings before.
    """
    return Belief(
        time_boot_ms=1000 * step,
        step=step if number is None else number,
        position=(float(step), 2.0),
        altitude_m=5.0,
        gas=step / 4,
        wind=(1.0, 2.0),
        sensor="gaussian:0.4,0.1",
        rate=1.0,
        diffusivity=1.0,
        lifetime=100.0,
        z=5.0,
        unknowns=("x", "y"),
        means=(7.0, 8.0),
        stds=(1.0, 1.0),
        mean=(7.0, 8.0),
        covariance=(1.0, 0.0, 1.0),
        spread=1.5,
        effective_sample_size=100.0,
        p_value=0.5,
        ceased=False,
    )


def known(step: int) -> TracePoint:
    return TracePoint((float(step), 2.0), step / 4, (7.0, 8.0), 1.5)


def heard(readings: range, beliefs: list[Belief]) -> HeardTrace:
    trace = HeardTrace()
    for step in readings:
        trace.reading(reading(step), 1)
    for said in beliefs:
        trace.belief(said)
    return trace


def test_every_belief_is_a_point_once() -> None:
    trace = heard(range(3), [belief(0), belief(1), belief(1), belief(2)])
    assert trace.missing == 0
    assert trace.points() == [known(0), known(1), known(2)]
    assert not trace.belief(belief(2))


def test_a_late_belief_closes_the_gap() -> None:
    trace = heard(range(4), [belief(0), belief(3), belief(2)])
    assert trace.missing == 1
    trace.belief(belief(1))
    assert trace.missing == 0
    assert trace.points() == [known(step) for step in range(4)]


def test_readings_tell_of_lost_beliefs() -> None:
    points = heard(range(5), [belief(1), belief(4)]).points()
    assert points is not None
    assert [(point.position, point.reading) for point in points] == [
        ((float(step), 2.0), step / 4) for step in range(5)
    ]
    assert [math.isnan(point.spread) for point in points] == [True, False, True, True, False]
    assert math.isnan(points[2].mean[0])
    assert points[4] == known(4)


def test_no_reading_is_taken_for_one_that_the_estimator_refused() -> None:
    # Of the readings of 1, 2 and 3 s the estimator took two: nobody can say which.
    assert heard(range(5), [belief(0), belief(4, number=3)]).points() is None
    assert heard(range(0, 5, 2), [belief(0), belief(4, number=2)]).points() is not None


def test_a_strangers_and_a_broken_reading_tell_nothing() -> None:
    trace = heard(range(1), [belief(0), belief(2)])
    for payload in (reading(1, Codec(9, 1)), reading(1)[:-1], b""):
        trace.reading(payload, 1)
    assert trace.points() is None
    trace.reading(reading(1), 1)
    assert trace.points() is not None


def test_the_readings_of_known_beliefs_are_let_go() -> None:
    trace = heard(range(50), [belief(step) for step in range(50)])
    trace.reading(reading(3), 1)
    assert not trace.kept


def test_the_trace_is_the_same_where_the_vehicles_time_wraps() -> None:
    def shifted(time_boot_ms: int) -> int:
        return (time_boot_ms + 2**32 - 2500) % 2**32  # after the third reading

    trace = HeardTrace()
    for step in (0, 2, 1, 3, 4):
        said = unpack_reading(reading(step))
        trace.reading(pack_reading(VEHICLE, said._replace(time_boot_ms=shifted(said.time_boot_ms))), 1)
    for known_belief in (belief(1), belief(4)):
        trace.belief(replace(known_belief, time_boot_ms=shifted(known_belief.time_boot_ms)))
    points = trace.points()
    assert points is not None
    assert [(point.position, point.reading) for point in points] == [
        ((float(step), 2.0), step / 4) for step in range(5)
    ]
    assert [trace.time_s(step) for step in (1, 4)] == [4_294_965.796, 4_294_968.796]
