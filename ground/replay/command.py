"""`plumeward replay`: a log takes the place of the vehicle.

`--verify` compares the services' answers with the recorded ones.
"""

import argparse
import math
import sys
import time
from functools import partial

import msgspec

from ground.findings.command import save
from ground.findings.documents import DOCUMENTS
from ground.findings.flight import gathered, home_of
from ground.findings.page import sentence
from ground.replay.player import Player, replay
from ground.replay.source import Source, find
from ground.replay.verify import Rules
from link import cli
from link.files import drop_if_empty
from link.record.reader import Recording, read
from link.terminal import tell
from plume import __version__
from plume.outcome import UNITS, assumed_text, gas_lines, on_earth, outside_text, verdict
from plume.parameters import LIMITS, MOST
from plume.randomness import MAX_SEED
from plume.sensors import names as sensor
from sitl.launch.processes import MissionFailed
from sitl.launch.recording import RecordFiles, give_up


def _pair(names: str, text: str) -> tuple[float, float]:
    try:
        one, two = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not allowed; wanted {names}, two numbers") from None
    return one, two


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add its flags."""
    seconds, positive = cli.number(0, math.inf), cli.number(0, math.inf, above=True)
    parser.add_argument(
        "log",
        metavar="LOG",
        type=cli.path,
        help="an .mcap that a mission or `record` wrote, any autopilot's .tlog, .bin or .ulg, or a table of "
        "positions and gas (.csv)",
    )
    parser.add_argument(
        "-e",
        "--connect",
        metavar="ENDPOINT",
        help="act only as the vehicle, on this router (default: also start router, estimator and agent with "
        "their recorded flags)",
    )
    parser.add_argument(
        "--policy",
        metavar="FILE.zip",
        help="the bundle that the recorded agent flew: a record never names a file to load",
    )
    parser.add_argument(
        "--namespace",
        metavar="NAME",
        help="the vehicle's key prefix (default: the recorded one; with --connect uav/1)",
    )
    cli.add_secure_argument(parser)
    parser.add_argument(
        "--speedup",
        type=cli.number(0, 1000),
        default=1.0,
        metavar="X",
        help="1 for the recorded pace, 0 for as fast as possible (default: 1)",
    )
    parser.add_argument(
        "--from",
        type=seconds,
        default=0.0,
        metavar="S",
        dest="from_s",
        help="skip this many seconds of simulation time",
    )
    parser.add_argument(
        "--to",
        type=seconds,
        default=math.inf,
        metavar="S",
        dest="to_s",
        help="end at this simulation time, from the beginning of the log",
    )
    parser.add_argument(
        "--loop", action="store_true", help="repeat, each time with new services; not with --connect"
    )
    parser.add_argument(
        "--verify",
        action="store_true",
        help="compare with the recorded answers: status 0, or 1 and the first difference",
    )
    parser.add_argument(
        "--ignore",
        action="append",
        default=[],
        metavar="FIELD",
        help="with --verify: ignore a field such as belief.p_value, the particles, or all of belief, stop or "
        "waypoint",
    )
    parser.add_argument(
        "--tolerance",
        type=seconds,
        default=0.0,
        metavar="X",
        help="with --verify: largest difference of numbers that is accepted (default: 0)",
    )
    parser.add_argument(
        "--json", action="store_true", help="print the result as one JSON object on the last line of stdout"
    )
    parser.add_argument(
        "--record",
        type=cli.file_ending(".mcap"),
        metavar="FILE.mcap",
        help="tlog, csv: record the replay, with the beliefs, as a mission's record",
    )
    parser.add_argument(
        "--findings",
        type=cli.path,
        metavar="DIR",
        help="tlog, csv: write what has been found into this folder: a page, GeoJSON, KML, CSV and JSON",
    )
    cli.add_output_guard(parser)
    parser.add_argument(
        "--sysid",
        type=cli.whole(1, 255),
        metavar="N",
        help="tlog: which vehicle (default: the one of most positions)",
    )
    parser.add_argument(
        "--gas",
        metavar="NAME",
        help="tlog: message of the gas readings, NAME or MESSAGE.FIELD, of another unit NAME@ppm "
        "(default: gas)",
    )
    parser.add_argument(
        "--wind",
        type=partial(_pair, "SPEED,FROM"),
        metavar="SPEED,FROM",
        help="tlog, csv: wind to use instead of the log's, m/s and the direction it comes from in degrees",
    )
    parser.add_argument(
        "--every",
        type=positive,
        metavar="S",
        help="tlog, csv: time between two readings (default: 1 s; all readings that a record holds; "
        "longer for a long table)",
    )
    parser.add_argument(
        "--origin",
        type=partial(_pair, "NORTH,EAST"),
        metavar="NORTH,EAST",
        help="tlog, csv: south-western corner of the search area, m in the log's local frame, of a "
        "table from its first position (default: home, if the readings lie in the area then, else around the "
        "flight)",
    )
    parser.add_argument(
        "--area",
        type=positive,
        metavar="M",
        help="tlog, csv: side of the search area (default: around the flight)",
    )
    parser.add_argument(
        "--plume", metavar="MISSION", help="tlog: simulate the gas along the path with this mission's plume"
    )
    parser.add_argument(
        "--columns",
        metavar="PRESET,NAME=COLUMN@UNIT",
        help="csv: what its columns are: skyhub, gasflux, or "
        "time=…,lat=…,lon=…,gas=COLUMN@UNIT,wind=…,from=… (default: the preset that its first row is like)",
    )
    parser.add_argument(
        "--background",
        type=cli.number(-MOST, MOST),
        metavar="G",
        help="tlog, csv: gas in clean air, subtracted, in the log's unit (default: that of the flight's "
        "clean air)",
    )
    parser.add_argument(
        "--ray",
        type=cli.number(0.1, 1000),
        metavar="M",
        help="csv: of gas in ppm*m, how long the sensor's path straight down is (default: the table's)",
    )
    cli.add_filter_arguments(parser)
    for flag, name, metavar, what in (
        (
            "--rate",
            "q",
            "Q",
            "release rate q (default: the plume's; of gas in a unit unknown, 1 kg/h; else 300 g/s)",
        ),
        ("--diffusivity", "d", "D", "diffusivity d (default: the plume's, or 4.5 m²/s)"),
        ("--lifetime", "tau", "TAU", "lifetime τ of the gas (default: the plume's, or 10 s)"),
    ):
        parser.add_argument(flag, type=cli.number(*LIMITS[name]), metavar=metavar, help=what)
    parser.add_argument(
        "--sensor",
        type=cli.checked(sensor.parse),
        metavar="KIND[:NUMBERS]",
        help="gaussian, threshold or hits, each with its numbers if wanted (default: the plume's; of gas in "
        "a unit gaussian or tdlas, with the noise of this flight; else gaussian)",
    )
    parser.add_argument(
        "--seed",
        type=cli.whole(0, MAX_SEED),
        metavar="N",
        help="seed of the filter's random draws (default: 0)",
    )


def run(args: argparse.Namespace) -> int:
    """Replay once, or until interrupted; raises BadInput.

    Returns the exit status: 1 if something differs, or if pieces of the log are missing.
    """
    if args.findings and args.loop:
        raise cli.BadInput("--findings: not with --loop, which never comes to an end")
    source, rules = find(args)
    files = RecordFiles(args.record) if args.record else None
    if files:
        files.prepare(args.force)
        files.made = True  # as soon as its recorder runs
    if args.findings:
        if source.recorded:
            raise cli.BadInput(
                f"--findings: {args.log} is a record: plumeward findings {args.log} writes them"
            )
        cli.make_folder("--findings", args.findings, DOCUMENTS, args.force)
    for note in source.notes:
        tell(f"replay: {note}")
    try:
        while True:
            began = time.monotonic()
            result = replay(
                source, rules, args.speedup, args.connect, args.secure, files.path if files else None
            )
            tell(
                _text(result, source, rules, time.monotonic() - began),
                sys.stderr if args.json else sys.stdout,
            )
            if result.difference or not args.loop:
                break
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        give_up(files, args.findings)
        raise
    except MissionFailed as failure:
        print(f"error: {failure}", file=sys.stderr)
        give_up(files, args.findings)
        return failure.status
    except Exception:  # it was refused, such as by a router
        give_up(files, args.findings)
        raise
    if files:
        if trouble := files.take_place():
            tell(f"warning: {trouble}", sys.stderr)
        files.tell(sys.stderr if args.json else sys.stdout)
    if args.findings:
        _write_findings(result, source, args)
    if args.json:
        print(_json(result, source, rules))
    return cli.FAILED if result.difference or source.damaged else 0


def _write_findings(result: Player, source: Source, args: argparse.Namespace) -> None:
    """Write the findings of a log that was replayed. Raises BadInput."""
    about = {**source.about, "versions": {"plumeward": __version__}}
    heard = Recording(about, [*source.entries, *result.said], complete=True)
    flight = gathered(heard, source.path, replayed_at=source.home)
    if flight is None:
        drop_if_empty(args.findings)
        raise cli.BadInput(f"--findings: no belief was received for {args.log}")
    it = save(flight, args.findings)
    tell(
        f"{sentence(it)}\nfindings {args.findings / 'findings.html'}", sys.stderr if args.json else sys.stdout
    )


def _text(result: Player, source: Source, rules: Rules | None, took_s: float) -> str:
    """Return, for people, what the services said and whether it equals the recording."""
    last = result.last
    outcome = "no belief received"
    if last is not None:
        x, y = last.mean
        ceased = "not ceased" if result.ceased_at is None else f"ceased at step {result.ceased_at}"
        if (
            verdict(result.ceased_at is not None, last.mean, None, last.outside, source.problem.area)
            == "outside"
        ):
            ceased += f": {outside_text(last.outside, source.problem.area.beyond(last.mean))}"
        readings = f"{last.step + 1} reading{'s' * (last.step > 0)}"
        outcome = f"{readings}, {ceased}\nestimate ({x:.2f}, {y:.2f}) ± {last.spread:.2f} m"
        if source.truth:
            outcome += (
                f"\nsource   ({source.truth[0]:.2f}, {source.truth[1]:.2f}), error "
                f"{math.dist(last.mean, source.truth):.2f} m"
            )
        outcome += f"\n{assumed_text(last.assume, last.stop, source.world)}"
        outcome += "".join(f"\n{line}" for line in gas_lines(last.intermittency, last.advised_dwell))
    replayed = f"replayed in {took_s:.1f} s: {outcome}"
    if rules is None:
        return replayed
    if result.difference:
        return f"{replayed}\ndiffers: {result.difference.text()}"
    counted = [
        f"{n} {kind}{'' if n == 1 else 's'}" for kind, n in result.counts.items() if kind not in rules.ignored
    ]
    relaxed = [f"within {rules.tolerance:g}"] * bool(rules.tolerance) + [
        f"without {name}" for name in sorted(rules.ignored)
    ]
    return f"{replayed}\nverified: {', '.join(counted)}" + f" ({', '.join(relaxed)})" * bool(relaxed)


def _json(result: Player, source: Source, rules: Rules | None) -> str:
    last = result.last
    home = home_of(read(source.path))[0] if source.recorded else source.home
    latitude_deg, longitude_deg = on_earth(home, last.mean) if last else (None, None)
    return msgspec.json.encode(
        {
            "verified": None if rules is None else result.difference is None,
            **{f"{kind}s": n for kind, n in result.counts.items()},
            "difference": result.difference.as_json() if result.difference else None,
            "ceased": result.ceased_at is not None,
            "estimate": last.mean if last else None,
            "spread_m": last.spread if last else None,
            "assume": last.assume if last else None,
            "stop": last.stop if last else None,
            "world": source.world,
            "outside_share": last.outside if last else None,
            "intermittency": last.intermittency if last else None,
            "advised_dwell_s": (last.advised_dwell or None) if last else None,
            "error_m": math.dist(last.mean, source.truth) if last and source.truth else None,
            "latitude_deg": latitude_deg,
            "longitude_deg": longitude_deg,
            "covariance_m2": last.covariance if last else None,
            "rate_gs": last.rate if last else None,
            "rate_interval_gs": result.rate_interval,
            "units": dict(UNITS),
        }
    ).decode()
