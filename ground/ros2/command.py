"""`plumeward ros2`: shows a vehicle and its search to ROS 2, without ROS."""

import argparse
import os

from link import cli
from link.access.roles import MOST_DOMAIN

DISTRIBUTIONS = ("humble", "jazzy", "kilted", "lyrical")
DOMAIN = "ROS_DOMAIN_ID"  # the environment variable that ROS reads


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add its flags."""
    parser.add_argument(
        "--domain",
        type=cli.whole(0, MOST_DOMAIN),
        metavar="N",
        help=f"the ROS domain (default: that of {DOMAIN}, else 0)",
    )
    parser.add_argument(
        "--distro",
        choices=DISTRIBUTIONS,
        default="jazzy",
        help="the distribution of the nodes that listen; only humble differs from the others (default: "
        "%(default)s)",
    )
    parser.add_argument(
        "--commands",
        action="store_true",
        help="obey goal_pose, pause and abort, too; without it nothing that ROS says reaches the vehicle",
    )
    cli.add_bus_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Translate until interrupted; a line on stderr says under which names. Raises BadInput."""
    domain = _domain() if args.domain is None else args.domain
    try:
        from ground.ros2.service import Ros
        from ground.ros2.wire import Wire
    except ModuleNotFoundError as error:
        if error.name not in ("rosbags", "xxhash"):
            raise
        raise cli.BadInput(
            f"ros2 needs the package {error.name}: install it with: pip install 'plumeward[ros2]'"
        ) from None
    from contextlib import closing

    from link.interrupts import on_end
    from link.record.tap import Tap

    wire = Wire(args.distro)
    usual = {"log_level": args.log_level, "secure": args.secure, "sole": True}
    with (
        Tap("ros2", args.connect, args.namespace, **usual) as bus,
        closing(Ros(bus, wire, args.namespace, domain, args.connect, args.secure, args.commands)) as ros,
    ):
        on_end(lambda _: ros.end())  # before it says that it is there: whoever reads that may end it
        bus.tally.state = "translating"
        bus.tally.about = f"ROS domain {domain}, {ros.node.namespace}"
        obeys = "it obeys commands" if args.commands else "it takes no commands"
        bus.log.info(
            f"{args.namespace} at {args.connect} is {ros.node.namespace} in ROS domain {domain}, as "
            f"{args.distro} has it; {obeys}"
        )
        bus.tell_fleet()
        bus.publish_health()
        ros.run()
    return 0


def _domain() -> int:
    """Return the domain of the environment. Raises BadInput."""
    text = os.environ.get(DOMAIN, "") or "0"
    try:
        return cli.whole(0, MOST_DOMAIN)(text)
    except argparse.ArgumentTypeError as error:
        raise cli.BadInput(f"{DOMAIN}: {error}") from None
