"""The settings that a record may give the services of its replay.

It may come from a stranger: nothing else of it is run.
"""

from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from link.cli import MOST_VEHICLES

# A name, perhaps with numbers: no flag, no path.
Plain = Annotated[str, Meta(pattern=r"\A[A-Za-z][\w:=.,+ -]*\Z", max_length=200)]
# The name of a policy, not the file of one.
Named = Annotated[str, Meta(pattern=r"\A[A-Za-z][\w+.-]*(?<!\.zip)\Z", max_length=200)]
# A problem as JSON, not the file of one.
Told = Annotated[str, Meta(pattern=r"\A(paper|\{.*\})\Z", max_length=20_000)]
Waypoints = Annotated[str, Meta(pattern=r"\A\d+:[\d.,;e+-]*\Z")]  # STEP:X,Y;X,Y;..


class _Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, rename="kebab", omit_defaults=True):
    """Flags by name, without those that were not given."""

    seed: int | None = None
    sysid: int | None = None
    area: float | None = None
    problem: Told | None = None


class Estimator(_Settings, frozen=True):
    """What the estimator assumes, and when it may stop."""

    particles: int | None = None
    assume: Plain | None = None
    threshold: float | None = None
    stop: Plain | None = None
    stop_on: Plain | None = None
    margin: float | None = None
    sensor: Plain | None = None
    rate: float | None = None
    diffusivity: float | None = None
    lifetime: float | None = None
    prior: list[Plain] = []
    vehicles: Annotated[int, Meta(ge=1, le=MOST_VEHICLES)] | None = None
    overdue: float | None = None
    doubted: Plain | None = None


class Agent(_Settings, frozen=True):
    """How the agent chooses waypoints."""

    policy: Named | None = None
    budget: int | None = None
    headings: int | None = None
    step: float | None = None
    measurements: int | None = None
    separation: float | None = None
    waypoints: list[Waypoints] = []


SETTINGS: dict[str, type[_Settings]] = {"estimator": Estimator, "agent": Agent}
REPEATED = ("prior", "waypoints")
LONGEST = 80  # characters of a word that are quoted


def words(service: str, recorded: list[str], bundle: str | None = None) -> list[str]:
    """Return the flags for a service of today from its recorded ones.

    bundle: the file of a policy that the user names in place of the recorded one. Raises ValueError with the
    flag that a record may not give.
    """
    given: dict[str, Any] = {}
    for flag, value in _pairs(recorded):
        name = flag.removeprefix("--")
        if name == flag or (name in given and name not in REPEATED):
            raise ValueError(_quoted(flag))
        if bundle and name == "policy":
            continue
        given[name] = [*given.get(name, []), value] if name in REPEATED else value
        try:
            msgspec.convert({name: given[name]}, SETTINGS[service], strict=False)
        except msgspec.ValidationError:
            raise ValueError(_quoted(f"{flag} {value}")) from None
    if service == "estimator":
        given.setdefault("assume", "paper")  # older estimators took all but the position to be known
        if "vehicles" in given:
            given["overdue"] = 0  # who leaves the search is what the record says
            given.pop("doubted", None)
    settings = msgspec.to_builtins(msgspec.convert(given, SETTINGS[service], strict=False))
    return as_words(settings | ({"policy": bundle} if bundle else {}))


def flew_a_bundle(recorded: list[str]) -> bool:
    """Whether an agent's recorded flags name the file of a policy."""
    return any(flag == "--policy" and value.endswith(".zip") for flag, value in pairwise(recorded))


def as_words(settings: Mapping[str, Any]) -> list[str]:
    """Return a command line of settings, by the names of their flags.

    Each item of a list is a flag of its own.
    """
    return [
        word
        for name, value in settings.items()
        for item in (value if isinstance(value, list) else [value])
        for word in (f"--{name.replace('_', '-')}", str(item))
    ]


def _pairs(recorded: list[str]) -> Iterator[tuple[str, str]]:
    """Yield flags with their values: all flags that a record may give have one."""
    if len(recorded) % 2:
        raise ValueError(_quoted(recorded[-1]))
    yield from zip(recorded[::2], recorded[1::2], strict=True)


def _quoted(word: str) -> str:
    """Quote what a stranger may have written, for one line of a terminal."""
    return ascii(word if len(word) <= LONGEST else f"{word[:LONGEST]} ...")
