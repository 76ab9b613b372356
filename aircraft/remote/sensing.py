"""The gas sensor of a real vehicle: its payload, which is asked over the bus."""

from collections.abc import Collection

from pymavlink.dialects.v20 import common as mavlink

from aircraft.aircraft import GasSensor, Measured
from aircraft.operator import SEARCH
from aircraft.payload.asking import Asking
from aircraft.remote.vehicle import RemoteVehicle
from aircraft.remote.winds import Winds
from aircraft.search.speaker import Speaker
from aircraft.state import Arrived, Ned
from link.bus.keys import PAYLOAD_IN, PAYLOAD_OUT
from link.bus.mavlink import Codec
from link.bus.session import Bus


class AskedSensor(GasSensor):
    """Asks the payload at each waypoint; and on the ground, whether it measures the wind."""

    services = GasSensor.services | {"payload"}
    keys = (PAYLOAD_OUT,)

    def __init__(self, vehicle: RemoteVehicle, bus: Bus, winds: Winds, say: Speaker) -> None:
        self._vehicle, self._winds, self._say = vehicle, winds, say
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
        for text in winds.news:
            self._say(mavlink.MAV_SEVERITY_WARNING, text)
        winds.news.clear()
        return measured

    def go_on(self) -> None:
        """Ask again, if it is time to."""
        self._asking.again()

    def next_s(self) -> float:
        """Return when to ask again, by time.monotonic()."""
        return self._asking.next_s()
