"""Protects that a command's parts start no threads that have no work."""

import os
import subprocess
import sys

import pytest

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
