"""A Zenoh router of our own, so that no other software is needed to fly."""

import threading

from link.bus import open_router


def run(endpoint: str) -> None:
    """Route until interrupted; stdout tells the endpoint, with the port chosen where port 0 was asked for."""
    session, listening = open_router(endpoint)
    with session:
        print(listening, flush=True)
        threading.Event().wait()
