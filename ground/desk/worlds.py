"""`plumeward worlds show FILE`: what is in a recorded plume, as text and as a picture."""

import argparse
import math
import shlex
import textwrap
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from link import cli
from link.files import whole
from link.terminal import printable
from plume.recorded.footage import PPM, Facts, Footage
from plume.recorded.opening import opened

FRAMES = 16  # at most that are looked at
PLACES = 200  # at most along x and y
LABEL = 16  # characters
WIDTH = 80
SEPARATORS = (",", "+")  # of parameters and of worlds: a name of a world cannot hold a path with one


class Look(NamedTuple):
    """What is found in some frames of a recorded plume, at the height of its source."""

    frames: list[int]
    middle: NDArray[np.float64]  # the gas (y, x) in the frame in the middle
    mean: NDArray[np.float64]  # of all frames that were looked at
    greatest: float
    when: int  # the frame of the greatest
    typical: float  # median of what is above 0
    share: float  # of places and frames where it is above 0
    wind: tuple[float, float] | None  # how the air moves at the source, or in the middle, in the first frame
    walls: NDArray[np.bool_] | None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add its flags."""
    parser.description = "Show what is in a recorded plume, which --world recorded:file=FILE flies in."
    parser.add_argument("what", choices=("show",), help="what to do")
    parser.add_argument(
        "file",
        metavar="FILE",
        type=cli.path,
        help="a .npy or .h5 movie, a folder of Zarr, or the folder of GADEN's iteration_0, iteration_1, …",
    )
    parser.add_argument("-o", "--out", metavar="FILE.png", type=cli.file_ending(".png"), help="draw it, too")
    cli.add_output_guard(parser)


def run(args: argparse.Namespace) -> int:
    """Print what is in a file; returns the exit status. Raises BadInput."""
    if args.out and find_spec("matplotlib") is None:
        return cli.failed("-o needs matplotlib: pip install 'plumeward[view]'")
    if args.out and (refusal := cli.unwritable("--out", [args.out], args.force)):
        raise cli.BadInput(refusal)
    try:
        footage = opened(args.file)
        look = looked_at(footage)
    except ValueError as error:
        raise cli.BadInput(printable(str(error))) from None
    print("\n".join(lines(args.file, footage.facts, look)))
    if args.out:
        _draw(args.file, footage.facts, look, args.out)
        print(f"\n{args.out}")
    return 0


def looked_at(footage: Footage) -> Look:
    """Look at some frames, evenly from the first to the last. Raises ValueError on a broken file."""
    facts = footage.facts
    frames = sorted({round(each) for each in np.linspace(0, facts.frames - 1, min(FRAMES, facts.frames))})
    axes = [
        np.linspace(low + (high - low) / count / 2, high - (high - low) / count / 2, min(count, PLACES))
        for low, high, count in zip(facts.low[:2], facts.high[:2], facts.cells[:2], strict=True)
    ]
    x, y = np.meshgrid(*axes)
    middle = [(low + high) / 2 for low, high in zip(facts.low, facts.high, strict=True)]
    source = np.array([*(facts.source or middle), 0.0][:3])
    places = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, source[2])])
    gas = np.array([footage.gas(places, np.full(x.size, frame)) for frame in frames]).reshape(-1, *x.shape)
    above = gas[gas > 0]
    with np.errstate(over="ignore"):  # of numbers that no gas has
        mean, typical = gas.mean(axis=0), float(np.median(above)) if len(above) else 0.0
    return Look(
        frames,
        gas[len(frames) // 2],
        mean,
        float(gas.max()),
        frames[int(gas.max(axis=(1, 2)).argmax())],
        typical,
        len(above) / gas.size,
        tuple(footage.wind(source[None], np.zeros(1, np.int64))[0][0].tolist()) if facts.windy else None,
        footage.walls(float(source[2])),
    )


def lines(file: Path, facts: Facts, look: Look) -> list[str]:
    """Return what is in a file, in lines for people."""
    axes = "xyz"[: len(facts.cells)]
    rate = "how many a second is not said"
    if facts.fps:
        rate = f"{facts.fps:g} a second, {facts.frames / facts.fps:g} s in all"
    extent = ", ".join(
        f"{axis} {low:g} to {high:g}" for axis, low, high in zip(axes, facts.low, facts.high, strict=True)
    )
    source = "not said"
    if facts.source:
        source = ", ".join(f"{axis} {place:g}" for axis, place in zip(axes, facts.source, strict=True))
    rows = {
        "kind": facts.kind,
        "frames": f"{facts.frames:,}; {rate}",
        "grid": f"{' × '.join(f'{count:,}' for count in facts.cells)} cells of "
        f"{' × '.join(f'{side:g}' for side in facts.cell)}, in {facts.length}",
        "extent": extent,
        "concentration": f"greatest {_gas(look.greatest, facts)}, in frame {look.when}; typical "
        f"{_gas(look.typical, facts)}; above 0 at {look.share:.0%} of places and times. Of "
        f"{len(look.frames)} frames{', at the height of the source' if len(axes) == 3 else ''}",
        "source": source,
        "wind": _wind(look),
        "more": "; ".join(facts.remarks),
        "not read": ", ".join(facts.unread),
        "to fly in it": f"under another name: a path with {' or '.join(SEPARATORS)} cannot be told"
        if any(sign in str(file) for sign in SEPARATORS)
        else f"--world {shlex.quote(world(file, facts, look))}",
    }
    return [
        line
        for label, text in rows.items()
        if text
        for line in textwrap.wrap(
            printable(text),
            WIDTH,
            initial_indent=label.ljust(LABEL),
            subsequent_indent=" " * LABEL,
            break_on_hyphens=False,
            break_long_words=False,
        )
    ]


def world(file: Path, facts: Facts, look: Look) -> str:
    """Return the name of the world, with what the file does not say left open."""
    places = [f"source_{axis}" for axis in "xyz"[: len(facts.cells)]] if facts.source is None else []
    open_ = [*(() if facts.fps else ("fps",)), *places, *(() if look.wind and any(look.wind) else ("wind",))]
    if facts.unit == PPM and facts.grams is None:
        open_.append("gas")
    return f"recorded:file={file}" + "".join(f",{name}=…" for name in open_)


def _gas(value: float, facts: Facts) -> str:
    grams = f", which is {value * facts.grams:.3g} g/m³" if facts.grams else ""
    return f"{value:.3g} {facts.unit}{grams}"


def _wind(look: Look) -> str:
    if look.wind is None:
        return "not in the file"
    x, y = look.wind
    speed = math.hypot(x, y)
    comes_from = math.degrees(math.atan2(-y, -x)) % 360
    return f"at the source {speed:.3g} m/s, from {comes_from:.0f}° (counter-clockwise from +x)"


def _draw(file: Path, facts: Facts, look: Look, path: Path) -> None:
    from scene.footage import Sight, Still, draw

    number = look.frames[len(look.frames) // 2]
    when = f" (after {number / facts.fps:.3g} s)" if facts.fps else ""
    stills = [
        Still(f"frame {number}{when}", look.middle),
        Still(f"mean of {len(look.frames)} frames", look.mean),
    ]
    source = (facts.source[0], facts.source[1]) if facts.source else None
    sight = Sight(
        f"{printable(file.name)}: {facts.kind}",
        stills,
        (facts.low[0], facts.high[0], facts.low[1], facts.high[1]),
        facts.length,
        facts.unit,
        source,
        look.walls,
        look.wind,
    )
    try:
        with whole(path) as unfinished:
            draw(sight, unfinished)
    except OSError as error:
        raise cli.BadInput(f"--out: {str(path)!r} cannot be written: {error.strerror or error}") from None
