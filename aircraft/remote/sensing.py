"""The gas sensor of a real vehicle: its payload, which is asked over the bus."""

import math
import time
from collections.abc import Callable, Collection

from aircraft.aircraft import GasSensor, Measured
from aircraft.operator import SEARCH
from aircraft.payload.messages import Sample, WindVector, pack_question, unpack_answer
from aircraft.remote.vehicle import RemoteVehicle
from aircraft.remote.winds import Winds
from aircraft.state import Arrived, Ned
from link.bus.backoff import Backoff
from link.bus.keys import PAYLOAD_IN, PAYLOAD_OUT, RESEND_FIRST_S, RESEND_LAST_S
from link.bus.mavlink import Codec
from link.bus.session import Bus


class Asking:
    """Asks the payload for a value.

    Question or answer may be lost, doubled or late; the payload may start again.
    """

    def __init__(
        self, send: Callable[[bytes], None], codec: Codec, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Take what publishes on `payload/in`, the vehicle's codec, and the clock of real time, s."""
        self._send = send
        self.codec = codec  # packs the questions
        self._clock = clock
        self._open: tuple[int, bytes] | None = None  # time_boot_ms of the question, and its frames
        self._repeating = Backoff(RESEND_FIRST_S, RESEND_LAST_S)

    @property
    def waiting(self) -> bool:
        """Whether a question is open."""
        return self._open is not None

    def ask(self, time_boot_ms: int, number: int, position: Ned, wind: WindVector | None) -> None:
        """Ask for reading `number` at a position (north, east, down) m.

        It replaces an open question, whose answer no longer counts.

        wind: (u cos φ, u sin φ) m/s, points to where it comes from, as the autopilot reports it; None if
        it reports none.
        """
        frames = pack_question(self.codec, time_boot_ms, number, position, wind)
        self._open = time_boot_ms, frames
        self._repeating.tried(self._clock())
        self._send(frames)

    def again(self) -> None:
        """Ask again if it is time to."""
        if self._open and self._repeating.due(self._clock()):
            self._send(self._open[1])

    def next_s(self) -> float:
        """Return when `again` is to be called, by the clock; infinity if no question is open."""
        return self._repeating.due_s if self._open else math.inf

    def receive(self, payload: bytes) -> Sample | None:
        """Return the answer to the open question, which is then closed; None for any other.

        Raises BadFrame as `unpack_answer` does.
        """
        sample = unpack_answer(payload)
        if self._open is None or sample.time_boot_ms != self._open[0]:
            return None
        self._open = None
        return sample


class AskedSensor(GasSensor):
    """Asks the payload at each waypoint; and on the ground, whether it measures the wind."""

    services = GasSensor.services | {"payload"}
    keys = (PAYLOAD_OUT,)

    def __init__(self, vehicle: RemoteVehicle, bus: Bus, winds: Winds) -> None:
        self._vehicle, self._winds = vehicle, winds
        self._asking = Asking(lambda question: bus.publish(PAYLOAD_IN, question), Codec(0, SEARCH))
        self._arrived: Arrived | None = None

    def prepare(self, waits_for: str, absent: Collection[str]) -> None:
        """Ask whether the payload measures the wind: before that is known there is no flight."""
        vehicle = self._vehicle
        undecided = self._winds.source is None and not self._asking.waiting
        if undecided and vehicle.preflight.has_read and not absent:
            self._asking.codec = Codec(vehicle.system, SEARCH)
            self._ask(round(vehicle.now_s * 1000), 0, vehicle.position)
        vehicle.preflight.bound(waits_for, absent)

    def measure(self, arrived: Arrived, time_boot_ms: int, number: int) -> None:
        """Ask for reading `number`."""
        self._arrived = arrived
        self._ask(time_boot_ms, number, arrived.position)

    def _ask(self, time_boot_ms: int, number: int, position: Ned) -> None:
        self._asking.ask(time_boot_ms, number, position, self._winds.asked(self._vehicle.wind))

    def take(self, payload: bytes, wanted: bool) -> Measured | None:
        """Take the payload's answer, unless the vehicle has been led away or its position is in doubt."""
        sample = self._asking.receive(payload)
        if sample is None:
            return None
        vehicle, winds, known, measured = self._vehicle, self._winds, self._vehicle.flight.known, None
        arrived, self._arrived = self._arrived, None
        if winds.source is None:
            check = winds.before(sample.wind, vehicle.wind, known.parameters, known.firmware.name)
            vehicle.preflight.take_wind(check)
        elif arrived and wanted and known.glitches.lasts(vehicle.now_s):
            vehicle.course.again()
        elif arrived and wanted:
            measured = Measured(arrived, sample.gas, winds.of(sample.wind, vehicle.wind))
        return measured

    def go_on(self) -> None:
        """Ask again, if it is time to."""
        self._asking.again()

    def next_s(self) -> float:
        """Return when to ask again, by time.monotonic()."""
        return self._asking.next_s()
