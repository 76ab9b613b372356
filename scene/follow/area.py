"""Where a vehicle is in the search area's frame, whose origin is home unless another one is known.

Its LOCAL_POSITION_NED is in a frame of its own.
"""

import math
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from link.modes import ARDUPILOT
from plume.geodesy import home_from

# HEARTBEAT, GPS_GLOBAL_ORIGIN and HOME_POSITION.
HEARTBEAT, ORIGIN, HOME = 0, 49, 242
# The messages that tell where the area lies: these, and EXTENDED_SYS_STATE.
PLACING = {HEARTBEAT, ORIGIN, HOME, mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE}
# What a HEARTBEAT says of a vehicle that stands, where there is no EXTENDED_SYS_STATE.
GROUNDED = {mavlink.MAV_STATE_UNINIT, mavlink.MAV_STATE_BOOT, mavlink.MAV_STATE_STANDBY}

Fix = tuple[float, float, float]  # latitude and longitude, degrees, and altitude above sea, m
Ned = tuple[float, float, float]  # (north, east, down) m


class AreaFrame:
    """The search area's frame as one vehicle's messages place it.

    Home is subtracted from GPS_GLOBAL_ORIGIN. A simulated vehicle sends no origin: its origin is its home.
    On the ground home may be set anew, as arming does. What it becomes in the air is not the frame's
    origin, also after the landing.
    """

    def __init__(self) -> None:
        # The area's origin, latitude and longitude, degrees; None: it is the vehicle's home.
        self._area: tuple[float, float] | None = None
        # Whether it is one of several, of which a simulated one takes off where it stands and returns there.
        self.is_shared = False
        self._autopilot = -1
        self.forget()

    def forget(self) -> None:
        """Know only which autopilot it is: the vehicle was started again, or is another one."""
        self.on_ground: bool | None = None  # None before the vehicle says anything
        self._landed, self._status = int(mavlink.MAV_LANDED_STATE_UNDEFINED), -1
        self._origin: Fix | None = None
        self._home: Fix | None = None  # the frame's origin
        self._newest_home: Fix | None = None
        # Where it was first heard to stand or take off, (x, y) m.
        self._stand: tuple[float, float] | None = None

    @property
    def zero(self) -> Ned | None:
        """The area's origin, at home's height, in the vehicle's own frame; None while it is not known."""
        if self._origin and self._home:
            return home_from(self._origin, self.home or self._home)
        return None if self._origin or self._autopilot == ARDUPILOT else (0.0, 0.0, 0.0)

    @property
    def home(self) -> Fix | None:
        """The frame's origin: latitude and longitude, degrees, and home's altitude, m; None if not told."""
        return (*self._area, self._home[2]) if self._area and self._home else self._home

    @property
    def own_home(self) -> tuple[float, float]:
        """Where the vehicle's own home is, (x, y) m; the frame's origin unless the search has another one.

        NaN of a simulated one of several that was first heard in flight.
        """
        if not (self._area and self._home):
            return self._stand or ((math.nan, math.nan) if self.is_shared else (0.0, 0.0))
        north, east, _ = home_from((*self._area, 0.0), self._home)
        return east, north

    def take(self, message_id: int, fields: dict[str, Any]) -> bool:
        """Take one of the `PLACING` messages of the vehicle's autopilot.

        Returns whether home has moved.
        """
        before = self.zero
        if message_id == HEARTBEAT:
            self._autopilot, self._status = fields["autopilot"], fields["system_status"]
        elif message_id == ORIGIN:
            self._origin = _fix(fields)
        elif message_id == HOME:
            home = _fix(fields)
            if self._home is None or (home != self._newest_home and self.on_ground is not False):
                self._home = home
            self._newest_home = home
        else:
            self._landed = fields["landed_state"]
        if self._landed != mavlink.MAV_LANDED_STATE_UNDEFINED:
            self.on_ground = self._landed == mavlink.MAV_LANDED_STATE_ON_GROUND
        elif self._status >= 0:
            self.on_ground = self._status in GROUNDED
        return self.zero != before

    def lies(self, fields: dict[str, Any]) -> bool:
        """Take the GPS_GLOBAL_ORIGIN of the search that flies it: the area's origin, if that is not home.

        Returns whether it has moved.
        """
        before, self._area = self.zero, _fix(fields)[:2]
        return self.zero != before

    def place(self, local: dict[str, Any]) -> tuple[float, float, float] | None:
        """Return (x, y) and height above home, m, of a LOCAL_POSITION_NED.

        None where it cannot be told, or is not finite.
        """
        if (zero := self.zero) is None:
            return None
        north, east, down = (local[name] - part for name, part in zip("xyz", zero, strict=True))
        place = east, north, -down
        if not all(map(math.isfinite, place)):
            return None
        climbs = self._landed == mavlink.MAV_LANDED_STATE_TAKEOFF  # straight up
        if self.is_shared and self._stand is None and (self.on_ground or climbs):
            self._stand = place[:2]
        return place


def _fix(fields: dict[str, Any]) -> Fix:
    return fields["latitude"] / 1e7, fields["longitude"] / 1e7, fields["altitude"] / 1e3
