"""A file that holds a secret in one line: a key, a passphrase or a word."""

import stat
from pathlib import Path

MOST_BYTES = 1024


def read_secret(path: str | Path, wanted: str) -> tuple[str, int]:
    """Return its text and its permissions; raises ValueError with what is wrong and what is `wanted`.

    Space around the text, a line end among it, does not count.
    """
    try:
        mode = Path(path).stat().st_mode
        if not stat.S_ISREG(mode):
            raise ValueError(f"{str(path)!r} is not a file; wanted {wanted}")
        with open(path, "rb") as file:
            content = file.read(MOST_BYTES + 1)
    except OSError as error:
        raise ValueError(f"{str(path)!r}: {error.strerror}; wanted {wanted}") from None
    try:
        text = content.decode("utf-8-sig").strip()
    except UnicodeDecodeError:
        raise ValueError(f"{str(path)!r} is not text; wanted {wanted}") from None
    if not text or not text.isprintable() or len(content) > MOST_BYTES:
        fault = (
            "is empty"
            if not text
            else "is too long"
            if len(content) > MOST_BYTES
            else "has more than one line"
        )
        raise ValueError(f"{str(path)!r} {fault}; wanted {wanted}")
    return text, stat.S_IMODE(mode)
