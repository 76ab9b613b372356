"""A terminal of so many columns, for commands that ask how wide theirs is."""

import fcntl
import os
import pty
import re
import struct
import subprocess
import sys
import termios
from pathlib import Path

CONTROL = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


def on_terminal(columns: int, *arguments: str, cwd: Path | None = None) -> tuple[int, list[str]]:
    """Run `python -m arguments` with stdout and stderr on a terminal; returns its status and each line it
    drew, redrawn ones too.
    """
    reader, terminal = pty.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 40, columns, 0, 0))
    environment = {
        name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES", "NO_COLOR")
    } | {"TERM": "xterm"}
    process = subprocess.Popen(
        [sys.executable, "-m", *arguments],
        stdin=subprocess.DEVNULL,
        stdout=terminal,
        stderr=terminal,
        cwd=cwd,
        env=environment,
    )
    os.close(terminal)
    drawn = b""
    try:
        while data := os.read(reader, 65536):
            drawn += data
    except OSError:  # EIO: nobody holds the terminal any more
        pass
    os.close(reader)
    return process.wait(), [line for line in re.split(r"[\r\n]+", CONTROL.sub("", drawn.decode())) if line]
