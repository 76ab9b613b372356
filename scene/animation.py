"""Animations: frames of a drawing written as a GIF, by Pillow, or as an MP4, by ffmpeg."""

import subprocess
from collections.abc import Iterable, Iterator
from pathlib import Path
from tempfile import TemporaryFile

import numpy as np
from numpy.typing import NDArray

FRAMES_PER_S = 5
"""Readings shown in a second."""
LAST_S = 2.0
"""The last frame stays so long."""

Frame = NDArray[np.uint8]
"""(height, width, 3): red, green and blue; row 0 on top."""


def write_gif(frames: Iterable[Frame], path: Path) -> None:
    """Write frames as a GIF that repeats for ever. They must differ, each from the one before it. Raises
    ValueError without any.
    """
    from PIL import Image

    images: list[Image.Image] = []
    palette = None
    for frame in frames:
        image = Image.fromarray(frame)
        palette = palette or image.quantize(255)  # the same for all: no flicker, and half the bytes
        images.append(image.quantize(palette=palette, dither=Image.Dither.NONE))
    if not images:
        raise ValueError("no frames")
    last = len(images) - 1
    lasting_ms = [1000 // FRAMES_PER_S] * last + [round(LAST_S * 1000)]
    images[0].save(
        path,
        "GIF",
        save_all=True,
        append_images=images[1:],
        duration=lasting_ms if last else lasting_ms[0],
        loop=0,
    )


def write_mp4(frames: Iterable[Frame], path: Path) -> None:
    """Write frames as an MP4, by the program ffmpeg. Raises ValueError without any frames, OSError if
    ffmpeg is missing or fails.
    """
    feed = _held(frames)
    first = next(feed, None)
    if first is None:
        raise ValueError("no frames")
    height, width, _ = first.shape
    form = [
        "-f",
        "rawvideo",
        "-pixel_format",
        "rgb24",
        "-video_size",
        f"{width}x{height}",
        "-framerate",
        str(FRAMES_PER_S),
    ]
    to = [
        "-pix_fmt",
        "yuv420p",
        "-movflags",
        "+faststart",
        "-fflags",
        "+bitexact",
        "-f",
        "mp4",
        str(path),
    ]  # what all players show
    with TemporaryFile() as said:
        encoder = subprocess.Popen(
            ["ffmpeg", "-y", "-loglevel", "error", *form, "-i", "-", *to], stdin=subprocess.PIPE, stderr=said
        )
        assert encoder.stdin
        try:
            encoder.stdin.write(first.tobytes())
            for frame in feed:
                encoder.stdin.write(frame.tobytes())
            encoder.stdin.close()
        except BrokenPipeError:  # it says why below
            pass
        except BaseException:
            encoder.kill()
            encoder.wait()
            raise
        if encoder.wait():
            said.seek(0)
            words = said.read().decode(errors="replace").strip().splitlines()
            raise OSError(f"ffmpeg: {words[-1] if words else f'exit status {encoder.returncode}'}")


def _held(frames: Iterable[Frame]) -> Iterator[Frame]:
    """Yield the frames, and the last one again and again until it has stayed as long as it should."""
    frame = None
    for frame in frames:
        yield frame
    if frame is not None:
        for _ in range(round(LAST_S * FRAMES_PER_S) - 1):
            yield frame
