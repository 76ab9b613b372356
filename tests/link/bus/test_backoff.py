"""Protects the waits between tries: they double up to the longest, and begin anew."""

from link.bus.backoff import Backoff


def tries(backoff: Backoff, since: int, until: int) -> list[int]:
    return [t for t in range(since, until) if backoff.due(t)]


def test_waits_double_up_to_the_longest() -> None:
    assert tries(Backoff(1.0, 4.0), 0, 20) == [0, 1, 3, 7, 11, 15, 19]


def test_after_a_first_try_elsewhere_the_next_waits() -> None:
    backoff = Backoff(1.0, 4.0)
    assert tries(backoff, 0, 8) == [0, 1, 3, 7]
    backoff.tried(8)
    assert tries(backoff, 8, 16) == [9, 11, 15]


def test_relaxed_it_tries_soon_but_not_at_once() -> None:
    backoff = Backoff(2.0, 8.0)
    assert tries(backoff, 0, 7) == [0, 2, 6]
    backoff.relax(7)
    assert tries(backoff, 7, 14) == [9, 11]
