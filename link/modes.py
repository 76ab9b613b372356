"""Flight modes of ArduCopter and PX4 as HEARTBEAT numbers them: their names for people, and what they are
to a search.
"""

ARDUPILOT, PX4 = 3, 12
"""HEARTBEAT's autopilot (MAV_AUTOPILOT)."""


def px4_mode(main: int, sub: int = 0) -> int:
    """Return the custom_mode of PX4's main and sub mode."""
    return main << 16 | sub << 24


NAMES = {
    ARDUPILOT: {
        0: "STABILIZE", 1: "ACRO", 2: "ALT_HOLD", 3: "AUTO", 4: "GUIDED", 5: "LOITER", 6: "RTL", 7: "CIRCLE",
        9: "LAND", 11: "DRIFT", 13: "SPORT", 14: "FLIP", 15: "AUTOTUNE", 16: "POSHOLD", 17: "BRAKE",
        18: "THROW", 19: "AVOID_ADSB", 20: "GUIDED_NOGPS", 21: "SMART_RTL", 22: "FLOWHOLD", 23: "FOLLOW",
        24: "ZIGZAG", 25: "SYSTEMID", 26: "AUTOROTATE", 27: "AUTO_RTL", 28: "TURTLE",
    },
    PX4: {
        px4_mode(1): "MANUAL", px4_mode(2): "ALTITUDE", px4_mode(3): "POSITION", px4_mode(4, 2): "TAKEOFF",
        px4_mode(4, 3): "HOLD", px4_mode(4, 4): "MISSION", px4_mode(4, 5): "RETURN", px4_mode(4, 6): "LAND",
        px4_mode(4, 8): "FOLLOW", px4_mode(4, 9): "PRECISION LAND", px4_mode(5): "ACRO",
        px4_mode(6): "OFFBOARD",
        px4_mode(7): "STABILIZED", px4_mode(8): "RATTITUDE",
    },
}  # fmt: skip
"""By autopilot and custom_mode."""
MEANINGS = {
    ARDUPILOT: {4: "OFFBOARD", 17: "HOLD", 6: "RETURN", 21: "RETURN", 27: "RETURN", 9: "LAND"},
    PX4: {
        px4_mode(4, 2): "TAKEOFF",
        px4_mode(4, 3): "HOLD",
        px4_mode(4, 5): "RETURN",
        px4_mode(4, 6): "LAND",
        px4_mode(4, 9): "LAND",
        px4_mode(6): "OFFBOARD",
    },
}
"""The mode of the search that a mode is, by autopilot and custom_mode; one that is not here only pilots
fly.
"""


def mode_name(autopilot: int, custom_mode: int) -> str:
    """Return a mode's name for people; one that is not known is told by its number."""
    if name := NAMES.get(autopilot, {}).get(custom_mode):
        return name
    return (
        f"mode {custom_mode >> 16 & 0xFF}.{custom_mode >> 24 & 0xFF}"
        if autopilot == PX4
        else f"mode {custom_mode}"
    )


def meaning(autopilot: int, custom_mode: int) -> str:
    """Return the mode of the search that a mode is, by its name in `aircraft.mode.Mode`; empty if
    it is none.
    """
    return MEANINGS.get(autopilot, {}).get(custom_mode, "")
