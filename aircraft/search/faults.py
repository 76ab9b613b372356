"""Simulated faults of the gas sensor and of the radio that carries its readings."""

import heapq
import itertools
import math
from collections.abc import Callable

from aircraft.search.events import Delay, Dropout, Duplicate, Lose, Spike, Stuck
from plume.elementary import float32


class FaultySensor:
    """Applies a script's sensor faults to each reading.

    Values are in the sensor's unit, times are simulation time in s.
    """

    def __init__(self) -> None:
        self._last: float | None = None
        self._silent_until_s = -math.inf
        self._stuck = 0
        self._spikes: list[tuple[int, float]] = []  # (readings left, added value)

    def begin(self, fault: Dropout | Stuck | Spike, now_s: float) -> None:
        """Start a fault with the next reading."""
        match fault:
            case Dropout(for_s=for_s):
                self._silent_until_s = max(self._silent_until_s, now_s + for_s)
            case Stuck(readings=readings):
                self._stuck = max(self._stuck, readings)
            case Spike(readings=readings, gas=gas):
                self._spikes.append((readings, gas))

    def silent(self, now_s: float) -> bool:
        """True during a dropout: the sensor gives no value."""
        return now_s < self._silent_until_s

    def read(self, gas: float) -> float:
        """Return the faulty value for a true one, as float32 as on the wire.

        A stuck sensor hides spikes; their readings still count.
        """
        gas = float32(gas + sum(added for _, added in self._spikes))
        self._spikes = [(left - 1, added) for left, added in self._spikes if left > 1]
        if self._stuck:
            self._stuck -= 1
            gas = gas if self._last is None else self._last
        self._last = gas
        return gas


class FaultyRadio:
    """Loses, delays and duplicates readings on their way to the bus.

    Its times are real time in s, whatever the speed-up.
    """

    def __init__(self, publish: Callable[[bytes], None]) -> None:
        self._publish = publish
        self._faults: list[tuple[int, Delay | Duplicate | Lose]] = []  # (readings left, fault)
        self._delay_s, self._copies, self._losses = 0.0, 1, 0
        self._order = itertools.count()
        self._on_the_way: list[tuple[float, int, bytes]] = []

    def begin(self, fault: Delay | Duplicate | Lose) -> None:
        """Start a fault with the next reading."""
        self._faults.append((fault.readings, fault))

    def new_reading(self) -> None:
        """Start a new reading: fix its delay, copies and losses for each time that it is sent."""
        faults = [fault for _, fault in self._faults]
        self._faults = [(left - 1, fault) for left, fault in self._faults if left > 1]
        self._delay_s = sum(fault.by_s for fault in faults if isinstance(fault, Delay))
        self._copies = 1 + sum(fault.copies for fault in faults if isinstance(fault, Duplicate))
        self._losses = sum(fault.times for fault in faults if isinstance(fault, Lose))

    def send(self, payload: bytes, now_s: float) -> None:
        """Send the current reading, once or again."""
        if self._losses:
            self._losses -= 1
            return
        for _ in range(self._copies):
            if self._delay_s:
                heapq.heappush(self._on_the_way, (now_s + self._delay_s, next(self._order), payload))
            else:
                self._publish(payload)

    def deliver(self, now_s: float) -> None:
        """Publish the delayed readings that are due."""
        while self._on_the_way and self._on_the_way[0][0] <= now_s:
            self._publish(heapq.heappop(self._on_the_way)[2])

    def next_s(self) -> float:
        """Return when the next delayed reading is due; infinity if there is none."""
        return self._on_the_way[0][0] if self._on_the_way else math.inf
