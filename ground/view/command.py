"""`plumeward view`: serves the page of a running stack or of records."""

import argparse
import asyncio
import contextlib
import json
import signal
import socket
import sys
import threading
import time
import webbrowser
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from ground.view.guard import AccessRules, Asgi, origin
from ground.view.word import word_in
from link import cli
from link.bus.opening import DEFAULT_ROUTER
from link.early import INTERRUPTED
from link.interrupts import ends, let_go_of_the_terminal
from plume.randomness import MAX_SEED
from plume.worlds import WORLDS, check
from sitl.script.script import Script, load, shipped
from sitl.script.typed_yaml import FileError

PORT = 8447
FIRST_PAGE_S = 30.0
"""How long a page of a mission that is over waits for its first browser."""
STREAM_EVERY_S = 0.05
"""How often scenes are streamed to Foxglove at most."""
RELOAD_S = 3.0
"""How long it waits for a browser to come back, which may be loading it again."""
OVER = signal.SIGUSR1
"""The launcher's signal that the mission is over."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add its flags."""
    logs = parser.add_argument(
        "logs",
        nargs="*",
        type=Path,
        metavar="LOG",
        help="a record, or two to compare; without one: a live stack",
    )
    cli.completed(logs, tuple, "mcap")
    parser.add_argument(
        "-e",
        "--connect",
        metavar="ENDPOINT",
        default=DEFAULT_ROUTER,
        help="the Zenoh router of the vehicles to show (default: %(default)s)",
    )
    cli.add_secure_argument(parser)
    parser.add_argument(
        "--host",
        metavar="ADDRESS",
        default="127.0.0.1",
        help="where to serve the page (default: %(default)s)",
    )
    parser.add_argument(
        "--port",
        type=cli.whole(0, 65535),
        default=PORT,
        metavar="N",
        help="0: a free port (default: %(default)s)",
    )
    parser.add_argument(
        "--token-file",
        type=Path,
        metavar="FILE",
        help="allow commands only to those who enter the word in this file; if there is none, it is made "
        "with a new word",
    )
    parser.add_argument("--token", type=_gone, help=argparse.SUPPRESS)
    parser.add_argument(
        "--origin",
        type=cli.checked(origin),
        action="append",
        default=[],
        metavar="URL",
        help="allow those who come from here, too: a proxy before the page, a web page that shows "
        "--foxglove; may be repeated",
    )
    parser.add_argument("--open", action="store_true", help="open the page in a browser")
    parser.add_argument(
        "--foxglove",
        type=cli.whole(0, 65535),
        metavar="N",
        help="stream the scenes to Foxglove, too, on this local port",
    )
    truth = "simulation only: the truth to show of the first vehicle is that of"
    parser.add_argument("--seed", type=cli.whole(0, MAX_SEED), metavar="S", help=f"{truth} this seed")
    world = parser.add_argument(
        "--world", type=cli.checked(check, WORLDS), metavar="NAME", help=f"{truth} this world"
    )
    cli.completed(world, lambda: WORLDS)
    mission = parser.add_argument("--mission", metavar="MISSION", help=f"{truth} this mission script")
    cli.completed(mission, shipped, "yaml", "yml")
    parser.add_argument("--about", type=json.loads, help=argparse.SUPPRESS)


def _gone(_: str) -> str:
    raise argparse.ArgumentTypeError(
        "not allowed any more: everyone on this machine can read it there; wanted --token-file FILE"
    )


def run(args: argparse.Namespace) -> int:
    """Serve until interrupted; a line on stdout says where."""
    if reason := _refusal(args):
        print(f"error: {reason}", file=sys.stderr)
        return cli.BAD_INPUT
    try:
        family = socket.AF_INET6 if ":" in args.host else socket.AF_INET
        listening = socket.create_server((args.host, args.port), family=family, backlog=64)
    except OSError as error:
        reason = str(error.strerror).partition(" (while")[0]
        print(f"error: --port: cannot serve on {args.host} port {args.port}: {reason}", file=sys.stderr)
        return cli.BAD_INPUT
    with listening:
        return asyncio.run(_serve(args, listening))


def _refusal(args: argparse.Namespace) -> str:
    """Return why these flags cannot be served; empty if they can. Notes what they tell of the truth."""
    truth = {
        name: value for name in ("mission", "seed", "world") if (value := getattr(args, name)) is not None
    }
    if not args.host:
        return "--host: '' is not allowed; wanted an address of this machine"
    if len(args.logs) > 2:
        return "LOG: three or more records are not allowed; wanted one, or two to compare"
    if args.logs and args.foxglove is not None:
        return "--foxglove: not with LOG: Foxglove opens records itself"
    if args.logs and truth:
        return f"--{next(iter(truth))}: not with LOG: a record holds its own truth"
    if truth:
        try:
            script = load(truth.pop("mission")) if args.mission else Script()
            script = script.changed(truth)
        except FileError as error:
            return str(error)
        args.about = {
            "namespace": None,
            "mission": script,
            "scenario": script.simulated().truth,
            "seed": script.seed,
        }
        args.about = msgspec.to_builtins(args.about)
    args.word = ""
    if args.token_file:
        try:
            args.word, line = word_in(args.token_file)
        except ValueError as error:
            return f"--token-file: {error}"
        if line:
            print(line, file=sys.stderr, flush=True)
    return ""


