"""Protects those who have a movie that is wrong or cut off: it is refused in one line that says what is wrong."""

import json
import os
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plume.recorded.opening import opened
from tests.plume.recorded import writers
from tests.plume.recorded.looks import BLOSC, FRAMES, every_pixel, refused


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


def test_a_numpy_movie_that_is_cut_off_while_it_is_open_is_one_line(tmp_path: Path) -> None:
    """Who looks at a page of it that is gone is ended by the system, so a process of its own looks."""
    path = writers.npy(tmp_path / "m.npy", np.ones((3, 64, 64)))
    look = (
        "import os, sys; from pathlib import Path; import numpy as np\n"
        "from plume.recorded.opening import opened\n"
        "path = Path(sys.argv[1]); movie = opened(path); size = path.stat().st_size\n"
        "place, frame = np.array([[5.0, 60.0, 0.0]]), np.array([2])\n"
        "print(movie.gas(place, frame)); os.truncate(path, 4096)\n"
        "try: movie.gas(place, frame)\n"
        "except ValueError as error: print(error)\n"
        "os.truncate(path, size); print(movie.gas(place, frame))\n"
        "path.unlink(); print(movie.gas(place, frame))\n"
    )
    size = path.stat().st_size
    done = subprocess.run([sys.executable, "-c", look, path], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.splitlines()) == (
        0,
        ["[1.]", f"{path}: 4,096 bytes are left of {size:,}; wanted all of them", "[0.]", "[0.]"],
    ), done.stderr


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


@pytest.mark.timeout(400)
def test_a_sidecar_whose_merge_keys_expand_to_billions_of_values_is_refused(tmp_path: Path) -> None:
    lines = [f"a{k}: &a{k} {{<<: [{', '.join([f'*a{k - 1}'] * 20)}]}}" for k in range(1, 9)]
    path = writers.with_sidecar(tmp_path / "m.h5", FRAMES, "\n".join(["a0: &a0 {x: 1}", *lines]))
    assert refused(path).startswith(".plume-movie.yaml: not valid YAML: more than 20,000 values")


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


@pytest.mark.parametrize("name", [".zattrs", "concentration/.zarray", "concentration/0.0.0"])
def test_what_is_no_file_in_a_folder_of_zarr_is_refused_and_not_waited_for(tmp_path: Path, name: str) -> None:
    path = writers.zarr(tmp_path / "m.zarr", FRAMES) / name
    path.unlink()
    os.mkfifo(path)
    assert refused(tmp_path / "m.zarr") == f"/{name}: not a file; wanted one"
    path.unlink()
    path.symlink_to("/dev/zero")
    assert refused(tmp_path / "m.zarr") == f"/{name}: not a file; wanted one"


def test_a_chunk_that_cannot_be_read_is_one_line(tmp_path: Path) -> None:
    path = writers.zarr(tmp_path / "m.zarr", FRAMES) / "concentration" / "0.0.0"
    path.unlink()
    path.symlink_to(path.name)
    assert refused(tmp_path / "m.zarr") == "/concentration/0.0.0: Too many levels of symbolic links"


def test_a_pipe_in_the_place_of_a_sidecar_is_not_waited_for(tmp_path: Path) -> None:
    path = writers.with_sidecar(tmp_path / "m.h5", FRAMES)
    (tmp_path / "m.h5.plume-movie.yaml").unlink()
    os.mkfifo(tmp_path / "m.h5.plume-movie.yaml")
    assert refused(path) == ".plume-movie.yaml: not a file; wanted one"
