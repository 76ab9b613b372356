"""`python -m agent`: the agent service alone, on any router; `rollout`, `evaluate`, `train`, `report`."""

if __name__ == "__main__":  # here, because the modules below take long to load
    from link.early import begin

    begin()

import argparse
import importlib
import sys
from concurrent.futures import BrokenExecutor
from contextlib import redirect_stdout
from types import ModuleType

from agent import service
from agent.policies import PolicyError, add_policy_argument, reach
from link import cli
from link.bus.session import Bus
from plume.problem import FARTHEST_M
from plume.problems.fleet import FARTHEST_APART_M
from plume.problems.options import add_problem_argument, problem_of
from plume.randomness import MAX_SEED
from plume.scenario import SEPARATION_M, BrokenFile, NoRelease, WorldError

# Commands with a module of their own. It is imported only for its command: a service starts fast and knows
# nothing of trials.
OTHERS = {
    "evaluate": ("agent.trials.evaluate", "fly many missions in-process and print the policies' figures"),
    "train": ("agent.learn.train.command", "train a policy and write it to a bundle that the agent flies"),
    "report": (
        "agent.trials.report.command",
        "draw tables, figures and a page from the missions of `evaluate`",
    ),
}


def _add_policy_arguments(parser: argparse.ArgumentParser, of: str) -> None:
    add_policy_argument(parser)
    parser.add_argument(
        "--seed", type=cli.whole(0, MAX_SEED), default=0, help=f"seed of the {of} (default: %(default)s)"
    )
    cli.add_reach_arguments(parser)
    add_problem_argument(parser)


def _add_rollout_arguments(parser: argparse.ArgumentParser) -> None:
    from agent.trials.evaluate import add_world_argument
    from estimator.options import add_sensor_argument
    from plume.problems.options import add_fleet_arguments

    _add_policy_arguments(parser, "mission")
    cli.add_filter_arguments(parser)
    add_sensor_argument(parser)
    add_world_argument(parser)
    add_fleet_arguments(parser)
    cli.add_output_arguments(parser)


def _module(command: str) -> ModuleType:
    return importlib.import_module(OTHERS[command][0])


def parse(prog: str, arguments: list[str]) -> argparse.Namespace:
    """Read a command line; exits as argparse does on a wrong one."""
    parser = cli.Parser(prog=prog, description="The agent service alone: beliefs in, waypoints out.")
    cli.add_bus_arguments(parser)
    _add_policy_arguments(parser, "policy's random draws")
    parser.add_argument(
        "--waypoints",
        action="append",
        default=[],
        metavar="STEP:X,Y;X,Y;...",
        help="fly these waypoints instead of the policy's, starting with the answer to the belief of this "
        "step",
    )
    parser.add_argument(
        "--area",
        type=cli.number(0, FARTHEST_M, above=True),
        metavar="M",
        help="side of a square search area with its south-west corner at home, m; the estimator needs the "
        "same (default: the problem's area)",
    )
    parser.add_argument(
        "--sysid",
        type=cli.whole(1, 255),
        metavar="N",
        help="the vehicle's system id (default: the one that the belief tells)",
    )
    parser.add_argument(
        "--separation",
        type=cli.number(0, FARTHEST_APART_M),
        default=SEPARATION_M,
        metavar="M",
        help="least distance between the ways of two vehicles that search together, m (default: %(default)g)",
    )
    commands = parser.add_subparsers(
        dest="command", parser_class=cli.Parser, metavar="rollout | evaluate | train | report"
    )
    rollout = commands.add_parser("rollout", help="fly one mission in-process, without Zenoh")
    if "rollout" in arguments:
        _add_rollout_arguments(rollout)
    for command, (_, help_text) in OTHERS.items():
        other = commands.add_parser(command, help=help_text)
        if command in arguments:
            _module(command).add_arguments(other)
    args = parser.parse_args(arguments)
    try:
        if args.command in ("rollout", "evaluate"):
            from agent.trials.evaluate import choose_problem
            from plume.problems.options import fleet_given

            choose_problem(args)
            args.fleet = fleet_given(args, args.problem)
        if args.command is None:
            args.problem = problem_of(args)
        if args.command in (None, "rollout"):
            args.reach = reach(args.policy, cli.reach_given(args), args.problem)
            args.scripted = {
                step: point
                for text in args.waypoints
                for step, point in service.waypoints(text, args.reach).items()
            }
    except ValueError as error:
        (commands.choices[args.command] if args.command else parser).error(str(error))
    return args


def _rollout(args: argparse.Namespace) -> None:
    from agent.trials.rollout import rollout
    from link.terminal import tell
    from plume.outcome import outcome_json, outcome_text

    (stop,) = args.stops
    with redirect_stdout(sys.stderr):  # for what a plug-in prints: stdout is for the outcome
        result, trace = rollout(
            args.seed,
            args.policy,
            args.particles,
            moves=cli.reach_given(args),
            problem=args.problem,
            world=args.world,
            stop=stop.text,
            vehicles=args.fleet.vehicles,
            formation=args.fleet.formation,
            separation_m=args.fleet.separation_m,
            **args.knowledge,
        )
    tell(outcome_text(result), sys.stderr if args.json else sys.stdout)
    if args.json:
        print(outcome_json(result, trace if args.trace else None))


def _serve(args: argparse.Namespace) -> None:
    with Bus(
        "agent", args.connect, args.namespace, log_level=args.log_level, secure=args.secure, sole=True
    ) as bus:
        service.run(
            bus,
            args.policy,
            args.seed,
            args.problem.budget,
            args.sysid,
            args.reach,
            args.scripted,
            args.separation,
        )


def main(prog: str = "python -m agent", arguments: list[str] | None = None) -> int | None:
    """Parse the command line, then serve, roll out, evaluate, train or report."""
    args = parse(prog, sys.argv[1:] if arguments is None else arguments)
    try:
        if args.command in OTHERS:
            return int(_module(args.command).run(args))
        (_rollout if args.command == "rollout" else _serve)(args)
    except (cli.BadInput, NoRelease, BrokenFile) as error:
        return cli.failed(error, cli.BAD_INPUT)
    except (PolicyError, WorldError) as error:
        for note in getattr(error, "__notes__", ()):  # the traceback of somebody's policy or world
            print(note, file=sys.stderr)
        return cli.failed(error)
    except BrokenExecutor as error:  # of `train`, which judges by a sweep
        return cli.failed(f"{error}. Run the command again: it resumes")
    return None


if __name__ == "__main__":
    cli.run(main)
