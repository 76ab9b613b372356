"""Protects when a real vehicle counts as having arrived: near, slow, and for long enough."""

from aircraft.remote.course import Approach, deadline_s
from aircraft.state import Ned

TARGET: Ned = (3.0, 4.0, -5.0)
STILL: Ned = (0.0, 0.0, 0.0)


def test_it_arrives_once_it_has_stayed_for_the_time_to_settle() -> None:
    leg = Approach(TARGET, 100.0)
    near: Ned = (3.1, 4.1, -5.1)  # 0.17 m away
    assert [leg.arrived(t_s, near, STILL, True) for t_s in (1.0, 1.2, 1.29, 1.31)] == [
        False,
        False,
        False,
        True,
    ]


def test_passing_by_or_overshooting_is_no_arrival() -> None:
    leg = Approach(TARGET, 100.0)
    assert not leg.arrived(1.0, TARGET, (0.2, 0.2, 0.0), True), "0.28 m/s"
    assert not leg.arrived(1.4, TARGET, STILL, True)
    assert not leg.arrived(1.6, (3.31, 4.0, -5.0), STILL, True), "0.31 m beyond it"
    assert not leg.arrived(1.8, TARGET, STILL, True), "the time counts anew"
    assert leg.arrived(2.11, TARGET, STILL, True)


def test_a_height_that_is_wrong_is_no_arrival() -> None:
    leg = Approach(TARGET, 100.0)
    assert not any(leg.arrived(t_s, (3.0, 4.0, -5.4), STILL, True) for t_s in (1.0, 2.0, 3.0))


def test_a_position_that_the_ekf_does_not_stand_by_is_no_arrival() -> None:
    leg = Approach(TARGET, 100.0)
    assert not any(leg.arrived(t_s, TARGET, STILL, False) for t_s in (1.0, 2.0, 3.0))
    assert not leg.arrived(3.1, TARGET, STILL, True)
    assert leg.arrived(3.5, TARGET, STILL, True)


def test_a_leg_of_5_m_may_take_35_s() -> None:
    assert deadline_s(10.0, (0.0, 0.0, -5.0), TARGET) == 45.0
