"""`plumeward draw`: a recorded mission as a picture or as an animation."""

import argparse
import shutil
import sys
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path

from link import cli
from link.files import whole
from link.record.reader import RecordError, read
from scene.animation import Picture, write_gif, write_mp4
from scene.follow.history import History, histories_of, remark_on
from scene.scene import Measurement, Scene

MOST_STEPS = 1_000_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add its flags."""
    parser.add_argument("log", metavar="LOG", type=cli.path, help="an .mcap written by a mission or `record`")
    parser.add_argument(
        "--out",
        type=cli.file_ending(".png", ".svg"),
        metavar="FILE",
        help="the picture, .png or .svg (default: LOG.png beside the log; none where only --gif or --mp4 is "
        "given)",
    )
    parser.add_argument(
        "--at",
        type=cli.listed(cli.whole(0, MOST_STEPS)),
        metavar="STEP,STEP",
        help="steps at which the picture shows the belief (default: the first ones at which the spread has "
        "fallen by a third and by two "
        "thirds, and the last)",
    )
    parser.add_argument(
        "--gif",
        type=cli.file_ending(".gif"),
        metavar="FILE.gif",
        help="an animation, a frame for each reading",
    )
    parser.add_argument(
        "--mp4", type=cli.file_ending(".mp4"), metavar="FILE.mp4", help="the same as a film; needs ffmpeg"
    )
    cli.add_output_guard(parser)


def run(args: argparse.Namespace) -> int:
    """Draw the log; returns the exit status: 1 if pieces of the log are missing. Raises BadInput."""
    if find_spec("matplotlib") is None:
        return cli.failed("draw needs matplotlib: pip install 'plumeward[view]'")
    if args.mp4 and shutil.which("ffmpeg") is None:
        return cli.failed("--mp4 needs the program ffmpeg, which is not installed; --gif needs nothing more")
    histories, damaged = _histories(args.log)
    if args.out is None and not (args.gif or args.mp4):
        args.out = args.log.with_suffix(".png")
    flags = (("--out", args.out), ("--gif", args.gif), ("--mp4", args.mp4))
    wanted = {flag: path for flag, path in flags if path}
    for flag, path in wanted.items():
        if refusal := cli.unwritable(flag, [path], args.force):
            raise cli.BadInput(refusal)
    beliefs = _beliefs(histories[0], args.at) if args.out else []
    for flag, path in wanted.items():
        try:
            with whole(path) as unfinished:
                if flag == "--out":
                    _draw(histories, beliefs, unfinished, path.suffix[1:])
                else:
                    (write_gif if flag == "--gif" else write_mp4)(_frames(histories), unfinished)
        except OSError as error:
            raise cli.BadInput(
                f"{flag}: {str(path)!r} cannot be written: {error.strerror or error}"
            ) from None
        print(path)
    return cli.FAILED if damaged else 0


def _histories(path: Path) -> tuple[list[History], bool]:
    """Return what a log tells of each vehicle, and whether it is damaged. Raises BadInput."""
    try:
        recording = read(path)
        histories = histories_of(recording)
    except RecordError as error:
        raise cli.BadInput(str(error)) from None
    if not histories[0].measurements.values:
        raise cli.BadInput(f"{path} has no belief that can be read: there is nothing to draw")
    if remark := remark_on(recording, histories[0]):
        print(f"warning: {path} {remark}", file=sys.stderr)
    return histories, bool(recording.damage)


def _beliefs(history: History, steps: Sequence[int] | None) -> list[Scene]:
    """Return the scenes whose beliefs the picture shows.

    Raises BadInput on a step that the log has not.
    """
    from scene.drawing import BELIEFS

    measured = {it.step: it for it in history.measurements.values}
    chosen = telling(list(measured.values())) if steps is None else sorted(steps)
    for step in chosen:
        if step not in measured:
            raise cli.BadInput(
                f"--at: {step} is not allowed; wanted steps of the log, {min(measured)} to {max(measured)}"
            )
    if len(chosen) > len(BELIEFS):
        raise cli.BadInput(f"--at: {len(chosen)} steps are not allowed; wanted at most {len(BELIEFS)}")
    return [history.at(measured[step].time_s) for step in chosen]


def telling(measured: Sequence[Measurement]) -> list[int]:
    """Return the steps whose beliefs tell most.

    They are the first ones at which the spread has gone a third and two thirds of its way from first to last,
    and the last step.
    """
    first, last = measured[0], measured[-1]
    way_m = first.spread_m - last.spread_m
    gone = [
        next((it for it in measured if first.spread_m - it.spread_m >= share * way_m), last)
        for share in (1 / 3, 2 / 3)
    ]
    return sorted({it.step for it in (*gone, last)})


def _draw(histories: Sequence[History], beliefs: Sequence[Scene], path: Path, form: str) -> None:
    from scene.drawing import Drawing

    scene, *beside = (history.at() for history in histories)
    steps = scene.measurements[-1].step
    Drawing(scene, beliefs, steps, beside).show(scene, beside).save(path, form)


def _frames(histories: Sequence[History]) -> Iterator[Picture]:
    """Yield a frame for each reading, and show on stderr how many are done."""
    from rich.console import Console
    from rich.progress import track

    from scene.drawing import Drawing

    measured = histories[0].measurements.values
    scene, *beside = (history.at() for history in histories)
    drawing = Drawing(scene, steps=measured[-1].step, beside=beside)
    for it in track(measured, "drawing", console=Console(stderr=True), transient=True):
        scene, *beside = (history.at(it.time_s) for history in histories)
        yield drawing.show(scene, beside).pixels()
