"""Movies of plume_nav_sim in Zarr, version 2: `concentration` (t, y, x) in chunks, each a file."""

import gzip
import io
import os
import struct
import zlib
from itertools import product
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import zstandard

from plume.recorded.footage import MOST_BYTES, content_of, one_line
from plume.recorded.movies import Movie, PixelGrid, Pixels, checked

NAME = "concentration"
LONGEST = 1 << 20  # bytes of a JSON file
MOST_CHUNKS = 1 << 16  # of a frame
COMPRESSORS = ("blosc", "zlib", "gzip", "zstd")
BLOSC_HEAD = struct.Struct("<4B3I")  # versions, flags, size of an item; bytes of the content, a block, all
PAIRS = ("pixel_to_grid", "origin", "extent")
READ = {"fps", *PAIRS, "source_location_px", "source_location_px_is_heuristic", "schema_version", "dims"}
Pair = float | tuple[float, float]


class MovieAttributes(msgspec.Struct):
    """The attributes that are read; pairs are (y, x)."""

    fps: float
    pixel_to_grid: Pair
    origin: Pair
    extent: Pair
    source_location_px: tuple[float, float] | None = None  # (x, y)


class ChunkedArray(msgspec.Struct):
    """What .zarray says."""

    zarr_format: int
    shape: tuple[int, int, int]
    chunks: tuple[int, int, int]
    dtype: str
    compressor: dict[str, Any] | None
    fill_value: float | str | None
    order: str
    filters: list[Any] | None = None
    dimension_separator: str = "."


