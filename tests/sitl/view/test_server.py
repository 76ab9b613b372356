"""Protects the bus and the other pages from one page that gives commands without end."""

import asyncio
import json
from types import SimpleNamespace
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from link.bus.mavlink import Codec
from scene.follow.history import History
from scene.scene import Backdrop
from sitl.autopilot.operator import OPERATOR
from sitl.view.guard import AccessRules
from sitl.view.live import LiveVehicle
from sitl.view.server import Client, PageServer


class Obeying(LiveVehicle):
    """A vehicle that accepts every command at once."""

    def __init__(self) -> None:
        self.name, self.here, self.system, self.listeners = "uav/1", True, 1, set()
        self.history = History(Backdrop("uav/1"))
        self.commanded = 0

    def send(self, payload: bytes) -> None:
        self.commanded += 1
        for message in mavlink.MAVLink(None).parse_buffer(payload):
            ack = mavlink.MAVLink_command_ack_message(message.command, 0, target_system=OPERATOR[0], target_component=OPERATOR[1])
            for listener in tuple(self.listeners):
                listener(Codec(1, 1).pack(ack))


class Socket:
    """A page's end of a WebSocket: says what it is given to say and keeps what it hears."""

    def __init__(self, reads: bool = True) -> None:
        self.said = asyncio.Queue[str]()
        self.heard: list[dict[str, Any]] = []
        self.closed = ""
        self._reads = reads

    async def receive(self) -> dict[str, Any]:
        return {"type": "websocket.receive", "text": await self.said.get()}

    async def send_text(self, text: str) -> None:
        if not self._reads:
            await asyncio.Event().wait()
        self.heard.append(json.loads(text))

    async def close(self, _: int, reason: str) -> None:
        self.closed = reason

    async def order(self, count: int, name: str = "pause") -> list[dict[str, Any]]:
        """Give a command so many times at once; returns the answers."""
        wanted = len(self.answers) + count
        for _ in range(count):
            self.said.put_nowait(json.dumps({"command": name, "vehicle": "uav/1"}))
        while len(self.answers) < wanted:
            await asyncio.sleep(0.001)
        return self.answers[wanted - count :]

    @property
    def answers(self) -> list[dict[str, Any]]:
        return [message["answer"] for message in self.heard if "answer" in message]


def pages(*sockets: Socket) -> tuple[Obeying, list[asyncio.Task[None]]]:
    """Serve a vehicle to pages."""
    vehicle = Obeying()
    shown = SimpleNamespace(vehicles={"uav/1": vehicle}, list_version=0, notice="", entries=lambda: [])
    server = PageServer(shown, AccessRules("127.0.0.1", 8447))
    return vehicle, [asyncio.create_task(Client(socket, server, shown, "").run()) for socket in sockets]  # type: ignore[arg-type]


def test_a_page_that_commands_without_end_is_refused_and_told_so_and_another_page_still_commands(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = [100.0]
    monkeypatch.setattr("sitl.view.server.time", SimpleNamespace(monotonic=lambda: now_s[0]))

    async def flood() -> None:
        one, other = Socket(), Socket()
        vehicle, tasks = pages(one, other)
        for _ in range(5):
            assert [answer["accepted"] for answer in await one.order(1)] == [True]
        flooded = await one.order(1000)
        assert {(answer["accepted"], answer["reason"]) for answer in flooded} == {(False, "more than 5 commands within 1 s: wait a moment")}
        assert vehicle.commanded == 5
        assert (await other.order(1, "abort"))[0]["accepted"]
        now_s[0] += 1.0
        assert (await one.order(1))[0]["accepted"]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    asyncio.run(flood())


def test_a_page_that_does_not_read_the_answers_to_its_commands_is_closed() -> None:
    async def flood() -> None:
        deaf = Socket(reads=False)
        _, (served,) = pages(deaf)
        for _ in range(1000):
            deaf.said.put_nowait('{"command":"pause","vehicle":"uav/1"}')
        await asyncio.wait_for(served, 4.0)
        assert deaf.closed == "commands come faster than their answers are read"
        assert deaf.said.qsize() > 850

    asyncio.run(flood())
