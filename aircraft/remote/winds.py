"""Where the wind of a real vehicle's readings comes from.

It is given, measured by the payload or estimated by the autopilot, never drawn.
"""

import math
from collections.abc import Callable, Mapping
from enum import Enum

from pymavlink.dialects.v20 import common as mavlink

from aircraft.payload.messages import WindVector
from aircraft.remote.safety import DRAG_PARAMETERS, Check, Verdict


class WindSource(Enum):
    """Where a wind comes from, in words."""

    GIVEN = "given by --wind"
    PAYLOAD = "measured by the payload"
    AUTOPILOT = "estimated by the autopilot"
    SCENARIO = "the mission's, as the payload is simulated"
    NONE = "none"


def in_words(wind: WindVector) -> str:
    """Return a wind for people."""
    return f"{math.hypot(*wind):.1f} m/s from {math.degrees(math.atan2(*wind)) % 360.0:.0f}°"


class Winds:
    """The wind of each reading.

    A source that goes quiet is replaced by another one, which is told, or by none: never by a drawn wind.
    """

    def __init__(
        self, given: WindVector | None, scenario: WindVector, say: Callable[[int, str], None]
    ) -> None:
        """Take the wind of all readings, if one is given, whatever payload and autopilot say.

        scenario: the wind that only a simulated payload knows.
        """
        # Of the last reading, before the first that of the flight; None until it is decided.
        self.source: WindSource | None = None
        self.given, self._scenario, self._say = given, scenario, say

    def before(
        self,
        measured: WindVector | None,
        estimated: WindVector | None,
        parameters: Mapping[str, float],
        firmware: str,
    ) -> Check:
        """Decide before arming, by what the payload says on the ground; returns a line of the list.
        Without any wind there is no flight.
        """
        source, wind = self._of(measured, estimated)
        estimates = any(parameters.get(name, 0.0) > 0.0 for name in DRAG_PARAMETERS[firmware])
        if source is WindSource.NONE and estimates:  # once it flies: on the ground it never does
            source = WindSource.AUTOPILOT
        if source is WindSource.NONE:
            return Check(
                "wind",
                Verdict.FORBIDS,
                f"no wind for the readings: neither the payload nor {firmware} tells one; set "
                f"{', '.join(DRAG_PARAMETERS[firmware])}, "
                "use a payload that measures it, or give it with --wind SPEED,FROM",
            )
        self.source = source
        return Check("wind", Verdict.OK, f"{source.value}, {in_words(wind) if wind else 'once it flies'}")

    def of(self, measured: WindVector | None, estimated: WindVector | None) -> WindVector | None:
        """Return the wind of a reading: what the payload measured with it, else the autopilot's.

        None if there is none now.
        """
        source, wind = self._of(measured, estimated)
        if source is not self.source:
            self.source = source
            quiet = "neither payload nor autopilot tells one; no readings until one does"
            self._say(
                mavlink.MAV_SEVERITY_WARNING,
                f"Wind of the readings: {f'now {source.value}, {in_words(wind)}' if wind else quiet}",
            )
        return wind

    def _of(
        self, measured: WindVector | None, estimated: WindVector | None
    ) -> tuple[WindSource, WindVector | None]:
        if self.given:
            return WindSource.GIVEN, self.given
        if measured and measured != estimated:  # a simulated payload repeats an estimate
            return WindSource.SCENARIO if measured == self._scenario else WindSource.PAYLOAD, measured
        return WindSource.AUTOPILOT if estimated else WindSource.NONE, estimated
