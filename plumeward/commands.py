"""The commands of `plumeward`: `plumeward fly`, `plumeward evaluate` and the others run the command lines
of the packages.
"""

import argparse
import os
import sys
from importlib import import_module
from typing import Any, NamedTuple

from link import cli
from plume import __version__


class Command(NamedTuple):
    """A command of `plumeward`."""

    package: str
    """The package that runs it."""
    does: str


GROUPS = {
    "Fly a mission": {
        "fly": Command("sitl", "fly one mission, each part a process of its own"),
        "rollout": Command("agent", "fly one mission in this process, without a network"),
        "list": Command("plumeward", "list the missions, policies, sensors, assumptions and worlds"),
    },
    "Look at missions": {
        "view": Command("sitl", "show missions on a page, live or recorded"),
        "status": Command("sitl", "show how the parts of a running mission are doing"),
        "log": Command("sitl", "summarise a log, or print one of its keys as CSV"),
        "draw": Command("sitl", "draw a log as a picture or an animation"),
        "replay": Command("sitl", "feed a log to the estimator and agent again"),
        "record": Command("sitl", "record everything on a bus until interrupted"),
    },
    "Compare and train policies": {
        "evaluate": Command("agent", "fly many missions and print the policies' figures"),
        "train": Command("agent", "train a policy with PPO, DQN or DDPG"),
        "report": Command("agent", "draw tables and figures from the missions of evaluate"),
    },
    "Run one part alone": {
        "router": Command("sitl", "the Zenoh router"),
        "uav": Command("sitl", "the simulated vehicle"),
        "payload": Command("sitl", "the gas sensor of a real autopilot"),
        "bridge": Command("sitl", "ground stations and autopilots over UDP, TCP, serial"),
        "estimator": Command("estimator", "the estimator: readings in, beliefs and the stop out"),
        "agent": Command("agent", "the agent: beliefs in, waypoints out"),
    },
    "Keep strangers out": {
        "certs": Command("link", "make the certificates that --secure takes"),
    },
}
"""The commands as the help shows them."""
COMMANDS = {name: command for group in GROUPS.values() for name, command in group.items()}
SERVICES = ("estimator", "agent")
"""Commands that run the whole command line of a package, not one of its sub-commands."""
COMPLETION = 'Tab completion in bash or zsh: eval "$(register-python-argcomplete plumeward)"'


def help_text() -> str:
    """Return the help of `plumeward`."""
    lines = [
        "usage: plumeward COMMAND ...",
        "",
        "Fly a simulated drone to a gas leak. A particle filter locates the leak",
        "and decides when the search may stop.",
    ]
    for group, commands in GROUPS.items():
        lines += ["", f"{group}:", *(f"  {name:<10} {command.does}" for name, command in commands.items())]
    lines += [
        "",
        "Options:",
        "  -h, --help  show this help; plumeward COMMAND --help shows a command's",
        "  --version   show the version",
        "",
        COMPLETION,
        "",
    ]
    return "\n".join(lines)


class _Front(cli.Parser):
    """The parser of `plumeward` itself."""

    def format_help(self) -> str:
        return help_text()


def _parser() -> argparse.ArgumentParser:
    parser = _Front(prog="plumeward")
    parser.add_argument("--version", action="version", version=f"plumeward {__version__}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True, parser_class=cli.Parser)
    for name, command in COMMANDS.items():
        commands.add_parser(name, help=command.does, add_help=False)
    return parser


def main() -> int | None:
    """Hand the command line to the package that runs the command."""
    words = sys.argv[1:]
    if cli.COMPLETING in os.environ:
        words = _words_to_complete()
    if not words:
        print(help_text(), end="")
        return 0
    if words[0] not in COMMANDS:
        _parser().parse_args(words[:1])
    return _run(words[0], words[1:])


def _run(name: str, words: list[str]) -> int | None:
    status: int | None
    if name == "list":
        from plumeward import choices

        return choices.main(words)
    package = import_module(f"{COMMANDS[name].package}.__main__")
    if name in SERVICES:
        status = package.main(f"plumeward {name}", words)
    elif name == "fly":
        status = package.main("plumeward", [name, *words], **_policies())
    else:
        status = package.main("plumeward", [name, *words])
    return status


def _policies() -> dict[str, Any]:
    """Return the arguments by which `fly`, which must not import the agent, learns the policies."""
    from agent.policies import check, named

    return {"check_policy": check, "policies": named}


def _words_to_complete() -> list[str]:
    """Return the command whose arguments the shell completes. While the command itself is typed, offer
    commands and exit.
    """
    line = os.environ.get("COMP_LINE", "")[: int(os.environ.get("COMP_POINT", "0"))]
    complete = f"{line}|".split()[:-1]  # without the word that the cursor is in
    start = int(os.environ[cli.COMPLETING])  # the words that `plumeward` itself takes in the line
    words = complete[start : start + 1]
    if not words or words[0] not in COMMANDS:
        _parser().parse_args([])  # offers the commands and exits
    if words[0] in (*SERVICES, "list"):
        os.environ[cli.COMPLETING] = str(start + 1)  # their parsers begin behind the command
    return words
