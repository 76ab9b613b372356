"""The generator of missions/mission.schema.json: the JSON schema of mission scripts, for editors.

`make docs` calls it.
"""

import json
from typing import Any

import msgspec

from sitl.script.script import Script


def schema() -> dict[str, Any]:
    """Return the JSON schema of mission scripts."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Plumeward mission",
        **_told_briefly(msgspec.json.schema(Script)),
    }


def _told_briefly(part: Any) -> Any:
    """Return a part of a schema whose descriptions end before the first empty line.

    What comes behind is for Python.
    """
    if isinstance(part, list):
        return [_told_briefly(each) for each in part]
    if not isinstance(part, dict):
        return part
    return {
        name: it.partition("\n\n")[0] if name == "description" and isinstance(it, str) else _told_briefly(it)
        for name, it in part.items()
    }


if __name__ == "__main__":
    print(json.dumps(schema(), indent=1))
