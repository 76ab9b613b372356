"""Protects the bar: its text fits a line of 60 or 80 columns."""

from collections.abc import Generator

import pytest
from rich.console import Console

from agent.trials.progress import progress_bar, with_bar


def shown(width: int, *, stands: str | None, what: str, done: int, total: int) -> str:
    """What a terminal of so many columns shows."""
    progress = progress_bar(stands=stands is not None)
    progress.add_task(what, total=total, completed=done, **({} if stands is None else {"stands": stands}))
    console = Console(width=width, force_terminal=True, color_system=None, legacy_windows=False)
    with console.capture() as capture:
        console.print(progress.get_renderable())
    return capture.get()


@pytest.mark.parametrize(
    ("what", "total"), [("missions", 1000), ("test missions", 3000), ("missions", 25_000)]
)
def test_a_bar_of_missions_says_how_many_and_how_long_in_a_line_of_80(what: str, total: int) -> None:
    (line,) = shown(80, stands=None, what=what, done=total // 2, total=total).splitlines()
    for word in (what, f"{total // 2}/{total}", "left", "-:--:--", "━━━━"):
        assert word in line
    assert line.index(what) < line.index("━") < line.index("/") < line.index("left")


def test_a_bar_of_training_says_how_it_stands_in_a_line_of_80() -> None:
    stands = "9,999 moves/s ceased 99.9% located 98.4% MTD 28.4 m"
    (line,) = shown(80, stands=stands, what="ppo", done=3_000_000, total=6_000_000).splitlines()
    for word in ("ppo", "━━━━", "50%", "-:--:--", stands):
        assert word in line


def test_bars_fit_a_line_of_60_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    for what, stands in (("starting 2 workers", None), ("ppo", "9,999 moves/s located 98.4% MTD 28.4 m")):
        (line,) = shown(60, stands=stands, what=what, done=12_500, total=25_000).splitlines()
        for word in (what, "-:--:--", stands or "12500/25000"):
            assert word in line


def test_a_bar_starts_with_its_first_words_before_anything_has_flown(
    capsys: pytest.CaptureFixture[str],
) -> None:
    def flights() -> Generator[int, None, None]:
        assert capsys.readouterr().err == "starting 3 workers for 2 missions\n"
        yield from (1, 2)

    assert list(with_bar(flights(), 2, "missions", "starting 3 workers")) == [1, 2]


def test_a_bar_is_for_people_and_goes_to_stderr() -> None:
    assert progress_bar().console.stderr
    assert progress_bar(stands=True).console.stderr
