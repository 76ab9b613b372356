"""Serial endpoints: a device that may be unplugged and come back."""

import fcntl
import io
import os
import termios

from aircraft.bridge.address import BAUDS, Address
from aircraft.bridge.pipe import Reopened

WAITING_S = 0.5  # frames that wait for a slow line are at most this old; the newest are sent
BITS_PER_BYTE = 10
LEAST_BYTES = 1024  # room for a few frames on the slowest line


class SerialLine(Reopened):
    """One link while the device is there."""

    def tick(self, now_s: float) -> None:
        """Open the device if it is time to."""
        if self._pipe is not None or not self._retry.due(now_s):
            return
        try:
            device = open_device(self.address)
        except OSError as error:
            self._fail(str(error.strerror))
        else:
            most_bytes = max(LEAST_BYTES, int(self.address.port / BITS_PER_BYTE * WAITING_S))
            self._begin(io.FileIO(device, "r+"), most_bytes, now_s)


def open_device(address: Address) -> int:
    """Open the device of a serial address; returns its descriptor, which does not block. Raises OSError.

    8 data bits, no parity, one stop bit, no flow control, no characters that the system changes or acts on.
    """
    speed = BAUDS[address.port]
    descriptor = os.open(address.host, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        characters = termios.tcgetattr(descriptor)[6]
        characters[termios.VMIN], characters[termios.VTIME] = 1, 0
        settings = [0, 0, termios.CS8 | termios.CREAD | termios.CLOCAL, 0, speed, speed, characters]
        fcntl.ioctl(descriptor, termios.TIOCEXCL)  # nobody else may read half of the frames
        termios.tcsetattr(descriptor, termios.TCSANOW, settings)
        termios.tcflush(descriptor, termios.TCIOFLUSH)
    except (OSError, termios.error) as error:  # termios.error is no OSError, though it holds the same
        os.close(descriptor)
        raise OSError(*error.args) from None
    return descriptor
