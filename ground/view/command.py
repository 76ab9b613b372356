"""`plumeward view`: serves the page of a running stack or of records."""

import argparse
import asyncio
import json
import socket
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import msgspec

from ground.view.access import origin, word_in
from link import cli
from link.bus.opening import DEFAULT_ROUTER
from plume.randomness import MAX_SEED
from plume.worlds.names import check, kinds
from scene.follow.described import outlines
from sitl.script.script import Script, load, shipped

PORT = 8447


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add its flags."""
    logs = parser.add_argument(
        "logs",
        nargs="*",
        type=cli.path,
        metavar="LOG",
        help="a record, or two to compare; without one: a live stack",
    )
    cli.completed(logs, tuple, "mcap")
    parser.add_argument(
        "-e",
        "--connect",
        metavar="ENDPOINT",
        default=DEFAULT_ROUTER,
        help="the Zenoh router of the vehicles to show (default: %(default)s)",
    )
    cli.add_secure_argument(parser)
    parser.add_argument(
        "--host",
        metavar="ADDRESS",
        default="127.0.0.1",
        help="where to serve the page (default: %(default)s)",
    )
    parser.add_argument(
        "--port",
        type=cli.whole(0, 65535),
        default=PORT,
        metavar="N",
        help="0: a free port (default: %(default)s)",
    )
    parser.add_argument(
        "--token-file",
        type=cli.path,
        metavar="FILE",
        help="allow commands only to those who enter the word in this file; if there is none, it is made "
        "with a new word",
    )
    parser.add_argument("--token", type=_gone, help=argparse.SUPPRESS)
    parser.add_argument(
        "--origin",
        type=cli.checked(origin),
        action="append",
        default=[],
        metavar="URL",
        help="allow those who come from here, too: a proxy before the page, a web page that shows "
        "--foxglove; may be repeated",
    )
    parser.add_argument("--open", action="store_true", help="open the page in a browser")
    parser.add_argument(
        "--foxglove",
        type=cli.whole(0, 65535),
        metavar="N",
        help="stream the scenes to Foxglove, too, on this local port",
    )
    truth = "simulation only: the truth to show of the first vehicle is that of"
    parser.add_argument("--seed", type=cli.whole(0, MAX_SEED), metavar="S", help=f"{truth} this seed")
    world = parser.add_argument(
        "--world", type=cli.checked(check), metavar="NAME", help=f"{truth} this world"
    )
    cli.completed(world, kinds)
    mission = parser.add_argument("--mission", metavar="MISSION", help=f"{truth} this mission script")
    cli.completed(mission, shipped, "yaml", "yml")
    parser.add_argument("--about", type=json.loads, help=argparse.SUPPRESS)


def _gone(_: str) -> str:
    raise argparse.ArgumentTypeError(
        "not allowed any more: everyone on this machine can read it there; wanted --token-file FILE"
    )


def run(args: argparse.Namespace) -> int:
    """Serve until interrupted; a line on stdout says where. Raises BadInput."""
    from ground.view.foxglove import HOST
    from ground.view.host import serve
    from link.record.reader import RecordError

    _check(args)
    args.about = _about(args)
    word = _word(args.token_file) if args.token_file else ""
    with ExitStack() as stack:
        page = stack.enter_context(_listening("--port", args.host, args.port))
        asked = args.foxglove is not None
        local = stack.enter_context(_listening("--foxglove", HOST, args.foxglove)) if asked else None
        try:
            return asyncio.run(serve(args, word, page, local))
        except RecordError as error:
            raise cli.BadInput(str(error)) from None


def _word(path: Path) -> str:
    """Return the word that allows commands, and say what people should know of its file. Raises BadInput."""
    try:
        word, line = word_in(path)
    except ValueError as error:
        raise cli.BadInput(f"--token-file: {error}") from None
    if line:
        print(line, file=sys.stderr, flush=True)
    return word


def _check(args: argparse.Namespace) -> None:
    """Raise BadInput for flags that do not go together."""
    if not args.host:
        raise cli.BadInput("--host: '' is not allowed; wanted an address of this machine")
    if len(args.logs) > 2:
        raise cli.BadInput("LOG: three or more records are not allowed; wanted one, or two to compare")
    if args.logs and args.foxglove is not None:
        raise cli.BadInput("--foxglove: not with LOG: Foxglove opens records itself")


def _about(args: argparse.Namespace) -> dict[str, Any]:
    """Return the description of the run, if one was given. Raises BadInput."""
    truth = {name: args.given[name] for name in ("mission", "seed", "world") if name in args.given}
    if not truth:
        return args.about or {}
    if args.logs:
        raise cli.BadInput(f"--{next(iter(truth))}: not with LOG: a record holds its own truth")
    mission = load(truth.pop("mission")) if args.mission else Script()
    script = mission.changed(truth)
    return dict(
        msgspec.to_builtins(
            {
                "mission": script,
                "problem": script.problem,
                "scenario": script.simulated().truth,
                "seed": script.seed,
                "walls": outlines(script.world),
            }
        )
    )


def _listening(flag: str, host: str, port: int) -> socket.socket:
    """Return a socket that listens on a port, 0 for any free one. Raises BadInput."""
    try:
        return socket.create_server(
            (host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET, backlog=64
        )
    except OSError as error:
        raise cli.BadInput(
            f"{flag}: cannot serve on {host} port {port}: {str(error.strerror).partition(' (while')[0]}"
        ) from None
