"""A sensor that writes numbers on a serial line, one a line."""

import math
import os
import re
import select
import time

from aircraft.bridge.address import Address
from aircraft.bridge.pipe import Retry
from aircraft.bridge.serial_line import open_device
from aircraft.payload.messages import LARGEST_FLOAT32
from link.bus.log import Log

NO_NUMBER = "not a number"  # what a payload counts in its health for each line that is none
NUMBER = re.compile(rb"nan|[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:e[+-]?[0-9]+)?", re.IGNORECASE)
END_OF_LINE = re.compile(rb"[\r\n]")
LONGEST = 100  # bytes of a line that are kept; a longer one is no number
LARGEST_READ = 4096
# Bytes that wait in the device without loss; beyond that the line that has begun may have a gap
MOST_WAITING = 1024
FLOOD = 1 << 18  # bytes after which what still waits counts as new: more than the system keeps for a device
LOOK_S = 0.1  # how often a lost device is looked for while a value is wanted


class NumberLines:
    """Cuts bytes into lines, holding at most one, and turns them into numbers.

    The first line may lack its beginning: it is left out.
    """

    def __init__(self, log: Log) -> None:
        """Take the log whose tally counts the lines that are no numbers."""
        self._log = log
        # The line that has begun; None if bytes of it may be missing: what comes up to its end is left out
        self.begun: bytes | None = None
        self._told = False

    def take(self, data: bytes) -> list[float]:
        """Return the numbers of the lines that are now complete.

        Blank lines say nothing; others are counted and told of once.
        """
        *lines, begun = END_OF_LINE.split((self.begun or b"") + data)
        if self.begun is None and not lines:
            return []
        lines = lines[self.begun is None :]
        self.begun = begun[: LONGEST + 1]
        return [value for line in lines if line.strip() and (value := self._number(line)) is not None]

    def _number(self, line: bytes) -> float | None:
        text = line.strip()
        if (
            len(line) <= LONGEST
            and NUMBER.fullmatch(text)
            and not abs(value := float(text)) > LARGEST_FLOAT32
        ):
            return value
        self._log.tally.refuse(NO_NUMBER)
        if not self._told:
            self._told = True
            self._log.warning(
                f"a line is not a number, {text[:LONGEST].decode(errors='replace')!r}: such lines are "
                "counted and left out"
            )
        return None


class SerialSensor:
    """The driver of a serial line of numbers. A device that is unplugged may come back."""

    def __init__(self, address: Address, log: Log) -> None:
        self._address = address
        self._lines = NumberLines(log)
        self._retry = Retry(address.text, "open", log)
        self._descriptor = -1

    def open(self) -> None:
        """Open the device; if it is not there, it is looked for when a value is wanted."""
        self._look()

    def read(self, timeout_s: float) -> float:
        """Return the first number whose line ends from now on; NaN if none does within timeout_s."""
        deadline = time.monotonic() + timeout_s
        self.forget()
        while (left_s := deadline - time.monotonic()) > 0.0:
            if self._descriptor < 0 and not self._look():
                time.sleep(min(LOOK_S, left_s))
            elif values := self._lines.take(self._receive(left_s)):
                return values[0]
        return math.nan

    def close(self) -> None:
        """Free the device."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def forget(self) -> None:
        """Leave out the numbers that came before they were asked for."""
        waited = 0
        while waited < FLOOD and self._descriptor >= 0 and (data := self._receive(0.0)):
            waited += len(data)
            self._lines.take(data)
            if waited > MOST_WAITING:
                self._lines.begun = None

    def _receive(self, timeout_s: float) -> bytes:
        """Return what comes within a time; empty if nothing does, or if the device is lost."""
        try:
            if select.select([self._descriptor], [], [], timeout_s)[0]:
                if data := os.read(self._descriptor, LARGEST_READ):
                    return data
                self._lose("the other side has closed it")
        except OSError as error:
            self._lose(str(error.strerror))
        return b""

    def _look(self) -> bool:
        """Open the device if it is time to; returns whether it is open."""
        now_s = time.monotonic()
        if not self._retry.due(now_s):
            return False
        try:
            self._descriptor = open_device(self._address)
        except OSError as error:
            self._lose(str(error.strerror))
            return False
        self._retry.succeeded(now_s)
        self._lines.begun = None
        return True

    def _lose(self, reason: str) -> None:
        self.close()
        self._retry.failed(reason)
