"""Protects docs/mavlink.md: it is what the code's own tables say."""

from pathlib import Path

from sitl.autopilot.telemetry import STREAMS
from sitl.protocol.document import document
from sitl.protocol.parameters import PARAMETERS
from sitl.protocol.protocol import COMMANDS, REQUESTED

PAGE = Path(__file__).parents[3] / "docs" / "mavlink.md"


def test_the_committed_page_is_up_to_date() -> None:
    assert PAGE.read_text() == document(), "run: make docs"


def test_every_command_message_and_parameter_has_a_row() -> None:
    page = PAGE.read_text()
    numbers = [*COMMANDS, *REQUESTED, *(stream.message_id for stream in STREAMS)]
    assert [number for number in numbers if f" | {number} | " not in page] == []
    assert [parameter.name for parameter in PARAMETERS if f"| {parameter.name} | " not in page] == []
    assert "|  |" not in page  # no empty cell
