"""Protects what a command does before all else: no threads that have no work, and a stack when it is asked."""

import os
import subprocess
import sys

import pytest

from link.early import ask_for_stack

PROGRAM = """
import os
from link.early import begin

begin()
import numpy

print(os.environ["OPENBLAS_NUM_THREADS"], len(os.listdir("/proc/self/task")))
"""


@pytest.mark.parametrize(("given", "said"), [({}, ["1", "1"]), ({"OPENBLAS_NUM_THREADS": "2"}, ["2"])])
def test_numpy_has_one_thread_unless_told_otherwise(given: dict[str, str], said: list[str]) -> None:
    kept = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    ran = subprocess.run(
        [sys.executable, "-c", PROGRAM], env=kept | given, check=True, capture_output=True, text=True
    )
    assert ran.stdout.split()[: len(said)] == said


BUSY = """
import threading
from link.early import tell_stack

def dive(depth):
    return depth and dive(depth - 1)

def work():
    while True:
        dive(60)
        exec("def made(): pass\\nmade()")

tell_stack()
for _ in range(4):
    threading.Thread(target=work, daemon=True).start()
print("busy", flush=True)
work()
"""


def test_who_is_asked_for_its_stack_survives_whatever_its_threads_do() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", BUSY], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as asked:
        assert asked.stdout
        asked.stdout.readline()
        for _ in range(20_000):
            ask_for_stack(asked.pid)
        died = asked.poll()
        asked.kill()
    assert died is None
