"""`plumeward certs`: makes a development CA, and certificates for the router, the vehicles and people."""

import argparse
import sys
from collections.abc import Iterable
from itertools import groupby
from pathlib import Path

from link import cli
from link.access.authority import CA, CA_DAYS, REPLACE, ROUTER_NAMES, Made, host, make, risks, unnamed
from link.access.identity import AccessError
from link.access.roles import MOST_IN_A_SEARCH, MOST_SEARCHES, MOST_VEHICLES, ROUTER


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add its flags."""
    parser.add_argument(
        "folder",
        type=cli.path,
        metavar="DIR",
        help="where they are kept; existing certificates stay, the CA above all",
    )
    parser.add_argument(
        "--vehicles",
        type=cli.listed(cli.whole(1, MOST_VEHICLES)),
        default=[1],
        metavar="N,N",
        help="the vehicles, by the number in uav/N (default: 1)",
    )
    parser.add_argument(
        "--search",
        type=cli.whole(1, MOST_SEARCHES),
        metavar="S",
        help="the vehicles search together, with fly --vehicles: they are those of search/S, which gets an "
        "estimator and an agent",
    )
    parser.add_argument(
        "--router",
        type=cli.listed(cli.checked(host)),
        metavar="HOST,HOST",
        help=f"names and addresses at which clients reach the router (default: {','.join(ROUTER_NAMES)})",
    )
    parser.add_argument(
        "--days",
        type=cli.whole(1, CA_DAYS),
        default=365,
        metavar="N",
        help="how long the certificates hold (default: %(default)s)",
    )
    parser.add_argument("--force", action="store_true", help="make all but the CA anew")


def run(args: argparse.Namespace) -> int:
    """Make what is missing and list what there is."""
    if args.search and (highest := max(args.vehicles)) > MOST_IN_A_SEARCH:
        wanted = f"wanted whole numbers from 1 to {MOST_IN_A_SEARCH}"
        return cli.failed(f"--vehicles: {highest} is not allowed with --search; {wanted}", cli.BAD_INPUT)
    try:
        hosts = args.router or ROUTER_NAMES
        made = make(args.folder, args.vehicles, hosts, args.days, search=args.search, force=args.force)
        lacks = unnamed(args.folder, args.router or ())
    except (AccessError, OSError) as error:
        told = (
            f"cannot write {error.filename or args.folder}: {error.strerror}"
            if isinstance(error, OSError)
            else error
        )
        return cli.failed(f"DIR: {told}", cli.BAD_INPUT)
    if lacks:
        told = f"{args.folder / ROUTER}.pem is kept, and does not name {', '.join(lacks)}: {REPLACE}"
        print(f"warning: --router: {told}", file=sys.stderr)
    for risk in risks(args.folder):
        print(f"warning: DIR: {risk}", file=sys.stderr)
    print("\n".join(_summary(args.folder, made)))
    return 0


def _summary(folder: Path, made: Iterable[Made]) -> Iterable[str]:
    for (space, until, new), those in groupby(
        made, lambda one: (one.name.rpartition("/")[0], f"{one.until:%Y-%m-%d}", one.new)
    ):
        names = ", ".join(one.name.rpartition("/")[2] for one in those)
        yield f"{'made' if new else 'kept'}  until {until}  {folder / space}: {names}"
    yield (
        f"Give --secure {folder} to each command. "
        f"To other machines copy {CA}.pem and what they run as, never {CA}.key."
    )
