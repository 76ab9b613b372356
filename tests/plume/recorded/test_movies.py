"""Protects the movies: each kind of file gives the pixels that were written, interpolated in between, and a
file that is wrong or cut off is refused in one line that says what is wrong.
"""

import json
import re
import struct
import sys
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plume.recorded.footage import LastRead
from plume.recorded.opening import opened
from tests.plume.recorded import writers

FRAMES = np.arange(5 * 4 * 3, dtype=np.float32).reshape(5, 4, 3)
"""5 frames of 4 rows and 3 columns: pixel (t, j, i) is 12 t + 3 j + i, linear in each."""
BLOSC = {"id": "blosc", "cname": "zstd", "clevel": 3, "shuffle": 1, "blocksize": 0}


def at(footage: Any, x: float, y: float, frame: int) -> float:
    return float(footage.gas(np.array([[x, y, 0.0]]), np.array([frame]))[0])


def every_pixel(footage: Any) -> np.ndarray:
    """The gas at the centre of each pixel in each frame (t, y, x)."""
    facts = footage.facts
    x, y = (
        low + step * (np.arange(count) + 0.5)
        for low, step, count in zip(facts.low, facts.cell, facts.cells, strict=True)
    )
    t, y, x = (each.ravel() for each in np.meshgrid(np.arange(facts.frames), y, x, indexing="ij"))
    gas = footage.gas(np.column_stack([x, y, 0 * x]), t)
    return gas.reshape(facts.frames, *facts.cells[::-1])


def refused(path: Path) -> str:
    """The line with which a file is refused, without its name."""
    with pytest.raises(ValueError, match=re.escape(f"{path}")) as raised:
        every_pixel(opened(path))
    line = str(raised.value)
    assert len(line.splitlines()) == 1
    return line.removeprefix(f"{path}")


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


# ---- files that are wrong ----


def test_every_place_at_which_a_numpy_movie_may_be_cut_off(tmp_path: Path) -> None:
    path = writers.npy(tmp_path / "m.npy", FRAMES[:1])
    whole = path.read_bytes()
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        line = refused(path)
        if length < len(whole) - FRAMES[:1].nbytes:
            assert line == ": head: not that of an array; wanted a .npy file"
        else:
            assert line == f": {length:,} bytes; wanted {len(whole):,} for (1, 4, 3) of float32"


@pytest.mark.parametrize(
    ("array", "told"),
    [
        (np.zeros((3, 3)), ": shape: (3, 3); wanted (frames, rows, columns), each at least 1"),
        (np.zeros((0, 3, 3)), ": shape: (0, 3, 3); wanted (frames, rows, columns), each at least 1"),
        (np.zeros((1, 2, 2), complex), ": type: complex128; wanted float16 to float64, or whole numbers"),
        (np.zeros((1, 2, 2), "S3"), ": type: |S3; wanted float16 to float64, or whole numbers"),
        (np.array([[[None]]]), ": type: object; wanted float16 to float64, or whole numbers"),
    ],
    ids=str,
)
def test_an_array_that_is_no_movie(tmp_path: Path, array: Any, told: str) -> None:
    np.save(tmp_path / "m.npy", array)
    assert refused(tmp_path / "m.npy") == told


def test_a_frame_that_is_too_large_is_not_even_mapped(tmp_path: Path) -> None:
    head = "{'descr': '<f8', 'fortran_order': False, 'shape': (2, 999999, 999999), }\n"
    (tmp_path / "m.npy").write_bytes(b"\x93NUMPY\1\0" + struct.pack("<H", len(head)) + head.encode())
    assert refused(tmp_path / "m.npy") == ": shape: (2, 999999, 999999); wanted at most 64 MiB a frame"


def test_an_hdf5_file_without_a_movie(tmp_path: Path) -> None:
    import h5py

    path = tmp_path / "m.h5"
    path.write_bytes(b"no HDF5 at all")
    assert refused(path).startswith(": HDF5: Unable to ")
    with h5py.File(path, "w") as file:
        file["odor/0"] = FRAMES[0]
    assert refused(path) == (
        ": no dataset '0' and no m.h5.plume-movie.yaml; wanted a dataset for each frame, '0', '1', …, "
        "or that file"
    )
    with h5py.File(path, "w") as file:
        file["0/odor"] = FRAMES[0]
    assert refused(path) == ": '0' is no dataset; wanted one with the frames"


def test_a_frame_that_is_missing_or_unlike_the_first(tmp_path: Path) -> None:
    import h5py

    path = writers.numbered(tmp_path / "m.h5", FRAMES)
    with h5py.File(path, "a") as file:
        del file["1"]
    assert refused(path) == ": no dataset '1', but '2', '3', '4'; wanted every frame"
    with h5py.File(path, "a") as file:
        file["1"] = np.zeros((4, 4), np.float32)
    assert refused(path) == ": frame 1: (4, 4) of float32; wanted (4, 3) of float32 as in frame 0"


