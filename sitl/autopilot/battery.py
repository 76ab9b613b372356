"""A battery that drains evenly while the motors are on."""

import math

from aircraft.state import LOW_BATTERY


class Battery:
    """Charge by time: full at the start, empty after `endurance_s` with the motors on. Times in s of
    simulation time.
    """

    def __init__(self) -> None:
        """Begin full, with the motors off."""
        self.alarms = 0
        """How many alarms it has given: 1 since it was low, 2 since it was empty."""
        self.on_s = 0.0
        """When the motors were last switched on."""
        self._on = False
        self._spent_s = 0.0  # time used up before the motors were last switched on

    @property
    def empty(self) -> bool:
        """True once the last alarm was given."""
        return self.alarms == 2

    def switch_on(self, t_s: float) -> None:
        """Switch the motors on."""
        self._on, self.on_s = True, t_s

    def switch_off(self, t_s: float) -> None:
        """Switch the motors off."""
        self._spent_s += t_s - self.on_s
        self._on = False

    def next_alarm_s(self, endurance_s: float) -> float:
        """Return when the next alarm is due with the motors on, low first, then empty; infinity if there
        is none.
        """
        if not self._on or self.empty:
            return math.inf
        lasts_s = endurance_s * (1.0 - LOW_BATTERY if self.alarms == 0 else 1.0)
        return self.on_s + lasts_s - self._spent_s

    def charge(self, t_s: float, endurance_s: float) -> float:
        """Return the remaining charge, 0 to 1."""
        spent = self._spent_s + (t_s - self.on_s if self._on else 0.0)
        return max(1.0 - spent / endurance_s, 0.0)
