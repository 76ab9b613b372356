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

signal.signal(signal.SIGINT, signal.default_int_handler)  # also where a shell began it in the background
ours, theirs = os.openpty()
tty.setraw(theirs)
LINE.unlink(missing_ok=True)
LINE.symlink_to(os.ttyname(theirs))
os.set_blocking(ours, False)
print(f"a sensor in clean air at {LINE}", flush=True)
try:
    while True:
        with contextlib.suppress(BlockingIOError):  # nobody reads
            os.write(ours, f"{random.gauss(0.0, NOISE):.3f}\n".encode())
        time.sleep(0.2)
except KeyboardInterrupt:
    LINE.unlink()
