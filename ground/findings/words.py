"""The findings in words, each figure with the digits that its interval supports."""

import math

from ground.findings.figures import KG_H, Findings, Ranged
from ground.findings.numbers import degree_decimals, degrees, rounded, significant, told


def place_text(it: Findings) -> str:
    """Return where the source is: WGS84, or metres from home where nobody said where that is."""
    x, y = it.last.mean
    place = it.on_earth((x, y))
    if place is None:
        return f"({x:.2f}, {y:.2f}) m east and north of home; nobody said where that is on earth"
    places = degree_decimals(it.ellipse.shorter_m)
    return f"latitude {degrees(place[0], places)}, longitude {degrees(place[1], places)} (WGS84)"


def ellipse_text(it: Findings) -> str:
    """Return the 95% ellipse in words."""
    longer, shorter = it.ellipse.longer_m, it.ellipse.shorter_m
    return (
        f"ellipse with half axes {significant(longer, 2)} m and {significant(shorter, 2)} m, the longer one "
        f"towards {it.ellipse.bearing_deg:.0f}° from north"
    )


def ranged_text(it: Ranged, unit: str) -> str:
    """Return a figure with its interval and its unit; one that was told, so."""
    if it.low is None or it.high is None:
        return f"{significant(it.value)} {unit}, as told"
    return f"{told(it.value, it.low, it.high)} {unit}"


def place_name(it: Findings) -> str:
    """Return what the place is: where the search did not stop, it is no find."""
    return "Source (best estimate)" if it.last.ceased else "Centre of the belief, no find"


def rate_name(it: Findings) -> str:
    """Return what the release rate is."""
    return "Release rate, 95% interval" if it.last.ceased else "Release rate if there is a source"


def rate_text(it: Findings) -> str:
    """Return the release rate in g/s and kg/h."""
    return f"{ranged_text(it.rate, 'g/s')}; {ranged_text(it.rate.times(KG_H), 'kg/h')}"


def compass(deg: float) -> str:
    """Return a direction, degrees clockwise from north, as 0 to 360."""
    return f"{round(deg) % 360}°"


def believed_from_text(it: Ranged) -> str:
    """Return a believed direction with its interval."""
    if it.low is None or it.high is None:
        return compass(it.value)
    return f"{compass(it.value)} ({compass(it.low)} to {compass(it.high)})"


def smallest_text(it: Findings) -> list[str]:
    """Return sentences about the smallest rates that the flight would have seen."""
    if it.smallest is None:
        return []
    seen = it.smallest.seen
    size = it.smallest.rates_gs.size
    if not len(seen):
        return ["Nowhere in the area would a source of any rate have been seen with 90% probability."]
    least, greatest = float(seen.min()), float(seen.max())
    rates = [f"{both_rates(least)} at the best place"]
    for words, share in (("half of the area", 0.5), ("nine tenths of it", 0.9)):
        if math.isfinite(rate := _share(it, share)):
            rates.append(f"in {words} {both_rates(rate)} or less")
    lines = [f"Smallest rate that would have been seen: {'; '.join(rates)}."]
    if len(seen) == size:
        lines.append(f"Anywhere in the area a source of {both_rates(greatest)} would have been seen.")
    else:
        unseen = 100 * (1 - len(seen) / size)
        told = rounded(unseen, 0 if 1 <= unseen <= 99 else 1)
        lines.append(f"In {told}% of the area no rate would have been seen.")
    if it.smallest.every > 1:
        lines.append(f"Of the readings every {it.smallest.every}th counts, so the rates are too great.")
    return lines


def _share(it: Findings, share: float) -> float:
    """Return the rate that suffices in a share of the area; infinite if none does."""
    assert it.smallest
    rates = sorted(it.smallest.rates_gs.ravel().tolist())
    return rates[min(math.ceil(share * len(rates)), len(rates)) - 1]


def both_rates(gs: float) -> str:
    """Return a rate in g/s and kg/h, with two digits."""
    return f"{significant(gs, 2)} g/s ({significant(KG_H * gs, 2)} kg/h)"


def quantile_text(quantiles: tuple[float, float, float], unit: str = "") -> str:
    """Return a median with its 90% interval."""
    low, middle, high = quantiles
    return f"{significant(middle, 2)} ({significant(low, 2)} to {significant(high, 2)}){unit and ' ' + unit}"
