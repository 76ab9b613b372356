"""Protects docs/bus.md: it matches the table of keys, and lists every key and field."""

from pathlib import Path

import msgspec

from docs.generate.bus import bus_document
from link.bus.keys import KEYS

PAGE = Path(__file__).parents[2] / "docs" / "bus.md"


def test_the_committed_page_is_up_to_date() -> None:
    assert PAGE.read_text() == bus_document(), "run: make docs"


def test_every_key_and_every_field_is_described() -> None:
    page = PAGE.read_text()
    for key in KEYS:
        assert f"| `{key.name}` |" in page
        if not isinstance(key.payload, str):
            for field in msgspec.structs.fields(key.payload):
                assert f"| `{field.name}` |" in page
