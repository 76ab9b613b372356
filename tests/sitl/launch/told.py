"""A part that runs given code: `python -m tests.sitl.launch.told 'PYTHON SOURCE'`."""

import sys

exec(sys.argv[1])
