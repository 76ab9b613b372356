"""Drivers of real gas sensors: what one has to do, those that ship, and what other packages plug in."""

import math
import threading
from collections.abc import Callable
from importlib.metadata import entry_points
from typing import Protocol

from aircraft.bridge.address import parse_address
from aircraft.payload.messages import LARGEST_FLOAT32, Question, Sample
from aircraft.payload.options import PLUGINS, SERIAL
from aircraft.payload.serial_sensor import SerialSensor
from link import cli
from link.bus.log import Log

# Real time that a sensor may take for a value; after that it has none (NaN), and the vehicle asks again
TIMEOUT_S = 5.0
SENSOR_ERROR = "sensor error"  # what a payload counts in its health when a driver fails
Measure = Callable[[Question], Sample]  # measures once; may take TIMEOUT_S


class Driver(Protocol):
    """A gas sensor.

    It is made with the text behind the colon in `--payload NAME:TEXT`, empty if there is none.

    All methods are called in one thread, except `close`. What they raise is counted and logged, and costs
    no more than the value.
    """

    def open(self) -> None:
        """Begin; called once.

        What this raises ends the payload with status 2: raise only what waiting cannot mend.
        """

    def read(self, timeout_s: float) -> float:
        """Return the first value that the sensor gives from now on, in its unit.

        NaN if it gives none within timeout_s.
        """

    def close(self) -> None:
        """End; called once, perhaps while `read` waits. It may take TIMEOUT_S."""


def make(text: str, log: Log) -> Driver:
    """Return the driver that a text names.

    Raises ValueError, with what is wrong, if a plug-in cannot be used.
    """
    name, _, rest = text.partition(":")
    if name == SERIAL:
        return SerialSensor(parse_address(text), log)
    plugins = tuple(entry_points(group=PLUGINS, name=name))
    if len(plugins) > 1:
        raise ValueError(
            f"{name} is plugged in more than once, by {' and '.join(each.value for each in plugins)}; wanted "
            "one"
        )
    try:
        driver: Driver = plugins[0].load()(rest)
    except (Exception, SystemExit) as error:  # it may be anybody's code
        raise ValueError(f"{text}: {plugins[0].value} cannot be used: {said(error)}") from error
    if missing := [
        method for method in ("open", "read", "close") if not callable(getattr(driver, method, None))
    ]:
        raise ValueError(
            f"{text}: {plugins[0].value} has no {cli.listing(missing)}; wanted open(), read(timeout_s) and "
            "close()"
        )
    return driver


def opened(text: str, log: Log) -> Driver:
    """Return the driver that a text names, open. Raises ValueError, with what is wrong."""
    driver = make(text, log)
    try:
        driver.open()
    except (Exception, SystemExit) as error:  # it may be anybody's code
        raise ValueError(f"{text}: {said(error)}") from error
    return driver


def said(error: BaseException) -> str:
    """Return an exception in one short line."""
    try:
        text = " ".join(str(error).split())
    except Exception:  # its words are anybody's code, too
        text = ""
    return f"{type(error).__name__}: {text[:200]}".removesuffix(": ")


class Driven:
    """Measures with a driver. Whatever it does, the answer is a value that the wire carries, or NaN."""

    def __init__(self, driver: Driver, log: Log) -> None:
        """Take an open driver, and the log whose tally counts what goes wrong."""
        self._driver = driver
        self._log = log
        self._told = ""

    def __call__(self, question: Question) -> Sample:
        """Measure once; a driver does not know the wind."""
        return Sample(question.time_boot_ms, self._value(), None)

    def close(self) -> None:
        """End the driver; one that hangs is left."""
        closing = threading.Thread(target=self._close, name="closing", daemon=True)
        closing.start()
        closing.join(TIMEOUT_S)

    def _close(self) -> None:
        try:
            self._driver.close()
        except BaseException as error:  # it may be anybody's code, and no signal is raised in this thread
            self._without_value(said(error))

    def _value(self) -> float:
        try:
            value = float(self._driver.read(TIMEOUT_S))
        except BaseException as error:  # it may be anybody's code, and no signal is raised in this thread
            return self._without_value(said(error))
        return (
            self._without_value(f"{value} is no value; wanted a finite number, or NaN for none")
            if abs(value) > LARGEST_FLOAT32
            else value
        )

    def _without_value(self, reason: str) -> float:
        self._log.tally.refuse(SENSOR_ERROR)
        if reason != self._told:
            self._told = reason
            self._log.warning(f"the sensor's driver: {reason}")
        return math.nan