def test_a_dataset_that_leads_to_another_file_is_not_followed(tmp_path: Path) -> None:
    import h5py

    writers.numbered(tmp_path / "other.h5", FRAMES)
    path = tmp_path / "m.h5"
    with h5py.File(path, "w") as file:
        file["0"] = h5py.ExternalLink("other.h5", "0")
    assert refused(path) == ": no dataset '0' in the file itself; it has '0'"
    (tmp_path / "secret").write_bytes(bytes(48))
    with h5py.File(path, "w") as file:
        file.create_dataset("0", (4, 3), "<f4", external=[(str(tmp_path / "secret"), 0, 48)])
    assert refused(path) == ": dataset '0' lies in other files; wanted one in the file itself"


def test_an_hdf5_movie_that_is_cut_off(tmp_path: Path) -> None:
    path = writers.with_sidecar(tmp_path / "m.h5", FRAMES)
    whole = path.read_bytes()
    for length in (0, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        assert refused(path).startswith(": HDF5: Unable to ")


SIDECAR = "fps: 15\nspatial_unit: mm\npixels_per_unit: [1, 2]\nh5_dataset: Plume Data/dataset_001\n"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "Expected `object`, got `null`"),
        ("fps: [", "not valid YAML: while parsing a flow node"),
        (SIDECAR.replace("fps: 15\n", ""), "Object missing required field `fps`"),
        (SIDECAR.replace("15", "fast"), "Expected `float`, got `str` - at `$.fps`"),
        (SIDECAR.replace("15", "-1"), "fps: -1; wanted a number above 0"),
        (SIDECAR.replace("15", ".nan"), "fps: nan; wanted a number above 0"),
        (
            SIDECAR.replace("[1, 2]", "[1, 0]"),
            "pixels_per_unit: (1.0, 0.0); wanted two numbers above 0, of y",
        ),
        (SIDECAR.replace("[1, 2]", "[1]"), "Expected `array` of length 2, got 1 - at `$.pixels_per_unit`"),
        (
            SIDECAR.replace("pixels_per_unit: [1, 2]\n", ""),
            "pixels_per_unit: None; wanted two numbers above 0",
        ),
        (SIDECAR + "frames: 3\n", "Object contains unknown field `frames`"),
        (SIDECAR + "path: " + "x" * 70_000, "70,"),
    ],
)
def test_a_sidecar_that_is_wrong_says_which_field(tmp_path: Path, text: str, told: str) -> None:
    path = writers.with_sidecar(tmp_path / "m.h5", FRAMES, text or " ")
    assert refused(path).startswith(f".plume-movie.yaml: {told}")


def test_a_sidecar_whose_dataset_is_not_there(tmp_path: Path) -> None:
    path = writers.with_sidecar(tmp_path / "m.h5", FRAMES, SIDECAR.replace("_001", "_002"))
    assert refused(path) == (": no dataset 'Plume Data/dataset_002' in the file itself; it has 'Plume Data'")


@pytest.mark.parametrize(
    ("said", "told"),
    [
        ({"fps": None}, "Object missing required field `fps`"),
        ({"fps": 0}, "fps: 0; wanted a number above 0"),
        ({"fps": "4"}, "Expected `float`, got `str` - at `$.fps`"),
        ({"pixel_to_grid": [1]}, "Expected `array` of length 2 - at `$.pixel_to_grid`"),
        ({"pixel_to_grid": [-2, 0.5]}, "pixel_to_grid: (-2.0, 0.5); wanted numbers above 0, of y and x"),
        ({"origin": "lower"}, "Expected `float | array`, got `str` - at `$.origin`"),
        ({"origin": [1e300, 0]}, "origin: (1e+300, 0.0); wanted numbers below 1e9"),
        (
            {"extent": [8.0, 3.0]},
            "extent: (8.0, 3.0); wanted pixel_to_grid (2.0, 0.5) times the pixels (4, 3)",
        ),
    ],
    ids=str,
)
def test_an_attribute_that_is_wrong_says_which(tmp_path: Path, said: Any, told: str) -> None:
    folder = writers.zarr(tmp_path / "m.zarr", FRAMES, said=writers.attributes(FRAMES.shape, **said))
    assert refused(folder) == f"/.zattrs: {told}"


def test_an_extent_may_go_from_centre_to_centre_or_from_edge_to_edge(tmp_path: Path) -> None:
    for number, extent in enumerate(([8.0, 1.5], [6.0, 1.0])):
        said = writers.attributes(FRAMES.shape, extent=extent)
        assert opened(writers.zarr(tmp_path / f"{number}.zarr", FRAMES, said=said)).facts.fps == 4


