"""What watches the bus, and what watches the watchers: recorder, status and page, and the requests of
browsers.
"""

import asyncio
import contextlib
import itertools
import json
import shutil
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
from starlette.types import ASGIApp

from ground.desk.scenes import RecordedScene
from ground.desk.status import Board
from ground.view.access import AccessRules
from ground.view.foxglove import ViewerRequest
from ground.view.records import RecordedVehicle
from ground.view.server import PageServer, message_of
from ground.view.serving import UNREADABLE
from link.bus.messages import Health
from link.record.reader import read
from link.record.record import Entry, SimulationClock
from link.record.writer import Writer
from scene.follow.history import History
from scene.scene import Backdrop
from tests.fuzz.files import FOLDER, record_seeds, shows
from tests.fuzz.mutants import as_sent
from tests.fuzz.services import BETWEEN, health, recorded

KEYS = ("mavlink/out", "mavlink/in", "waypoint", "reading", "belief", "agdc/stop", "health/uav")


# ---- the bus as the recorder, the page and `status` hear it ----


@cache
def messages_seeds() -> list[bytes]:
    """Return real messages, each behind the number of its key."""
    said = recorded()
    seeds = [bytes([number]) + said[key][0] for number, key in enumerate(KEYS) if key in said]
    kinds = {}
    for payload in said["mavlink/out"]:
        kinds.setdefault(payload[7:10], payload)
    seeds += [b"\0" + payload for payload in itertools.islice(kinds.values(), 12)]
    belief, _, particles = said["belief"][2].partition(BETWEEN)
    return [*seeds, b"\3" + belief + BETWEEN + particles[:160], b"\5" + health()]


def messages(data: bytes) -> None:
    """Whatever is said on the bus is shown or left out, and a record gives it back as it was."""
    payload = data[:1] + as_sent(data[1:])
    key = KEYS[payload[0] % len(KEYS)] if payload else KEYS[0]
    payload, _, attachment = payload[1:].partition(BETWEEN)
    said = [
        Entry(key, 5, 0.0, payload, attachment),
        Entry("belief", 6, 0.0, *recorded()["belief"][-1].split(BETWEEN, 1)),
    ]
    clock, history, scene = (
        SimulationClock(),
        History(Backdrop("uav/1"), whole=False),
        RecordedScene({}, "uav/1"),
    )
    entries = [
        entry._replace(simulation_s=clock.time_s(entry.key, entry.payload, entry.published_ns))
        for entry in said
    ]
    for entry in entries:
        history.take(entry.key, entry.payload, entry.attachment, entry.simulation_s, entry.published_ns / 1e9)
        scene.take(entry, entry.published_ns)
    assert not scene.failure, scene.failure
    shows(history.at(wall_s=1.0))


def recording(data: bytes) -> None:
    """A record gives back every message as it was published."""
    folder = Path(tempfile.mkdtemp(dir=FOLDER))
    try:
        key = KEYS[data[0] % len(KEYS)] if data else KEYS[0]
        payload, _, attachment = data[1:].partition(BETWEEN)
        entry = Entry(key, 5, 1.5, payload, attachment)
        writer = Writer(folder / "run.mcap", {"seed": 3})
        writer.write(entry, 5)
        writer.close()
        kept = read(folder / "run.mcap")
        assert kept.complete
        assert kept.entries == [entry]
    finally:
        shutil.rmtree(folder)


def health_seeds() -> list[bytes]:
    return [health(), *(said[0] for key, said in recorded().items() if key.startswith("health/"))]


def heard(data: bytes) -> None:
    """A health message is refused, or `status` shows it."""
    board = Board(("uav",), ("uav",), 0.0)
    try:
        board.hears(msgspec.json.decode(data, type=Health), 1.0)
    except (msgspec.DecodeError, UnicodeDecodeError):
        return
    json.dumps(board.report(2.0))


# ---- browsers ----


class OneRecord:
    """A short recorded mission to show."""

    list_version, notice = 0, ""

    def __init__(self) -> None:
        (FOLDER / "shown.mcap").write_bytes(record_seeds()[0])
        from scene.follow.history import history_of

        self.vehicles = {
            "uav/1": RecordedVehicle("uav/1", history_of(read(FOLDER / "shown.mcap")), FOLDER / "shown.mcap")
        }


