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
from aircraft.bridge.links import Hub
from aircraft.bridge.pipe import Reopened
from aircraft.keeper import keeper
from link.bus.mavlink import Message

MOST_BYTES = 65536  # that wait for a keeper that does not read
SILENT_S = 5.0  # a keeper tells each second how it does. It is replaced once it is silent for this long.
START_S = 60.0  # longest time in which a keeper starts, on a busy machine
# How long a keeper may take to end after the uav; one that sends the vehicle home takes longer, and is left.
END_S = 1.0


class Kept(Reopened):
    """One link, to the keeper, a process in a session of its own: no signal for the uav or its group
    reaches it. One that dies is replaced.
    """

    there = "kept"

    def __init__(self, address: Address, hub: Hub) -> None:
        super().__init__(address, hub)
        # Why the keeper has sent the vehicle home, once it has: nothing of ours goes out any more.
        self.sent_home = ""
        self._process: subprocess.Popen[bytes] | None = None
        self._said = ""
        self._said_s = self._looked_s = math.inf

    def hear(self, said: Message) -> None:
        """Take the keeper's own word, a STATUSTEXT."""
        self._said_s = self._looked_s
        if said.severity <= mavlink.MAV_SEVERITY_CRITICAL:
            self.sent_home = f"The keeper has taken the vehicle over: {said.text}"
        else:
            self._said = said.text

    def open(self) -> None:
        """Start the keeper; raises ValueError if it cannot use the URL on this machine."""
        stdout = self._start(subprocess.PIPE, -math.inf).stdout
        assert stdout
        with stdout:
            line = stdout.readline() if select.select([stdout], [], [], START_S)[0] else b""
        if line != b"\n":
            raise ValueError(line.decode().strip() or f"{self.address.text}: its keeper does not start")

    def tick(self, now_s: float) -> None:
        """Start a new keeper if the last has died or hangs."""
        if now_s - self._looked_s > keeper.HELD_UP_S:
            # we ourselves were held up: what it has said meanwhile is not read yet
            self._said_s += now_s - self._looked_s
        self._looked_s = now_s
        if self._process and self._pipe and now_s - self._said_s > SILENT_S:
            self._hub.log.warning(f"{self.address.text}: its keeper hangs and is killed")
            self._said_s = math.inf
            self._process.kill()  # which closes the link
        if self._pipe is None and self._retry.due(now_s):
            self._start(subprocess.DEVNULL, now_s)

    def _start(self, stdout: int, now_s: float) -> "subprocess.Popen[bytes]":
        ours, its = socket.socketpair()
        with its:
            self._process = subprocess.Popen(
                [sys.executable, "-m", keeper.__name__, self.address.text, self._hub.log.least],
                stdin=its.fileno(),
                stdout=stdout,
                start_new_session=True,
                env={
                    **os.environ,
                    "PYTHONSAFEPATH": "1",
                    "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
                },
            )
        ours.setblocking(False)
        self._said_s = math.inf
        self._begin(ours, MOST_BYTES, now_s)
        return self._process

    def _fail(self, reason: str) -> None:
        super()._fail("its keeper has ended")

    @property
    def state(self) -> str:
        """How the keeper's own endpoint does."""
        return self._said

    def close(self) -> None:
        """Let go of the keeper."""
        super().close()
        if self._process:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(END_S)
