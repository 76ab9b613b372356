"""The file with the secret key that a vehicle and its ground stations share."""

import hashlib
import os
import re
import stat
from pathlib import Path
from typing import NamedTuple

WANTED = "a file with 64 hexadecimal digits, or with a passphrase in one line"
MOST_BYTES = 1024


class SecretKey(NamedTuple):
    """A key, and what a user should know of its file."""

    secret: bytes
    """32 bytes."""
    made_from: str
    """What the file holds, in words."""
    open_to_all: bool
    """Whether every user of the machine may read or change the file."""


def read_key(path: str | Path) -> SecretKey:
    """Read a key file; raises ValueError with what is wrong and what is allowed.

    64 hexadecimal digits are the key itself. Any other line is a passphrase: the key is its SHA-256, as in MAVProxy,
    QGroundControl and Mission Planner. Space around it, a line end among it, does not count.
    """
    try:
        mode = Path(path).stat().st_mode
        if not stat.S_ISREG(mode):
            raise ValueError(f"{str(path)!r} is not a file; wanted {WANTED}")
        with open(path, "rb") as file:
            content = file.read(MOST_BYTES + 1)
    except OSError as error:
        raise ValueError(f"{str(path)!r}: {error.strerror}; wanted {WANTED}") from None
    open_to_all = bool(mode & (stat.S_IROTH | stat.S_IWOTH)) and os.name == "posix"
    try:
        text = content.decode("utf-8-sig").strip()
    except UnicodeDecodeError:
        raise ValueError(f"{str(path)!r} is not text; wanted {WANTED}") from None
    if not text or not text.isprintable() or len(content) > MOST_BYTES:
        fault = "is empty" if not text else "is too long" if len(content) > MOST_BYTES else "has more than one line"
        raise ValueError(f"{str(path)!r} {fault}; wanted {WANTED}")
    if re.fullmatch(r"[0-9a-fA-F]{64}", text):
        return SecretKey(bytes.fromhex(text), "64 hexadecimal digits", open_to_all)
    return SecretKey(hashlib.sha256(text.encode()).digest(), "a passphrase", open_to_all)
