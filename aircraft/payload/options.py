"""The flag that chooses the gas sensor, for `payload` and `fly`. What it needs is imported when it is
used: a part starts fast.
"""

import argparse
from collections.abc import Iterable

from link import cli

SIMULATED, SERIAL = "simulated", "serial"
WANTED_SERIAL = "serial:PATH[:BAUD]"


def add_payload_argument(parser: argparse.ArgumentParser, when: str = "") -> None:
    """Add it; `when` says when it counts."""
    kind = parser.add_argument(
        "--payload",
        type=cli.checked(_check),
        default=SIMULATED,
        metavar="KIND",
        help=f"{when}the gas sensor: {SIMULATED}, {WANTED_SERIAL} for a line of numbers, or a plug-in, "
        "NAME[:TEXT] (default: %(default)s)",
    )
    cli.completed(kind, _kinds)


def _check(text: str) -> None:
    from aircraft.payload.drivers import check

    check(text)


def _kinds() -> Iterable[str]:
    from aircraft.payload.drivers import kinds

    return kinds()
