"""One line an event, on stderr: stdout is for results."""

import sys


class Log:
    """Writes lines that begin with the service's name."""

    def __init__(self, service: str) -> None:
        """Take the name of the service that speaks."""
        self.service = service

    def info(self, text: str) -> None:
        """Say what happened."""
        print(f"{self.service}: {text}", file=sys.stderr, flush=True)

    def warn(self, text: str) -> None:
        """Say what went wrong and was survived."""
        self.info(f"warning: {text}")
