"""Completeness of kept messages: puts each publisher's messages in order and notices where some are missing.

Zenoh's advanced subscriber gives history and live messages, but (1.10.2) not always all of it to one that joins while more are being
published: live messages that arrive before its history query is under way make it drop the answer. So we count for ourselves.
"""

from dataclasses import dataclass, field
from typing import Generic, TypeVar

T = TypeVar("T")

ASK_EVERY_S = 0.3
GIVE_UP_S = 5.0


@dataclass
class _Source(Generic[T]):
    next_number: int = 0
    waiting: dict[int, T] = field(default_factory=dict)
    waiting_since_s: float = 0.0
    ask_at_s: float = 0.0


class Sequence(Generic[T]):
    """The messages of one key, whose publishers number them from 0."""

    def __init__(self) -> None:
        """Start with nothing received."""
        self._sources: dict[str, _Source[T]] = {}

    def arrived(self, source: str, number: int, message: T, now_s: float) -> list[T]:
        """Take a message; return those that are now next in line. One that has been before is dropped."""
        state = self._sources.setdefault(source, _Source())
        if number < state.next_number:
            return []
        if not state.waiting:
            state.waiting_since_s = state.ask_at_s = now_s
        state.waiting[number] = message
        ready = []
        while state.next_number in state.waiting:
            ready.append(state.waiting.pop(state.next_number))
            state.next_number += 1
        return ready

    def should_ask_again(self, now_s: float) -> bool:
        """Whether messages wait for missing ones, and it is time to ask for these."""
        late = [state for state in self._sources.values() if state.waiting and now_s >= state.ask_at_s]
        for state in late:
            state.ask_at_s = now_s + ASK_EVERY_S
        return bool(late)

    def wait_on(self, now_s: float) -> None:
        """Begin to wait anew: there is nobody to ask."""
        for state in self._sources.values():
            state.waiting_since_s = now_s

    def given_up(self, now_s: float) -> tuple[int, list[T]]:
        """Return how many messages have been missing for too long, and those that waited for them, in order."""
        missing, ready = 0, []
        for state in self._sources.values():
            if state.waiting and now_s - state.waiting_since_s >= GIVE_UP_S:
                numbers = sorted(state.waiting)
                missing += numbers[-1] + 1 - state.next_number - len(numbers)
                ready += [state.waiting[number] for number in numbers]
                state.waiting.clear()
                state.next_number = numbers[-1] + 1
        return missing, ready
