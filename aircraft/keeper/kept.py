"""The uav's side of its keeper: an endpoint behind which the keeper has the link to the autopilot."""

import contextlib
import math
import os
import select
import socket
import subprocess
import sys

from pymavlink.dialects.v20 import all as mavlink

from aircraft.bridge.address import Address
from aircraft.bridge.links import Channel, Hub, Reopened
from aircraft.keeper import keeper
from link.bus.frames import Frame

MOST_BYTES = 65536
"""Most bytes that wait for a keeper that does not read."""
SILENT_S = 5.0
"""A keeper, which says each second how it does, is replaced once it is silent for so long."""
START_S = 60.0
"""Longest time in which a keeper starts, on a busy machine."""
END_S = 1.0
"""How long a keeper may take to end after the uav; one that sends the vehicle home takes longer, and is
left.
"""


class Kept(Reopened):
    """One link, to the keeper, a process in a session of its own: no signal for the uav or its group
    reaches it. One that dies is replaced.

    It stands between its hub and the link, and keeps the keeper's own words for itself.
    """

    def __init__(self, address: Address, hub: Hub) -> None:
        """Start without a keeper."""
        self.selector, self.log = hub.selector, hub.log
        super().__init__(address, self, "kept")
        self._outer = hub
        self._process: subprocess.Popen[bytes] | None = None
        self._socket: socket.socket | None = None
        self._said = ""
        self._said_s = self._looked_s = math.inf
        self.sent_home = ""
        """Why the keeper has sent the vehicle home, once it has: nothing of ours goes out any more."""

    # ---- between the hub and the link ----

    def join(self, link: Channel) -> None:
        """The keeper is there."""
        self._outer.join(link)

    def leave(self, link: Channel) -> None:
        """It has gone."""
        self._outer.leave(link)

    def route(self, link: Channel, frames: list[Frame]) -> None:
        """Pass frames on, and take the keeper's own words."""
        for frame in frames:
            if frame.system == keeper.OWN:
                message = mavlink.MAVLink(None).decode(bytearray(frame.data))
                self._said_s = self._looked_s
                if message.severity <= mavlink.MAV_SEVERITY_CRITICAL:
                    self.sent_home = f"The keeper has taken the vehicle over: {message.text}"
                else:
                    self._said = message.text
        self._outer.route(link, [frame for frame in frames if frame.system != keeper.OWN])

    # ---- as an endpoint ----

    def open(self) -> None:
        """Start the keeper; raises ValueError if it cannot use the URL on this machine."""
        stdout = self._start(subprocess.PIPE, -math.inf).stdout
        assert stdout
        with stdout:
            line = stdout.readline() if select.select([stdout], [], [], START_S)[0] else b""
        if line != b"\n":
            self.close()
            raise ValueError(line.decode().strip() or f"{self.address.text}: its keeper does not start")

    def tick(self, now_s: float) -> None:
        """Start a new keeper if the last has died or hangs."""
        if (
            now_s - self._looked_s > keeper.HELD_UP_S
        ):  # we ourselves were: what it has said meanwhile is not read yet
            self._said_s += now_s - self._looked_s
        self._looked_s = now_s
        if self._process and self._pipe and now_s - self._said_s > SILENT_S:
            self.log.warning(f"{self.address.text}: its keeper hangs and is killed")
            self._said_s = math.inf
            self._process.kill()  # which closes the link
        if self._pipe is None and self._retry.due(now_s):
            self._start(subprocess.DEVNULL, now_s)

    def _start(self, stdout: int, now_s: float) -> "subprocess.Popen[bytes]":
        ours, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", keeper.__name__, self.address.text, self.log.least],
                stdin=theirs.fileno(),
                stdout=stdout,
                start_new_session=True,
                env={
                    **os.environ,
                    "PYTHONSAFEPATH": "1",
                    "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
                },
            )
        ours.setblocking(False)
        self._socket, self._said_s = ours, math.inf
        self._begin(ours.fileno(), MOST_BYTES, now_s)
        return self._process

    def _fail(self, reason: str) -> None:
        super()._fail("its keeper has ended")

    def state(self) -> str:
        """How the keeper's own endpoint does."""
        return self._said

    def close(self) -> None:
        """Let go of the keeper."""
        super().close()
        if self._socket:
            self._socket.close()
            self._socket = None
        if self._process:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(END_S)
