"""Protects the inbox: however much arrives, a bounded amount waits, per kind of message, and no sender
blocks.
"""

import os
import queue
import signal
import threading
import time

import pytest

from link.bus.inbox import BURST_S, WAITING_BYTES, Inbox
from link.bus.log import Log
from link.bus.tally import Tally


def drained(inbox: Inbox) -> list[object]:
    items = []
    while True:
        try:
            items.append(inbox.get(timeout=0))
        except queue.Empty:
            return items


def test_what_comes_is_taken_in_the_order_in_which_it_came() -> None:
    inbox = Inbox()
    readings, beliefs = inbox.lane("reading"), inbox.lane("belief")
    for number in range(3):
        readings(f"r{number}", 1)
        inbox.put(f"own{number}")
        beliefs(f"b{number}", 1)
    assert drained(inbox) == ["r0", "own0", "b0", "r1", "own1", "b1", "r2", "own2", "b2"]


def test_the_urgent_overtakes_all_that_waits_and_each_item_is_taken_once() -> None:
    inbox = Inbox()
    commands, stop = inbox.lane("mavlink/in"), inbox.lane("agdc/stop", urgent=True)
    for number in range(3):
        commands(number, 1)
    assert inbox.get(timeout=0) == 0
    stop("stop", 1)
    stop("stop again", 1)
    assert [inbox.get(timeout=0) for _ in range(2)] == ["stop", "stop again"]
    commands(3, 1)
    stop("third stop", 1)
    assert drained(inbox) == ["third stop", 1, 2, 3]
    assert inbox.waiting() == 0


def test_who_waits_is_woken_by_the_urgent() -> None:
    inbox = Inbox()
    stop = inbox.lane("agdc/stop", urgent=True)
    for number in range(3):  # from the second on, a turn may be left from before
        inbox.put("own")
        stop("early", 1)
        assert drained(inbox) == ["early", "own"]
        sender = threading.Thread(target=stop, args=(number, 1))
        sender.start()
        assert inbox.get(timeout=30) == number
        sender.join()


def test_a_flood_leaves_its_newest_and_all_of_the_others() -> None:
    inbox = Inbox()
    flood, stop = inbox.lane("mavlink/in", 100), inbox.lane("agdc/stop")
    stop("stop", 1)
    for number in range(100_000):
        flood(number, 1)
        assert inbox.waiting() <= 101
    inbox.put("end")
    assert drained(inbox) == ["stop", *range(99_900, 100_000), "end"]
    assert inbox.waiting() == 0


def test_of_a_state_only_the_newest_waits_and_nothing_is_said_to_be_lost(
    capsys: pytest.CaptureFixture[str],
) -> None:
    inbox, tally = Inbox(), Tally()
    belief = inbox.lane("belief", newest=True)
    for number in range(1000):
        belief(number, 1)
    assert drained(inbox) == [999]
    belief(1000, 1)
    assert drained(inbox) == [1000]
    inbox.tell_dropped(Log("agent", "uav/1", tally))
    assert (tally.refused, capsys.readouterr().err) == ({}, "")


def test_big_messages_are_fewer() -> None:
    inbox = Inbox()
    add = inbox.lane("mavlink/in", 100)
    for number in range(10):
        add(number, WAITING_BYTES // 4)
    assert drained(inbox) == [6, 7, 8, 9]
    add("too big", WAITING_BYTES + 1)
    add("small", 1)
    assert drained(inbox) == ["small"]


def test_who_waits_for_an_item_is_not_woken_by_the_turn_of_one_that_was_dropped() -> None:
    inbox = Inbox()
    add = inbox.lane("mavlink/in", 100)
    for _ in range(50):
        add("small", 1)
    add("big", WAITING_BYTES)
    assert inbox.get(timeout=0) == "big"
    with pytest.raises(queue.Empty):
        inbox.get(timeout=0)
    later = threading.Timer(0.05, add, ("late", 1))
    later.start()
    assert inbox.get(timeout=30) == "late"
    later.join()


def test_what_is_dropped_is_counted_each_time_and_logged_once_a_burst(
    capsys: pytest.CaptureFixture[str],
) -> None:
    now_s = 1000.0
    inbox, tally = Inbox(), Tally(lambda: now_s)
    log = Log("uav", "uav/1", tally)
    add = inbox.lane("mavlink/in", 10)
    for _ in range(20):  # a burst that lasts longer than BURST_S
        for number in range(15):
            add(number, 1)
        inbox.tell_dropped(log)
        inbox.tell_dropped(log)
        now_s += 0.9 * BURST_S
    assert tally.refused == {"overflow": 20 * 15 - 10}
    assert capsys.readouterr().err.count("refused mavlink/in: ") == 1
    now_s += BURST_S
    add(0, 1)
    inbox.tell_dropped(log)
    assert capsys.readouterr().err.count("refused mavlink/in: ") == 1


def test_many_threads_lose_nothing_between_them() -> None:
    inbox = Inbox()
    ways = [inbox.lane(name, 10_000) for name in ("a", "b")]

    def put(first: int) -> None:
        for number in range(first, first + 1000):
            ways[number % 2](number, 1)

    threads = [threading.Thread(target=put, args=(1000 * thread,)) for thread in range(8)]
    for thread in threads:
        thread.start()
    taken = [inbox.get(timeout=30) for _ in range(8000)]
    for thread in threads:
        thread.join()
    assert sorted(taken) == list(range(8000))


def test_an_inbox_that_overflows_in_many_threads_still_hands_out_all_that_waits() -> None:
    inbox = Inbox()
    add = inbox.lane("mavlink/in", 50)
    threads = [
        threading.Thread(target=lambda: [add(number, WAITING_BYTES // 40) for number in range(2000)])
        for _ in range(4)
    ]
    taken = 0
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        taken += len(drained(inbox))
    taken += len(drained(inbox))
    assert inbox.waiting() == 0
    assert 0 < taken <= 8000


def test_a_wait_ends_in_time_though_a_signals_handler_runs_across_its_end() -> None:
    """`SimpleQueue.get(timeout)` of CPython 3.11 and 3.12 would wait for ever."""
    inbox = Inbox()
    before = signal.signal(signal.SIGUSR1, lambda *_: time.sleep(0.6))
    interrupts = threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGUSR1))
    rescues = threading.Timer(20.0, inbox.put, ("nobody else has put anything",))
    try:
        interrupts.start()
        rescues.start()
        with pytest.raises(queue.Empty):
            inbox.get(timeout=0.3)
        interrupts.join()
    finally:
        rescues.cancel()
        signal.signal(signal.SIGUSR1, before)
