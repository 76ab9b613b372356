"""A Zenoh router in this process: no other software is needed to fly."""

import time

from link.bus.session import SIGNAL_POLL_S, open_router


def run(endpoint: str) -> None:
    """Route until interrupted. Prints the endpoint on stdout; port 0 is replaced by the chosen port."""
    session, listening = open_router(endpoint)
    with session:
        print(listening, flush=True)
        while True:
            time.sleep(SIGNAL_POLL_S)  # all the work is in Zenoh's threads
