"""Protects how payloads are named and plugged in, and that a driver may do what it likes: the answer is a
value or NaN.
"""

import math
import re
import textwrap
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from aircraft.payload.drivers import SENSOR_ERROR, TIMEOUT_S, Driven, make, opened
from aircraft.payload.messages import Question, Sample
from aircraft.payload.options import check, kinds
from link.bus.log import Log
from link.bus.tally import Tally

ASKED = Question(1, 1000, 0, (3.0, 4.0), (1.0, 0.0))

Plug = Callable[..., str]


@pytest.fixture
def log() -> Log:
    return Log("payload", "uav/1", Tally(), "error")


@pytest.fixture
def plug(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Plug:
    """Plug in drivers, NAME=OBJECT, of one module; returns the module's name."""
    module = re.sub(r"\W", "_", f"stranger_{tmp_path.name}")  # unique per test, since Python caches modules

    def put(source: str, *names: str) -> str:
        (tmp_path / f"{module}.py").write_text(textwrap.dedent(source))
        said = tmp_path / f"{module}-1.0.dist-info"
        said.mkdir()
        (said / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n")
        lines = [f"{name.partition('=')[0]} = {module}:{name.partition('=')[2]}" for name in names]
        (said / "entry_points.txt").write_text("\n".join(["[plumeward.payloads]", *lines]) + "\n")
        monkeypatch.syspath_prepend(tmp_path)
        return module

    return put


SNIFFER = """
    class Sniffer:
        def __init__(self, text):
            self.text = text

        def open(self):
            self.value = float(self.text)

        def read(self, timeout_s):
            return self.value + timeout_s

        def close(self):
            pass
"""


@pytest.mark.parametrize("text", ["simulated", "serial:/dev/ttyUSB0", "serial:/dev/ttyUSB0:9600"])
def test_the_payloads_that_ship_are_allowed(text: str) -> None:
    check(text)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "'' is not allowed; wanted simulated or serial:PATH[:BAUD]"),
        (
            "simulate",
            "'simulate' is not allowed; did you mean 'simulated'? Wanted simulated or serial:PATH[:BAUD]",
        ),
        ("simulated:1", "'simulated:1' is not allowed; wanted simulated alone"),
        ("serial", "'serial' is not allowed; wanted serial:PATH[:BAUD]"),
        ("serial:", "'serial:' is not allowed; wanted serial:PATH[:BAUD]"),
        (
            "serial:/dev/ttyUSB0:12345",
            "'serial:/dev/ttyUSB0:12345': 12345 baud is not allowed; wanted one of 1200,",
        ),
    ],
)
def test_another_payload_is_refused_with_what_is_allowed(text: str, reason: str) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(reason)}"):
        check(text)


def test_a_plug_in_is_found_by_its_name_and_gets_the_text_behind_the_colon(plug: Plug, log: Log) -> None:
    plug(SNIFFER, "sniffer=Sniffer")
    check("sniffer")
    check("sniffer:1.5")
    assert "sniffer" in kinds()
    driver = opened("sniffer:1.5", log)
    assert driver.read(2.0) == 3.5
    with pytest.raises(
        ValueError, match=re.escape("did you mean 'sniffer'? Wanted simulated, serial:PATH[:BAUD] or sniffer")
    ):
        check("snifer")


def test_a_plug_in_that_cannot_be_used_is_refused_with_the_reason(plug: Plug, log: Log) -> None:
    source = """
        def broken(text):
            raise OSError("no such bus")

        def leaves(text):
            raise SystemExit(0)

        class Half:
            def __init__(self, text): ...
            def open(self): ...
    """
    module = plug(source, "broken=broken", "leaves=leaves", "missing=nothing", "half=Half")
    for name, reason in {
        "broken": f"broken: {module}:broken cannot be used: OSError: no such bus",
        "leaves": f"leaves: {module}:leaves cannot be used: SystemExit: 0",
        "missing": f"missing: {module}:nothing cannot be used: AttributeError: ",
        "half": f"half: {module}:Half has no read or close; wanted open(), read(timeout_s) and close()",
    }.items():
        with pytest.raises(ValueError, match=f"^{re.escape(reason)}"):
            make(name, log)


