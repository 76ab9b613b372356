"""Flight modes of PX4 and ArduCopter: numbers, names for people, and what they are to a search."""

from enum import Enum

# HEARTBEAT's autopilot (MAV_AUTOPILOT).
ARDUPILOT, PX4 = 3, 12


def px4_mode(main: int, sub: int = 0) -> int:
    """Return the custom_mode of PX4's main and sub mode, as HEARTBEAT (0) carries it."""
    return main << 16 | sub << 24


class Mode(Enum):
    """The modes that a search and the simulated vehicle know, by PX4's numbers (main mode, sub mode)."""

    TAKEOFF = (4, 2)
    HOLD = (4, 3)
    MISSION = (4, 4)
    RETURN = (4, 5)
    LAND = (4, 6)
    OFFBOARD = (6, 0)

    @property
    def custom_mode(self) -> int:
        """PX4's custom_mode."""
        return px4_mode(*self.value)

    @property
    def standard(self) -> int:
        """MAV_STANDARD_MODE, for stations that do not know PX4's numbers; 0 if none is like this mode."""
        return {Mode.RETURN: 5, Mode.MISSION: 6, Mode.LAND: 7, Mode.TAKEOFF: 8}.get(self, 0)


# By autopilot and custom_mode.
NAMES = {
    ARDUPILOT: {
        0: "STABILIZE", 1: "ACRO", 2: "ALT_HOLD", 3: "AUTO", 4: "GUIDED", 5: "LOITER", 6: "RTL", 7: "CIRCLE",
        9: "LAND", 11: "DRIFT", 13: "SPORT", 14: "FLIP", 15: "AUTOTUNE", 16: "POSHOLD", 17: "BRAKE",
        18: "THROW", 19: "AVOID_ADSB", 20: "GUIDED_NOGPS", 21: "SMART_RTL", 22: "FLOWHOLD", 23: "FOLLOW",
        24: "ZIGZAG", 25: "SYSTEMID", 26: "AUTOROTATE", 27: "AUTO_RTL", 28: "TURTLE",
    },
    PX4: {mode.custom_mode: mode.name for mode in Mode} | {
        px4_mode(1): "MANUAL", px4_mode(2): "ALTITUDE", px4_mode(3): "POSITION", px4_mode(4, 8): "FOLLOW",
        px4_mode(4, 9): "PRECISION LAND", px4_mode(5): "ACRO", px4_mode(7): "STABILIZED",
        px4_mode(8): "RATTITUDE",
    },
}  # fmt: skip
# The mode of the search that a mode is, by autopilot and custom_mode; only pilots fly the others.
MEANINGS = {
    ARDUPILOT: {4: "OFFBOARD", 17: "HOLD", 6: "RETURN", 21: "RETURN", 27: "RETURN", 9: "LAND"},
    PX4: {mode.custom_mode: mode.name for mode in Mode if mode is not Mode.MISSION}
    | {px4_mode(4, 9): "LAND"},
}


def mode_name(autopilot: int, custom_mode: int) -> str:
    """Return a mode's name for people; the number of an unknown one."""
    number = f"{custom_mode >> 16 & 0xFF}.{custom_mode >> 24 & 0xFF}" if autopilot == PX4 else custom_mode
    return NAMES.get(autopilot, {}).get(custom_mode, f"mode {number}")


def meaning(autopilot: int, custom_mode: int) -> str:
    """Return the name of the `Mode` that a mode is to a search; empty if it is none."""
    return MEANINGS.get(autopilot, {}).get(custom_mode, "")
