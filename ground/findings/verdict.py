"""The verdict on a search: found, doubtful and why, outside, or not found."""

import re
from typing import NamedTuple

from ground.findings.assumed import Told
from ground.findings.flight import Flight
from plume.scenario import SURE_OUTSIDE
from plume.sensors.instruments import Instrument
from scene.follow.described import problem_of

FOUND, DOUBTFUL, OUTSIDE, NOT_FOUND = "found", "doubtful", "outside", "not found"
# As in `estimator/belief.py`; a test holds them equal.
INCOMPATIBLE = 1e-4  # below this p-value readings, or winds, do not fit the model
CLEAR = 5.0  # least evidence of a plume for a stop, nats
# What the estimator says of messages that it drops and of a vehicle that leaves: no word on the find.
NO_DOUBT = re.compile(r"refused |uav/\d+ has left the search")
NARROW_M = 1.0  # a belief whose spread is below this claims a place, stop or not


class Judgement(NamedTuple):
    """How a search has ended."""

    kind: str  # FOUND, DOUBTFUL, OUTSIDE or NOT_FOUND
    sentence: str  # the whole verdict in words, without the place
    reasons: tuple[str, ...] = ()  # why it is doubtful


def verdict(flight: Flight, told: Told) -> Judgement:
    """Judge a flight by what it says of itself: nobody knows the truth."""
    last = flight.last
    if last.ceased and last.outside >= SURE_OUTSIDE:
        to = problem_of(flight.about).area.beyond(last.mean)
        where = f", to the {to}" if to else ""
        sentence = f"The source is outside the search area{where} ({100 * last.outside:.0f}% of the belief)."
        doubts = _doubts(flight, told)
        return Judgement(OUTSIDE, sentence + _but(doubts), doubts)
    if last.ceased:
        if reasons := _doubts(flight, told):
            return Judgement(
                DOUBTFUL,
                f"A source was located after {flight.read_text}, but the find is doubtful: "
                f"{'; '.join(reasons)}.",
                reasons,
            )
        return Judgement(FOUND, f"A source was found after {flight.read_text}.")
    reasons = _withheld(flight)
    if last.spread < NARROW_M and reasons:
        return Judgement(
            DOUBTFUL,
            f"The belief is narrow after {flight.read_text}, but the search claims no find: "
            f"{'; '.join(reasons)}.",
            reasons,
        )
    met = (
        "the readings hold gas of a source, but its place is not known well enough for a stop"
        if last.evidence >= CLEAR and not flight.is_flat
        else "the readings need no source to explain them"
    )
    more = (
        f" The record {flight.remark}: what the search has found later is not in it." if flight.remark else ""
    )
    reasons = _withheld(flight, narrow=False)
    but = _but(reasons[bool(flight.remark) :])  # the first is the record's, which `more` says
    return Judgement(NOT_FOUND, f"No source was found in {flight.read_text}: {met}.{but}{more}", reasons)


def _but(reasons: tuple[str, ...]) -> str:
    return f" But {'; '.join(reasons)}." if reasons else ""


def _reason(warning: str) -> str:
    """Return what a warning says, without its figures and the question that it ends with."""
    said = warning.rpartition(": ")[0] if warning.endswith("?") else warning
    return said.partition(" (")[0].rstrip(":")


def _doubts(flight: Flight, told: Told) -> tuple[str, ...]:
    """Return why a stop deserves a second look."""
    last, doubts = flight.last, []
    if flight.remark:
        doubts.append(f"the record {flight.remark}")
    if last.wind_p_value < INCOMPATIBLE:
        doubts.append(f"the wind was not the same at all readings (p = {last.wind_p_value:.1g})")
    warned = dict.fromkeys(_reason(it.text) for it in flight.estimator_warned)
    winds = "the wind is not the same"
    doubts += [
        f"the estimator warned in flight: {text}"
        for text in warned
        if not ((text.startswith(winds) and last.wind_p_value < INCOMPATIBLE) or NO_DOUBT.match(text))
    ]
    if isinstance(told.sensor, Instrument) and told.sensor.air:
        doubts.append(
            "the sensor is a metal oxide, whose gas is taken to be steady: in gusty gas up to a fifth of "
            "such stops are false"
        )
    elif last.advised_dwell > 0:
        doubts.append(
            f"the gas came and went: without a hover of {last.advised_dwell:g} s about one such stop in "
            "twenty is false"
        )
    return tuple(doubts)


def _withheld(flight: Flight, *, narrow: bool = True) -> tuple[str, ...]:
    """Return which checks kept a search from a stop."""
    last, reasons = flight.last, [f"the record {flight.remark}"] * bool(flight.remark)
    if last.p_value < INCOMPATIBLE:
        reasons.append(
            f"the last readings do not fit the model (p = {last.p_value:.1g}): the sensor may be stuck, or "
            "the model wrong"
        )
    if narrow and last.evidence < CLEAR:
        reasons.append(
            "one value plus noise explains the readings as well as a plume does: the sensor may hum"
        )
    if last.wind_p_value < INCOMPATIBLE:
        reasons.append(f"the wind was not the same at all readings (p = {last.wind_p_value:.1g})")
    return tuple(reasons)
