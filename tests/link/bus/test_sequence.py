"""Protects the order and completeness of kept messages."""

import random

from link.bus.sequence import ASK_FIRST_S, ASK_LAST_S, GIVE_UP_S, MOST_SOURCES, Sequence


def test_messages_in_order_pass_at_once() -> None:
    sequence: Sequence[str] = Sequence(100)
    assert [sequence.arrived("uav", n, f"m{n}", 0.0) for n in range(3)] == [["m0"], ["m1"], ["m2"]]
    assert not sequence.should_ask_again(100.0)


def test_a_message_waits_for_those_before_it() -> None:
    sequence: Sequence[str] = Sequence(100)
    assert sequence.arrived("uav", 2, "m2", 0.0) == []
    assert sequence.arrived("uav", 1, "m1", 0.0) == []
    assert sequence.arrived("uav", 0, "m0", 0.0) == ["m0", "m1", "m2"]


def test_any_order_with_any_repeats_comes_out_once_and_in_order() -> None:
    for seed in range(20):
        numbers = [*range(50), *range(50)]
        random.Random(seed).shuffle(numbers)
        sequence: Sequence[int] = Sequence(100)
        assert [m for n in numbers for m in sequence.arrived("uav", n, n, 0.0)] == list(range(50))


def test_a_restarted_publisher_counts_from_0_again() -> None:
    sequence: Sequence[str] = Sequence(100)
    sequence.arrived("first life", 0, "a", 0.0)
    assert sequence.arrived("second life", 0, "b", 0.0) == ["b"]


def test_missing_messages_are_asked_for_at_once_and_then_less_and_less_often() -> None:
    sequence: Sequence[str] = Sequence(100)
    for began_s in (10.0, 100.0):  # a later gap is as urgent as the first
        number = int(began_s)
        sequence.arrived("uav", number + 1, "later", began_s)
        now_s, every_s = began_s, ASK_FIRST_S
        assert sequence.should_ask_again(now_s)
        for _ in range(6):
            assert not sequence.should_ask_again(now_s + 0.9 * every_s)
            now_s += 1.1 * every_s
            assert sequence.should_ask_again(now_s)
            every_s = min(2 * every_s, ASK_LAST_S)
        assert sequence.given_up(now_s)[1] == ["later"]
        assert not sequence.should_ask_again(now_s)


def test_what_nobody_has_kept_is_given_up_and_counted() -> None:
    sequence: Sequence[str] = Sequence(100)
    sequence.arrived("uav", 5, "m5", 10.0)
    sequence.arrived("uav", 7, "m7", 11.0)
    assert sequence.given_up(10.0 + 0.9 * GIVE_UP_S) == (0, [])
    assert sequence.given_up(10.0 + GIVE_UP_S) == (6, ["m5", "m7"])
    assert sequence.arrived("uav", 8, "m8", 20.0) == ["m8"]


def test_time_in_which_there_is_nobody_to_ask_does_not_count() -> None:
    sequence: Sequence[str] = Sequence(100)
    sequence.arrived("uav", 5, "m5", 10.0)
    sequence.wait_on(10.0 + 0.9 * GIVE_UP_S)
    assert sequence.given_up(10.0 + 1.8 * GIVE_UP_S) == (0, [])
    assert sequence.given_up(10.0 + 1.9 * GIVE_UP_S) == (5, ["m5"])


def test_what_was_delivered_is_never_delivered_again() -> None:
    sequence: Sequence[str] = Sequence(100)
    assert sequence.arrived("uav", 0, "m0", 0.0) == ["m0"]
    assert sequence.arrived("uav", 1, "m1", 0.0) == ["m1"]
    for number in (1, 0):
        assert sequence.arrived("uav", number, f"m{number} again", 1.0) == []
    assert not sequence.should_ask_again(1.0)  # nothing waits
    assert sequence.given_up(1.0 + GIVE_UP_S) == (0, [])
    assert sequence.arrived("uav", 2, "m2", 100.0) == ["m2"]


