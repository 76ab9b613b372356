"""The readings of a search: measured where the vehicle has arrived, and published until they are answered."""

import math
import time
from functools import partial

from aircraft.aircraft import Clients, GasSensor, Measured
from aircraft.search.events import Timeline
from aircraft.search.faults import FaultyRadio, FaultySensor
from aircraft.search.search import Search
from aircraft.state import Arrived
from link.bus.backoff import Backoff
from link.bus.keys import READING, RESEND_FIRST_S, RESEND_LAST_S
from link.bus.log import Log
from link.bus.mavlink import Codec, Reading, pack_reading
from link.bus.session import Bus
from plume.flight import TRY_AGAIN_S


class Sampling:
    """Takes one reading at each waypoint of a search. Readings are numbered from 0, the one at the start."""

    def __init__(
        self,
        search: Search,
        clients: Clients,
        sensor: GasSensor,
        timeline: Timeline,
        bus: Bus | None,
        log: Log,
    ) -> None:
        self.faults = FaultySensor()  # what a script does to the sensor's values
        self.radio = FaultyRadio(self._publish)  # what a script does to readings on their way to the bus
        self.codec = Codec(0, 0)  # packs the readings
        self._search, self._vehicle, self._clients = search, search.vehicle, clients
        self._sensor, self._timeline, self._bus, self._log = sensor, timeline, bus, log
        self._number = 0
        self._arrivals = 0  # at which it dwells
        self._time_boot_ms = -1
        self._newest = b""
        self._silent = False  # whether the sensor had no value when it was read last
        self._gas = math.nan  # the newest reading's
        self._sampled_at = time.monotonic()
        self._resending = Backoff(RESEND_FIRST_S, RESEND_LAST_S)

    @property
    def newest(self) -> int:
        """The number of the newest reading; -1 before the first."""
        return self._number - 1

    @property
    def lack(self) -> str:
        """Why no waypoint is to be expected: what the newest reading lacks; empty if it lacks nothing."""
        if self._silent:
            return f"the sensor has no value for reading {self._number}"
        unanswered = f"reading {self.newest} ({self._gas:.4g}) has no answer"
        return unanswered * self._search.answers.awaited

    def begin(self, number: int) -> None:
        """Begin with reading `number`, in a search that others have begun."""
        self._number = number
        self._timeline.join(number)

    @property
    def is_wanted(self) -> bool:
        """Whether an arrival is measured.

        A search measures at its waypoints, a plain vehicle, which has no bus, everywhere.
        """
        return self._search.measures or self._bus is None

    @property
    def awaits_answer(self) -> bool:
        """Whether the newest reading is published again until it is answered."""
        return self._bus is not None and self._search.wants_answers

    def arrived(self, arrived: Arrived) -> None:
        """Measure where the vehicle came to rest, if it is to be measured there, after the sensor's dwell."""
        if not self.is_wanted:
            return
        if self._sensor.dwell_s:
            self._arrivals += 1
            self._timeline.at(
                self._vehicle.now_s + self._sensor.dwell_s, partial(self._dwelled, self._arrivals, arrived)
            )
        else:
            self._measure(arrived)

    def _dwelled(self, arrival: int, arrived: Arrived) -> None:
        """Measure, unless the vehicle has left the place meanwhile, or come to it anew."""
        if arrival == self._arrivals:
            self._again(arrived)

    def _measure(self, arrived: Arrived) -> None:
        self._timeline.reach(self._number, by_operator=False)
        boot_ms = self._vehicle.now_s * 1000 if arrived.boot_ms is None else arrived.boot_ms
        self._time_boot_ms = self._search.answers.time_of(boot_ms)
        if measured := self._sensor.measure(arrived, self._time_boot_ms, self._number):
            self._read(measured)

    def take(self, payload: bytes) -> None:
        """Take what the bus says to the sensor. Raises BadFrame."""
        if measured := self._sensor.take(payload, self.is_wanted):
            self._read(measured)

    def _read(self, measured: Measured) -> None:
        """Make a reading of what was measured. A sensor without a value publishes NaN and is read again."""
        arrived, gas, wind = measured
        if wind is None:
            self._try_again(arrived)
            return
        north, east, down = arrived.position
        has_value = not (math.isnan(gas) or self.faults.silent(self._vehicle.now_s))
        self._gas = gas = self.faults.read(gas) if has_value else math.nan
        self._silent = not has_value
        reading = pack_reading(self.codec, Reading(self._time_boot_ms, (east, north), -down, wind, gas))
        if not has_value:
            self._publish(reading)
            self._try_again(arrived)
            return
        self._clients.measured(self._time_boot_ms, gas)
        self._search.answers.sampled(self._time_boot_ms)
        self._newest = reading
        self._sampled_at = time.monotonic()
        self.radio.new_reading()
        self.radio.send(reading, self._sampled_at)
        self._resending.tried(self._sampled_at)
        self._log.tally.did(self._number)
        self._log.debug(f"reading {gas:.4g} at ({east:.2f}, {north:.2f}) m, {self._vehicle.now_s:.2f} s")
        if self._bus:
            self._bus.publish_health()
        self._number += 1
        self._timeline.reach(self._number - 1, by_operator=True)

    def _try_again(self, arrived: Arrived) -> None:
        self._timeline.at(self._vehicle.now_s + TRY_AGAIN_S, partial(self._again, arrived))

    def _again(self, arrived: Arrived) -> None:
        if self.is_wanted and not self._vehicle.moving:
            self._measure(self._vehicle.still(arrived))

    def _publish(self, reading: bytes) -> None:
        if self._bus:
            self._bus.publish(READING, reading)

    def answered(self) -> None:
        """Note that the newest reading has been answered."""
        self._log.tally.latency_s = time.monotonic() - self._sampled_at

    def go_on(self) -> None:
        """Send what is due. A reading without an answer, the belief or the waypoint may have been lost."""
        now_s = time.monotonic()
        self.radio.deliver(now_s)
        self._sensor.go_on()
        if self.awaits_answer and self._resending.due(now_s):
            self.radio.send(self._newest, now_s)

    def next_s(self) -> float:
        """Return when `go_on` has something to send, by time.monotonic()."""
        return min(
            self.radio.next_s(),
            self._sensor.next_s(),
            self._resending.due_s if self.awaits_answer else math.inf,
        )
