"""`plumeward`: the one command. It answers signals first, then loads what it needs."""

import os

from link.early import begin


def command() -> None:
    """Run as `plumeward`, the command that an install gives."""
    begin()
    from link import cli
    from plumeward.commands import main

    os.environ["PYTHONSAFEPATH"] = "1"  # child processes ignore an agent.py in the current folder
    cli.run(main)


if __name__ == "__main__":
    command()
