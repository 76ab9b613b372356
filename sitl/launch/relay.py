"""A link that can be cut: forwards TCP, and TLS within it, between a part and the router."""

import asyncio
import contextlib
import socket
import threading

CHUNK = 1 << 16


class Relay:
    """One part's link to the router, in its own thread.

    While it is cut it forwards nothing and closes nothing, like a radio out of range: each side must
    notice by itself.
    """

    def __init__(self, router: str) -> None:
        """Listen on a free local port; raises ValueError if the router's endpoint is neither TCP nor TLS."""
        protocol, _, address = router.partition("/")
        host, _, port = address.rpartition(":")
        if protocol not in ("tcp", "tls"):
            raise ValueError(f"--listen: {router!r} is not allowed where links are cut; wanted tcp/HOST:PORT")
        self._router = (host.strip("[]"), int(port))
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.endpoint = (
            f"{protocol}/127.0.0.1:{self._listener.getsockname()[1]}"  # where the part connects to
        )
        self._loop = asyncio.new_event_loop()
        self._end = self._loop.create_future()
        self._whole = asyncio.Event()
        self._whole.set()
        self._thread = threading.Thread(target=self._run, name="relay", daemon=True)
        self._thread.start()

    def cut(self) -> None:
        """Stop forwarding."""
        self._loop.call_soon_threadsafe(self._whole.clear)

    def restore(self) -> None:
        """Forward again. What was sent meanwhile arrives late, if its sender still waits."""
        self._loop.call_soon_threadsafe(self._whole.set)

    def close(self) -> None:
        """End the thread and close all connections."""
        self._loop.call_soon_threadsafe(self._end.cancel)
        self._thread.join()

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._serve())

    async def _serve(self) -> None:
        server = await asyncio.start_server(self._join, sock=self._listener, limit=CHUNK)
        with contextlib.suppress(asyncio.CancelledError):
            await self._end
        server.close()

    async def _join(self, part: asyncio.StreamReader, to_part: asyncio.StreamWriter) -> None:
        """Carry one connection of the part until either side closes it."""
        with contextlib.closing(to_part):
            try:
                await self._whole.wait()
                opening = asyncio.open_connection(*self._router, limit=CHUNK)
                router, to_router = await asyncio.wait_for(opening, timeout=1.0)
                with contextlib.closing(to_router):
                    await asyncio.gather(self._carry(part, to_router), self._carry(router, to_part))
            # The router is not there (yet), or one of them has gone; or the mission ends: asyncio would tell
            # a cancelled task as a fault.
            except (OSError, asyncio.CancelledError):
                pass
            except Exception as error:  # a fault of ours: the thread must not live on in silence
                self._end.set_exception(error)

    async def _carry(self, source: asyncio.StreamReader, target: asyncio.StreamWriter) -> None:
        while data := await source.read(CHUNK):
            await self._whole.wait()
            target.write(data)
            await target.drain()
        raise ConnectionResetError  # ends the other direction, too
