"""Protects what people see while a mission flies: one line that never wraps, and what is waited for."""

import io
import re
from collections.abc import Callable
from types import SimpleNamespace

import pytest
from msgspec import UNSET
from rich.console import Console

from sitl.launch import progress
from sitl.launch.progress import Progress
from tests.system.screen import CONTROL

STEP = SimpleNamespace(
    step=20,
    position=(14.94, 17.12),
    gas=0.331,
    mean=(21.37, 22.07),
    spread=5.6,
    ceased=False,
    readings=UNSET,
)
"""What is shown of a belief."""


@pytest.fixture
def shown(monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[Progress, io.StringIO]]:
    """A progress on a terminal of so many columns, or on none, and what it has written."""

    def on(columns: int | None) -> tuple[Progress, io.StringIO]:
        file = io.StringIO()
        console = Console(
            file=file,
            width=columns or 80,
            force_terminal=columns is not None,
            highlight=False,
            color_system=None,
        )
        monkeypatch.setattr(progress, "Console", lambda **_: console)
        return Progress(300), file

    return on


def live_line(shown: tuple[Progress, io.StringIO]) -> str:
    """The live line as a terminal gets it, however often it is drawn; fails where it wraps."""
    progress, file = shown
    with progress:
        pass
    (line,) = {line for line in re.split(r"[\r\n]+", CONTROL.sub("", file.getvalue())) if line}
    return line


@pytest.mark.parametrize(
    ("columns", "expected"),
    [
        (
            120,
            "step  20/300  at (14.94, 17.12)  gas   0.33  spread  5.60 m  flown  20.0 m  estimate (21.37, "
            "22.07)",
        ),
        (80, "step  20/300  at (14.94, 17.12)  gas   0.33  spread  5.60 m  flown  20.0 m"),
        (60, "step  20/300  at (14.94, 17.12)  gas   0.33  spread  5.60 m"),
        (50, "step  20/300  at (14.94, 17.12)  gas   0.33"),
        (10, "step  20/3"),
    ],
)
def test_the_live_line_drops_fields_from_the_right_and_never_wraps(
    shown: Callable, columns: int, expected: str
) -> None:
    on_terminal = shown(columns)
    on_terminal[0].show(STEP, 20.0)
    assert live_line(on_terminal) == expected


def test_a_long_reason_to_wait_is_cropped_too(shown: Callable) -> None:
    on_terminal = shown(20)
    on_terminal[0].wait("waiting for agent, estimator")
    assert live_line(on_terminal) == "waiting for agent, e"


def test_without_a_terminal_a_wait_is_told_once_and_only_if_it_lasts(
    shown: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = 100.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now_s)
    plain, file = shown(None)
    for reason, until_s in (
        ("compiling kernels", 108.0),
        ("taking off", 109.0),
        ("flying to the start", 112.0),
    ):
        while now_s < until_s:
            plain.wait(reason)
            now_s += 0.5
    assert file.getvalue().splitlines() == ["compiling kernels", "flying to the start"]


def test_gas_below_nothing_has_no_sign_where_it_rounds_to_nothing(shown: Callable) -> None:
    plain, file = shown(None)
    for step, gas in ((0, -0.004), (10, -0.006)):
        plain.show(SimpleNamespace(**vars(STEP) | {"step": step, "gas": gas}), 0.0)
    assert re.findall(r"gas +(\S+)", file.getvalue()) == ["0.00", "-0.01"]


def test_without_a_terminal_each_tenth_step_is_a_line_of_at_most_60_characters(shown: Callable) -> None:
    plain, file = shown(None)
    for step in range(21):
        plain.show(SimpleNamespace(**vars(STEP) | {"step": step}), float(step))
    lines = file.getvalue().splitlines()
    assert [line[:8] for line in lines] == ["step   0", "step  10", "step  20"]
    assert {len(line) for line in lines} == {59}


@pytest.mark.parametrize(
    ("columns", "expected"),
    [
        (30, "the sensor drops out twice;\n  the vehicle waits\n"),
        (None, "the sensor drops out twice; the vehicle waits\n"),
    ],
)
def test_a_line_that_stays_is_broken_at_words_on_a_terminal_and_whole_elsewhere(
    shown: Callable, columns: int | None, expected: str
) -> None:
    progress, file = shown(columns)
    progress.say("the sensor drops out twice; the vehicle waits")
    assert file.getvalue() == expected
