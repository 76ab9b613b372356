"""`plumeward fly`: as `python -m sitl fly`, and it knows the policies, so it refuses a wrong one at once."""

import argparse

from agent.policies import check, named
from sitl.launch import command

run = command.run


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add its flags."""
    command.add_arguments(parser, check, named)