class Chunked:
    """The frames of a Zarr array."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        file = folder / ".zarray"
        said: ChunkedArray = _read(file, ChunkedArray)
        self._said = said
        if said.zarr_format != 2:
            raise ValueError(f"{file}: zarr_format: {said.zarr_format}; wanted 2")
        try:
            self._dtype = np.dtype(said.dtype)
        except (TypeError, ValueError, SyntaxError):
            raise ValueError(f"{file}: dtype: {said.dtype[:50]!r}; wanted one such as '<f4'") from None
        self.shape = checked(file, said.shape, self._dtype)
        if min(said.chunks) < 1 or self._chunk_bytes > MOST_BYTES:
            raise ValueError(f"{file}: chunks: {said.chunks}; wanted at most {MOST_BYTES // 2**20} MiB each")
        if self._rows * self._columns > MOST_CHUNKS:
            raise ValueError(f"{file}: chunks: {said.chunks}; wanted at most {MOST_CHUNKS:,} a frame")
        self._codec = said.compressor and said.compressor.get("id")
        if self._codec not in (None, *COMPRESSORS):
            raise ValueError(
                f"{file}: compressor: {str(self._codec)[:50]!r}; wanted null, {', '.join(COMPRESSORS)}"
            )
        if said.filters or said.order not in ("C", "F") or said.dimension_separator not in (".", "/"):
            raise ValueError(f"{file}: wanted filters null, order C or F, and dimension_separator . or /")
        try:
            self._fill = float(said.fill_value or 0)
        except ValueError:
            raise ValueError(f"{file}: fill_value: {str(said.fill_value)[:50]!r}; wanted a number") from None
        self.together = min(said.chunks[0], self.shape[0])
        if self.together * self.shape[1] * self.shape[2] * self._dtype.itemsize > MOST_BYTES:
            self.together = 1

    @property
    def _chunk_bytes(self) -> int:
        deep, high, wide = self._said.chunks
        return deep * high * wide * self._dtype.itemsize

    @property
    def _rows(self) -> int:
        return -(-self.shape[1] // self._said.chunks[1])

    @property
    def _columns(self) -> int:
        return -(-self.shape[2] // self._said.chunks[2])

    def read(self, first: int, count: int) -> Pixels:
        """Return frames; those of a chunk that is not there have the fill value."""
        deep, high, wide = self._said.chunks
        with np.errstate(over="ignore", invalid="ignore"):
            frames: Pixels = np.full((count, *self.shape[1:]), self._fill, self._dtype.newbyteorder("="))
        for number in range(first // deep, (first + count - 1) // deep + 1):
            for row, column in product(range(self._rows), range(self._columns)):
                chunk = self._chunk(number, row, column)
                if chunk is None:
                    continue
                begin, end = max(first, number * deep), min(first + count, (number + 1) * deep)
                part = frames[begin - first : end - first, row * high :, column * wide :]
                part = part[:, :high, :wide]
                part[:] = chunk[begin - number * deep : end - number * deep, : part.shape[1], : part.shape[2]]
        return frames

    def _chunk(self, *number: int) -> Pixels | None:
        path = self._folder / self._said.dimension_separator.join(map(str, number))
        if not os.path.lexists(path):
            return None
        content = self._content(path, content_of(path, 2 * MOST_BYTES))
        if len(content) != self._chunk_bytes:
            found = f"{len(content):,}" if len(content) < self._chunk_bytes else "more"
            raise ValueError(f"{path}: {found} bytes; wanted {self._chunk_bytes:,} of a chunk")
        flat: Pixels = np.frombuffer(content, self._dtype)
        return flat.reshape(self._said.chunks, order="F" if self._said.order == "F" else "C")

    def _content(self, path: Path, data: bytes) -> bytes:
        """Return the content of a chunk, or a byte more than it may have. Raises ValueError."""
        most = self._chunk_bytes + 1
        try:
            match self._codec:
                case "blosc":
                    return _unblosc(data, self._chunk_bytes)
                case "zlib":
                    stream = zlib.decompressobj()
                    content = stream.decompress(data, most)
                    if len(content) < most and not stream.eof:
                        raise ValueError("the stream is cut off")
                    return content
                case "gzip":
                    return gzip.GzipFile(fileobj=io.BytesIO(data)).read(most)
                case "zstd":
                    return zstandard.ZstdDecompressor().stream_reader(data).read(most)
        except ImportError:
            raise ValueError(f"{path}: needs numcodecs: pip install 'plumeward[plumes]'") from None
        except Exception as error:  # each of these libraries has errors of its own
            raise ValueError(f"{path}: {self._codec}: {one_line(error)}") from None
        return data


def _unblosc(data: bytes, wanted: int) -> bytes:
    """Decompress a Blosc frame whose head promises just as much as is wanted."""
    from numcodecs import blosc

    *_, content, _block, whole = BLOSC_HEAD.unpack_from(data)
    if content != wanted or whole != len(data):
        raise ValueError(
            f"its head says {content:,} bytes in {whole:,}; wanted {wanted:,} in the {len(data):,} here"
        )
    return bytes(blosc.decompress(data))


def movie(folder: Path) -> Movie:
    """Return the movie in a folder of Zarr, version 2. Raises ValueError."""
    if (folder / "zarr.json").exists():
        raise ValueError(f"{folder}: zarr.json: Zarr of version 3; wanted version 2")
    if not (folder / NAME / ".zarray").exists():
        raise ValueError(f"{folder}: no array {NAME!r}; wanted {NAME} (t, y, x)")
    reel = Chunked(folder / NAME)
    file = folder / ".zattrs"
    said = _read(file, MovieAttributes)
    if not 0 < said.fps < float("inf"):
        raise ValueError(f"{file}: fps: {said.fps:g}; wanted a number above 0")
    pixel, origin, extent = (_pair(file, name, getattr(said, name)) for name in PAIRS)
    for name, pair in (("pixel_to_grid", pixel), ("extent", extent)):
        if min(pair) <= 0:
            raise ValueError(f"{file}: {name}: {pair}; wanted numbers above 0, of y and x")
    for size, count, step in zip(extent, reel.shape[1:], pixel, strict=True):
        # From centre to centre, or from edge to edge.
        if not (count - 1.01) * step <= size <= (count + 0.01) * step:
            raise ValueError(
                f"{file}: extent: {extent}; wanted pixel_to_grid {pixel} times the pixels {reel.shape[1:]}"
            )
    source = said.source_location_px
    place = source and (origin[1] + source[0] * pixel[1], origin[0] + source[1] * pixel[0])
    attributes = _read(file, dict[str, Any])
    return Movie(
        "movie of plume_nav_sim (Zarr 2)",
        reel,
        PixelGrid(pixel[::-1], origin[::-1], "units of its grid", said.fps, place),
        remarks=("where the source is, is a guess, it says",)
        if attributes.get("source_location_px_is_heuristic")
        else (),
        unread=tuple(f"attribute {name!r}" for name in sorted(attributes.keys() - READ)),
    )


def _pair(file: Path, name: str, value: Pair) -> tuple[float, float]:
    y, x = value if isinstance(value, tuple) else (value, value)
    if max(abs(y), abs(x)) > 1e9:
        raise ValueError(f"{file}: {name}: {(y, x)}; wanted numbers below 1e9")
    return float(y), float(x)


def _read(path: Path, kind: type[Any]) -> Any:
    """Return what a JSON file says. Raises ValueError."""
    try:
        return msgspec.json.decode(content_of(path, LONGEST), type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"{path}: {one_line(error)}") from None
