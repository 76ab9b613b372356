"""`python -m sitl.script` prints the JSON schema of mission scripts, for editors."""

import json

from sitl.script.script import schema

if __name__ == "__main__":
    print(json.dumps(schema(), indent=1))
