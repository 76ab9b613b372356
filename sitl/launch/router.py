"""A Zenoh router of our own, so that no other software is needed to fly."""

import time

from link.bus.session import SIGNAL_POLL_S, open_router


def run(endpoint: str) -> None:
    """Route until interrupted; stdout tells the endpoint, with the port chosen where port 0 was asked for."""
    session, listening = open_router(endpoint)
    with session:
        print(listening, flush=True)
        while True:
            time.sleep(SIGNAL_POLL_S)  # all the work is in Zenoh's threads
