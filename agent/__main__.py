"""`python -m agent`: the agent service alone, on any router; `python -m agent rollout`: a mission in-process."""

import argparse
import sys

from agent.planners import PLANNERS
from estimator.options import add_sensor_argument, knowledge
from link import cli
from link.bus import Bus
from plume.randomness import MAX_SEED
from plume.scenario import BUDGET_STEPS


def _add_policy_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--policy", choices=PLANNERS, default="infotaxis", help="how to choose waypoints: %(choices)s (default: %(default)s)"
    )
    parser.add_argument(
        "--budget",
        type=cli.whole(1, 1_000_000),
        default=BUDGET_STEPS,
        metavar="STEPS",
        help="moves before giving up (default: %(default)s)",
    )
    parser.add_argument(
        "--seed", type=cli.whole(0, MAX_SEED), default=0, help="of the policy's draws; of the mission in a rollout (default: %(default)s)"
    )


def _parse() -> argparse.Namespace:
    parser = cli.Parser(prog="python -m agent", description="Beliefs in, waypoints out.")
    cli.add_bus_arguments(parser)
    _add_policy_arguments(parser)
    parser.add_argument("--sysid", type=cli.whole(1, 255), default=1, help="MAVLink system id of the vehicle (default: %(default)s)")
    commands = parser.add_subparsers(dest="command", parser_class=cli.Parser, metavar="rollout")
    rollout = commands.add_parser("rollout", help="fly one mission in-process, without Zenoh")
    _add_policy_arguments(rollout)
    cli.add_filter_arguments(rollout)
    add_sensor_argument(rollout)
    cli.add_output_arguments(rollout)
    args = parser.parse_args()
    if args.command == "rollout":
        try:
            args.knowledge = knowledge(args)
        except ValueError as error:
            rollout.error(str(error))
    return args


def _rollout(args: argparse.Namespace) -> None:
    from agent.rollout import rollout
    from plume.outcome import outcome_json, outcome_text

    result, trace = rollout(args.seed, args.policy, args.particles, args.threshold, args.budget, **args.knowledge)
    print(outcome_text(result), file=sys.stderr)
    if args.json:
        print(outcome_json(result, trace if args.trace else None))


def main() -> None:
    """Parse the command line, then serve or roll out."""
    args = _parse()
    if args.command == "rollout":
        _rollout(args)
        return
    from agent.service import run

    with Bus("agent", args.connect, args.namespace) as bus:
        run(bus, args.policy, args.seed, args.budget, args.sysid)


if __name__ == "__main__":
    cli.run(main)