def test_one_that_waits_twice_is_delivered_once() -> None:
    sequence: Sequence[str] = Sequence(100)
    assert sequence.arrived("uav", 1, "m1", 0.0) == []
    assert sequence.arrived("uav", 1, "m1 again", 0.0) == []
    assert sequence.arrived("uav", 0, "m0", 0.0) == ["m0", "m1"]
    assert sequence.given_up(GIVE_UP_S) == (0, [])


def test_nothing_is_given_up_while_what_is_missing_keeps_coming() -> None:
    """A late joiner computes on each of thousands of kept readings, while a live reading waits for all of
    them.
    """
    sequence: Sequence[int] = Sequence(100)
    sequence.arrived("uav", 20, 20, 0.0)
    now_s, delivered = 0.0, []
    for number in range(20):
        now_s += 0.8 * GIVE_UP_S
        assert sequence.given_up(now_s) == (0, [])
        delivered += sequence.arrived("uav", number, number, now_s)
    assert delivered == list(range(21))


def test_a_flood_that_never_gets_in_order_has_a_bounded_part_of_it_wait() -> None:
    sequence: Sequence[int] = Sequence(100)
    for number in range(1, 100_001):
        assert sequence.arrived("stranger", number, number, 0.0) == []
    assert sequence.arrived("uav", 0, 0, 0.0) == [0]  # a message in order needs no room
    assert sequence.dropped == 100_000 - 100
    assert sequence.given_up(GIVE_UP_S) == (1, list(range(1, 101)))


def test_a_message_that_found_no_room_is_asked_for_and_taken_when_it_comes_again() -> None:
    sequence: Sequence[int] = Sequence(2)
    for number in (1, 2, 3):
        sequence.arrived("uav", number, number, 0.0)
    assert sequence.dropped == 1
    assert sequence.should_ask_again(0.0)
    assert [message for number in range(4) for message in sequence.arrived("uav", number, number, 0.1)] == [
        0,
        1,
        2,
        3,
    ]
    assert not sequence.should_ask_again(10.0)


def test_big_messages_find_room_for_fewer() -> None:
    sequence: Sequence[bytes] = Sequence(100, 1000, len)
    for life in range(3):  # released messages make room again
        for number in range(1, 6):
            sequence.arrived(f"uav {life}", number, bytes(300), 0.0)
        assert [len(message) for message in sequence.given_up(GIVE_UP_S)[1]] == [300, 300, 300]
    assert sequence.dropped == 6


def test_made_up_publishers_are_forgotten_and_what_waited_of_them() -> None:
    sequence: Sequence[int] = Sequence(1000)
    for number in range(100_000):
        sequence.arrived(f"stranger {number}", 5, number, 0.0)
    assert sequence.dropped == 100_000 - MOST_SOURCES
    missing, ready = sequence.given_up(GIVE_UP_S)
    assert (missing, ready) == (5 * MOST_SOURCES, list(range(100_000 - MOST_SOURCES, 100_000)))
    assert sequence.arrived("uav", 0, -1, 10.0) == [-1]


def test_a_publisher_that_goes_on_speaking_is_not_forgotten_for_those_that_come() -> None:
    sequence: Sequence[int] = Sequence(1000)
    for number in range(1000):
        sequence.arrived(f"stranger {number}", 5, number, 0.0)
        assert sequence.arrived("uav", number, number, 0.0) == [number]


def test_however_many_publishers_lack_messages_they_are_asked_for_no_more_often() -> None:
    sequence: Sequence[int] = Sequence(1000)
    asked = 0
    for number in range(50):  # within 0.9 of the time
        sequence.arrived(f"stranger {number}", 5, number, 0.0)
        asked += sequence.should_ask_again(0.9 * ASK_FIRST_S * number / 50)
    assert asked == 1
