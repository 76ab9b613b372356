"""A part that does as it is told: `python -m tests.sitl.launch.told 'PYTHON SOURCE'`."""

import sys

exec(sys.argv[1])
