"""Completeness of kept messages: puts each publisher's messages in order and detects missing ones.

Zenoh's advanced subscriber delivers history and live messages. In 1.10.2 it can lose history when it joins
a busy publisher: live messages that arrive before its history query has started make it drop the answer.
Therefore we check the sequence numbers ourselves.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from link.bus.backoff import Backoff

T = TypeVar("T")

# First and longest time between two requests for missing messages; it doubles each time, since a long
# history takes long to arrive.
ASK_FIRST_S, ASK_LAST_S = 0.3, 2.4
GIVE_UP_S = 5.0  # missing messages are given up after this time
# Most publishers remembered, the most recent ones. It is bounded because identities are easily forged.
MOST_SOURCES = 64


@dataclass
class _Source(Generic[T]):
    next_number: int = 0
    waiting: dict[int, T] = field(default_factory=dict)
    waiting_since_s: float = 0.0


class Sequence(Generic[T]):
    """Orders the messages of one key. Each publisher numbers its messages from 0."""

    def __init__(
        self, most: int, most_bytes: float = math.inf, size: Callable[[T], int] = lambda _: 0
    ) -> None:
        """Start empty.

        At most `most` messages and `most_bytes` bytes (measured by `size`) may wait for missing ones.
        """
        self.dropped = 0  # messages dropped for lack of room. They count as missing and are requested again
        self._most = most
        self._most_bytes = most_bytes
        self._size = size
        self._waiting = 0
        self._waiting_bytes = 0
        self._asking = Backoff(ASK_FIRST_S, ASK_LAST_S)
        self._sources: dict[str, _Source[T]] = {}

    def arrived(self, source: str, number: int, message: T, now_s: float) -> list[T]:
        """Take a message; return the messages that are now next in order.

        A message seen before is dropped.
        """
        state = self._sources[source] = self._sources.pop(source, _Source())
        if len(self._sources) > MOST_SOURCES:
            forgotten = self._sources.pop(next(iter(self._sources)))
            self.dropped += len(self._release(forgotten, list(forgotten.waiting)))
        if number > state.next_number and number not in state.waiting:
            self._wait(state, number, message, now_s)
        if number != state.next_number:
            return []
        ready = [message]
        state.next_number += 1
        while state.next_number in state.waiting:
            ready += self._release(state, [state.next_number])
            state.next_number += 1
        # Messages are still coming in; the service may compute for long between two of them.
        state.waiting_since_s = now_s
        return ready

    def _wait(self, state: _Source[T], number: int, message: T, now_s: float) -> None:
        size = self._size(message)
        if self._waiting >= self._most or self._waiting_bytes + size > self._most_bytes:
            self.dropped += 1
            return
        if not state.waiting:
            state.waiting_since_s = now_s
        state.waiting[number] = message
        self._waiting += 1
        self._waiting_bytes += size

    def _release(self, state: _Source[T], numbers: list[int]) -> list[T]:
        released = [state.waiting.pop(number) for number in numbers]
        self._waiting -= len(released)
        self._waiting_bytes -= sum(map(self._size, released))
        return released

    def should_ask_again(self, now_s: float) -> bool:
        """True if messages wait for missing ones and it is time to request these."""
        if self._waiting:
            return self._asking.due(now_s)
        self._asking.relax(now_s)
        return False

    def wait_on(self, now_s: float) -> None:
        """Restart all waiting times: there is nobody to ask at the moment."""
        self._asking.tried(now_s)
        for state in self._sources.values():
            state.waiting_since_s = now_s

    def given_up(self, now_s: float) -> tuple[int, list[T]]:
        """Return the number of messages missing for GIVE_UP_S, and those that waited for them, in order."""
        missing, ready = 0, []
        for state in self._sources.values():
            if state.waiting and now_s - state.waiting_since_s >= GIVE_UP_S:
                numbers = sorted(state.waiting)
                missing += numbers[-1] + 1 - state.next_number - len(numbers)
                ready += self._release(state, numbers)
                state.next_number = numbers[-1] + 1
        return missing, ready