async def _serve(args: argparse.Namespace, listening: socket.socket) -> int:
    import uvicorn

    from ground.view.connections import Lobby
    from ground.view.foxglove import LONGEST_REQUEST, LiveFoxglove, NoFoxglove
    from ground.view.live import Described, LiveFleet
    from ground.view.records import RecordedFleet
    from ground.view.server import LONGEST_MESSAGE, SEND_S, PageServer
    from link.record.reader import RecordError
    from scene.follow.recorded import backdrop_of, turns_of

    loop = asyncio.get_running_loop()
    port = listening.getsockname()[1]
    origins = tuple(map(origin, args.origin))
    server: PageServer | None = None
    try:
        stream = None if args.foxglove is None else LiveFoxglove(args.foxglove, origins)
    except NoFoxglove as error:
        print(f"error: {error}", file=sys.stderr)
        return cli.BAD_INPUT
    news = asyncio.Event()

    def told() -> None:
        news.set()
        if server is not None:
            server.news()

    def changed() -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended
            loop.call_soon_threadsafe(told)

    def show(stream: LiveFoxglove) -> None:
        for vehicle in tuple(shown.vehicles.values()):
            stream.show(vehicle.scene()[0])

    async def keep_streaming(stream: LiveFoxglove) -> None:
        try:
            while True:
                await news.wait()
                news.clear()
                await asyncio.to_thread(show, stream)
                await asyncio.sleep(STREAM_EVERY_S)
        except Exception as error:  # nobody awaits it
            print(
                f"error: Foxglove gets no more scenes: {type(error).__name__}: {error}",
                file=sys.stderr,
                flush=True,
            )
            end(cli.FAILED)

    try:
        if args.logs:
            shown: Any = RecordedFleet(args.logs)
            if shown.notice:
                print(f"warning: {shown.notice}", file=sys.stderr)
        else:
            described = None
            if args.about:
                described = Described(args.about["namespace"], *backdrop_of(args.about), turns_of(args.about))
            shown = LiveFleet(
                args.connect,
                described,
                changed,
                lambda line: print(line, file=sys.stderr, flush=True),
                args.secure,
            )
    except RecordError as error:
        print(f"error: {error}", file=sys.stderr)
        return cli.BAD_INPUT
    rules = AccessRules(args.host, port, args.word, origins)
    server = PageServer(shown, rules)

    class _Uvicorn(uvicorn.Server):
        @contextlib.contextmanager
        def capture_signals(self) -> Iterator[None]:
            yield  # they are ours

    def serving(app: Asgi, longest_message: int) -> uvicorn.Server:
        guest, page_socket = Lobby(SEND_S).protocols()
        config = uvicorn.Config(
            app,
            http=guest,
            ws=page_socket,
            lifespan="off",
            log_config=None,
            log_level="critical",
            access_log=False,
            server_header=False,
            date_header=False,
            ws_max_size=longest_message,
            ws_per_message_deflate=False,
            timeout_graceful_shutdown=1,
            proxy_headers=bool(origins),  # who is behind a proxy of this machine, by X-Forwarded-For
        )
        return _Uvicorn(config)

    http = serving(server.app(), LONGEST_MESSAGE)
    servers = [(http, listening)]
    if stream:
        servers.append((serving(stream.app(), LONGEST_REQUEST), stream.listening))
    status = [0]

    def end(number: int = INTERRUPTED) -> None:
        let_go_of_the_terminal()
        status[0] = cli.FAILED if args.logs and shown.damaged else number
        http.should_exit = True

    async def linger() -> None:
        await asyncio.to_thread(shown.end)
        server.bye = "the mission is over"
        server.news()
        began = time.monotonic()
        while server.watched or time.monotonic() < (
            began + FIRST_PAGE_S if server.left_at is None else server.left_at + RELOAD_S
        ):
            await asyncio.sleep(0.1)
        http.should_exit = True

    lingering: list[asyncio.Task[None]] = []
    for number in ends():
        loop.add_signal_handler(number, end)
    loop.add_signal_handler(OVER, lambda: lingering.append(asyncio.create_task(linger())))
    print(f"page at {rules.address}", flush=True)
    if stream:
        print(f"Foxglove at {stream.address}", flush=True)
        streaming = asyncio.create_task(keep_streaming(stream))
    if args.open:
        threading.Thread(target=_open, args=(rules.address,), daemon=True).start()
    tasks = [asyncio.create_task(each.serve(sockets=[at])) for each, at in servers]
    await tasks[0]
    for each, _ in servers:
        each.should_exit = True
    await asyncio.gather(*tasks)
    shown.end()
    if stream:
        streaming.cancel()
    return status[0]


def _open(address: str) -> None:
    """Open a browser; where it cannot be started, the page stays without it."""
    try:
        webbrowser.open(address)
    except (OSError, webbrowser.Error) as error:
        print(f"warning: --open: no browser shows {address}: {error}", file=sys.stderr, flush=True)
