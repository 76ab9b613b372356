"""Stands in for a gas sensor in clean air: a number a line, five a second, on the serial line ./gas-sensor."""

import os
import random
import time
import tty
from pathlib import Path

NOISE = 0.02  # standard deviation, g/m³
LINE = Path("gas-sensor")

ours, theirs = os.openpty()
tty.setraw(theirs)
LINE.unlink(missing_ok=True)
LINE.symlink_to(os.ttyname(theirs))
os.set_blocking(ours, False)
print(f"a sensor in clean air at {LINE}", flush=True)
try:
    while True:
        try:
            os.write(ours, f"{random.gauss(0.0, NOISE):.3f}\n".encode())
        except BlockingIOError:  # nobody reads
            pass
        time.sleep(0.2)
except KeyboardInterrupt:
    LINE.unlink()
