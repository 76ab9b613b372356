"""Protects how sessions are opened: large messages are dropped and the link stays; a router says where it
is reached.
"""

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import numpy as np
import pytest
import zenoh

from link.bus import opening
from link.bus.keys import BELIEF, MIB
from link.bus.messages import pack_particles
from link.bus.opening import MOST_QUERY, open_router, zenoh_config
from link.bus.session import Arrival, Bus
from plume.parameters import PARAMETERS

pytestmark = pytest.mark.slow

MOST = 256 * 1024
AGAIN_S = 20.0


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Set a limit that a test can exceed quickly."""
    monkeypatch.setattr(opening, "MOST_MESSAGE", MOST)


def plain(mode: str, **settings: object) -> zenoh.Session:
    """A session with Zenoh's own limit."""
    config = zenoh_config(mode, {}, **settings)
    config.insert_json5("transport/link/rx/max_message_size", json.dumps(2**30))
    return zenoh.open(config)


@contextmanager
def router_without_limit() -> Iterator[str]:
    with plain("router", listen__endpoints=["tcp/127.0.0.1:0"], adminspace__enabled=True) as router:
        (reply,) = router.get(f"@/{router.zid()}/router")
        assert reply.ok
        yield str(json.loads(reply.ok.payload.to_bytes())["locators"][0])


@contextmanager
def our_router() -> Iterator[str]:
    session, endpoint = open_router("tcp/127.0.0.1:0")
    with session:
        yield endpoint


def publish(stranger: zenoh.Session, wait_until: Callable[..., None], *sizes: int) -> None:
    publisher = stranger.declare_publisher("uav/1/belief", congestion_control=zenoh.CongestionControl.BLOCK)
    wait_until(lambda: publisher.matching_status.matching)
    for size in sizes:
        publisher.put(bytes(size))


def test_a_part_drops_a_message_above_the_limit_and_gets_the_next_one(
    wait_until: Callable[..., None],
) -> None:
    with (
        router_without_limit() as endpoint,
        Bus("agent", endpoint) as agent,
        plain("client", connect__endpoints=[endpoint]) as stranger,
    ):
        agent.subscribe(BELIEF)
        publish(stranger, wait_until, MOST - 1000, MOST + 1, 5)
        got = [item for item in (agent.receive(60.0), agent.receive(60.0)) if isinstance(item, Arrival)]
        assert [len(item.payload) for item in got] == [MOST - 1000, 5]
        assert agent.connected


def test_the_router_drops_a_message_above_the_limit_and_keeps_its_sender(
    wait_until: Callable[..., None],
) -> None:
    with (
        our_router() as endpoint,
        plain("client", connect__endpoints=[endpoint]) as hears,
        plain("client", connect__endpoints=[endpoint]) as stranger,
    ):
        sizes: list[int] = []
        held = hears.declare_subscriber("uav/1/belief", lambda sample: sizes.append(len(sample.payload)))
        publish(stranger, wait_until, MOST - 1000, MOST + 1, 5)
        wait_until(lambda: 5 in sizes)
        assert sizes == [MOST - 1000, 5]
        assert stranger.info.routers_zid()
        held.undeclare()


@pytest.mark.parametrize("key", ["mavlink/in", "reading", "agdc/stop", "health/agent"])
def test_the_router_drops_what_is_larger_than_a_message_of_its_key_can_be(
    key: str, wait_until: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()
    with (
        our_router() as endpoint,
        plain("client", connect__endpoints=[endpoint]) as hears,
        plain("client", connect__endpoints=[endpoint]) as stranger,
    ):
        heard: dict[tuple[str, int], None] = {}  # in the order in which they first came
        hears.declare_subscriber(
            "uav/1/**", lambda sample: heard.setdefault((str(sample.key_expr), len(sample.payload)))
        )

        def say(of: str, *sizes: int) -> None:
            """Publish until the last is heard: Zenoh closes a session that a busy machine blocks for 5 s,
            and opens it again.
            """
            awaited = f"uav/1/{of}", sizes[-1]
            for _ in range(20):
                for size in sizes:
                    stranger.put(f"uav/1/{of}", bytes(size), congestion_control=zenoh.CongestionControl.BLOCK)
                with suppress(AssertionError):
                    return wait_until(lambda: awaited in heard, AGAIN_S)
            pytest.fail(f"{awaited} was not heard")

        say("belief", 5 * MIB)
        say(key, MIB + 1, 60 * MIB, MIB)
        assert [*heard] == [("uav/1/belief", 5 * MIB), (f"uav/1/{key}", MIB)]


def test_a_large_question_reaches_nobody(
    wait_until: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()
    with (
        our_router() as endpoint,
        plain("client", connect__endpoints=[endpoint]) as answers,
        plain("client", connect__endpoints=[endpoint]) as stranger,
    ):
        asked: list[int] = []
        key = "uav/1/reading/@adv/pub/**"

        def answer(query: zenoh.Query) -> None:
            asked.append(len(query.payload or b""))
            query.reply("uav/1/reading/@adv/pub/x", b"kept")

        answers.declare_queryable(key, answer)
        wait_until(lambda: [reply for reply in stranger.get(key, timeout=5) if reply.ok])
        for _ in stranger.get(key, payload=bytes(MOST_QUERY + 1), timeout=1):
            pass
        assert set(asked) == {0}


ALONE = """
import ctypes, fcntl, socket, struct, sys
if ctypes.CDLL(None).unshare(0x10000000 | 0x40000000):  # a user and a network of its own
    sys.exit("not permitted")
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any:
    fcntl.ioctl(any, 0x8914, struct.pack("16sh14x", b"lo", 1))  # loopback is up
from link.bus.opening import BusError, open_router  # its threads may not move to another network
session, endpoint = open_router("tcp/0.0.0.0:7447")
print(endpoint)
session.close()
try:
    open_router("tcp/0.0.0.0:0")
except BusError as error:
    print(error)
"""


def test_on_a_machine_with_loopback_only_a_router_on_all_addresses_says_the_loopback_one() -> None:
    ran = subprocess.run([sys.executable, "-c", ALONE], capture_output=True, text=True, timeout=300)
    if ran.stderr == "not permitted\n":
        pytest.skip("a network of its own is not permitted here")
    assert ran.stdout.splitlines() == [
        "tcp/127.0.0.1:7447",
        "--listen: the router on tcp/0.0.0.0:0 does not report its address; wanted one with a port, like "
        "tcp/127.0.0.1:7447",
    ], ran.stderr


def test_the_largest_belief_is_below_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    particles = np.zeros((1_000_000, len(PARAMETERS) + 1), np.float32)
    assert (
        len(pack_particles(particles)) + 10_000 < opening.MOST_MESSAGE
    )  # the rest of a belief has some 1,000 bytes
