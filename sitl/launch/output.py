"""Cuts what a part prints into lines. Long lines are cropped; bytes that are not text are replaced."""

LONGEST = 4_000
"""Bytes of a line that are kept."""


class Lines:
    """Cuts the data of a pipe into lines, holding at most one."""

    def __init__(self) -> None:
        """Start empty."""
        self.begun = b""
        """The line that has begun."""

    def take(self, data: bytes) -> list[str]:
        """Return the complete lines, without blank ones. Empty data means the end: an unfinished line is
        then complete.
        """
        *whole, begun = (self.begun + (data or b"\n")).split(b"\n")
        self.begun = begun[: LONGEST + 1]
        return [text for line in whole if (text := _text(line))]


def _text(line: bytes) -> str:
    text = line[:LONGEST].decode(errors="replace").strip()
    return f"{text} …" if len(line) > LONGEST else text
