"""Protects the order of events: each happens once, at its step or time."""

from aircraft.search.events import Hold, Land, Return, Spike, Stuck, Wind
from aircraft.search.timeline import Timeline


def test_events_of_a_time_come_in_the_order_of_their_times() -> None:
    late, early, other = Wind(time_s=9.0, u=1.0), Wind(time_s=3.0, u=2.0), Wind(time_s=9.0, u=3.0)
    timeline = Timeline([late, early, other])
    came = []
    while (at := timeline.next_s()) is not None:
        came.append((at, timeline.pop()))
    assert came == [(3.0, early), (9.0, late), (9.0, other)]


def test_events_of_a_step_come_once_those_of_the_operator_behind_its_reading() -> None:
    stuck, hold, spike = Stuck(step=4, readings=2), Hold(step=4), Spike(step=4, gas=1.0)
    back, land = Return(step=5), Land(step=5)
    timeline = Timeline([stuck, hold, spike, back, land])
    assert timeline.next_s() is None
    assert (timeline.before(3), timeline.after(3)) == ([], [])
    assert (timeline.before(4), timeline.after(4)) == ([stuck, spike], [hold])
    assert (timeline.before(4), timeline.after(4)) == ([], [])
    assert (timeline.before(5), timeline.after(5)) == ([], [back, land])
