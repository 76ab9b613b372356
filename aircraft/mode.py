"""The flight modes. This file loads little: the keeper of a real vehicle needs no more of this room."""

from enum import Enum

from pymavlink.dialects.v20 import common as mavlink


class Mode(Enum):
    """The supported PX4 flight modes, by PX4's numbers (main mode, sub mode)."""

    TAKEOFF = (4, 2)
    HOLD = (4, 3)
    MISSION = (4, 4)
    RETURN = (4, 5)
    LAND = (4, 6)
    OFFBOARD = (6, 0)

    @property
    def custom_mode(self) -> int:
        """Both numbers packed into one, as HEARTBEAT (0) carries them."""
        main, sub = self.value
        return int(main << 16 | sub << 24)

    @property
    def standard(self) -> int:
        """MAV_STANDARD_MODE, for stations that do not know PX4's numbers; 0 if no standard mode is like
        this one.
        """
        return STANDARD_MODES.get(self, int(mavlink.MAV_STANDARD_MODE_NON_STANDARD))


STANDARD_MODES = {
    Mode.TAKEOFF: int(mavlink.MAV_STANDARD_MODE_TAKEOFF),
    Mode.MISSION: int(mavlink.MAV_STANDARD_MODE_MISSION),
    Mode.RETURN: int(mavlink.MAV_STANDARD_MODE_SAFE_RECOVERY),
    Mode.LAND: int(mavlink.MAV_STANDARD_MODE_LAND),
}
