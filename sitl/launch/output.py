"""What a part prints, cut into lines: a long one is cut short, and what is no text is shown all the same."""

LONGEST = 4_000
"""Bytes of a line that are kept."""


class Lines:
    """Cuts what comes through a pipe into lines, and never holds more than one."""

    def __init__(self) -> None:
        """Begin with nothing."""
        self._begun = b""

    def take(self, data: bytes) -> list[str]:
        """Return the lines that are whole now, without those that are blank. No data is the end: what was begun is a line then."""
        *whole, begun = (self._begun + (data or b"\n")).split(b"\n")
        self._begun = begun[: LONGEST + 1]
        return [text for line in whole if (text := _text(line))]


def _text(line: bytes) -> str:
    text = line[:LONGEST].decode(errors="replace").strip()
    return f"{text} …" if len(line) > LONGEST else text
