"""Protects an operator in a hurry, and the bus and the other pages from one page that gives commands
without end.
"""

import asyncio
import json
import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from aircraft.operator import OPERATOR_IDS
from ground.view.access import AccessRules
from ground.view.control import CommandAnswer, operate
from ground.view.live import LiveVehicle
from ground.view.server import Client, PageServer
from link.bus.mavlink import Codec
from link.modes import Mode
from scene.follow.history import History
from scene.scene import Backdrop, Scene


class Obeying(LiveVehicle):
    """A vehicle that does what it is told at once, unless it is deaf."""

    system = 1

    def __init__(self) -> None:
        self.name, self.here, self.listeners = "uav/1", True, set()
        self.history = History(Backdrop("uav/1"))
        self.heard: list[str] = []
        """The mode that each copy of a command asks for."""
        self.deaf = False

    def send(self, payload: bytes) -> None:
        for message in mavlink.MAVLink(None).parse_buffer(payload):
            mode = ASKED.get(message.command) or Mode((int(message.param2), int(message.param3)))
            self.heard.append(mode.name)
            ack = mavlink.MAVLink_command_ack_message(
                message.command, 0, target_system=OPERATOR_IDS[0], target_component=OPERATOR_IDS[1]
            )
            shown = mavlink.MAVLink_heartbeat_message(2, 12, 128, mode.custom_mode, 4, 3)
            for listener in () if self.deaf else tuple(self.listeners):
                listener(Codec(1, 1).pack(ack, shown))


ASKED = {mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH: Mode.RETURN, mavlink.MAV_CMD_NAV_LAND: Mode.LAND}


class Socket:
    """A page's end of a WebSocket: says what it is given to say and keeps what it hears."""

    def __init__(self, reads: bool = True) -> None:
        self.said = asyncio.Queue[str]()
        self.heard: list[dict[str, Any]] = []
        self.scenes = 0
        self.closed = ""
        self._reads = reads

    async def receive(self) -> dict[str, Any]:
        return {"type": "websocket.receive", "text": await self.said.get()}

    async def send_bytes(self, _: bytes) -> None:
        self.scenes += 1

    async def send_text(self, text: str) -> None:
        if not self._reads:
            await asyncio.Event().wait()
        self.heard.append(json.loads(text))

    async def close(self, _: int, reason: str) -> None:
        self.closed = reason

    async def order(self, count: int, name: str = "hold") -> list[dict[str, Any]]:
        """Give a command so many times at once; returns the answers."""
        wanted = len(self.answers) + count
        for _ in range(count):
            self.asks(name)
        while len(self.answers) < wanted:
            await asyncio.sleep(0.001)
        return self.answers[wanted - count :]

    def asks(self, name: str) -> None:
        """Give a command."""
        self.said.put_nowait(json.dumps({"command": name, "vehicle": "uav/1"}))

    @property
    def answers(self) -> list[dict[str, Any]]:
        return [message["answer"] for message in self.heard if "answer" in message]


def pages(*sockets: Socket) -> tuple[Obeying, list[asyncio.Task[None]]]:
    """Serve a vehicle to pages."""
    vehicle = Obeying()
    shown = SimpleNamespace(vehicles={"uav/1": vehicle}, list_version=0, notice="")
    server = PageServer(shown, AccessRules("127.0.0.1", 8447))
    return vehicle, [asyncio.create_task(Client(socket, server, shown, "").run()) for socket in sockets]  # type: ignore[arg-type]


