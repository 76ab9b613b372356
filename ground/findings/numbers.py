"""Numbers for people: with the digits that their interval supports, and times in UTC."""

import math
from datetime import UTC, datetime

from plume.geodesy import EARTH_RADIUS_M

METRES_A_DEGREE = math.radians(EARTH_RADIUS_M)
LEAST_DECIMALS, MOST_DECIMALS = 5, 8  # of degrees: 1.1 m and 1.1 mm
SIGNIFICANT = 2  # digits of half an interval's width that a number is given to


def decimals(low: float, high: float) -> int:
    """Return how many decimals a number between these ends deserves; negative: tens, hundreds, …."""
    half = abs(high - low) / 2
    if not (half > 0 and math.isfinite(half)):
        return 3
    return SIGNIFICANT - 1 - math.floor(math.log10(half))


def rounded(value: float, places: int) -> str:
    """Write a number to so many decimals; negative ones round to tens, hundreds, …."""
    if not math.isfinite(value):
        return "unknown"
    if abs(value) >= 1e15:
        return f"{value:.3g}"
    return f"{round(value, places):,.{max(places, 0)}f}"


def between(low: float, high: float) -> str:
    """Write an interval: `250 to 560`."""
    places = decimals(low, high)
    return f"{rounded(low, places)} to {rounded(high, places)}"


def told(value: float, low: float, high: float) -> str:
    """Write a number with its interval, both to the digits that the interval supports: `380 (250 to 560)`."""
    return f"{rounded(value, decimals(low, high))} ({between(low, high)})"


def significant(value: float, digits: int = 3) -> str:
    """Write a number with so many significant digits and no exponent where it is short."""
    if not math.isfinite(value):
        return "unknown"
    number = float(f"{value:.{digits}g}")
    return (
        f"{number:,.{max(digits - 1 - math.floor(math.log10(abs(number))), 0)}f}"
        if (number and 1e-4 <= abs(number) < 1e7)
        else f"{number:g}"
    )


def degree_decimals(spread_m: float) -> int:
    """Return the decimals of a latitude that is known to so many metres: to a tenth of that."""
    if not (spread_m > 0 and math.isfinite(spread_m)):
        return MOST_DECIMALS
    wanted = math.ceil(-math.log10(spread_m / 10 / METRES_A_DEGREE))
    return min(max(wanted, LEAST_DECIMALS), MOST_DECIMALS)


def degrees(value: float, places: int) -> str:
    """Write degrees with so many decimals."""
    return f"{value:.{places}f}°"


def utc(ns: int) -> str:
    """Write a time in ns since the Unix epoch as ISO 8601 in UTC, to milliseconds."""
    try:
        at = datetime.fromtimestamp(ns / 1e9, UTC)
    except (OverflowError, OSError, ValueError):
        return "unknown"
    return f"{at:%Y-%m-%dT%H:%M:%S}.{at.microsecond // 1000:03d}Z"
