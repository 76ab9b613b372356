"""The stop criterion: how sure a belief must be of the source's position, in the form of the flag --stop."""

import math
from typing import NamedTuple

from plume.problems.values import number

USUAL_THRESHOLD_M = 0.5
WIDEST_M = 100.0  # greatest ζ, and greatest radius
FORMS = "spread:Z, metres, or within:R,P, metres and a share"


class Criterion(NamedTuple):
    """A stop criterion: the paper's, or with `within` the other."""

    threshold_m: float = USUAL_THRESHOLD_M  # ζ: the spread of the belief is below it
    # (R, P): at least the share P of the belief's weight lies within R metres of the estimate. None: the
    # spread decides.
    within: tuple[float, float] | None = None

    @property
    def text(self) -> str:
        """The text that `parse` reads back."""
        return (
            f"within:{','.join(map(short, self.within))}"
            if self.within
            else f"spread:{short(self.threshold_m)}"
        )


def parse(text: str) -> Criterion:
    """Read `spread:0.5` or `within:1,0.99`; raises ValueError with what is allowed."""
    kind, _, rest = text.partition(":")
    try:
        numbers = [float(number) for number in rest.split(",")]
    except ValueError:
        numbers = []
    match kind, numbers:
        case "spread", [threshold_m]:
            sound, rule = 0 < threshold_m <= WIDEST_M, f"Z above 0 up to {WIDEST_M:g} m"
        case "within", [radius_m, share]:
            sound = 0 < radius_m <= WIDEST_M and 0 < share <= 1
            rule = f"R above 0 up to {WIDEST_M:g} m, P above 0 up to 1"
        case _:
            sound, rule = False, FORMS
    if not sound or not all(map(math.isfinite, numbers)):
        raise ValueError(f"{text!r} is not allowed; wanted {rule}")
    return Criterion(numbers[0]) if kind == "spread" else Criterion(within=(numbers[0], numbers[1]))


def chosen(threshold_m: float | None, stop: str | None, usual: str) -> Criterion:
    """Return the criterion of two arguments of which one may be given, else the usual one.

    `threshold_m` is the short form of `stop="spread:…"`. Raises ValueError if both are given, or one is not
    allowed.
    """
    if threshold_m is not None:
        threshold_m = number("threshold_m", threshold_m, 0, WIDEST_M, above=True)
        if stop is not None:
            raise ValueError(
                f"stop {stop!r} is not allowed with threshold_m {threshold_m:g}; wanted one of them"
            )
        return Criterion(threshold_m)
    if not isinstance(stop, str | None):
        raise ValueError(f"stop {stop!r} is not allowed; wanted {FORMS}")
    try:
        return parse(usual if stop is None else stop)
    except ValueError as error:
        raise ValueError(f"stop {error}") from None


def short(number: float) -> str:
    """Write a number with few digits if they are exact, else with all."""
    return f"{number:g}" if float(f"{number:g}") == number else repr(number)
