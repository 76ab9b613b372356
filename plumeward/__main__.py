"""`plumeward`: the one command; `plumeward fly`, `plumeward evaluate` and the others run the parts' own command lines."""

import os
import sys
from importlib import import_module
from typing import NoReturn

from link import cli
from plume import __version__

COMMANDS = {
    "fly": ("sitl", "fly one mission: router, uav, estimator and agent as processes"),
    "replay": ("sitl", "fly a log again: what the vehicle said then, to services that run now"),
    "log": ("sitl", "what a log holds: a summary, or one key as CSV"),
    "status": ("sitl", "how the parts of a mission are doing"),
    "rollout": ("agent", "fly one mission in-process, without Zenoh"),
    "evaluate": ("agent", "the figures of policies over many missions"),
    "train": ("agent", "learn a policy, and write it down as a bundle that the agent flies"),
    "report": ("agent", "tables, pictures and a page from the missions that `evaluate` flew"),
    "router": ("sitl", "a Zenoh router alone"),
    "uav": ("sitl", "the simulated vehicle alone"),
    "estimator": ("estimator", "the estimator service alone"),
    "agent": ("agent", "the agent service alone"),
    "record": ("sitl", "record all that is said on a bus, until interrupted"),
}
"""Each command, the package that runs it, and what it does."""


def main() -> int | None:
    """Hand the command line to the package that runs the command."""
    parser = cli.Parser(prog="plumeward", description="Fly a simulated drone to a gas leak, and know when it has been found.")
    parser.add_argument("--version", action="version", version=f"plumeward {__version__}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    for command, (_, does) in COMMANDS.items():
        commands.add_parser(command, help=does, add_help=False)
    words = sys.argv[1:]
    if not words:
        parser.print_help()
        return 0
    if words[0] not in COMMANDS:
        parser.parse_args(words[:1])
    package = COMMANDS[words[0]][0]
    alone = words[0] == package  # a service has no command of its own
    status: int | None = import_module(f"{package}.__main__").main(
        f"plumeward {package}" if alone else "plumeward", words[1:] if alone else words
    )
    return status


def command() -> NoReturn:
    """Run as `plumeward`, the command that an install gives."""
    os.environ["PYTHONSAFEPATH"] = "1"  # the parts are the installed ones, whatever an agent.py in this folder is
    cli.run(main)


if __name__ == "__main__":
    cli.run(main)
