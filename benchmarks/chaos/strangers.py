"""Processes that do not belong on a bus: `python -m benchmarks.chaos.strangers deaf|echo|station ENDPOINT
SEED`.
"""

import heapq
import sys
import time
from collections.abc import Callable

import zenoh
from pymavlink.dialects.v20 import common as mavlink

from aircraft.search.udp import UdpPorts
from link import cli
from link.bus.keys import KEYS, READING
from link.bus.log import Log
from link.bus.session import Arrival, Bus
from link.bus.tally import Tally
from plume.randomness import keyed

MOST_COPIES, LATEST_S = 3, 3.0
BEAT_S = 0.5


class Deaf(Bus):
    """Subscribes to every key with a queue for one message, and never takes it out: its session soon takes
    nothing more.
    """

    def listen(self) -> None:
        """Subscribe, without history: whoever asks for it waits for it, behind messages that are never
        taken.
        """
        self._unread = [
            self._session.declare_subscriber(key.named(), zenoh.handlers.FifoChannel(1)) for key in KEYS
        ]


def deaf(endpoint: str, seed: int) -> None:
    """Never read."""
    bus = Deaf("deaf", endpoint, announced=False)
    bus.listen()
    _ready()
    while True:
        time.sleep(BEAT_S)


def echo(endpoint: str, seed: int) -> None:
    """Publish each reading again, a few times, late and in any order."""
    rng = keyed(seed, "chaos echo")
    late: list[tuple[float, int, bytes]] = []
    with Bus("echo", endpoint, announced=False) as bus:
        publisher = bus._session.declare_publisher(
            READING.name, congestion_control=zenoh.CongestionControl.BLOCK
        )
        bus._hold(  # as a stranger: each reading as it comes, without history
            READING.name,
            lambda session: session.declare_subscriber(
                READING.name,
                lambda sample: bus._inbox.put(Arrival(READING, sample.payload.to_bytes(), b"")),
                allowed_origin=zenoh.Locality.REMOTE,
            ),
        )
        _ready()
        count = 0
        while True:
            due_s = late[0][0] - time.monotonic() if late else BEAT_S
            if (arrival := bus.receive(max(due_s, 0.0))) is not None:
                for _ in range(int(rng.integers(MOST_COPIES + 1))):
                    heapq.heappush(
                        late, (time.monotonic() + LATEST_S * float(rng.random()), count, arrival.payload)
                    )
                    count += 1
            while late and late[0][0] <= time.monotonic():
                publisher.put(heapq.heappop(late)[2])


def station(endpoint: str, seed: int) -> None:
    """Be a ground station on UDP: say heartbeats, hear telemetry."""
    log = Log("station", "-", Tally())
    link = UdpPorts([endpoint], log, system=255, component=mavlink.MAV_COMP_ID_MISSIONPLANNER)
    _ready()
    while True:
        link.receive()
        link.ports[0].send(
            mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 0, 3)
        )
        time.sleep(BEAT_S)


def _ready() -> None:
    print("ready", flush=True)


KINDS: dict[str, Callable[[str, int], None]] = {"deaf": deaf, "echo": echo, "station": station}

if __name__ == "__main__":
    cli.run(lambda: KINDS[sys.argv[1]](sys.argv[2], int(sys.argv[3])))
