"""`python -m estimator`: the estimator service alone, on any router."""

if __name__ == "__main__":  # here, because the modules below take long to load
    from link.early import begin

    begin()

import math

from estimator.options import add_sensor_argument, criteria, knowledge
from link import cli
from link.bus.session import Bus
from plume.parameters import LIMITS
from plume.problem import FARTHEST_M
from plume.problems.options import add_problem_argument, problem_of
from plume.randomness import MAX_SEED


def main(prog: str = "python -m estimator", arguments: list[str] | None = None) -> None:
    """Parse the command line and serve."""
    parser = cli.Parser(
        prog=prog, description="The estimator service alone: readings in, beliefs and the stop (AGDC) out."
    )
    cli.add_bus_arguments(parser)
    cli.add_filter_arguments(parser)
    add_sensor_argument(parser)
    add_problem_argument(parser)
    parser.add_argument(
        "--seed",
        type=cli.whole(0, MAX_SEED),
        default=0,
        help="seed of the filter's random draws (default: %(default)s)",
    )
    parser.add_argument(
        "--rate",
        type=cli.number(*LIMITS["q"]),
        default=300.0,
        metavar="Q",
        help="release rate q, g/s (default: %(default)g)",
    )
    parser.add_argument(
        "--diffusivity",
        type=cli.number(*LIMITS["d"]),
        default=4.5,
        metavar="D",
        help="diffusivity d, m²/s (default: %(default)g)",
    )
    parser.add_argument(
        "--lifetime",
        type=cli.number(*LIMITS["tau"]),
        default=10.0,
        metavar="TAU",
        help="lifetime τ of the gas, s (default: %(default)g)",
    )
    parser.add_argument(
        "--area",
        type=cli.number(0, FARTHEST_M, above=True),
        metavar="M",
        help="side of a square search area with its south-west corner at home, m (default: the problem's "
        "area)",
    )
    parser.add_argument(
        "--sysid",
        type=cli.whole(1, 255),
        metavar="N",
        help="the vehicle's system id, of several that of the first, those of the others follow it (default: "
        "the first reading's)",
    )
    cli.add_vehicles_argument(parser)
    parser.add_argument(
        "--overdue",
        type=cli.number(0, math.inf),
        default=20.0,
        metavar="S",
        help="of several vehicles, one for which the others have waited S real seconds leaves the search; 0: "
        "they wait without end (default: %(default)g)",
    )
    cli.add_doubted_argument(parser)
    args = parser.parse_args(arguments)
    if args.sysid and args.sysid + args.vehicles > 256:
        parser.error(
            f"--sysid: {args.sysid} is not allowed with --vehicles {args.vehicles}; wanted 1 to "
            f"{256 - args.vehicles}: the others' follow it, and 255 is the last"
        )
    try:
        problem = problem_of(args)
        known, (stop,) = knowledge(args, problem), criteria(args, problem)
    except ValueError as error:
        parser.error(str(error))

    from estimator.filter import Config  # loads or compiles the kernels, so only for a good command line
    from estimator.service import run

    config = Config(
        args.particles,
        stop.threshold_m,
        args.seed,
        args.rate,
        args.diffusivity,
        args.lifetime,
        problem.ground,
        within=stop.within,
        expected=problem.support,
        **known,
    )
    with Bus(
        "estimator",
        args.connect,
        cli.namespace_of(args, args.vehicles > 1),
        log_level=args.log_level,
        announced=False,  # until its health says for how many vehicles it is
        secure=args.secure,
        sole=True,
        vehicles=cli.numbers(args.vehicles),
    ) as bus:
        systems = [args.sysid and args.sysid + other for other in range(args.vehicles)]
        run(bus, config, systems, args.overdue, args.doubted == cli.LEAVE_OUT)


if __name__ == "__main__":
    cli.run(main)