@pytest.mark.parametrize("error", ["OSError('no such bus')", "SystemExit(0)"])
def test_a_driver_that_does_not_open_is_refused_with_the_reason(plug: Plug, log: Log, error: str) -> None:
    plug(SNIFFER.replace("self.value = float(self.text)", f"raise {error}"), "sniffer=Sniffer")
    wanted = "sniffer: " + error.replace("(", ": ").replace("'", "").removesuffix(")")
    with pytest.raises(ValueError, match=f"^{re.escape(wanted)}$"):
        opened("sniffer", log)


def test_a_name_that_is_plugged_in_twice_is_refused(plug: Plug, log: Log, tmp_path: Path) -> None:
    module = plug(SNIFFER, "sniffer=Sniffer")
    other = tmp_path / "other-1.0.dist-info"
    other.mkdir()
    (other / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1.0\n")
    (other / "entry_points.txt").write_text(f"[plumeward.payloads]\nsniffer = {module}:Other\n")
    with pytest.raises(ValueError, match="sniffer is plugged in more than once, by "):
        make("sniffer", log)


class Wordless(Exception):
    """An error that fails to say what it is."""

    def __str__(self) -> str:
        raise RuntimeError("no words")


class Says:
    """A driver that says what it is told to, or raises it."""

    def __init__(self, *said: object) -> None:
        self.said = list(said)
        self.waited_s: list[float] = []

    def open(self) -> None: ...

    def close(self) -> None:
        raise OSError("does not close")

    def read(self, timeout_s: float) -> float:
        self.waited_s.append(timeout_s)
        value = self.said.pop(0)
        if isinstance(value, BaseException):
            raise value
        return value  # type: ignore[return-value]


def test_a_value_is_passed_on_without_a_wind(log: Log) -> None:
    driver = Says(0.5, 7)
    driven = Driven(driver, log)
    assert [driven(ASKED), driven(ASKED)] == [Sample(1000, 0.5, None), Sample(1000, 7.0, None)]
    assert driver.waited_s == [TIMEOUT_S, TIMEOUT_S]


def test_no_value_is_no_error(log: Log) -> None:
    assert math.isnan(Driven(Says(math.nan), log)(ASKED).gas)
    assert not log.tally.refused


@pytest.mark.parametrize(
    "said",
    [
        *(OSError("unplugged"), ValueError("?"), SystemExit(3), KeyboardInterrupt(), Wordless()),
        *(None, "much", math.inf, -math.inf, 1e39, [1.0]),
    ],
    ids=repr,
)
def test_whatever_else_a_driver_does_costs_the_value_and_is_counted(said: object, log: Log) -> None:
    driven = Driven(Says(said, 0.5), log)
    assert math.isnan(driven(ASKED).gas)
    assert log.tally.refused == {SENSOR_ERROR: 1}
    assert driven(ASKED).gas == 0.5


def test_an_error_while_it_closes_is_counted_and_ends_nothing_else(log: Log) -> None:
    Driven(Says(), log).close()
    assert log.tally.refused == {SENSOR_ERROR: 1}


def test_a_driver_that_hangs_while_it_closes_is_left(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("aircraft.payload.drivers.TIMEOUT_S", 0.01)
    began, let_go = threading.Event(), threading.Event()

    class Hangs(Says):
        def close(self) -> None:
            began.set()
            let_go.wait()

    Driven(Hangs(), log).close()
    assert began.is_set()
    let_go.set()


def test_the_same_error_is_told_once_and_counted_each_time(capsys: pytest.CaptureFixture[str]) -> None:
    log = Log("payload", "uav/1", Tally(), "info")
    driven = Driven(Says(*[OSError("unplugged")] * 3, ValueError("bad\nweather")), log)
    for _ in range(4):
        driven(ASKED)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert "OSError: unplugged" in lines[0]
    assert "ValueError: bad weather" in lines[1]
    assert log.tally.refused == {SENSOR_ERROR: 4}
