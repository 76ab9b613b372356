"""Worlds by name: `puffs:share=0.2,meander=10+wind-30` is a gas with parameters, and how the truth errs.

All commands, scripts, environments and functions take these names.
"""

import inspect
import math
import sys
from collections.abc import Mapping, Sequence
from contextlib import nullcontext, redirect_stdout, suppress
from functools import lru_cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any, NamedTuple

from plume.mistakes.explained import nearest
from plume.problem import PAPER, Problem
from plume.scenario import AS_MODELLED, NoRelease, Scenario, draw
from plume.worlds.air import Air, Make, Steady
from plume.worlds.errors import WRONG, Errors, combined

# Where the gas of each kind is made. It is loaded when it is first asked for.
GASES = {
    "puffs": "plume.worlds.puffs:puffs",
    "walls": "plume.walls.making:walls",
    "recorded": "plume.recorded.air:recorded",
}
OURS = (AS_MODELLED, *GASES, *WRONG)  # of which the project's own worlds are made
PLUGINS = "plumeward.worlds"  # entry points of this group are worlds of other packages: docs/worlds.md
# What the flag --world means.
ABOUT = (
    "how the gas moves, and how the truth differs from what the estimator is told: a name of `plumeward list "
    "worlds`, with parameters or not, or several: puffs:share=0.2+wind-30"
)
LONGEST = 500  # characters of a name


class Named(NamedTuple):
    """A world as its name says."""

    make: Make
    parameters: Mapping[str, Any]
    wrong: tuple[str, ...]  # names in the table of errors

    def errors(self, seed: int, problem: Problem = PAPER) -> Errors:
        """Return how the truth of a problem's mission differs from what is told. Raises ValueError."""
        return combined(self.wrong, seed, problem)

    def air(self, truth: Scenario, seed: int) -> Air:
        """Return the air of a mission of which the release truly is this. Raises ValueError."""
        return self.make(truth, seed, **self.parameters)


@lru_cache(64)
def named(name: str) -> Named:
    """Return the world of a name. Raises ValueError with what is wrong and what is allowed."""
    if len(name) > LONGEST:
        raise ValueError(f"a world of {len(name):,} characters is not allowed; wanted {LONGEST} at most")
    make: Make = Steady
    parameters: dict[str, Any] = {}
    wrong: list[str] = []
    gas = ""
    for part in name.split("+"):
        kind, colon, numbers = part.partition(":")
        if kind in WRONG or kind == AS_MODELLED:
            if colon:
                raise ValueError(f"world {part!r} is not allowed; {kind} has no parameters")
            wrong.append(kind)
            continue
        make = _made(kind)
        if gas:
            raise ValueError(f"world {name!r} is not allowed: {gas} and {kind} are both a gas; wanted one")
        gas = kind
        parameters = _parameters(kind, make, numbers)
    world = Named(make, parameters, tuple(each for each in wrong if each != AS_MODELLED))
    try:
        world.errors(0)
        with suppress(NoRelease), nullcontext() if gas in ("", *GASES) else redirect_stdout(sys.stderr):
            world.air(draw(0), 0)
    except (Exception, SystemExit) as error:  # it may be anybody's code
        kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
        said = " ".join(str(error).split())[:LONGEST]
        raise ValueError(f"world {name!r} is not allowed: {kind}{said}") from error
    return world


def check(name: str, problem: Problem = PAPER) -> None:
    """Raise ValueError, with what is allowed, if this is not the name of a world for such a problem."""
    world = named(name)
    if problem is not PAPER:
        world.errors(0, problem)


def separate(text: str) -> list[str]:
    """Return the names of a list with commas between them; a comma stands before a parameter, too."""
    names: list[str] = []
    for item in text.split(","):
        if names and "=" in item.partition(":")[0].partition("+")[0]:
            names[-1] += f",{item}"
        else:
            names.append(item)
    return names


def kinds() -> tuple[str, ...]:
    """Return the names of which a world's name is made."""
    return (*OURS, *(plugin.name for plugin in entry_points(group=PLUGINS)))


def worlds() -> dict[str, str]:
    """Return the names of which a world's name is made, and one line about each."""
    listed = {AS_MODELLED: "as the estimator is told"}
    for kind in kinds():
        try:
            if kind not in OURS:
                make, whence = _plugged_in(kind), " [plug-in]"
            elif kind in GASES:
                make, whence = _load(GASES[kind]), ""
            else:
                continue
            listed[kind] = _first_line(make) + _with_parameters(make) + whence
        except ValueError as error:
            listed[kind] = str(error)
    return listed | {kind: wrong.about for kind, wrong in WRONG.items()}


def _load(where: str) -> Make:
    module, _, function = where.partition(":")
    make: Make = getattr(import_module(module), function)
    return make


def _made(kind: str) -> Make:
    if kind in GASES:
        return _load(GASES[kind])
    if not entry_points(group=PLUGINS, name=kind):
        raise ValueError(f"no world {kind!r}{nearest(kind, kinds(), 'wanted')} {', '.join(kinds())}")
    return _plugged_in(kind)


def _plugged_in(kind: str) -> Make:
    plugins: Sequence[EntryPoint] = tuple(entry_points(group=PLUGINS, name=kind))
    if len(plugins) > 1:
        raise ValueError(
            f"world {kind} is plugged in more than once, by {' and '.join(each.value for each in plugins)}; "
            "wanted one"
        )
    try:
        with redirect_stdout(sys.stderr):  # for what it prints: stdout is the command's
            make: Make = plugins[0].load()
        allowed = _allowed(make)
    except (Exception, SystemExit) as error:  # it may be anybody's code
        said = " ".join(str(error).split())[:200]
        raise ValueError(
            f"world {kind} of {plugins[0].value} does not load: {type(error).__name__}: {said}"
        ) from error
    for name, default in allowed.items():
        if type(default) not in (float, int, str):
            raise ValueError(f"world {kind}: its parameter {name} has no default that is a number or text")
    return make


def _allowed(make: Make) -> dict[str, Any]:
    """Return the parameters of a world, which are its keywords, with their defaults."""
    keywords = inspect.signature(make).parameters.values()
    return {each.name: each.default for each in keywords if each.kind is inspect.Parameter.KEYWORD_ONLY}


def _parameters(kind: str, make: Make, text: str) -> dict[str, Any]:
    """Read the parameters of a world from `name=value,name=value`. Raises ValueError."""
    allowed, given = _allowed(make), {}
    for item in text.split(",") if text else ():
        name, equals, value = item.partition("=")
        if name not in allowed or not equals or name in given:
            wanted = ",".join(f"{name}=…" for name in allowed)
            raise ValueError(
                f"{item!r} of world {kind!r} is not allowed; wanted "
                + (f"some of {kind}:{wanted}, each once" if allowed else "no parameters")
            )
        given[name] = _value(f"{name} of world {kind!r}", value, type(allowed[name]))
    return given


def _value(name: str, text: str, kind: type) -> Any:
    if kind is str:
        return text
    try:
        value = kind(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        wanted = "a whole number" if kind is int else "a number"
        raise ValueError(f"{name} is {text!r}; wanted {wanted}")
    return value


def _first_line(make: Make) -> str:
    line = (inspect.getdoc(make) or "").partition("\n")[0].rstrip(".")
    return line[:1].lower() + line[1:]


def _with_parameters(make: Make) -> str:
    """Say which parameters a world has, with their defaults."""
    allowed = ", ".join(
        f"{name}={value:g}" if isinstance(value, float) else f"{name}={value}"
        for name, value in _allowed(make).items()
    )
    return f"; {allowed}" if allowed else ""