def test_a_page_that_commands_without_end_is_refused_and_told_so_and_another_page_still_commands(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now_s = [100.0]
    monkeypatch.setattr("ground.view.server.time", SimpleNamespace(monotonic=lambda: now_s[0]))

    async def flood() -> None:
        one, other = Socket(), Socket()
        vehicle, tasks = pages(one, other)
        for _ in range(5):
            assert [answer["accepted"] for answer in await one.order(1)] == [True]
        flooded = await one.order(1000)
        assert {(answer["accepted"], answer["reason"]) for answer in flooded} == {
            (False, "more than 5 commands within 1 s: wait a moment")
        }
        assert vehicle.heard == ["HOLD"] * 5
        assert (await other.order(1))[0]["accepted"]
        assert [answer["accepted"] for answer in await one.order(6, "land")] == [True] * 6
        assert vehicle.heard[6:] == ["LAND"] * len(vehicle.heard[6:])
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
            deaf.said.put_nowait('{"command":"hold","vehicle":"uav/1"}')
        await asyncio.wait_for(served, 4.0)
        assert deaf.closed == "commands come faster than their answers are read"
        assert deaf.said.qsize() > 850

    asyncio.run(flood())


async def until(holds: Callable[[], object]) -> None:
    """Let the server work until something holds."""
    async with asyncio.timeout(60):
        while not holds():
            await asyncio.sleep(0.001)


def test_land_goes_out_while_a_hold_is_unanswered_which_is_then_not_sent_again_and_nothing_replaces_it() -> (
    None
):
    async def hurry() -> None:
        one, other = Socket(), Socket()
        vehicle, tasks = pages(one, other)
        vehicle.deaf = True
        one.asks("hold")
        await until(lambda: vehicle.heard == ["HOLD"])
        other.asks("land")
        await until(lambda: vehicle.heard[-1] == "LAND")
        one.asks("resume")
        await until(lambda: len(one.answers) == 2)
        await until(lambda: vehicle.heard.count("LAND") == 3)
        vehicle.deaf = False
        await until(lambda: other.answers)
        assert vehicle.heard[vehicle.heard.index("LAND") :] == ["LAND"] * vehicle.heard.count("LAND")
        assert [
            (answer["command"], answer["accepted"], answer["reason"])
            for answer in (*one.answers, *other.answers)
        ] == [
            ("hold", False, "an urgent command took its place"),
            ("resume", False, "the vehicle has not answered the last command yet"),
            ("land", True, ""),
        ]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    asyncio.run(hurry())


def test_a_command_that_is_cancelled_is_not_sent_later() -> None:
    async def cancel() -> None:
        vehicle = Obeying()
        vehicle.deaf = True
        command = asyncio.create_task(operate(vehicle, "resume"))
        await until(lambda: len(vehicle.heard) == 2)
        command.cancel()
        await asyncio.gather(command, return_exceptions=True)
        land = asyncio.create_task(operate(vehicle, "land"))
        await until(lambda: len(vehicle.heard) == 5)  # more than the time between two copies has passed
        vehicle.deaf = False
        assert await land == CommandAnswer(True)
        assert vehicle.heard == ["OFFBOARD"] * 2 + ["LAND"] * (len(vehicle.heard) - 2)
        assert not vehicle.listeners

    asyncio.run(cancel())


def test_a_command_waits_until_the_vehicle_has_said_which_system_it_is() -> None:
    async def hurry() -> None:
        vehicle = Obeying()
        vehicle.system = 0
        land = asyncio.create_task(operate(vehicle, "land"))
        await asyncio.wait([land], timeout=0.1)
        assert vehicle.heard == []
        vehicle.system = 1
        assert await land == CommandAnswer(True)

    asyncio.run(hurry())


def test_a_scene_is_built_once_for_all_pages_and_not_in_the_loop_that_serves_them(
    router: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    build, built_in = History.at, list[threading.Thread]()

    def at(history: History, **when: float) -> Scene:
        built_in.append(threading.current_thread())
        return build(history, **when)

    monkeypatch.setattr(History, "at", at)

    async def watch() -> None:
        sockets = [Socket() for _ in range(5)]
        vehicle = LiveVehicle("uav/1", router, {})
        shown = SimpleNamespace(vehicles={"uav/1": vehicle}, list_version=0, notice="")
        server = PageServer(shown, AccessRules("127.0.0.1", 8447))
        tasks = [asyncio.create_task(Client(socket, server, shown, "").run()) for socket in sockets]  # type: ignore[arg-type]
        for socket in sockets:
            socket.said.put_nowait('{"show":["uav/1"]}')
        await until(lambda: all(socket.scenes for socket in sockets))
        assert len(built_in) == 1
        vehicle.lives("agent", True)  # a new version
        server.news()
        for socket in sockets:
            socket.said.put_nowait('{"drawn":99}')
        await until(lambda: all(socket.scenes == 2 for socket in sockets))
        assert len(built_in) == 2
        assert threading.current_thread() not in built_in
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        vehicle.close()

    asyncio.run(watch())
