"""Protects animations: every frame is in the file, the last one stays, and an encoder that fails says why."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scene.animation import Picture, write_gif, write_mp4


def frames(count: int) -> Iterator[Picture]:
    """A square that moves to the right."""
    for i in range(count):
        frame = np.full((40, 60, 3), 255, np.uint8)
        frame[10:20, 5 * i : 5 * i + 5] = (200, 30, 30)
        yield frame


def test_a_gif_has_each_frame_and_stays_at_the_last(tmp_path: Path) -> None:
    write_gif(frames(7), tmp_path / "a.partial")
    with Image.open(tmp_path / "a.partial") as gif:
        assert (gif.format, gif.n_frames, gif.info["loop"]) == ("GIF", 7, 0)
        lasting = []
        for i in range(7):
            gif.seek(i)
            lasting.append(gif.info["duration"])
            red, green, _ = gif.convert("RGB").getpixel((5 * i + 2, 15))
            assert red - green > 100
        assert lasting == [200] * 6 + [2000]


def ffmpeg_that(does: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Put a program of this name in the place of ffmpeg. It finds its last argument, the file to write, in
    $to.
    """
    (folder / "bin").mkdir()
    (folder / "bin" / "ffmpeg").write_text(
        f'#!/bin/sh\nfor to; do :; done\necho "$@" > {folder}/words\n{does}\n'
    )
    (folder / "bin" / "ffmpeg").chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder / 'bin'}:/usr/bin:/bin")


def test_ffmpeg_gets_the_frames_as_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ffmpeg_that('cat > "$to"', tmp_path, monkeypatch)
    write_mp4(frames(3), tmp_path / "a.mp4")
    plain = [frame.tobytes() for frame in frames(3)]
    assert (tmp_path / "a.mp4").read_bytes() == b"".join(plain + [plain[-1]] * 9)  # two seconds of the last
    words = (tmp_path / "words").read_text()
    assert "-video_size 60x40 -framerate 5" in words


def test_ffmpeg_that_fails_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ffmpeg_that("echo first >&2; echo 'no such encoder' >&2; exit 3", tmp_path, monkeypatch)
    with pytest.raises(OSError, match=r"^ffmpeg: no such encoder$"):
        write_mp4(frames(3), tmp_path / "a.mp4")
