"""`plumeward findings`: what a flight has found, as documents for people and for other programs."""

import argparse
import json
import math
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from ground.findings.background import Background, BackgroundError, background
from ground.findings.documents import DOCUMENTS, write
from ground.findings.exchange import figures_json
from ground.findings.figures import Findings, findings_of
from ground.findings.flight import Flight, flight_of
from ground.findings.page import sentence
from link import cli
from link.files import drop_if_empty
from link.record.reader import RecordError, is_record
from link.terminal import tell
from scene.follow.described import problem_of
from scene.scene import Point


def _bounds(text: str) -> tuple[float, float, float, float]:
    try:
        west, south, east, north = (float(part) for part in text.split(","))
    except ValueError:
        west = south = east = north = math.nan
    if not (-180 <= west <= 180 and west < east <= 360 + west and -90 <= south < north <= 90):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not allowed; wanted WEST,SOUTH,EAST,NORTH in degrees, WEST below EAST, which may "
            "be above 180, and SOUTH below NORTH"
        )
    return west, south, east, north


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add its flags."""
    parser.add_argument(
        "log", metavar="RECORD", type=cli.path, help="an .mcap written by a mission or `record`"
    )
    parser.add_argument(
        "--out",
        type=cli.path,
        metavar="DIR",
        help=f"folder of the documents: {', '.join(DOCUMENTS)} (default: RECORD-findings beside the record)",
    )
    parser.add_argument(
        "--background",
        type=cli.path,
        metavar="IMAGE",
        help="picture under the map: a GeoTIFF, or a PNG or JPEG with a world file beside it or --bounds",
    )
    parser.add_argument(
        "--bounds",
        type=_bounds,
        metavar="WEST,SOUTH,EAST,NORTH",
        help="with --background: the image's edges, degrees",
    )
    cli.add_output_guard(parser)
    parser.add_argument(
        "--json", action="store_true", help="print the figures as one JSON object on the last line of stdout"
    )


def run(args: argparse.Namespace) -> int:
    """Write the documents; returns the exit status: 1 if pieces of the record are missing.

    Raises BadInput.
    """
    if args.bounds and not args.background:
        raise cli.BadInput("--bounds: only with --background")
    try:
        if not is_record(args.log):
            raise cli.BadInput(
                f"{args.log} is not a record of a search; of a log of an autopilot `plumeward replay "
                f"{args.log} --findings DIR` makes findings"
            )
        flight = flight_of(args.log)
    except RecordError as error:
        raise cli.BadInput(str(error)) from None
    picture = _background(args, flight)
    folder = args.out or args.log.with_name(f"{args.log.stem}-findings")
    cli.make_folder("--out", folder, DOCUMENTS, args.force)
    it = save(flight, folder, picture)
    results = sys.stderr if args.json else sys.stdout
    tell(f"{sentence(it)}\nfindings {folder / 'findings.html'}", results)
    if flight.remark:
        tell(f"warning: {args.log} {flight.remark}")
    if args.json:
        print(json.dumps(json.loads(figures_json(it))))
    return cli.FAILED if flight.is_damaged else 0


def save(flight: Flight, folder: Path, picture: Background | None = None) -> Findings:
    """Write the documents of a flight, and return its findings; without documents the folder goes, too.

    Raises BadInput if the folder does not take them.
    """
    try:
        it = findings_of(flight, _watched)
        write(it, folder, picture)
        return it
    except OSError as error:
        raise cli.BadInput(f"{folder}: {error.strerror}") from None
    finally:
        drop_if_empty(folder)


def _watched(places: Sequence[Point]) -> Iterable[Point]:
    """Give the places of the smallest rates, and tell on stderr that they are sought."""
    from rich.console import Console
    from rich.progress import track

    what, console = "the smallest rate that would have been seen", Console(stderr=True)
    if console.is_terminal:
        return track(places, what, console=console, transient=True)
    tell(f"looking for {what}, at {len(places)} places")
    return places


def _background(args: argparse.Namespace, flight: Flight) -> Background | None:
    if args.background is None:
        return None
    if flight.home is None:
        raise cli.BadInput(f"--background: {args.log} does not say where on earth its area lies")
    try:
        return background(args.background, flight.home, args.bounds, problem_of(flight.about).area)
    except BackgroundError as error:
        raise cli.BadInput(f"--background: {error}") from None
