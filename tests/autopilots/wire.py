"""A double's link: frames in, frames out, and what the link loses. `Double` serves it over TCP or UDP in a
thread.
"""

import contextlib
import random
import select
import socket
import threading
import time
from types import TracebackType

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.autopilots.arducopter import ArduCopter
from tests.autopilots.autopilot import Autopilot
from tests.autopilots.body import DT_S
from tests.autopilots.own import Own
from tests.autopilots.px4 import Px4
from tests.autopilots.settings import Settings

KINDS: dict[str, type[Autopilot] | type[Own]] = {"ardupilot": ArduCopter, "px4": Px4, "plumeward": Own}
DATAGRAM_BYTES = 1200
MOST_STEPS = 50
"""At most this many time steps (1 s) between two looks at the socket."""


class Wire:
    """A double with MAVLink 2 frames as bytes. The same bytes at the same simulation times give the same
    bytes.
    """

    def __init__(self, kind: str, settings: Settings) -> None:
        self.autopilot = KINDS[kind](settings)
        self._mav = mavlink.MAVLink(
            None, srcSystem=self.autopilot.system, srcComponent=mavlink.MAV_COMP_ID_AUTOPILOT1
        )
        self._parser = mavlink.MAVLink(None)
        self._parser.robust_parsing = True
        self.said: list[bytes] = []
        """All frames that have come out of the link."""
        self._luck_in, self._luck_out = (random.Random(f"{settings.seed} {way}") for way in ("in", "out"))

    def hear(self, data: bytes) -> None:
        """Take bytes; frames that the link loses are never heard."""
        for message in self._parser.parse_buffer(data) or ():
            if not self._lost(self._luck_in, "silence", "deaf") and message.get_type() != "BAD_DATA":
                self.autopilot.hear(message)

    def advance(self, steps: int = 1) -> list[bytes]:
        """Time steps; return the frames that come out of the link."""
        frames = []
        for _ in range(steps):
            self.autopilot.step()
            said, self.autopilot.out = self.autopilot.out, []
            for message in said:
                frame = bytes(message.pack(self._mav))
                self._mav.seq = (self._mav.seq + 1) % 256
                if not self._lost(self._luck_out, "silence", "mute"):
                    frames.append(frame)
        self.said += frames
        return frames

    def _lost(self, luck: random.Random, *silences: str) -> bool:
        faults = self.autopilot.faults
        return luck.random() < faults.drop_share() or faults.on(*silences)


class Double:
    """A double on a socket, in a thread; use it in a `with`.

    `listen` is `tcp:HOST:PORT` (it waits for one client at a time; port 0 takes a free one),
    `udpin:HOST:PORT` (it answers whoever spoke last), `udp:HOST:PORT` (it sends there at once), or `udp`,
    PX4's own: from port 14580 + instance to 14540 + instance.
    """

    def __init__(
        self,
        kind: str,
        listen: str = "tcp:127.0.0.1:0",
        settings: Settings | None = None,
        speedup: float = 1.0,
    ) -> None:
        settings = settings or Settings()
        self.wire, self.speedup = Wire(kind, settings), speedup
        own = 0
        if listen == "udp":
            listen, own = f"udp:127.0.0.1:{14540 + settings.instance}", 14580 + settings.instance
        try:
            self._way, host, port = listen.split(":")
            address = (host, int(port))
        except ValueError:
            raise ValueError(
                f"listen {listen!r}: must be tcp:HOST:PORT, udpin:HOST:PORT, udp:HOST:PORT or udp"
            ) from None
        if self._way not in ("tcp", "udpin", "udp") or speedup <= 0.0:
            raise ValueError(
                f"listen {listen!r}, speedup {speedup:g}: must be tcp, udpin or udp, and above 0"
            )
        self._socket = socket.socket(type=socket.SOCK_STREAM if self._way == "tcp" else socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._socket.bind((host, own) if self._way == "udp" else address)
        self._peer: tuple[str, int] | None = address if self._way == "udp" else None
        self._client: socket.socket | None = None
        if self._way == "tcp":
            self._socket.listen()
        host, port = self._socket.getsockname()
        self.url = {
            "tcp": f"tcp:{host}:{port}",
            "udpin": f"udpout:{host}:{port}",
            "udp": f"udpin:{':'.join(map(str, address))}",
        }[self._way]
        """What a client connects to, as pymavlink writes it."""
        self._stop, self._asked_to_hang_up = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"{kind} double", daemon=True)

    def __enter__(self) -> "Double":
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join(10.0)
        for one in (self._client, self._socket):
            if one is not None:
                one.close()

    def hang_up(self) -> None:
        """Close the connection with its client, soon: the thread does it, which may be about to read."""
        self._asked_to_hang_up.set()

    def wait(self) -> None:
        """Until the thread ends, which it does only by an error or at the end of the `with`."""
        self._thread.join()

    def _run(self) -> None:
        began, done = time.monotonic(), 0
        while not self._stop.is_set():
            if self._asked_to_hang_up.is_set():
                self._asked_to_hang_up.clear()
                self._hang_up()
            self._listen(max(0.002, DT_S / self.speedup / 2.0))
            due = int((time.monotonic() - began) * self.speedup / DT_S) - done
            if due > MOST_STEPS:  # the machine is too slow: simulation time falls behind
                began += (due - MOST_STEPS) * DT_S / self.speedup
                due = MOST_STEPS
            if due > 0:
                done += due
                self._send(self.wire.advance(due))

    def _listen(self, wait_s: float) -> None:
        watched = [one for one in (self._socket, self._client) if one is not None]
        for ready in select.select(watched, [], [], wait_s)[0]:
            if ready is self._socket and self._way == "tcp":
                self._hang_up()
                self._client = self._socket.accept()[0]
                self._client.settimeout(1.0)  # a client that does not read is hung up on
                self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            elif ready is self._socket:
                with contextlib.suppress(ConnectionError):  # an earlier datagram found nobody
                    data, self._peer = self._socket.recvfrom(65536)
                    self.wire.hear(data)
            elif ready is self._client:
                try:
                    data = ready.recv(65536)
                except ConnectionError:
                    data = b""
                if data:
                    self.wire.hear(data)
                else:
                    self._hang_up()

    def _hang_up(self) -> None:
        if self._client is not None:
            self._client.close()
        self._client = None

    def _send(self, frames: list[bytes]) -> None:
        if self._way == "tcp":
            if self._client is not None and frames:
                try:
                    self._client.sendall(b"".join(frames))
                except OSError:
                    self._hang_up()
            return
        packet = b""
        for frame in [*frames, b""]:
            if packet and (not frame or len(packet) + len(frame) > DATAGRAM_BYTES):
                if self._peer is not None:
                    with contextlib.suppress(OSError):
                        self._socket.sendto(packet, self._peer)
                packet = b""
            packet += frame
