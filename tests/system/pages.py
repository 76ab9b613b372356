"""A browser's stand-in: connects to the page's WebSocket, acknowledges scenes and keeps what a page would
keep.
"""

import json
import socket
import struct
import time
from base64 import urlsafe_b64encode
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

from websockets.sync.client import ClientConnection, connect

from tests.system.conftest import Part


class Browser:
    """One page of a server at 127.0.0.1; `host` is what its Host header says instead."""

    def __init__(self, port: int, word: str = "", host: str = "", **how: Any) -> None:
        self.port = port
        offered = (
            ["plumeward", f"word.{urlsafe_b64encode(word.encode()).decode().rstrip('=')}"] if word else None
        )
        how = {"origin": f"http://127.0.0.1:{port}", "max_size": None, "subprotocols": offered, **how}
        self._open = ExitStack()
        plain = socket.create_connection(("127.0.0.1", port))
        self.socket: ClientConnection = self._open.enter_context(
            connect(f"ws://{host or f'127.0.0.1:{port}'}/scenes", sock=plain, **how)
        )
        self.hello: dict[str, Any] = {}
        self.vehicles: dict[str, dict[str, Any]] = {}
        self.notice = ""
        self.scenes: dict[str, dict[str, Any]] = {}
        """The newest header of each vehicle."""
        self.steps: dict[str, list[int]] = {}
        self.happened: dict[str, list[str]] = {}
        self.particles: dict[str, int] = {}
        self.answers: list[dict[str, Any]] = []
        self.bye = ""
        self.received = 0
        self.behind_ms: list[float] = []
        """From the publication of each scene to its arrival."""
        self._listed = False
        self.until(lambda: self._listed)

    def __enter__(self) -> "Browser":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._open.close()

    def say(self, **message: object) -> None:
        self.socket.send(json.dumps(message))

    def show(self, *names: str, truth: bool = False, at_s: float | None = None) -> None:
        self.say(show=names, truth=truth, at_s=at_s)

    def order(self, command: str, vehicle: str = "uav/1") -> dict[str, Any]:
        """Give a command; returns its answer."""
        before = len(self.answers)
        self.say(command=command, vehicle=vehicle)
        self.until(lambda: len(self.answers) > before)
        return self.answers[-1]

    def until(self, holds: Callable[[], object], timeout_s: float = 60.0) -> None:
        """Take messages until something holds."""
        deadline = time.monotonic() + timeout_s
        while not holds():
            assert time.monotonic() < deadline, (
                f"not within {timeout_s:g} s; the newest scenes are {self.scenes}"
            )
            try:
                self._take(self.socket.recv(0.5))
            except TimeoutError:
                continue

    def _take(self, message: str | bytes) -> None:
        if isinstance(message, bytes):
            return self._draw(message)
        said = json.loads(message)
        self.hello = said.get("hello", self.hello)
        self.bye = said.get("bye", self.bye)
        if "vehicles" in said:
            self.vehicles = {each["name"]: each for each in said["vehicles"]}
            self.notice, self._listed = said["notice"], True
        if "answer" in said:
            self.answers.append(said["answer"])

    def _draw(self, message: bytes) -> None:
        (length,) = struct.unpack_from("<I", message)
        scene = json.loads(message[4 : 4 + length])
        name = scene["vehicle"]
        for kept, new in (
            (self.steps, [row[0] for row in scene["measurements"]["rows"]]),
            (self.happened, [f"{row[2]}: {row[3]}" for row in scene["happenings"]["rows"]]),
        ):
            begin = scene["measurements" if kept is self.steps else "happenings"]["from"]
            kept[name] = [*kept.get(name, [])[:begin], *new]
        self.particles.update(
            (name, array["shape"][0]) for array in scene["arrays"] if array["name"] == "particles"
        )
        self.scenes[name] = scene
        self.received += 1
        if scene["published_ms"]:
            self.behind_ms.append(1000 * time.time() - scene["published_ms"])
        self.say(drawn=scene["number"])

    def verdicts(self, name: str = "uav/1") -> dict[str, str]:
        """The verdict on each service of a vehicle."""
        return {
            service["name"]: service["verdict"] for service in self.scenes.get(name, {}).get("services", [])
        }


def port_of(part: Part, wait_until: Callable[..., None]) -> int:
    """The port of a page that a process serves, once it does."""
    wait_until(lambda: any("page at" in line for line in part.out) or part.process.poll() is not None)
    return int(next(line for line in part.out if "page at" in line).rpartition(":")[2].split("/")[0])
