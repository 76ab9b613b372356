"""The file with the secret key that a vehicle and its ground stations share."""

import hashlib
import os
import re
import stat
from pathlib import Path
from typing import NamedTuple

from link.access.secret import read_secret

WANTED = "a file with 64 hexadecimal digits, or with a passphrase in one line"


class SecretKey(NamedTuple):
    """A key, and what a user should know of its file."""

    secret: bytes  # 32 bytes
    made_from: str  # what the file holds, in words
    open_to_all: bool  # whether every user of the machine may read or change the file


def read_key(path: str | Path) -> SecretKey:
    """Read a key file; raises ValueError with what is wrong and what is allowed.

    64 hexadecimal digits are the key itself. Any other line is a passphrase: the key is its SHA-256, as in
    MAVProxy, QGroundControl and Mission Planner. Space around it, a line end among it, does not count.
    """
    text, mode = read_secret(path, WANTED)
    open_to_all = bool(mode & (stat.S_IROTH | stat.S_IWOTH)) and os.name == "posix"
    if re.fullmatch(r"[0-9a-fA-F]{64}", text):
        return SecretKey(bytes.fromhex(text), "64 hexadecimal digits", open_to_all)
    return SecretKey(hashlib.sha256(text.encode()).digest(), "a passphrase", open_to_all)
