"""The process behind `plumeward view`: serves what there is to see, on a page and to Foxglove."""

import argparse
import asyncio
import contextlib
import signal
import socket
import threading
import time
import webbrowser

from ground.view.access import AccessRules, origin
from ground.view.foxglove import LONGEST_REQUEST, LiveFoxglove
from ground.view.live import LiveFleet
from ground.view.records import RecordedFleet
from ground.view.server import LONGEST_MESSAGE, Fleet, PageServer
from ground.view.serving import server_of
from link import cli
from link.early import INTERRUPTED, ends
from link.interrupts import let_go_of_the_terminal
from link.terminal import tell

FIRST_PAGE_S = 30.0  # how long the page of a mission that is over waits for its first browser
RELOAD_S = 3.0  # how long it waits for a browser to come back, which may be loading it again
STREAM_EVERY_S = 0.05  # shortest time between two scenes for Foxglove
OVER = signal.SIGUSR1  # the launcher's signal that the mission is over


async def serve(args: argparse.Namespace, word: str, page: socket.socket, local: socket.socket | None) -> int:
    """Serve the page, and Foxglove if there is a socket for it, until interrupted.

    Returns the exit status. Raises RecordError.
    """
    return await Host(args, word, page, local).run()


class Host:
    """Serves what there is to see until it is told to end. It has to be made within an event loop."""

    def __init__(
        self, args: argparse.Namespace, word: str, page: socket.socket, local: socket.socket | None
    ) -> None:
        """Begin to follow. Raises RecordError."""
        self._loop = asyncio.get_running_loop()
        self._ended = asyncio.Event()
        self._news = asyncio.Event()
        self._status = 0
        self._opens = args.open
        self._shown: Fleet
        if args.logs:
            self._shown = RecordedFleet(args.logs)
            if self._shown.notice:
                tell(f"warning: {self._shown.notice}")
        else:
            self._shown = LiveFleet(args.connect, args.about, self._changed, tell, args.secure)
        origins = tuple(map(origin, args.origin))
        rules = AccessRules(args.host, page.getsockname()[1], word, origins)
        self._address = rules.address
        self._pages = PageServer(self._shown, rules)
        self._servers = {page: server_of(self._pages.app(), LONGEST_MESSAGE, proxied=bool(origins))}
        self._stream = LiveFoxglove(local.getsockname()[1], origins) if local else None
        if local and self._stream:
            self._servers[local] = server_of(self._stream.app(), LONGEST_REQUEST, proxied=bool(origins))

    async def run(self) -> int:
        """Serve; returns the exit status."""
        for number in ends():
            self._loop.add_signal_handler(number, self._end, INTERRUPTED)
        tasks = [asyncio.create_task(each.serve(sockets=[at])) for at, each in self._servers.items()]
        aside = set[asyncio.Task[None]]()
        self._loop.add_signal_handler(OVER, lambda: aside.add(asyncio.create_task(self._linger())))
        print(f"page at {self._address}", flush=True)
        if self._stream:
            print(f"Foxglove at {self._stream.address}", flush=True)
            aside.add(asyncio.create_task(self._keep_streaming(self._stream)))
        if self._opens:
            threading.Thread(target=_open, args=(self._address,), daemon=True).start()
        await self._ended.wait()
        for server in self._servers.values():
            server.should_exit = True
        await asyncio.gather(*tasks)
        self._shown.end()
        for each in aside:
            each.cancel()
        return self._status

    def _end(self, status: int) -> None:
        let_go_of_the_terminal()
        self._status = cli.FAILED if self._shown.damaged else status
        self._ended.set()

    def _changed(self) -> None:
        """There is something new to see, says the bus's thread."""
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._tell)

    def _tell(self) -> None:
        self._news.set()
        self._pages.news()

    async def _linger(self) -> None:
        """The mission is over: stay until the last browser has gone, or none has come."""
        await asyncio.to_thread(self._shown.end)
        self._pages.bye = "the mission is over"
        self._pages.news()
        first_until = time.monotonic() + FIRST_PAGE_S
        while self._pages.clients or time.monotonic() < (
            first_until if self._pages.left_at is None else self._pages.left_at + RELOAD_S
        ):
            await asyncio.sleep(0.1)
        self._ended.set()

    async def _keep_streaming(self, stream: LiveFoxglove) -> None:
        try:
            while await self._news.wait():
                self._news.clear()
                for name in tuple(self._shown.vehicles):
                    scene, _, _ = await asyncio.to_thread(self._shown.vehicles[name].scene)
                    await asyncio.to_thread(stream.show, scene)
                await asyncio.sleep(STREAM_EVERY_S)
        except Exception as error:  # nobody awaits it
            tell(f"error: Foxglove gets no more scenes: {type(error).__name__}: {error}")
            self._end(cli.FAILED)


def _open(address: str) -> None:
    """Open a browser; where it cannot be started, the page stays without it."""
    try:
        webbrowser.open(address)
    except (OSError, webbrowser.Error) as error:
        tell(f"warning: --open: no browser shows {address}: {error}")
