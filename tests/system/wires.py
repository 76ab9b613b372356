"""The other sides of a bridge for tests: UDP, TCP and serial peers, and the bus itself, that say frames
and keep those they hear.
"""

import contextlib
import os
import socket
import threading
import time
import tty
from collections.abc import Callable
from pathlib import Path

from pymavlink.dialects.v20 import common as mavlink

from link.bus.frames import Frame, FrameStream
from link.bus.keys import MAVLINK_IN, MAVLINK_OUT, Key
from link.bus.session import Bus


def free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Speaker:
    """Packs messages of one sender."""

    def __init__(self, system: int, component: int, version: int = 2) -> None:
        self._mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
        self._version = version

    def pack(self, message) -> bytes:
        frame = bytes(message.pack(self._mav, force_mavlink1=self._version == 1))
        self._mav.seq = (self._mav.seq + 1) % 256
        return frame

    def beat(self, autopilot: bool = False) -> bytes:
        kinds = (
            (mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4)
            if autopilot
            else (mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID)
        )
        return self.pack(mavlink.MAVLink_heartbeat_message(*kinds, 0, 0, 0, 3))

    def order(self, system: int, component: int = 1) -> bytes:
        return self.pack(
            mavlink.MAVLink_command_long_message(system, component, 512, 0, 148, 0, 0, 0, 0, 0, 0)
        )

    def answer(self, system: int, component: int) -> bytes:
        return self.pack(mavlink.MAVLink_command_ack_message(512, 0, 0, 0, system, component))


class Wire:
    """One peer; what it hears is kept. `with` closes it."""

    def __init__(self) -> None:
        self.heard: list[Frame] = []
        self._ended = False
        self._stream = FrameStream()
        self._thread = threading.Thread(target=self._listen, daemon=True)

    def has(self, *frames: bytes) -> bool:
        """Whether it has heard these frames, bit by bit, each once."""
        heard = [frame.data for frame in self.heard]
        return all(heard.count(frame) == 1 for frame in frames)

    def say(self, data: bytes) -> None:
        raise NotImplementedError

    def read(self) -> bytes:
        raise NotImplementedError

    def _listen(self) -> None:
        while not self._ended:
            try:
                data = self.read()
            except TimeoutError:
                continue
            except OSError:
                return
            self.heard += self._stream.take(data)

    def turn_deaf(self) -> None:
        """Read nothing from now on."""
        self._ended = True
        self._thread.join()

    def close(self) -> None:
        self._ended = True
        self._thread.join(5)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class UdpWire(Wire):
    """A UDP peer; with `calls` it calls that port, without it waits to be called."""

    def __init__(self, calls: int = 0) -> None:
        super().__init__()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(0.2)
        self._socket.bind(("127.0.0.1", 0))
        self.port = self._socket.getsockname()[1]
        self._to = ("127.0.0.1", calls) if calls else None

    def say(self, data: bytes) -> None:
        assert self._to
        self._socket.sendto(data, self._to)

    def read(self) -> bytes:
        data, self._to = self._socket.recvfrom(65536)
        return data

    def close(self) -> None:
        super().close()
        self._socket.close()


class TcpWire(Wire):
    """One side of a TCP connection."""

    def __init__(self, connection: socket.socket) -> None:
        super().__init__()
        self._connection = connection
        connection.settimeout(0.2)

    def say(self, data: bytes) -> None:
        self._connection.sendall(data)

    def read(self) -> bytes:
        if not (data := self._connection.recv(65536)):
            raise OSError
        return data

    def close(self) -> None:
        self._connection.close()
        super().close()


class SerialWire(Wire):
    """The far end of a serial line, a pseudo-terminal; `device` is a link to its near end, as
    /dev/serial/by-id has.
    """

    def __init__(self, device: Path) -> None:
        super().__init__()
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        device.unlink(missing_ok=True)
        device.symlink_to(os.ttyname(self._slave))
        os.set_blocking(self._master, False)

    def say(self, data: bytes) -> None:
        os.write(self._master, data)

    def read(self) -> bytes:
        with contextlib.suppress(BlockingIOError):
            return os.read(self._master, 65536)
        time.sleep(0.002)
        raise TimeoutError

    def close(self) -> None:
        """Unplug it."""
        super().close()
        os.close(self._slave)
        os.close(self._master)


class BusWire:
    """What is said on a bus, and a voice there."""

    def __init__(self, router: str, service: str = "other") -> None:
        self._bus = Bus(service, router, announced=False)
        self.out: list[Frame] = []
        self.into: list[Frame] = []
        for key, heard in ((MAVLINK_OUT, self.out), (MAVLINK_IN, self.into)):
            self._bus.on(key, self._keep(heard), own=False)

    def _keep(self, heard: list[Frame]) -> Callable:
        return lambda arrival: heard.extend(FrameStream().take(arrival.payload, datagram=True))

    def say(self, key: Key, data: bytes) -> None:
        self._bus.publish(key, data)

    def connected(self) -> bool:
        return self._bus.connected

    def settle(self) -> None:
        self._bus.settle(5.0)

    def __enter__(self) -> "BusWire":
        return self

    def __exit__(self, *_: object) -> None:
        self._bus.close()


def count(heard: list[Frame], frame: bytes) -> int:
    return sum(one.data == frame for one in heard)
