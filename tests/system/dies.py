"""A service that kills a process at given points: `python -m tests.system.dies WHOM POINT,… MODULE
ARGUMENTS`.

It runs `python -m MODULE ARGUMENTS` with one change: the first time that it publishes `key` at `step` or
later, a point `before:key:step` sends SIGKILL just before the message is handed to Zenoh, and a point
`after:key:step` just after. Whether that message still leaves the dying process depends on Zenoh's
threads. WHOM is `self`, or a file with the id of the process to kill.
"""

import os
import runpy
import signal
import sys
from pathlib import Path
from typing import Any

from link.bus.keys import Key
from link.bus.session import Bus


def main(whom: str, points: list[str], module: str, *arguments: str) -> None:
    """Run the module with a Bus that kills at the points."""
    publish = Bus.publish

    def strike(when: str, key: Key, step: int) -> None:
        for point in [
            point
            for point in points
            if point.startswith(f"{when}:{key.name}:") and step >= int(point.rpartition(":")[2])
        ]:
            points.remove(point)
            os.kill(os.getpid() if whom == "self" else int(Path(whom).read_text()), signal.SIGKILL)

    def killing(bus: Bus, key: Key, *message: Any) -> None:
        strike("before", key, bus.tally.step)
        publish(bus, key, *message)
        strike("after", key, bus.tally.step)

    Bus.publish = killing  # type: ignore[method-assign]
    sys.argv = [module, *arguments]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2].split(","), *sys.argv[3:])
