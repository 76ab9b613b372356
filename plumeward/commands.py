"""The commands of `plumeward`: those of `python -m sitl`, and the command lines of the other packages."""

import os
import sys
from importlib import import_module

from link import cli
from link.cli import Command
from plume import __version__
from sitl.__main__ import COMMANDS as OF_SITL

# Commands that the command line of a package parses.
PACKAGES = {
    "rollout": Command("agent", "fly one mission in this process, without a network"),
    "evaluate": Command("agent", "fly many missions and print the policies' figures"),
    "train": Command("agent", "train a policy with PPO, DQN or DDPG"),
    "report": Command("agent", "draw tables and figures from the missions of evaluate"),
    "estimator": Command("estimator", "the estimator: readings in, beliefs and the stop out"),
    "agent": Command("agent", "the agent: beliefs in, waypoints out"),
}
# The commands as the help shows them: by what people want.
GROUPS = {
    "Fly a mission": ("fly", "list"),
    "Look while it flies": ("view", "status", "leave-out"),
    "Analyse a flight": ("findings", "draw", "log", "replay"),
    "Do research": ("rollout", "evaluate", "train", "report", "worlds"),
    "Operate parts by themselves": (
        "router",
        "uav",
        "payload",
        "bridge",
        "estimator",
        "agent",
        "record",
        "ros2",
        "certs",
    ),
}
KNOWN = {
    **OF_SITL,
    **PACKAGES,
    "fly": OF_SITL["fly"]._replace(module="plumeward.flight"),
    "certs": Command("link.certs", "make the certificates that --secure takes"),
    "list": Command("plumeward.choices", "list missions, policies, sensors, assumptions and worlds"),
}
COMMANDS = {name: KNOWN[name] for names in GROUPS.values() for name in names}
# Commands that run the whole command line of a package, not one of its sub-commands.
SERVICES = ("estimator", "agent")
COMPLETION = 'Tab completion in bash or zsh: eval "$(register-python-argcomplete plumeward)"'


def help_text() -> str:
    """Return the help of `plumeward`."""
    lines = [
        "usage: plumeward COMMAND ...",
        "",
        "Fly a drone, simulated or real, to a gas leak. A particle filter locates the",
        "leak and decides when the search may stop.",
        "",
        "Begin with: plumeward fly --view",
    ]
    for group, names in GROUPS.items():
        lines += ["", f"{group}:", *(f"  {name:<10} {COMMANDS[name].does}" for name in names)]
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
    def format_help(self) -> str:
        return help_text()


def _front() -> _Front:
    front = _Front(prog="plumeward")
    front.add_argument("--version", action="version", version=f"plumeward {__version__}")
    cli.front(front, {name: command.does for name, command in COMMANDS.items()})
    return front


def main() -> int | None:
    """Run a command; without one, print the help."""
    words = sys.argv[1:]
    if cli.COMPLETING in os.environ:
        words = _words_to_complete()
    if not words:
        print(help_text(), end="")
        return 0
    if words[0] not in COMMANDS:
        _front().parse_args(words[:1])
    name, command = words[0], COMMANDS[words[0]]
    if name not in PACKAGES:
        return cli.start(f"plumeward {name}", command, words[1:])
    package = import_module(f"{command.module}.__main__")
    prog, rest = (f"plumeward {name}", words[1:]) if name in SERVICES else ("plumeward", words)
    status: int | None = package.main(prog, rest)
    return status


def _words_to_complete() -> list[str]:
    """Return the command whose arguments the shell completes.

    While the command itself is typed, offer commands and exit.
    """
    line = os.environ.get("COMP_LINE", "")[: int(os.environ.get("COMP_POINT", "0"))]
    complete = f"{line}|".split()[:-1]  # without the word that the cursor is in
    start = int(os.environ[cli.COMPLETING])  # the words that `plumeward` itself takes in the line
    words = complete[start : start + 1]
    if not words or words[0] not in COMMANDS:
        _front().parse_args([])  # offers the commands and exits
    if words[0] in SERVICES or words[0] not in PACKAGES:
        os.environ[cli.COMPLETING] = str(start + 1)  # their parsers begin behind the command
    return words
