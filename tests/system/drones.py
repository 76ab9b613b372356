"""MAVSDK-Python with a server of the test's own, which ends with the test."""

import asyncio
import socket
import subprocess
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from tests.system.wires import free_port

TIMEOUT_S = 60.0


async def until(stream: Any, holds: Callable[[Any], object]) -> Any:
    """Return the first item of a telemetry stream that is as wanted."""
    async with asyncio.timeout(TIMEOUT_S):
        async for item in stream:
            if holds(item):
                return item
    raise AssertionError("the stream ended")


@asynccontextmanager
async def connected(url: str) -> AsyncIterator[Any]:
    """A mavsdk.System that has found the vehicle at a URL."""
    import mavsdk

    port = free_port(socket.SOCK_STREAM)
    words = [str(Path(mavsdk.__file__).parent / "bin" / "mavsdk_server"), "-p", str(port), url]
    with subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as server:
        try:
            drone = mavsdk.System(mavsdk_server_address="localhost", port=port)
            async with asyncio.timeout(TIMEOUT_S):
                await drone.connect()
            await until(drone.core.connection_state(), lambda state: state.is_connected)
            yield drone
        finally:
            server.kill()
