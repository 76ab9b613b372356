"""Serial endpoints: a device that may be unplugged and come back."""

import contextlib
import fcntl
import os
import termios

from aircraft.bridge.address import BAUDS, Address
from aircraft.bridge.links import Hub, Reopened

WAITING_S = 0.5
"""Frames that wait for a slow line are at most this old; the newest are sent."""
BITS_PER_BYTE = 10
LEAST_BYTES = 1024
"""Room for a few frames on the slowest line."""


class SerialLine(Reopened):
    """One link while the device is there."""

    def __init__(self, address: Address, hub: Hub) -> None:
        """Start without the device."""
        super().__init__(address, hub, "open")
        self._descriptor = -1

    def tick(self, now_s: float) -> None:
        """Open the device if it is time to."""
        if self._pipe is not None or not self._retry.due(now_s):
            return
        try:
            self._descriptor = open_device(self.address)
        except OSError as error:
            self._fail(str(error.strerror))
        else:
            most_bytes = max(LEAST_BYTES, int(self.address.port / BITS_PER_BYTE * WAITING_S))
            self._begin(self._descriptor, most_bytes, now_s)

    def close(self) -> None:
        """Free the device."""
        super().close()
        if self._descriptor >= 0:
            with contextlib.suppress(OSError):
                os.close(self._descriptor)
            self._descriptor = -1


def open_device(address: Address) -> int:
    """Open the device of a serial address; returns its descriptor, which does not block. Raises OSError."""
    descriptor = os.open(address.host, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        _make_raw(descriptor, BAUDS[address.port])
    except (OSError, termios.error) as error:  # termios.error is no OSError, though it holds the same
        os.close(descriptor)
        raise OSError(*error.args) from None
    return descriptor


def _make_raw(descriptor: int, speed: int) -> None:
    """8 data bits, no parity, one stop bit, no flow control, no characters that the system changes or acts
    on.
    """
    settings = termios.tcgetattr(descriptor)
    characters = settings[6]
    characters[termios.VMIN], characters[termios.VTIME] = 1, 0
    settings = [0, 0, termios.CS8 | termios.CREAD | termios.CLOCAL, 0, speed, speed, characters]
    fcntl.ioctl(descriptor, termios.TIOCEXCL)  # nobody else may read half of the frames
    termios.tcsetattr(descriptor, termios.TCSANOW, settings)
    termios.tcflush(descriptor, termios.TCIOFLUSH)
