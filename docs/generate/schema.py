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
        **msgspec.json.schema(Script),
    }


if __name__ == "__main__":
    print(json.dumps(schema(), indent=1))
