"""Protects docs/mavlink.md: it is what the code's own tables say."""

import re
from pathlib import Path

from docs.generate.mavlink import TRIED, document
from sitl.autopilot.commands import COMMANDS, REQUESTED
from sitl.autopilot.parameters import PARAMETERS
from sitl.autopilot.telemetry import STREAMS

ROOT = Path(__file__).parents[3]
PAGE = ROOT / "docs" / "mavlink.md"


def test_the_committed_page_is_up_to_date() -> None:
    assert PAGE.read_text() == document(), "run: make docs"


def test_every_command_message_and_parameter_has_a_row() -> None:
    page = PAGE.read_text()
    numbers = [*COMMANDS, *REQUESTED, *(stream.message_id for stream in STREAMS)]
    assert [number for number in numbers if f" | {number} | " not in page] == []
    assert [parameter.name for parameter in PARAMETERS if f"{parameter.name} " not in page] == []
    assert "|  |" not in page  # no empty cell


def test_the_clients_that_were_tried_are_those_that_the_tests_install() -> None:
    files = [ROOT / "constraints.txt", *(ROOT / "tests" / "clients").glob("*.txt")]
    installed = {line.lower() for file in files for line in file.read_text().splitlines()}
    tried = {f"{client.lower()}=={version}" for client, version, _ in TRIED if version[0].isdigit()}
    tried |= {
        f"pymavlink=={version}" for _, said, _ in TRIED for version in re.findall(r"by pymavlink (.+)", said)
    }
    assert len(tried) == len(TRIED)
    assert tried <= installed
