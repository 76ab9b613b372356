"""The readings of a search as they were said on its bus: the .tlog of a record holds their frames among
the others.
"""

from collections.abc import Callable

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from ground.tlog.clock import VehicleClock
from ground.tlog.samples import LoggedGas, Pair
from ground.tlog.sender import LOCAL, Autopilot, FlightLog
from ground.tlog.track import Place
from link.bus.mavlink import BadFrame, unpack_reading

FRAMES = (LOCAL, mavlink.MAVLINK_MSG_ID_WIND_COV, mavlink.MAVLINK_MSG_ID_NAMED_VALUE_FLOAT)
"""Of one reading: they stand one behind the other, and share a sender and a time."""


class Recorded:
    """The readings of a log. Their positions are m from home, wherever the vehicle has the origin of its
    own frame.
    """

    def __init__(self, log: FlightLog, autopilot: Autopilot, clock: VehicleClock) -> None:
        """Find them. One that was said again counts once."""
        self.fixes: list[int] = []
        """The records of their LOCAL_POSITION_NEDs, which are no fixes of the vehicle's own frame."""
        self._places: dict[float, Place] = {}
        self._winds: dict[float, Pair] = {}
        samples: dict[int, LoggedGas] = {}
        records = log.records
        for first in log.select(autopilot.system, FRAMES[:1]).tolist():
            three = slice(first, first + 3)
            if tuple(records.message_ids[three]) != FRAMES or any(
                np.ptp(ids[three]) for ids in (records.systems, records.components)
            ):
                continue
            try:
                reading = unpack_reading(b"".join(log.frame(index) for index in range(first, first + 3)))
            except BadFrame as error:
                if error.kind == "not finite":  # its sensor had no value
                    self.fixes.append(first)
                continue
            self.fixes.append(first)
            time_ms = round(float(clock.own_ms(np.array([first]), np.array([reading.time_boot_ms]))[0]))
            if time_ms not in samples:
                samples[time_ms] = LoggedGas(time_ms, int(log.times_us[first]), reading.gas)
                self._places[time_ms] = reading.position[1], reading.position[0], reading.altitude_m
                self._winds[time_ms] = reading.wind
        self.samples = [samples[time_ms] for time_ms in sorted(samples)]

    def around(self, home: Pair) -> Callable[[float], Place | None]:
        """Return what maps the time of a reading to its place in the vehicle's own frame, in which home is
        (north, east) m.
        """

        def at(time_ms: float) -> Place | None:
            if (place := self._places.get(time_ms)) is None:
                return None
            return home[0] + place[0], home[1] + place[1], place[2]

        return at

    def air(self, time_ms: float) -> Pair | None:
        """Return the wind of a reading."""
        return self._winds.get(time_ms)
