"""Which faults a mission has: drawn from its seed, so that the same seed gives the same faults."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import msgspec
import numpy as np

from plume.randomness import keyed

RESTARTED = ("router", "estimator", "agent")
"""Parts that are started again after a kill."""
PARTS = (*RESTARTED, "uav", "recorder", "launcher", "bridge", "station")
LAST_STEP = 15
"""Latest step at which a fault begins: few searches are over before."""
MOST_FAULTS = 3
SILENCES = ("kill", "hang", "cut", "unplug")


class Fault(msgspec.Struct, frozen=True, omit_defaults=True):
    """One fault of a mission."""

    kind: str
    """A name of KINDS."""
    step: int = -1
    """The belief after which it begins; -1: it is there from the start."""
    part: str = ""
    """Whom it hits, or which part is started twice."""
    for_s: float = 0.0
    """How long it lasts, or how late something is, real time in s."""
    amount: float = 0.0
    """What else has a size: the share of packets dropped, the step of the clock in s, the bytes of the
    disk.
    """


class Kind(NamedTuple):
    """One row of the campaign."""

    what: str
    promise: str
    parts: tuple[str, ...] = ()
    """One of these is hit."""
    for_s: tuple[float, float] = (0.0, 0.0)
    """Shortest and longest duration, s."""
    amount: tuple[float, float] = (0.0, 0.0)
    from_start: bool = False
    split: bool = False
    """Needs a part on another machine: a network namespace of its own, behind a link whose packets can be
    dropped.
    """


ENDS = "the mission ends as if undisturbed"
KINDS: Mapping[str, Kind] = {
    "kill": Kind(
        "SIGKILL of a part; router, estimator and agent are started again after at most 5 s",
        f"{ENDS}; without the uav it fails and says so, and all parts end with the launcher",
        PARTS,
        (0.1, 5.0),
    ),
    "hang": Kind("SIGSTOP of a part for 1 to 20 s", ENDS, PARTS, (1.0, 20.0)),
    "cut": Kind(
        "a relay between a part and the router stalls for 1 to 15 s",
        ENDS,
        ("uav", "estimator", "agent"),
        (1.0, 15.0),
    ),
    "unplug": Kind(
        "the link to a part's machine drops all packets for 1 to 15 s",
        ENDS,
        ("uav", "estimator", "agent"),
        (1.0, 15.0),
        split=True,
    ),
    "loss": Kind(
        "the link to a part's machine drops 10 to 30% of packets, both ways",
        ENDS,
        ("uav", "estimator", "agent"),
        amount=(0.1, 0.3),
        from_start=True,
        split=True,
    ),
    "radio": Kind("the vehicle's radio delays, duplicates and loses readings", ENDS, (), (0.1, 3.0)),
    "echo": Kind(
        "a stranger publishes old readings again: up to 3 times each, up to 3 s late, in any order", ENDS
    ),
    "deaf": Kind("a subscriber to every key that never reads", ENDS),
    "second": Kind(
        "a second estimator or agent, with other settings",
        f"{ENDS}; the second is refused with one line",
        ("estimator", "agent"),
    ),
    "clock": Kind(
        "the wall clock of all parts is stepped by 1 s to 1 day, forward or back",
        ENDS,
        amount=(1.0, 86_400.0),
    ),
    "disk": Kind(
        "the disk under the record is full at 40 to 400 kB",
        f"{ENDS}; the record says why it stops",
        amount=(4e4, 4e5),
        from_start=True,
    ),
}


def plan(seed: int, only: str | None = None) -> list[Fault]:
    """Draw the faults of a mission, by time; with `only` one fault, of this kind."""
    rng = keyed(seed, "chaos")
    if only:
        return [_draw(only, rng)]
    kinds = list(KINDS)
    first = kinds[rng.integers(len(kinds))]
    count = 1 + int(rng.integers(MOST_FAULTS))
    split = KINDS[first].split
    # On two machines nothing of the first is relayed; on one machine no packet can be dropped.
    others = [
        kind
        for kind in kinds
        if kind not in (first, "cut" if split else "") and (split or not KINDS[kind].split)
    ]
    others = [str(kind) for kind in rng.permutation(others)][: count - 1]
    if split:
        others = [kind for kind in others if not KINDS[kind].split]
    drawn = [_draw(kind, rng) for kind in (first, *others)]
    twice = {fault.part for fault in drawn if fault.kind == "second"}
    # Of a part that is gone for a while the second one takes the place: nobody can tell which of them is
    # meant.
    return sorted(
        (it for it in drawn if it.kind not in SILENCES or it.part not in twice), key=lambda fault: fault.step
    )


def is_split(faults: list[Fault]) -> bool:
    """Whether the mission needs two machines."""
    return any(KINDS[fault.kind].split for fault in faults)


def far(faults: list[Fault]) -> str:
    """Return the part on the far machine; the launcher and the recorder are with the uav."""
    return next(fault.part for fault in faults if KINDS[fault.kind].split)


def _draw(name: str, rng: np.random.Generator) -> Fault:
    """Draw a fault; durations and sizes are log-uniform, so that short ones are frequent."""
    kind = KINDS[name]
    step = int(rng.integers(LAST_STEP + 1))
    part = kind.parts[rng.integers(len(kind.parts))] if kind.parts else ""
    for_s, amount = (_log_uniform(rng, *bounds) for bounds in (kind.for_s, kind.amount))
    if name == "clock" and rng.random() < 0.5:
        amount = -amount
    return Fault(name, -1 if kind.from_start else step, part, for_s, amount)


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    share = float(rng.random())
    return float(f"{low * math.exp(share * math.log(high / low)):.3g}") if low else 0.0


def text(fault: Fault) -> str:
    """Return a fault in a few words."""
    words = [fault.kind, fault.part, "" if fault.step < 0 else f"at {fault.step}"]
    words += [f"{fault.for_s:g} s"] * bool(fault.for_s) + [f"{fault.amount:g}"] * bool(fault.amount)
    return " ".join(filter(None, words))
