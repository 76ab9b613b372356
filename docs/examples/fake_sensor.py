"""Stands in for a gas sensor in clean air: a number a line, five a second, on a serial line, ./gas-sensor."""

import contextlib
import os
import random
import signal
import time
import tty
from pathlib import Path

NOISE = 0.02  # standard deviation, g/m³
LINE = Path("gas-sensor")

for ending in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):  # also where a shell began it in the background
    signal.signal(ending, signal.default_int_handler)
ours, theirs = os.openpty()
tty.setraw(theirs)
LINE.unlink(missing_ok=True)
os.set_blocking(ours, False)
try:
    LINE.symlink_to(os.ttyname(theirs))
    print(f"a sensor in clean air at {LINE}", flush=True)
    while True:
        with contextlib.suppress(BlockingIOError):  # nobody reads
            os.write(ours, f"{random.gauss(0.0, NOISE):.3f}\n".encode())
        time.sleep(0.2)
except KeyboardInterrupt:
    LINE.unlink(missing_ok=True)