@cache
def _shown() -> OneRecord:
    return OneRecord()


def browser_seeds() -> list[bytes]:
    """Return a Host, an Origin, a subprotocol, a path, and the messages, a line each."""
    head = b"127.0.0.1:8447\nhttp://127.0.0.1:8447\nword.c2VjcmV0\n/static/page.js\n"
    return [
        head + b'{"show":["uav/1"],"truth":true,"at_s":1.5}\n{"drawn":1}',
        head + b'{"command":"hold","vehicle":"uav/1"}\n{"show":[]}',
        b"[::1]:80\nhttp://localhost\n\n/\n{}",
    ]


def browser(data: bytes) -> None:
    """Requests and messages of a page are answered or refused with a reason; none ends the server."""
    host, origin, protocol, path, *said = data.split(b"\n")[:12] + [b""] * max(4 - data.count(b"\n") - 1, 0)
    for each in said:
        with contextlib.suppress(*UNREADABLE):
            message_of(each)
    asyncio.run(_both(host, origin, protocol, path, said))


async def _both(*hostile: Any) -> None:
    app = PageServer(_shown(), AccessRules("127.0.0.1", 8447, "secret")).app()
    await _asked(app, *hostile)
    await _asked(
        app,
        b"127.0.0.1:8447",
        b"http://127.0.0.1:8447",
        b"word.c2VjcmV0",
        b"/",
        [b'{"show":["uav/1"]}'],
        fine=True,
    )


async def _asked(
    app: ASGIApp,
    host: bytes,
    origin: bytes,
    protocol: bytes,
    path: bytes,
    said: list[bytes],
    fine: bool = False,
) -> None:
    scope = {
        "path": path.decode("latin-1"),
        "raw_path": path,
        "query_string": protocol,
        "root_path": "",
        "http_version": "1.1",
        "headers": [(b"host", host), (b"origin", origin)],
        "scheme": "http",
        "client": ("127.0.0.1", 1),
        "server": ("127.0.0.1", 8447),
        "method": "GET",
        "subprotocols": [protocol.decode("latin-1")],
        "asgi": {"version": "3.0"},
        "extensions": {"websocket.http.response": {}},
    }
    answers: list[dict[str, Any]] = []
    waiting = [{"type": "websocket.connect"}]
    for number, each in enumerate(said):
        text = {"text": each.decode("latin-1")} if number % 2 else {"bytes": each}
        waiting.append({"type": "websocket.receive", **text})
    waiting += [{"type": "websocket.disconnect", "code": 1000}]

    async def receive() -> dict[str, Any]:
        await asyncio.sleep(0)
        return waiting.pop(0) if waiting else {"type": "websocket.disconnect", "code": 1000}

    asked = iter([{"type": "http.request", "body": b"", "more_body": False}])

    async def ask() -> dict[str, Any]:
        return next(asked, None) or await asyncio.get_running_loop().create_future()

    async def answer(message: Any) -> None:
        answers.append(message)

    await app({**scope, "type": "http"}, ask, answer)
    assert answers[0]["status"] in (200, 307, 400, 403, 404, 405), answers[0]["status"]
    assert not fine or answers[0]["status"] == 200
    answers.clear()
    await app({**scope, "type": "websocket", "path": "/scenes"}, receive, answer)
    assert answers[0].get("status") == 403 or answers[0]["type"] == "websocket.accept"
    assert not fine or answers[0]["type"] == "websocket.accept"


def viewer_seeds() -> list[bytes]:
    """Return what Foxglove and Lichtblick ask for."""
    return [
        b'{"op":"subscribe","subscriptions":[{"id":0,"channelId":3},{"id":1,"channelId":4}]}',
        b'{"op":"unsubscribe","subscriptionIds":[0,1]}',
        b'{"op":"getParameters","parameterNames":["a"],"id":"1"}',
    ]


def viewer(data: bytes) -> None:
    """A viewer's message is read or refused."""
    with contextlib.suppress(*UNREADABLE):
        msgspec.json.decode(data, type=ViewerRequest)
