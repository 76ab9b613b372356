"""Animations: frames of a drawing written as a GIF, by Pillow, or as an MP4, by ffmpeg."""

from collections.abc import Iterable, Iterator
from contextlib import suppress
from itertools import chain
from pathlib import Path
from subprocess import PIPE, Popen
from tempfile import TemporaryFile

import numpy as np
from numpy.typing import NDArray

FRAMES_PER_S = 5  # readings shown in a second
LAST_S = 2.0  # the last frame stays this long

Picture = NDArray[np.uint8]  # (height, width, 3): red, green and blue; row 0 on top

RAW = "-f rawvideo -pixel_format rgb24 -video_size {width}x{height} -framerate {rate} -i -"
MP4 = "-pix_fmt yuv420p -movflags +faststart -fflags +bitexact -f mp4"  # what all players show


def write_gif(frames: Iterable[Picture], path: Path) -> None:
    """Write frames as a GIF that repeats for ever.

    They must differ, each from the one before it.
    """
    from PIL import Image

    images: list[Image.Image] = []
    palette = None
    for frame in frames:
        image = Image.fromarray(frame)
        palette = palette or image.quantize(255)  # the same for all: no flicker, and half the bytes
        images.append(image.quantize(palette=palette, dither=Image.Dither.NONE))
    lasting_ms = [1000 // FRAMES_PER_S] * (len(images) - 1) + [round(LAST_S * 1000)]
    images[0].save(
        path,
        "GIF",
        save_all=True,
        append_images=images[1:],
        duration=lasting_ms if len(images) > 1 else lasting_ms[0],
        loop=0,
    )


def write_mp4(frames: Iterable[Picture], path: Path) -> None:
    """Write frames as an MP4, by the program ffmpeg.

    Raises OSError if ffmpeg is missing or fails.
    """
    feed = _held(frames)
    first = next(feed)
    height, width, _ = first.shape
    raw = RAW.format(rate=FRAMES_PER_S, width=width, height=height)
    words = ["ffmpeg", "-y", "-loglevel", "error", *raw.split(), *MP4.split(), str(path)]
    with TemporaryFile() as said:
        # A broken pipe: it says why below.
        with (
            suppress(BrokenPipeError),
            Popen(words, stdin=PIPE, stderr=said) as encoder,
        ):
            assert encoder.stdin
            encoder.stdin.writelines(frame.tobytes() for frame in chain([first], feed))
        if encoder.returncode:
            said.seek(0)
            lines = said.read().decode(errors="replace").strip().splitlines()
            raise OSError(f"ffmpeg: {lines[-1] if lines else f'exit status {encoder.returncode}'}")


def _held(frames: Iterable[Picture]) -> Iterator[Picture]:
    """Yield the frames, and the last one again and again until it has stayed as long as it should."""
    for frame in frames:
        yield frame
    yield from [frame] * (round(LAST_S * FRAMES_PER_S) - 1)
