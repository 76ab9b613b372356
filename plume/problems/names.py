"""Problems by name: `paper`, a YAML file, or JSON, as flags, functions and environments take them."""

import json
import os
import re
import stat
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from ruamel.yaml.error import YAMLError

from plume.mistakes.bounded_yaml import value_of
from plume.mistakes.explained import nearest
from plume.problem import PAPER, Problem
from plume.problems import fences
from plume.scenario import AS_MODELLED
from plume.sensors import names as sensors
from plume.sensors.names import Sensor

PROBLEMS = {"paper": PAPER}
# What the flag --problem means.
ABOUT = (
    "what is searched, where and from what knowledge: paper, a YAML file of area, step_m, prior and so on, "
    "or a fence, FILE.kml, .geojson or .plan; other flags override its fields"
)
FORMS = "paper, a YAML file, a fence (.kml, .geojson, .plan), or a JSON object of its fields"
MOST_BYTES = 100_000
FIELDS = Problem.__struct_fields__


def named(said: "str | os.PathLike[str] | Problem | Mapping[str, Any]") -> Problem:
    """Return the problem of a name, a file, a JSON text, or fields. Raises ValueError, one line."""
    if isinstance(said, Problem):
        check(said)
        return said
    if isinstance(said, Mapping):
        return _made(dict(said))
    if isinstance(said, os.PathLike):
        said = os.fsdecode(said)
    if not isinstance(said, str):
        raise ValueError(f"problem {said!r:.60} is not allowed; wanted {FORMS}")
    return _of(said) if said in PROBLEMS or said.lstrip().startswith("{") else of_file(said)


def with_arguments(problem: "str | os.PathLike[str] | Problem | Mapping[str, Any]", **given: Any) -> Problem:
    """Return a problem with the fields that are given, not None. Raises ValueError."""
    changes = {name: value for name, value in given.items() if value is not None}
    return named(named(problem).changed(**changes)) if changes else named(problem)


@lru_cache(64)
def _of(text: str) -> Problem:
    if text in PROBLEMS:
        return PROBLEMS[text]
    try:
        fields = json.loads(text, object_pairs_hook=fences.each_once)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"not valid JSON: {str(error)[:200]}; wanted {FORMS}") from None
    return _made(fields)


def of_file(name: str) -> Problem:
    """Return the problem of a YAML file. Raises ValueError."""
    path = Path(name)
    kind = path.suffix.lower()
    if not os.path.lexists(name) and re.fullmatch(r"[^/.]*", name):
        raise ValueError(f"{name!r:.60} is no problem and no file{nearest(name, PROBLEMS, 'wanted')} {FORMS}")
    if kind == ".kmz":
        raise ValueError(f"{name}: a .kmz is a zip file; wanted the .kml in it")
    try:
        with open(path, "rb", opener=lambda file, flags: os.open(file, flags | os.O_NONBLOCK)) as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise ValueError(f"{name}: a pipe or a device is not allowed; wanted a file")
            content = file.read(fences.MOST_BYTES + 1)
    except OSError as error:
        raise ValueError(f"{name}: {error.strerror}; wanted {FORMS}") from None
    if kind == ".json" and b'"FeatureCollection"' in content:
        kind = ".geojson"
    if kind in fences.READERS:
        try:
            return named(fences.problem_of(content, kind))
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from None
    if len(content) > MOST_BYTES:
        raise ValueError(f"{name}: more than {MOST_BYTES:,} bytes are not allowed")
    try:
        value = value_of(content.decode())
    except (YAMLError, ValueError, RecursionError, LookupError) as error:
        what = getattr(error, "problem", None) or str(error).split("\n")[0]
        mark = getattr(error, "problem_mark", None)
        raise ValueError(f"{name}:{f'{mark.line + 1}:' if mark else ''} not valid YAML: {what}") from None
    try:
        if isinstance(value, dict) and "problem" in value:  # a mission script
            value = value["problem"]
        if value is None:
            raise ValueError(f"there is nothing in it; wanted fields: {', '.join(FIELDS)}")
        return _made(value)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


def _made(fields: Any) -> Problem:
    """Return the problem of these fields. Raises ValueError."""
    wanted = f"fields: {', '.join(FIELDS)}"
    if not isinstance(fields, dict):
        raise ValueError(f"{fields!r:.60} is not allowed; wanted {wanted}")
    for name in fields:
        if name not in FIELDS:
            raise ValueError(f"unknown field {name!r:.60}{nearest(name, FIELDS, 'wanted')} {wanted}")
    problem = Problem(**fields)
    check(problem)
    return problem


def check(problem: Problem) -> None:
    """Raise ValueError if a problem's sensor or world is not known, or is not for such a problem."""
    try:
        sensor_of(problem)
    except ValueError as error:
        raise ValueError(f"sensor: {error}") from None
    if problem.world == AS_MODELLED:
        return
    from plume.worlds import names as worlds  # a service, which knows no world, does not load them

    try:
        worlds.check(problem.world, problem)
    except ValueError as error:
        raise ValueError(f"world: {error}") from None


def sensor_of(problem: Problem) -> Sensor:
    """Return a problem's sensor, with its dwell. Raises ValueError."""
    return sensors.parse(sensor_text(problem))


def sensor_text(problem: Problem) -> str:
    """Return the text of a problem's sensor, with its dwell. Raises ValueError."""
    return sensors.dwelling(problem.sensor, problem.dwell_s)
