"""Compares the answers of estimator and agent with the recorded ones, field by field.

It decodes their bytes without their code.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from link.bus.keys import BELIEF, STOP, WAYPOINT
from link.bus.mavlink import BadFrame, nearest, unpack
from link.bus.messages import Belief, Stop
from link.cli import BadInput
from link.record.record import Entry

# Kinds of answers to a reading and their keys, in the order of publication.
ANSWERS = {"stop": STOP.name, "belief": BELIEF.name, "waypoint": WAYPOINT.name}
PARTICLES = "particles"
SETPOINT_MESSAGE = mavlink.MAVLink_set_position_target_local_ned_message
FIELDS: Mapping[str, tuple[str, ...]] = {
    "stop": Stop.__struct_fields__,
    "belief": (*Belief.__struct_fields__, PARTICLES),
    "waypoint": tuple(SETPOINT_MESSAGE.fieldnames),
}
# Fields that older records lack; then they are not compared.
NEWER_FIELDS = (
    "assume",
    "stop",
    "evidence",
    "outside",
    "wind_p_value",
    "intermittency",
    "advised_dwell",
    "measured",
    "system",
    "stands",
)
# Fields shown of a message that only one side has.
HEADLINE = {"stop": ("estimate",), "belief": ("mean",), "waypoint": ("x", "y")}


class Answer(NamedTuple):
    """One answer of a service to one reading."""

    kind: str
    time_ms: int  # time of the reading that it answers
    fields: dict[str, Any]
    published_ns: int = 0  # of a log's
    system: int = 0  # whose reading closes the round that it answers, in a search of several

    def near(self, time_ms: float) -> "Answer":
        """Return it with its time near to another, ms: it goes on where time_boot_ms wraps."""
        return self._replace(time_ms=nearest(round(time_ms), self.time_ms))


class Difference(NamedTuple):
    """The first difference from the recording."""

    kind: str
    time_ms: int
    step: int | None  # none where no belief says it
    field: str  # the value that differs; empty if only one side has the message
    was: Any
    now: Any

    def text(self) -> str:
        """One line for people."""
        step = "" if self.step is None else f" (step {self.step})"
        return (
            f"{self.kind} at {self.time_ms / 1000:.2f} s{step}: {self.field or 'it'} "
            f"was {_text(self.was)}, is {_text(self.now)}"
        )

    def as_json(self) -> dict[str, Any]:
        """The fields that `--json` prints."""
        return {
            "key": ANSWERS[self.kind],
            "time_s": self.time_ms / 1000,
            "step": self.step,
            "field": self.field,
            "was": self.was,
            "is": self.now,
        }


class Rules(NamedTuple):
    """Differences that are accepted."""

    ignored: frozenset[str] = frozenset()  # kinds, and fields as KIND.FIELD
    tolerance: float = 0.0  # largest difference of numbers that is accepted


def place(key: tuple[int, str]) -> tuple[int, int]:
    """Sort key of answers by time and kind: the order in which they are compared."""
    time_ms, kind = key
    return time_ms, list(ANSWERS).index(kind)


def answers(key: str, payload: bytes, attachment: bytes = b"") -> list[Answer]:
    """Return the answers in a message, with their time_boot_ms.

    Empty if it is not an answer of a service, or does not decode.
    """
    if key == WAYPOINT.name:
        return _waypoints(payload)
    kind = {BELIEF.name: "belief", STOP.name: "stop"}.get(key)
    if kind is None:
        return []
    try:
        fields = msgspec.json.decode(payload)
        time_boot_ms = fields["time_boot_ms"]
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError, KeyError, TypeError):
        return []
    if not isinstance(time_boot_ms, int):
        return []
    if kind == "belief":
        fields[PARTICLES] = _particles(attachment, fields.get("unknowns"))
    return [Answer(kind, time_boot_ms, fields, system=_closing_system(fields.get("readings")))]


def said(
    entries: Iterable[Entry], placed: Callable[[Answer, float], Answer] = Answer.near
) -> dict[tuple[int, str], Answer]:
    """Return the answers in a log by reading and kind, in order; repeated ones count once.

    placed: gives an answer the time of its round, near to another time, ms.
    """
    found: dict[tuple[int, str], Answer] = {}
    for entry in entries:
        for each in answers(entry.key, entry.payload, entry.attachment):
            answer = placed(each, 1000 * entry.simulation_s)._replace(published_ns=entry.published_ns)
            found.setdefault((answer.time_ms, answer.kind), answer)
    return {key: found[key] for key in sorted(found, key=place)}


def ignored(names: Sequence[str], then: Iterable[Answer] = ()) -> frozenset[str]:
    """Parse the values of --ignore; raises BadInput.

    Fields that only the log has can be ignored too.
    """
    fields = {kind: dict.fromkeys(known) for kind, known in FIELDS.items()}
    for answer in then:
        fields[answer.kind] |= dict.fromkeys(answer.fields)
    kinds = {**{kind: kind for kind in ANSWERS}, **{key: kind for kind, key in ANSWERS.items()}}
    found = set()
    for name in names:
        key, _, field = name.partition(".")
        if name == PARTICLES:
            found.add(f"belief.{PARTICLES}")
        elif key not in kinds:
            raise BadInput(
                f"--ignore: {name!r} is not allowed; wanted {', '.join(kinds)}, a field of theirs, or "
                f"{PARTICLES}"
            )
        elif field and field not in fields[kinds[key]]:
            raise BadInput(f"--ignore: {name!r} is not allowed; {key} has {', '.join(fields[kinds[key]])}")
        else:
            found.add(f"{kinds[key]}.{field}" if field else kinds[key])
    return frozenset(found)


def difference(was: Answer | None, now: Answer | None, rules: Rules, step: int | None) -> Difference | None:
    """Compare one message with its counterpart; returns the first field that differs.

    One of the two may be missing. `step` is used for messages that have none.
    """
    one = was or now
    assert one is not None
    if one.kind in rules.ignored:
        return None
    where = (
        one.kind,
        one.time_ms,
        next((known for known in (step_of(was), step_of(now), step) if known is not None), None),
    )
    if was is None or now is None:
        return Difference(*where, "", _headline(was), _headline(now))
    for name in dict.fromkeys((*was.fields, *now.fields)):
        if f"{one.kind}.{name}" in rules.ignored or (name in NEWER_FIELDS and name not in was.fields):
            continue
        if found := _first(name, was.fields.get(name), now.fields.get(name), rules.tolerance):
            return Difference(*where, *found)
    return None


def must_be_silent(then: Mapping[tuple[int, str], Answer], time_ms: int, kind: str, budget: float) -> bool:
    """True if a missing answer proves that none was sent.

    Else the log may begin later or end earlier. Answers to the last reading may have been sent after the
    recording ended, unless the log shows that none was to be sent.
    """
    times = [time for time, _ in then]
    if not times or not times[0] <= time_ms <= times[-1]:
        return False
    if time_ms < times[-1]:
        return True
    belief = then.get((time_ms, "belief"))
    if kind != "waypoint" or belief is None:
        return any((time_ms, later) in then for later in ("belief", "waypoint") if later != kind)
    step = step_of(belief)
    return bool(belief.fields.get("ceased")) or (step is not None and step >= budget)


def step_of(answer: Answer | None) -> int | None:
    """Return the step that a belief or stop says; None if it says none."""
    step = answer.fields.get("step") if answer else None
    return step if isinstance(step, int) else None


# ---- decoding ----


def _closing_system(readings: Any) -> int:
    """Return the system of the last reading of a round; 0 if there is none."""
    last = readings[-1] if isinstance(readings, list) and readings else None
    system = last.get("system") if isinstance(last, dict) else None
    return system if isinstance(system, int) else 0


def _waypoints(payload: bytes) -> list[Answer]:
    try:
        messages = unpack(payload)
    except BadFrame:
        return []
    systems = {
        message.target_system for message in messages if message.get_type() == SETPOINT_MESSAGE.msgname
    }
    if len(systems) == len(messages) > 1:  # the answer to a round of several vehicles, at the last one's time
        places = {
            f"{name} of {message.target_system}": _float32(getattr(message, name))
            for message in messages
            for name in SETPOINT_MESSAGE.fieldnames
        }
        last = messages[-1]
        return [Answer("waypoint", last.time_boot_ms, places, system=last.target_system)]
    return [
        Answer(
            "waypoint",
            message.time_boot_ms,
            {name: _float32(getattr(message, name)) for name in SETPOINT_MESSAGE.fieldnames},
            system=message.target_system,
        )
        for message in messages
        if message.get_type() == SETPOINT_MESSAGE.msgname
    ]


def _particles(attachment: bytes, unknowns: Any) -> Any:
    """Return rows of float32, or the bytes unchanged if they do not divide into rows."""
    columns = len(unknowns) + 1 if isinstance(unknowns, list) else 1
    return (
        attachment
        if len(attachment) % (4 * columns)
        else np.frombuffer(attachment, "<f4").reshape(-1, columns)
    )


def _float32(value: Any) -> Any:
    """Return the number with the fewest digits that is the same float32, as the wire carries it."""
    return float(str(np.float32(value))) if isinstance(value, float | np.floating) else value


# ---- comparing ----


def _first(name: str, was: Any, now: Any, tolerance: float) -> tuple[str, Any, Any] | None:
    """Return the first value that differs, with its full name."""
    if isinstance(was, np.ndarray) and isinstance(now, np.ndarray) and was.shape == now.shape:
        if was.tobytes() == now.tobytes():
            return None
        was, now = _rows(was), _rows(now)
    if isinstance(was, list) and isinstance(now, list) and len(was) == len(now):
        pairs = enumerate(zip(was, now, strict=True))
        found = (_first(f"{name}[{place}]", a, b, tolerance) for place, (a, b) in pairs)
        return next(filter(None, found), None)
    if _is_number(was) and _is_number(now):
        return None if _same(was, now, tolerance) else (name, was, now)
    if type(was) is type(now) and not isinstance(was, np.ndarray) and was == now:
        return None
    return name, _plain(was), _plain(now)


def _rows(array: "np.ndarray[Any, Any]") -> list[list[float]]:
    return [[_float32(value) for value in row] for row in array]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _same(was: float, now: float, tolerance: float) -> bool:
    both_nan = math.isnan(was) and math.isnan(now)
    near = tolerance > 0.0 and abs(was - now) <= tolerance
    return both_nan or near or (was == now and math.copysign(1.0, was) == math.copysign(1.0, now))


def _plain(value: Any) -> Any:
    """Return the size of an array or of bytes as text, other values unchanged."""
    if isinstance(value, np.ndarray):
        return f"{len(value)} rows of {value.shape[1]}"
    return f"{len(value)} bytes" if isinstance(value, bytes) else value


def _headline(answer: Answer | None) -> dict[str, Any] | None:
    return None if answer is None else {name: answer.fields.get(name) for name in HEADLINE[answer.kind]}


def _text(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_text(each)}" for name, each in value.items())
    if isinstance(value, str | float):
        return value if isinstance(value, str) else repr(value)
    return "none" if value is None else msgspec.json.encode(value).decode()
