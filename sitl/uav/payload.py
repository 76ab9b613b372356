"""`plumeward payload`: the gas sensor of a real autopilot, simulated in the world of a mission or not."""

import argparse

from aircraft.payload import command
from sitl.script.options import add_mission_arguments, script_of


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add its flags."""
    command.add_arguments(parser)
    add_mission_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Answer the vehicle's questions until interrupted."""
    return command.run(args, script_of(args).simulated())
