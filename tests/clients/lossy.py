"""A radio between a vehicle and its client that loses frames: 5% of each kind, in both directions, the
same ones in every run.

The idea is MAVSDK's (mission_transfer_lossy.cpp). There chance decides; here it is the seed and how many
frames of a kind have passed, so that neither the telemetry between them nor the load of the machine
changes which frames are lost.
"""

import hashlib
import select
import socket
import threading
from collections import Counter
from contextlib import suppress
from typing import Self

LOST = 0.05
SPARED = {0, 47}
"""Types that pass, as in MAVSDK's test: a lost HEARTBEAT only delays the connection, and neither MAVSDK
nor QGroundControl asks again for the MISSION_ACK that ends an upload."""


def kind_of(frame: bytes) -> int:
    """The type of the message in a datagram that holds one frame of MAVLink 2 or 1."""
    return int.from_bytes(frame[7:10], "little") if frame[0] == 0xFD else frame[5]


class LossyLink:
    """Relays datagrams between the port that a vehicle sends to and a client's port, both on this machine."""

    def __init__(self, client: int, seed: int, lost: float = LOST) -> None:
        self.lost: Counter[tuple[str, int]] = Counter()
        """Lost frames, by direction and type."""
        self._passed: Counter[tuple[str, int]] = Counter()
        self._seed, self._share = seed, lost
        self._air, self._ground = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        self._air.bind(("127.0.0.1", 0))
        self._ground.connect(("127.0.0.1", client))
        for each in (self._air, self._ground):
            each.setblocking(False)
        self.port = int(self._air.getsockname()[1])
        """Where the vehicle sends to."""
        self._vehicle: tuple[str, int] | None = None
        self._end, self._ended = socket.socketpair()
        self._thread = threading.Thread(target=self._relay)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.close()
        self._thread.join()
        for each in (self._air, self._ground, self._ended):
            each.close()

    def loses(self, direction: str, kind: int) -> bool:
        """Whether the next frame of this kind is lost."""
        if kind in SPARED:
            return False
        self._passed[direction, kind] += 1
        key = f"{self._seed} {direction} {kind} {self._passed[direction, kind]}"
        lost = int.from_bytes(hashlib.sha256(key.encode()).digest()[:4]) < self._share * 2**32
        self.lost[direction, kind] += lost
        return lost

    def _relay(self) -> None:
        while True:
            readable, _, _ = select.select([self._air, self._ground, self._ended], [], [])
            if self._ended in readable:
                return
            for source in readable:
                with suppress(OSError):  # the client is not there yet
                    datagram, sender = source.recvfrom(65535)
                    if source is self._air:
                        self._vehicle = sender
                    if self.loses("down" if source is self._air else "up", kind_of(datagram)):
                        continue
                    if source is self._air:
                        self._ground.send(datagram)
                    elif self._vehicle:
                        self._air.sendto(datagram, self._vehicle)
