"""Protects a part one of whose threads dies: it ends with a line that says which and why, and status 1,
instead of hanging in silence.
"""

import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow

COMMON = """
import socket, sys, time
from link import cli
"""
PARTS = {
    "to the bus": """
from types import SimpleNamespace
from link.bus.log import Log
from link.bus.tally import Tally
from aircraft.bridge.bus_link import BusChannel

def publish(*_):
    raise RuntimeError("a fault")

def command():
    bus = SimpleNamespace(log=Log("bridge", "-", Tally()), on=lambda *_, **__: None, publish=publish)
    BusChannel(bus, "bus", lambda: None).send(b"a frame", vehicle=False)
    time.sleep(600)
""",
    "tap": """
from link.bus.inbox import Inbox
from link.bus.keys import STOP
from link.bus.session import Bus
from link.record.tap import Tap

class Faulty(Inbox):
    def lane(self, *_, **__):
        def put(item, size):
            raise RuntimeError("a fault")
        return put

def command():
    with Tap("recorder", sys.argv[1], inbox=Faulty()) as tap, Bus("estimator", sys.argv[1]) as estimator:
        tap.subscribe(STOP)
        estimator.publish(STOP, b"said")
        time.sleep(600)
""",
    "relay": """
from sitl.launch.relay import Relay

def command():
    relay = Relay(f"tcp/{'x' * 64}:1")  # longer than any name of a machine
    host, port = relay.endpoint.removeprefix("tcp/").split(":")
    with socket.create_connection((host, int(port))):
        time.sleep(600)
""",
    "sensor": """
from link.bus.inbox import Inbox
from aircraft.payload.messages import Question
from aircraft.payload.service import Measuring

def measure(question):
    raise RuntimeError("a fault")

def command():
    Measuring(measure, Inbox()).begin(Question(1, 1000, 0, (4.0, 3.0), None))
    time.sleep(600)
""",
    "bus": """
from sitl.__main__ import main
from ground.view.live import Roster

def changes(_):
    raise RuntimeError("a fault")

def command():
    Roster.changes = changes
    return main(arguments=["view", "--connect", sys.argv[1], "--port", "0"])
""",
}


@pytest.mark.parametrize("thread", PARTS)
def test_a_part_whose_thread_dies_ends_with_one_line_that_says_which_and_why(
    router: str, thread: str
) -> None:
    program = f"{COMMON}{PARTS[thread]}\ncli.run(command)"
    ran = subprocess.run([sys.executable, "-c", program, router], capture_output=True, text=True, timeout=400)
    assert ran.returncode == 1
    (line,) = ran.stderr.splitlines()
    assert line.startswith(
        f"error: thread {thread!r} has died: "
        f"{'UnicodeError' if thread == 'relay' else 'RuntimeError: a fault'}"
    )


MISSES = """
import contextlib, threading, time
from link import cli

def fail():
    raise RuntimeError("a fault")

def command():
    with contextlib.suppress(KeyboardInterrupt):
        threading.Thread(target=fail, name="short").start()
        time.sleep(600)
    time.sleep(600)

cli.run(command)
"""


def test_a_part_that_misses_the_first_signal_ends_with_the_next() -> None:
    ran = subprocess.run([sys.executable, "-c", MISSES], capture_output=True, text=True, timeout=400)
    assert (ran.returncode, len(ran.stderr.splitlines())) == (1, 1)
