"""Protects the movies: each kind of file gives the pixels that were written, interpolated in between, and only
those that are asked for are read.
"""

import struct
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plume.recorded.footage import LastRead
from plume.recorded.opening import opened
from tests.plume.recorded import writers
from tests.plume.recorded.looks import BLOSC, FRAMES, every_pixel


def at(footage: Any, x: float, y: float, frame: int) -> float:
    return float(footage.gas(np.array([[x, y, 0.0]]), np.array([frame]))[0])


# ---- what is in the files ----


@pytest.mark.parametrize("dtype", ["<f4", "<f8", ">f4", "<f2", "u1", "<i2", "?"])
def test_a_numpy_movie_gives_the_numbers_in_it(tmp_path: Path, dtype: str) -> None:
    footage = opened(writers.npy(tmp_path / "m.npy", FRAMES.astype(dtype)))
    assert (every_pixel(footage) == FRAMES.astype(dtype).astype(float)).all()
    assert (footage.facts.frames, footage.facts.cells, footage.facts.fps) == (5, (3, 4), None)
    assert (footage.facts.low, footage.facts.high) == ((-0.5, -0.5), (2.5, 3.5))


def test_a_numpy_movie_in_columns_gives_the_same(tmp_path: Path) -> None:
    np.save(tmp_path / "m.npy", np.asfortranarray(FRAMES))
    assert (every_pixel(opened(tmp_path / "m.npy")) == FRAMES).all()


def test_a_movie_with_a_dataset_a_frame_gives_the_numbers_in_it(tmp_path: Path) -> None:
    many = np.arange(12 * 2 * 2, dtype=np.float64).reshape(12, 2, 2)  # "10" is before "2" in the file
    footage = opened(writers.numbered(tmp_path / "m.h5", many))
    assert (every_pixel(footage) == many).all()
    assert footage.facts.kind == "movie of olfactory-navigation (.h5)"


@pytest.mark.parametrize(
    "options", [{}, {"chunks": (2, 3, 2)}, {"chunks": (3, 4, 3), "compression": "gzip"}], ids=str
)
def test_a_movie_with_a_sidecar_lies_as_that_says(tmp_path: Path, options: Any) -> None:
    footage = opened(writers.with_sidecar(tmp_path / "m.h5", FRAMES, **options))
    assert (every_pixel(footage) == FRAMES).all()
    facts = footage.facts
    assert (facts.fps, facts.length) == (15.0, "m")
    assert facts.cell == (pytest.approx(0.25e-3), pytest.approx(0.5e-3))  # 4 and 2 pixels a mm


def test_a_sidecar_in_pixels_or_in_a_unit_of_its_own(tmp_path: Path) -> None:
    for unit, more, cell, length in (
        ("pixel", "", (1.0, 1.0), "pixels"),
        ("cm", "pixels_per_unit: [0.5, 2]\n", (0.005, 0.02), "m"),
        ("fly", "pixels_per_unit: [0.5, 2]\n", (0.5, 2.0), "fly"),
    ):
        text = f"fps: 3\nspatial_unit: {unit}\nh5_dataset: Plume Data/dataset_001\n{more}"
        facts = opened(writers.with_sidecar(tmp_path / "m.h5", FRAMES, text)).facts
        assert (facts.cell, facts.length) == (pytest.approx(cell), length)


@pytest.mark.parametrize("codec", [None, {"id": "zlib"}, {"id": "gzip"}, {"id": "zstd"}, BLOSC], ids=str)
@pytest.mark.parametrize("order", ["C", "F"])
def test_a_zarr_movie_gives_the_numbers_in_it_however_it_is_packed(
    tmp_path: Path, codec: Any, order: str
) -> None:
    folder = writers.zarr(tmp_path / "m.zarr", FRAMES, compressor=codec, order=order)
    assert (every_pixel(opened(folder)) == FRAMES).all()


@pytest.mark.parametrize("chunks", [(1, 1, 1), (5, 4, 3), (7, 9, 8), (3, 2, 2)], ids=str)
def test_a_zarr_movie_gives_the_same_in_chunks_of_any_size(tmp_path: Path, chunks: Any) -> None:
    folder = writers.zarr(tmp_path / "m.zarr", FRAMES, chunks=chunks, separator="/")
    assert (every_pixel(opened(folder)) == FRAMES).all()


def test_a_zarr_movie_lies_as_its_attributes_say_and_knows_its_source(tmp_path: Path) -> None:
    said = writers.attributes(FRAMES.shape, source_location_px=[1, 2], camera="blue")
    footage = opened(writers.zarr(tmp_path / "m.zarr", FRAMES, said=said))
    facts = footage.facts
    assert (facts.fps, facts.cell, facts.low) == (4.0, (0.5, 2.0), (-3.25, 9.0))
    assert facts.source == (-2.5, 14.0)  # 1 pixel of 0.5 right of −3, 2 of 2.0 above 10
    assert at(footage, *facts.source, 3) == FRAMES[3, 2, 1]
    assert facts.unread == ("attribute 'camera'", "attribute 'source_dtype'")