@pytest.mark.parametrize(
    ("array", "told"),
    [
        ({"zarr_format": 3}, "zarr_format: 3; wanted 2"),
        ({"shape": [5, 12]}, "Expected `array` of length 3 - at `$.shape`"),
        ({"chunks": [1, 0, 1]}, "chunks: (1, 0, 1); wanted at most 64 MiB each"),
        ({"chunks": [99999, 99999, 99999]}, "chunks: (99999, 99999, 99999); wanted at most 64 MiB each"),
        (
            {"shape": [1, 4000, 4000], "chunks": [1, 1, 1]},
            "chunks: (1, 1, 1); wanted at most 65,536 a frame",
        ),
        ({"dtype": "<c8"}, "type: complex64; wanted float16 to float64, or whole numbers"),
        ({"dtype": "nonsense"}, "dtype: 'nonsense'; wanted one such as '<f4'"),
        ({"compressor": {"id": "lzma"}}, "compressor: 'lzma'; wanted null, blosc, zlib, gzip, zstd"),
        ({"fill_value": "much"}, "fill_value: 'much'; wanted a number"),
        ({"filters": [{}]}, "wanted filters null, order C or F, and dimension_separator . or /"),
        ({"order": "A"}, "wanted filters null, order C or F, and dimension_separator . or /"),
    ],
    ids=str,
)
def test_an_array_of_zarr_that_is_wrong_says_which_field(tmp_path: Path, array: Any, told: str) -> None:
    folder = writers.zarr(tmp_path / "m.zarr", FRAMES)
    file = folder / "concentration" / ".zarray"
    file.write_text(json.dumps(json.loads(file.read_text()) | array))
    assert refused(folder) == f"/concentration/.zarray: {told}"


def test_a_folder_of_zarr_that_is_of_another_version_or_has_no_movie(tmp_path: Path) -> None:
    (tmp_path / ".zgroup").write_text('{"zarr_format": 2}')
    assert refused(tmp_path) == ": no array 'concentration'; wanted concentration (t, y, x)"
    (tmp_path / "zarr.json").write_text("{}")
    assert refused(tmp_path) == ": zarr.json: Zarr of version 3; wanted version 2"


@pytest.mark.parametrize("codec", [None, {"id": "zlib"}, {"id": "gzip"}, {"id": "zstd"}, BLOSC], ids=str)
def test_every_place_at_which_a_chunk_may_be_cut_off(tmp_path: Path, codec: Any) -> None:
    folder = writers.zarr(tmp_path / "m.zarr", FRAMES, chunks=(5, 4, 3), compressor=codec)
    chunk = folder / "concentration" / "0.0.0"
    whole = chunk.read_bytes()
    for length in range(len(whole)):
        chunk.write_bytes(whole[:length])
        assert refused(folder).startswith("/concentration/0.0.0: ")


@pytest.mark.parametrize("codec", [None, {"id": "zlib"}, {"id": "gzip"}, {"id": "zstd"}, BLOSC], ids=str)
def test_a_chunk_that_holds_more_than_it_may_is_not_unpacked(tmp_path: Path, codec: Any) -> None:
    folder = writers.zarr(tmp_path / "m.zarr", FRAMES, chunks=(5, 4, 3), compressor=codec)
    chunk = folder / "concentration" / "0.0.0"
    chunk.write_bytes(writers.compressed(bytes(50_000_000 if codec else 241), codec))
    wanted = {
        "blosc": "blosc: its head says 50,000,000 bytes in",
    }.get(codec and codec["id"], "more bytes; wanted 240 of a chunk")
    assert refused(folder).startswith(f"/concentration/0.0.0: {wanted}")


def test_what_is_no_plume_at_all(tmp_path: Path) -> None:
    (tmp_path / "m.mp4").write_bytes(b"")
    (tmp_path / "empty").mkdir()
    kinds = (
        "wanted a .npy or .h5 movie, a folder of Zarr, or the folder of GADEN's iteration_0, iteration_1, …"
    )
    assert refused(tmp_path / "m.mp4") == f": not a recorded plume; {kinds}"
    assert refused(tmp_path / "empty") == f": not a recorded plume; {kinds}"
    assert refused(tmp_path / "gone.npy") == f": no such file; {kinds}"


def test_a_missing_library_is_one_line_that_says_how_to_install_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    movie = writers.numbered(tmp_path / "m.h5", FRAMES)
    folder = writers.zarr(tmp_path / "m.zarr", FRAMES, compressor=BLOSC)
    plain = writers.zarr(tmp_path / "plain.zarr", FRAMES)
    monkeypatch.setitem(sys.modules, "h5py", None)
    monkeypatch.setitem(sys.modules, "numcodecs", None)
    assert refused(movie) == ": needs h5py: pip install 'plumeward[plumes]'"
    assert refused(folder) == "/concentration/0.0.0: needs numcodecs: pip install 'plumeward[plumes]'"
    assert (every_pixel(opened(plain)) == FRAMES).all()


def test_json_that_is_none(tmp_path: Path) -> None:
    folder = writers.zarr(tmp_path / "m.zarr", FRAMES)
    (folder / ".zattrs").write_bytes(b"\xff{")
    assert refused(folder).startswith("/.zattrs: ")
    (folder / ".zattrs").write_text(json.dumps("x" * 2_000_000))
    assert refused(folder) == "/.zattrs: 2,000,002 bytes; wanted at most 1,048,576"
    (folder / ".zattrs").unlink()
    assert refused(folder) == "/.zattrs: No such file or directory"


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
