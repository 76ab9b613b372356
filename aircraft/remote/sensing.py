"""The gas sensor of a real vehicle: its payload, which is asked over the bus."""

import math
import time
from collections.abc import Collection

from aircraft.aircraft import GasSensor, Measured
from aircraft.operator import SEARCH
from aircraft.payload.messages import pack_question, unpack_answer
from aircraft.remote.preflight import NO_VALUE
from aircraft.remote.vehicle import RemoteVehicle
from aircraft.remote.winds import Winds
from aircraft.state import Arrived, Ned
from aircraft.together import AT_START_M, Berth, Together
from link.bus.backoff import Backoff
from link.bus.keys import OF_VEHICLE, PAYLOAD_IN, PAYLOAD_OUT, RESEND_FIRST_S, RESEND_LAST_S
from link.bus.mavlink import Codec
from link.bus.session import Bus
from plume.flight import TRY_AGAIN_S


class AskedSensor(GasSensor):
    """Asks the payload at each waypoint; and on the ground, whether it measures the wind.

    One question is open at a time. It is asked again until it is answered: question or answer may be lost,
    doubled or late, and the payload may start again.
    """

    keys = (PAYLOAD_OUT,)

    def __init__(
        self,
        vehicle: RemoteVehicle,
        bus: Bus,
        winds: Winds,
        vehicles: int = 1,
        number: int = 1,
        berth: Berth | None = None,
    ) -> None:
        """Take the vehicle, how many search together with it, itself included, its number and place there."""
        super().__init__(Together(vehicles, number, berth))
        self._vehicle, self._bus, self._winds, self._number = vehicle, bus, winds, number
        self._payload = "payload" if vehicles == 1 else f"payload/{number}"
        self._announced = vehicles == 1
        self._codec = Codec(0, SEARCH)
        self._open: tuple[int, bytes] | None = None  # time_boot_ms of the question, and its frames
        self._repeating = Backoff(RESEND_FIRST_S, RESEND_LAST_S)
        self._arrived: Arrived | None = None
        self._again_s = 0.0  # when a sensor that had no value before the flight is asked again

    def prepare(self, waits_for: str, absent: Collection[str]) -> None:
        """Ask whether the payload has a value and measures the wind: before that there is no flight."""
        vehicle = self._vehicle
        undecided = self._winds.source is None and self._open is None and vehicle.now_s >= self._again_s
        if undecided and vehicle.preflight.has_read and self._payload not in absent:
            self._codec = Codec(vehicle.system, SEARCH)
            self._ask(round(vehicle.now_s * 1000), 0, vehicle.flight.known.place)
        vehicle.preflight.bound(waits_for, absent)
        self.waits_for = "" if self._announced else vehicle.preflight.unready
        if not (self._announced or self.waits_for):  # now the others may take off
            self._bus.announce()
            self._announced = True

    @property
    def services(self) -> frozenset[str]:
        """Those that are left, and its own payload: its own token says when it can take off."""
        return self.together.services - {f"{OF_VEHICLE}{self._number}"} | {self._payload}

    def latecomer(self) -> str:
        """Return why its vehicle cannot join a search that has begun: its way up is not kept clear."""
        berth, (north, east, _) = self.together.berth, self._vehicle.flight.known.place
        if berth and (away_m := math.dist((east, north), berth.start)) > AT_START_M:
            return (
                f"to join late it has to stand within {AT_START_M:g} m of its start "
                f"({berth.start[0]:.1f}, {berth.start[1]:.1f}); it is {away_m:.1f} m away"
            )
        return ""

    def measure(self, arrived: Arrived, time_boot_ms: int, number: int) -> None:
        """Ask for reading `number`. An open question is replaced: its answer no longer counts."""
        self._arrived = arrived
        self._ask(time_boot_ms, number, arrived.position)

    def _ask(self, time_boot_ms: int, number: int, position: Ned) -> None:
        wind = self._winds.given or self._vehicle.wind
        question = pack_question(self._codec, time_boot_ms, number, position, wind)
        self._open = time_boot_ms, question
        self._repeating.tried(time.monotonic())
        self._bus.publish(PAYLOAD_IN, question)

    def take(self, payload: bytes, wanted: bool) -> Measured | None:
        """Take the payload's answer, unless the vehicle has been led away or its position is in doubt.

        Raises BadFrame.
        """
        sample = unpack_answer(payload)
        if self._open is None or sample.time_boot_ms != self._open[0]:
            return None
        vehicle, winds, known = self._vehicle, self._winds, self._vehicle.flight.known
        arrived, self._arrived, self._open = self._arrived, None, None
        if winds.source is None and math.isnan(sample.gas):
            vehicle.preflight.payload_lacks, self._again_s = NO_VALUE, vehicle.now_s + TRY_AGAIN_S
        elif winds.source is None:
            check = winds.before(sample.wind, vehicle.wind, known.parameters, known.firmware.name)
            vehicle.preflight.take_wind(check)
        elif arrived and wanted and known.glitches.lasts(vehicle.now_s):
            vehicle.course.again()
        elif arrived and wanted:
            return Measured(arrived, sample.gas, winds.of(sample.wind, vehicle.wind))
        return None

    def go_on(self) -> None:
        """Ask again, if it is time to."""
        if self._open and self._repeating.due(time.monotonic()):
            self._bus.publish(PAYLOAD_IN, self._open[1])

    def next_s(self) -> float:
        """Return when to ask again, by time.monotonic()."""
        return self._repeating.due_s if self._open else math.inf