def test_a_chunk_that_is_not_there_has_the_fill_value(tmp_path: Path) -> None:
    folder = writers.zarr(tmp_path / "m.zarr", FRAMES, chunks=(1, 4, 3), fill_value=7.5)
    (folder / "concentration" / "2.0.0").unlink()
    wanted = FRAMES.copy()
    wanted[2] = 7.5
    assert (every_pixel(opened(folder)) == wanted).all()


def test_what_else_is_in_a_file_is_said_not_to_be_read(tmp_path: Path) -> None:
    import h5py

    path = writers.numbered(tmp_path / "m.h5", FRAMES)
    with h5py.File(path, "a") as file:
        file["speed"] = 3.0
    assert opened(path).facts.unread == ("dataset 'speed'",)


# ---- between the pixels ----


def test_between_pixels_gas_is_linear_and_outside_it_is_0(tmp_path: Path) -> None:
    footage = opened(writers.npy(tmp_path / "m.npy", FRAMES))
    assert at(footage, 0.5, 2.25, 1) == 12 + 3 * 2.25 + 0.5
    assert at(footage, 2.0, 3.0, 4) == FRAMES[4, 3, 2]
    assert at(footage, 2.4, 3.4, 4) == FRAMES[4, 3, 2]  # in the outer half of the last pixel
    for x, y in ((2.6, 1.0), (-0.6, 1.0), (1.0, 3.6), (1.0, -0.6), (1e300, 1.0)):
        assert at(footage, x, y, 4) == 0


def test_a_corner_of_four_pixels_is_weighed_by_hand(tmp_path: Path) -> None:
    pixels = np.array([[[1.0, 3.0], [8.0, 4.0]]])
    footage = opened(writers.npy(tmp_path / "m.npy", pixels))
    # a quarter right, three quarters up: below 1.5, above 7; then 1.5/4 + 3 · 7/4
    assert at(footage, 0.25, 0.75, 0) == 5.625


def test_a_movie_of_one_pixel_is_that_pixel(tmp_path: Path) -> None:
    footage = opened(writers.npy(tmp_path / "m.npy", np.full((1, 1, 1), 2.5)))
    assert [at(footage, x, 0.1, 0) for x in (-0.4, 0.0, 0.4, 0.6)] == [2.5, 2.5, 2.5, 0.0]


def test_what_is_no_gas_counts_as_none(tmp_path: Path) -> None:
    pixels = np.array([[[-1.0, 2.0], [np.nan, np.inf]]])
    footage = opened(writers.npy(tmp_path / "m.npy", pixels))
    assert every_pixel(footage).ravel().tolist() == [0.0, 2.0, 0.0, 0.0]


def test_a_pixel_is_the_same_whatever_was_asked_before_and_beside_it(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    frames = rng.random((9, 6, 7)).astype(np.float32)
    places, when = rng.uniform(-1, 7, (200, 3)), rng.integers(0, 9, 200)
    folder = writers.zarr(tmp_path / "m.zarr", frames, said=writers.attributes(frames.shape, origin=0.0))
    together = opened(folder).gas(places, when)
    alone = [
        opened(folder).gas(place[None], number[None])[0] for place, number in zip(places, when, strict=True)
    ]
    assert together.tolist() == alone
    assert 0 < np.count_nonzero(together) < 200


def test_only_so_much_of_a_movie_stays_in_memory() -> None:
    read: list[int] = []

    def number(which: int) -> int:
        read.append(which)
        return which

    recent = LastRead(number, lambda _: 10, most=30)
    assert [recent[which] for which in (1, 2, 3, 1, 4, 1, 2)] == [1, 2, 3, 1, 4, 1, 2]
    assert read == [1, 2, 3, 4, 2]  # 2 was the longest unasked for when 4 came; then 3 went


def test_a_movie_of_gigabytes_is_read_frame_by_frame(tmp_path: Path) -> None:
    """The files have holes where nothing was written: they take no room here."""
    import h5py

    head = "{'descr': '<f4', 'fortran_order': False, 'shape': (2048, 1024, 1024), }".ljust(117) + "\n"
    with (tmp_path / "m.npy").open("wb") as file:
        file.write(b"\x93NUMPY\1\0" + struct.pack("<H", len(head)) + head.encode())
        file.truncate(128 + 2048 * 2**22)
    with h5py.File(tmp_path / "m.h5", "w") as file:
        file.create_dataset("movie", (2048, 1024, 1024), "<f4", chunks=(4, 512, 512), fillvalue=2.5)
    (tmp_path / "m.h5.plume-movie.yaml").write_text("{fps: 1, spatial_unit: pixel, h5_dataset: movie}")
    tracemalloc.start()
    for name, gas in (("m.npy", 0.0), ("m.h5", 2.5)):
        footage = opened(tmp_path / name)
        assert {at(footage, 500.5, 300.0, frame) for frame in range(0, 2048, 50)} == {gas}
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 200 * 2**20  # of 8 GiB
