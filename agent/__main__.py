"""`python -m agent`: the agent service alone, on any router; `rollout`, `evaluate`, `train`, `report`."""

import argparse
import sys
import traceback

from agent.evaluate import add_arguments as add_evaluate_arguments
from agent.evaluate import run as evaluate
from agent.policies import PolicyError, named, policy_argument, reach
from agent.report import add_arguments as add_report_arguments
from agent.report import run as report
from agent.service import waypoints
from agent.train import add_arguments as add_train_arguments
from agent.train import run as train
from estimator.options import add_sensor_argument, knowledge
from link import cli
from link.bus import Bus
from plume.randomness import MAX_SEED
from plume.scenario import BUDGET_STEPS


def _add_policy_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--policy",
        type=policy_argument,
        default="infotaxis",
        metavar="NAME",
        help=f"how to choose waypoints: {', '.join(named())}, or a bundle, FILE.zip (default: %(default)s)",
    )
    parser.add_argument(
        "--seed", type=cli.whole(0, MAX_SEED), default=0, help="of the policy's draws; of the mission in a rollout (default: %(default)s)"
    )
    cli.add_reach_arguments(parser, BUDGET_STEPS)


def _parse() -> argparse.Namespace:
    parser = cli.Parser(prog="python -m agent", description="Beliefs in, waypoints out.")
    cli.add_bus_arguments(parser)
    _add_policy_arguments(parser)
    parser.add_argument(
        "--waypoints", type=waypoints, action="append", default=[], metavar="STEP:X,Y;X,Y;...",
        help="fly these instead of the policy's, from the answer to this step's belief on",
    )  # fmt: skip
    parser.add_argument("--sysid", type=cli.whole(1, 255), default=1, help="MAVLink system id of the vehicle (default: %(default)s)")
    commands = parser.add_subparsers(dest="command", parser_class=cli.Parser, metavar="rollout | evaluate | train | report")
    rollout = commands.add_parser("rollout", help="fly one mission in-process, without Zenoh")
    _add_policy_arguments(rollout)
    cli.add_filter_arguments(rollout)
    add_sensor_argument(rollout)
    cli.add_output_arguments(rollout)
    evaluate = commands.add_parser("evaluate", help="the figures of policies over many missions, in-process")
    add_evaluate_arguments(evaluate)
    add_train_arguments(commands.add_parser("train", help="learn a policy, and write it down as a bundle that the agent flies"))
    add_report_arguments(commands.add_parser("report", help="tables, pictures and a page from the missions that `evaluate` flew"))
    args = parser.parse_args()
    if args.command in ("rollout", "evaluate"):
        try:
            args.knowledge = knowledge(args)
        except ValueError as error:
            commands.choices[args.command].error(str(error))
    if args.command in (None, "rollout"):
        try:
            args.reach = reach(args.policy, cli.reach_given(args))
        except ValueError as error:
            (commands.choices[args.command] if args.command else parser).error(str(error))
    return args


def _rollout(args: argparse.Namespace) -> None:
    from agent.rollout import rollout
    from plume.outcome import outcome_json, outcome_text

    result, trace = rollout(args.seed, args.policy, args.particles, args.threshold, args.budget, cli.reach_given(args), **args.knowledge)
    print(outcome_text(result), file=sys.stderr)
    if args.json:
        print(outcome_json(result, trace if args.trace else None))


def main() -> int | None:
    """Parse the command line, then serve, roll out, evaluate, train or report."""
    args = _parse()
    try:
        return _run(args)
    except PolicyError as error:
        if error.__cause__:
            traceback.print_exception(error.__cause__)
        print(f"error: {error}", file=sys.stderr)
        return cli.FAILED


def _run(args: argparse.Namespace) -> int | None:
    if args.command == "evaluate":
        return evaluate(args)
    if args.command == "train":
        return train(args)
    if args.command == "report":
        return report(args)
    if args.command == "rollout":
        _rollout(args)
        return None
    from agent.service import run

    with Bus("agent", args.connect, args.namespace, log_level=args.log_level) as bus:
        scripted = {step: point for path in args.waypoints for step, point in path.items()}
        run(bus, args.policy, args.seed, args.budget, args.sysid, args.reach, scripted)
    return None


if __name__ == "__main__":
    cli.run(main)
