"""Which system on a vehicle's bus is the vehicle: a bridge may publish others on `mavlink/out`, too."""

from contextlib import suppress
from typing import Annotated

import msgspec
from pymavlink.dialects.v20 import common as mavlink

from link.bus.frames import Frame
from link.bus.keys import HEALTH, MAVLINK_OUT
from link.bus.mavlink import ONBOARD_COMPUTER, BadFrame, split

OWN_HEALTH = HEALTH.named("uav")  # with --secure only the vehicle may publish it


class _Told(msgspec.Struct):
    system: Annotated[int, msgspec.Meta(ge=0, le=255)] = 0


class OwnSystem:
    """The vehicle's MAVLink system id.

    It is the one that its health tells; until then that of the first autopilot heard on `mavlink/out`.
    """

    def __init__(self) -> None:
        self.system = 0  # 0: not known yet

    def learn(self, key: str, payload: bytes) -> bool:
        """Take a message. Returns whether another system was taken for the vehicle until now."""
        before, system = self.system, 0
        with suppress(msgspec.DecodeError, UnicodeDecodeError, RecursionError, BadFrame):
            if key == OWN_HEALTH:
                system = msgspec.json.decode(payload, type=_Told).system
            elif key == MAVLINK_OUT.name and not before:
                system = next((frame.system for frame in split(payload) if _from_autopilot(frame)), 0)
        self.system = system or before
        return before not in (0, self.system)

    def sent(self, frame: Frame) -> bool:
        """Whether a frame is from the vehicle's own autopilot."""
        return frame.system == self.system and _from_autopilot(frame)

    def searched(self, frame: Frame) -> bool:
        """Whether a frame is from the search that flies a real vehicle.

        It speaks under the autopilot's system id.
        """
        return frame.system == self.system and frame.component == ONBOARD_COMPUTER


def _from_autopilot(frame: Frame) -> bool:
    return frame.component == int(mavlink.MAV_COMP_ID_AUTOPILOT1)
