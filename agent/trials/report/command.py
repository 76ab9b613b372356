"""`plumeward report`: tables, pictures and one page from raw results."""

import argparse
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from agent.policies import OURS
from agent.trials.evaluate import FIRST_TEST_SEED
from agent.trials.report.leaderboard import Leaderboard, read_boards
from agent.trials.report.page import Picture, page
from agent.trials.report.results import Results, read
from agent.trials.report.tables import tables
from link import cli
from link.files import drop_if_empty, whole
from link.terminal import tell
from plume.scenario import BUDGET_STEPS, SUCCESS_RADIUS_M

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FLIGHTS = 100
# A scenario in which policies differ: there is no gas between the start and the source.
TELLING_SEED = 1_000_009
PICTURES = ("particles", "thresholds", "trajectories", "hundred", "distances")
# The files of a report.
FILES = (*(f"{name}.{ending}" for name in PICTURES for ending in ("png", "svg")), "results.md", "index.html")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `report`."""
    parser.add_argument(
        "--results",
        type=cli.path,
        default=Path("results"),
        metavar="DIR",
        help="folder of raw results, the .csv and .csv.gz files of `evaluate --missions` (default: "
        "%(default)s)",
    )
    parser.add_argument(
        "--out",
        type=cli.path,
        default=Path("report"),
        metavar="DIR",
        help="folder to write to (default: %(default)s)",
    )
    cli.add_output_guard(parser)


def run(args: argparse.Namespace) -> int:
    """Write the report on a folder of raw results; returns the exit status. Raises BadInput."""
    if find_spec("matplotlib") is None:
        return cli.failed("report needs matplotlib: pip install 'plumeward[view]'")
    try:
        results = read(args.results)
        leaderboard = read_boards(args.results, results)
    except ValueError as error:
        raise cli.BadInput(f"--results: {error}") from error
    except OSError as error:
        raise cli.BadInput(f"--results: {error.filename}: {error.strerror}") from error
    try:
        args.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cli.BadInput(f"--out: no folder {str(args.out)!r} to write in: {error.strerror}") from error
    if refusal := cli.unwritable("--out", (args.out / name for name in FILES), args.force):
        raise cli.BadInput(refusal)
    try:
        write(results, leaderboard, args.out, FLIGHTS)
    except OSError as error:
        raise cli.BadInput(f"--out: {error}") from error
    finally:
        drop_if_empty(args.out)
    return 0


def write(results: Results, leaderboard: Leaderboard, out: Path, flights: int) -> None:
    """Write pictures, tables and the page to a folder, or none of them.

    Two of the pictures show `flights` missions, which are flown here.
    """
    import matplotlib  # not at the top: it takes long to import

    from scene.drawing import STYLE

    pictures = []
    with ExitStack() as files:
        with matplotlib.rc_context(STYLE):
            for name, title, caption, figure in _drawn(results, flights):
                pictures.append(Picture(name, title, caption, save(figure, out / name, files)))
        all_tables = [*leaderboard.tables(), *tables(results)]
        text = "\n".join(["# Results\n", _summary(results) + "\n", *(it.markdown() for it in all_tables)])
        of_page = page(_summary(results), pictures, all_tables)
        for name, words in (("results.md", text), ("index.html", of_page)):
            files.enter_context(whole(out / name)).write_text(words)
    for name in (*(f"{picture.name}.png, .svg" for picture in pictures), "results.md", "index.html"):
        tell(str(out / name), sys.stdout)


def save(figure: "Figure", stem: Path, files: ExitStack) -> bytes:
    """Write a picture as stem.png and stem.svg, which are there when `files` close; returns the SVG."""
    from scene.drawing import UNDATED

    figure.savefig(files.enter_context(whole(stem.with_suffix(".png"))), format="png")
    svg = files.enter_context(whole(stem.with_suffix(".svg")))
    figure.savefig(svg, format="svg", metadata=UNDATED)
    return svg.read_bytes()


def _summary(results: Results) -> str:
    return (
        f"{sum(map(len, results.rows.values())):,} missions of {len(results.policies)} policies: "
        f"{results.behind(list(results.rows))}."
        " `plumeward evaluate --missions FILE.csv` flew them. `plumeward report` made this page from their "
        "rows."
    )


def _drawn(results: Results, flights: int) -> Iterator[tuple[str, str, str, "Figure"]]:
    """Yield (name, title, caption, figure)."""
    from agent.trials.report import drawing
    from agent.trials.rollout import rollout

    curves = (
        "Bars: 95% intervals, Wilson's for ceased, bootstrap for MTD and ST. Points are shifted sideways so "
        "that none hides another. The scale of ceased is stretched towards 100%."
    )
    bars = "Thin lines: 95% intervals, Wilson's for ceased, bootstrap for MTD and ST."
    for_both = (
        "Dashed: the mean information floor. Hollow: the paper. MTD and ST are means over ceased missions. "
        "Made by `plumeward report`."
    )
    if hidden := len(results.policies) - len(drawing.compared(results.policies)):
        for_both += f" {hidden} more policies are in the tables."
    for name, title, axis, at in (
        ("particles", "Figures by number of particles", "particles", f"ζ = {results.threshold_m:g} m"),
        ("thresholds", "Figures by threshold ζ", "threshold_m", f"N = {results.particles:,}"),
    ):
        behind = results.behind(results.along(axis))
        yield (
            name,
            title,
            f"{at}, assume {results.assume}; {behind}. {bars if results.is_one_along(axis) else curves} "
            f"{for_both}",
            drawing.against(results, axis),
        )
    setting = results.usual
    set_to = (
        f"N = {setting.particles:,}, ζ = {setting.threshold_m:g} m, assume {results.assume}, "
        f"{BUDGET_STEPS} steps at most"
    )
    flags = f"--particles {setting.particles} --threshold {setting.threshold_m:g} --assume {results.assume}"
    tell(f"flying {len(drawing.FIVE)} policies on one scenario")
    yield (
        "trajectories",
        "Policies on one scenario",
        f"Seed {TELLING_SEED}, chosen because policies differ in it; {set_to}. One mission per policy, flown "
        "by `plumeward report`. To fly"
        f" one of them: `plumeward rollout --seed {TELLING_SEED} --policy infotaxis {flags}`.",
        drawing.trajectories(
            [rollout(TELLING_SEED, policy, *setting, assume=results.assume) for policy in drawing.FIVE]
        ),
    )
    best = results.best(setting, OURS)
    policy = best or OURS[0]
    tell(f"flying {flights} missions of {policy}")
    seeds = range(FIRST_TEST_SEED, FIRST_TEST_SEED + flights)
    flown = [rollout(seed, policy, *setting, assume=results.assume) for seed in seeds]
    ceased, located = (
        sum(it) for it in zip(*((result.ceased, result.located) for result, _ in flown), strict=True)
    )
    missions = (
        f"{flights} missions of {policy}, seeds {FIRST_TEST_SEED} to {FIRST_TEST_SEED + flights - 1}, "
        f"{set_to}: {ceased} ceased, {located}"
        f" located."
    )
    if best:
        missions += (
            f" {best} has the lowest MTD of the policies whose ceased share is within one point of "
            "the highest at this N and ζ."
        )
    yield (
        "hundred",
        f"{flights} missions: paths of the UAV and of the belief's mean",
        f"{missions} The source is at the origin. Dots: ends of missions. Dashed: {SUCCESS_RADIUS_M:g} m "
        "around the source. Flown by"
        " `plumeward report`.",
        drawing.many(flown),
    )
    yield (
        "distances",
        f"{flights} missions: distances at each step",
        f"{missions} Thin: each mission, with a dot at its end. Black: the median. Band: the quartiles. "
        "Median and quartiles include ended"
        f" missions with their last distance. Distances below {drawing.LEAST_DISTANCE_M:g} m are drawn at "
        "this value. Flown by"
        " `plumeward report`.",
        drawing.distances(flown),
    )
