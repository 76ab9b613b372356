"""Protects the machine's shared memory: no part of a mission uses it, so none can leave a file there,
however it ends.
"""

import os
import subprocess
import sys
from pathlib import Path

from link.bus.keys import BELIEF
from link.bus.session import Bus


def used_by(pid: int) -> list[str]:
    """The files in shared memory that a process has open."""
    links = [os.readlink(link) for link in Path(f"/proc/{pid}/fd").iterdir() if link.is_symlink()]
    return [link for link in links if link.startswith("/dev/shm")]


def test_router_and_services_have_no_file_in_shared_memory_open_after_a_large_belief() -> None:
    command = [sys.executable, "-m", "sitl", "router", "--listen", "tcp/127.0.0.1:0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as router:
        assert router.stdout
        endpoint = router.stdout.readline().strip()
        before = set(used_by(os.getpid()))  # the test process may hold files of its own
        with Bus("estimator", endpoint) as bus, Bus("agent", endpoint) as agent:
            agent.subscribe(BELIEF)
            bus.publish(BELIEF, b"belief", bytes(1_000_000))
            arrived = agent.receive(30)
            files = used_by(router.pid), set(used_by(os.getpid())) - before
        router.terminate()
    assert arrived.attachment == bytes(1_000_000)
    assert files == ([], set())
