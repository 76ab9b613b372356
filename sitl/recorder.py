"""`python -m sitl record`: the recorder."""

import argparse


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add its flags."""


def run(args: argparse.Namespace) -> int:
    """Run it."""
    return 0
