"""Protects the order of events: each happens once, at its step or time."""

from aircraft.search.events import Hold, Land, OnBoard, Resume, Return, Spike, Stuck, Timeline, Wind


def test_events_of_a_time_come_in_the_order_of_their_times() -> None:
    late, early, other = Wind(time_s=9.0, u=1.0), Wind(time_s=3.0, u=2.0), Wind(time_s=9.0, u=3.0)
    came: list[OnBoard] = []
    timeline = Timeline([late, early, other], came.append)
    assert timeline.next_s() == 3.0
    timeline.go_on(2.9)
    assert came == []
    timeline.go_on(3.0)
    assert (came, timeline.next_s()) == ([early], 9.0)
    timeline.go_on(9.0)
    timeline.go_on(9.0)
    assert (came, timeline.next_s()) == ([early, late, other], None)


def test_a_resume_counts_from_the_last_hold() -> None:
    came: list[OnBoard] = []
    timeline = Timeline([Resume(after_s=5.0)], came.append)
    assert timeline.next_s() is None
    timeline.held(20.0)
    assert timeline.next_s() == 25.0
    timeline.go_on(25.0)
    assert came == [Resume(time_s=25.0)]
    timeline.held(30.0)
    assert timeline.next_s() is None


def test_events_of_a_step_come_once_those_of_the_operator_behind_its_reading() -> None:
    stuck, hold, spike = Stuck(step=4, readings=2), Hold(step=4), Spike(step=4, gas=1.0)
    back, land = Return(step=5), Land(step=5)
    came: list[OnBoard | str] = []
    timeline = Timeline([stuck, hold, spike, back, land], came.append)
    assert timeline.next_s() is None
    reading = "reading"
    for step in (3, 4, 4, 5):
        timeline.reach(step, by_operator=False)
        came.append(reading)
        timeline.reach(step, by_operator=True)
    assert came == [reading, stuck, spike, reading, hold, reading, reading, back, land]
