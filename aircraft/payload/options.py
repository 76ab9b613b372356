"""The flag that chooses the gas sensor, for `payload` and `fly`."""

import argparse
from importlib.metadata import entry_points

from aircraft.bridge.address import parse_address
from link import cli

SIMULATED, SERIAL = "simulated", "serial"
WANTED_SERIAL = "serial:PATH[:BAUD]"
PLUGINS = "plumeward.payloads"  # entry points of this group are drivers of other packages: docs/payload.md


def add_payload_argument(parser: argparse.ArgumentParser, when: str = "") -> None:
    """Add it; `when` says when it counts."""
    kind = parser.add_argument(
        "--payload",
        type=cli.checked(check),
        default=SIMULATED,
        metavar="KIND",
        help=f"{when}the gas sensor: {SIMULATED}, {WANTED_SERIAL} for a line of numbers, or a plug-in, "
        "NAME[:TEXT] (default: %(default)s)",
    )
    cli.completed(kind, kinds)


def kinds() -> tuple[str, ...]:
    """Return the names of all payloads: what --payload takes, without the text behind the colon."""
    return (SIMULATED, SERIAL, *(plugin.name for plugin in entry_points(group=PLUGINS)))


def check(text: str) -> None:
    """Raise ValueError, with what is allowed, unless it is a payload. A plug-in is not loaded."""
    name, colon, _ = text.partition(":")
    if name == SERIAL:
        try:
            parse_address(text)
        except ValueError as error:
            raise ValueError(
                str(error) if "baud" in str(error) else f"{text!r} is not allowed; wanted {WANTED_SERIAL}"
            ) from None
    elif name not in kinds():
        wanted = cli.listing([SIMULATED, WANTED_SERIAL, *kinds()[2:]])
        raise ValueError(cli.not_allowed(text, kinds(), wanted))
    elif name == SIMULATED and colon:
        raise ValueError(f"{text!r} is not allowed; wanted {SIMULATED} alone")
