"""Protects the order and completeness of kept messages."""

import random

from link.bus.sequence import ASK_EVERY_S, GIVE_UP_S, Sequence


def test_messages_in_order_pass_at_once() -> None:
    sequence: Sequence[str] = Sequence()
    assert [sequence.arrived("uav", n, f"m{n}", 0.0) for n in range(3)] == [["m0"], ["m1"], ["m2"]]
    assert not sequence.should_ask_again(100.0)


def test_a_message_waits_for_those_before_it() -> None:
    sequence: Sequence[str] = Sequence()
    assert sequence.arrived("uav", 2, "m2", 0.0) == []
    assert sequence.arrived("uav", 1, "m1", 0.0) == []
    assert sequence.arrived("uav", 0, "m0", 0.0) == ["m0", "m1", "m2"]


def test_any_order_with_any_repeats_comes_out_once_and_in_order() -> None:
    for seed in range(20):
        numbers = [*range(50), *range(50)]
        random.Random(seed).shuffle(numbers)
        sequence: Sequence[int] = Sequence()
        assert [m for n in numbers for m in sequence.arrived("uav", n, n, 0.0)] == list(range(50))


def test_a_restarted_publisher_counts_from_0_again() -> None:
    sequence: Sequence[str] = Sequence()
    sequence.arrived("first life", 0, "a", 0.0)
    assert sequence.arrived("second life", 0, "b", 0.0) == ["b"]


def test_missing_messages_are_asked_for_at_once_and_then_now_and_again() -> None:
    sequence: Sequence[str] = Sequence()
    sequence.arrived("uav", 5, "m5", 10.0)
    assert sequence.should_ask_again(10.0)
    assert not sequence.should_ask_again(10.0 + 0.9 * ASK_EVERY_S)
    assert sequence.should_ask_again(10.0 + 1.1 * ASK_EVERY_S)


def test_what_nobody_has_kept_is_given_up_and_counted() -> None:
    sequence: Sequence[str] = Sequence()
    sequence.arrived("uav", 5, "m5", 10.0)
    sequence.arrived("uav", 7, "m7", 11.0)
    assert sequence.given_up(10.0 + 0.9 * GIVE_UP_S) == (0, [])
    assert sequence.given_up(10.0 + GIVE_UP_S) == (6, ["m5", "m7"])
    assert sequence.arrived("uav", 8, "m8", 20.0) == ["m8"]


def test_time_in_which_there_is_nobody_to_ask_does_not_count() -> None:
    sequence: Sequence[str] = Sequence()
    sequence.arrived("uav", 5, "m5", 10.0)
    sequence.wait_on(10.0 + 0.9 * GIVE_UP_S)
    assert sequence.given_up(10.0 + 1.8 * GIVE_UP_S) == (0, [])
    assert sequence.given_up(10.0 + 1.9 * GIVE_UP_S) == (5, ["m5"])
