"""Where the clients are installed, and the ports that they may use."""

import os
import socket
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent


def python_of(client: str) -> str:
    """The Python of a client's environment; skips the test if it is not installed, or not from the
    requirements here.
    """
    there, wanted = Path(sys.prefix) / "clients" / client, HERE / f"{client}.txt"
    made_from = there / "requirements.txt"
    if not made_from.is_file() or made_from.read_text() != wanted.read_text():
        missing = f"{client} is not installed as tests/clients/{client}.txt says; run: make setup"
        if os.environ.get("CI"):
            pytest.fail(missing)
        pytest.skip(missing)
    return str(there / "bin" / "python")


def free_udp_port() -> int:
    """A port that nobody uses now."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
