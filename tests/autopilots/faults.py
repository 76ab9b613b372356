"""What can go wrong with an autopilot double: one table, and when each fault strikes.

A fault is written `NAME[@WHEN][:ARGUMENT]`. WHEN is `12` (s after boot), `+12` (s after take-off) or `#3`
(with the third accepted target); without it the fault is there from boot.  Examples: `gps@+20:15`,
`pilot@#3:LOITER`, `drop:5`.
"""

from dataclasses import dataclass
from typing import NamedTuple


class Kind(NamedTuple):
    """What a fault's argument means, its value if it is left out, and what the fault does."""

    argument: str
    default: str
    does: str


FOREVER = "inf"
FAULTS = {
    "arm": Kind("seconds", FOREVER, "arming is refused, with a reason"),
    "mode": Kind("seconds", FOREVER, "GUIDED or OFFBOARD is refused"),
    "takeoff": Kind("seconds", FOREVER, "take-off is refused"),
    "stuck": Kind("seconds", FOREVER, "the vehicle accepts take-off and stays on the ground"),
    "busy": Kind("seconds", FOREVER, "every command is answered TEMPORARILY_REJECTED"),
    "progress": Kind("seconds", FOREVER, "a command is answered IN_PROGRESS first, and finally after 1 s"),
    "ignore": Kind("seconds", FOREVER, "targets are ignored silently"),
    "gps": Kind("seconds", FOREVER, "GPS is lost: the position flows on, the EKF flags drop, LAND follows"),
    "glitch": Kind(
        "seconds",
        FOREVER,
        "GPS is 33 m off: the EKF rejects it for 10 s (PX4: 7), then follows, and so back again",
    ),
    "jump": Kind("seconds", FOREVER, "the EKF's position is 33 m off at once, without a word"),
    "ekf": Kind("seconds", FOREVER, "the EKF's variances are too large"),
    "low": Kind("", "", "the battery is low"),
    "critical": Kind("", "", "the battery is critical"),
    "fence": Kind("", "", "the geofence is breached"),
    "pilot": Kind("mode", "LOITER", "a pilot with a radio changes the mode (PX4: POSCTL, HOLD ...)"),
    "rc": Kind("seconds", FOREVER, "the pilot's radio is lost"),
    "reboot": Kind("", "", "the autopilot starts again"),
    "silence": Kind("seconds", FOREVER, "the link carries nothing, both ways"),
    "deaf": Kind("seconds", FOREVER, "the link carries nothing to the autopilot"),
    "mute": Kind("seconds", FOREVER, "the link carries nothing from the autopilot"),
    "drop": Kind("percent", "5", "the link loses frames at random, both ways"),
}


@dataclass
class Fault:
    """One fault of a run: its name, when it strikes, its argument, and the simulation time (s) at which it
    struck.
    """

    name: str
    when: float = 0.0
    clock: str = "boot"
    argument: str = ""
    struck_s: float | None = None

    def due(self, now_s: float, airborne_s: float | None, targets: int) -> bool:
        """Whether it strikes now; `airborne_s` is the time since take-off, `targets` counts the accepted
        targets.
        """
        if self.clock == "boot":
            return now_s >= self.when
        if self.clock == "takeoff":
            return airborne_s is not None and airborne_s >= self.when
        return targets >= self.when

    def lasts(self, now_s: float) -> bool:
        """Whether it has struck and is not over."""
        return self.struck_s is not None and (
            FAULTS[self.name].argument != "seconds" or now_s < self.struck_s + float(self.argument)
        )


def fault(text: str) -> Fault:
    """Read `NAME[@WHEN][:ARGUMENT]`; raises ValueError with one line that says what was wrong."""
    head, _, argument = text.partition(":")
    name, _, when = head.partition("@")
    if name not in FAULTS:
        raise ValueError(f"fault {name!r}: must be one of {', '.join(FAULTS)}")
    kind = FAULTS[name]
    clock = {"+": "takeoff", "#": "targets"}.get(when[:1], "boot")
    try:
        if kind.argument in ("seconds", "percent"):
            float(argument or kind.default)
        return Fault(name, float(when.lstrip("+#") or 0.0), clock, argument or kind.default)
    except ValueError:
        raise ValueError(
            f"fault {text!r}: must be NAME[@WHEN][:{kind.argument.upper() or 'nothing'}], WHEN like 12, +12 "
            "or #3"
        ) from None


class Faults:
    """The faults of one run, each of which strikes once."""

    def __init__(self, texts: tuple[str, ...]) -> None:
        self.all = [fault(text) for text in texts]
        self.now_s = 0.0

    def strike(self, now_s: float, airborne_s: float | None, targets: int) -> list[Fault]:
        """Set the time; return the faults that strike now."""
        self.now_s = now_s
        struck = [one for one in self.all if one.struck_s is None and one.due(now_s, airborne_s, targets)]
        for one in struck:
            one.struck_s = now_s
        return struck

    def on(self, *names: str) -> bool:
        """Whether a fault of one of these names lasts now."""
        return any(one.name in names and one.lasts(self.now_s) for one in self.all)

    def knows(self, name: str) -> bool:
        """Whether such a fault has struck, or is to come."""
        return any(one.name == name for one in self.all)

    def drop_share(self) -> float:
        """The share of frames that the link loses now."""
        return max(
            (float(one.argument) / 100.0 for one in self.all if one.name == "drop" and one.lasts(self.now_s)),
            default=0.0,
        )
