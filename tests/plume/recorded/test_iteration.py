"""Protects the reading of GADEN's iterations: every version says what was written, and a file that is wrong,
cut off or a bomb is refused in one line that names the field and what was expected.
"""

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plume.recorded.iteration import GASES, Moment, read
from tests.plume.recorded import writers
from tests.plume.recorded.writers import ALL_VERSIONS, content

SHAPES = {"point": (), "box": (1, 2, 3), "line": (4, 5, 6), "sphere": (0.5,), "cylinder": (0.5, 2)}
PPM = np.arange(6 * 5 * 4, dtype=np.float32).reshape(4, 5, 6)


def moment(tmp_path: Path, data: bytes) -> Moment:
    path = tmp_path / "iteration_0"
    path.write_bytes(writers.packed(data))
    return read(path)


def refused(tmp_path: Path, data: bytes, packed: bool = True) -> str:
    """The line with which a file is refused, without its name."""
    path = tmp_path / "iteration_0"
    path.write_bytes(writers.packed(data) if packed else data)
    with pytest.raises(ValueError, match="iteration_0") as raised:
        read(path)
    line = str(raised.value)
    assert len(line.splitlines()) == 1
    assert line.startswith(f"{path}: ")
    return line.removeprefix(f"{path}: ")


@pytest.mark.parametrize("version", ALL_VERSIONS)
def test_every_version_says_what_was_written(tmp_path: Path, version: str) -> None:
    found = moment(tmp_path, content(version, wind=3))
    assert found.version == version
    assert found.grid == ((6, 5, 4), (-1.0, 0.5, 0.0), (2.0, 3.0, 2.0), 0.5)
    assert found.wind == 3
    assert (found.moles, found.air) == pytest.approx((writers.MOLES, writers.AIR), rel=1e-7)
    assert found.filaments == pytest.approx(np.array(writers.FILAMENTS), rel=1e-7)
    assert found.ppm is None
    if version in ("2.6", "2.9"):
        assert (found.source, found.gas, found.shape) == (None, "", "")
    else:
        assert (found.source, found.gas, found.shape) == (writers.SOURCE, "methane", "point")


@pytest.mark.parametrize("version", ALL_VERSIONS)
def test_a_moment_without_filaments_is_one(tmp_path: Path, version: str) -> None:
    found = moment(tmp_path, content(version, filaments=[]))
    assert found.filaments is not None
    assert found.filaments.shape == (0, 4)


@pytest.mark.parametrize("shape", SHAPES)
def test_every_shape_of_a_source_is_read_past(tmp_path: Path, shape: str) -> None:
    found = moment(tmp_path, content("3.0", shape=shape, sizes=SHAPES[shape]))
    assert (found.shape, found.source, found.gas) == (shape, writers.SOURCE, "methane")
    assert found.filaments is not None
    assert len(found.filaments) == 3


def test_concentrations_are_one_a_cell_along_x_first(tmp_path: Path) -> None:
    found = moment(tmp_path, content("3.0", ppm=PPM))
    assert found.filaments is None
    assert found.ppm is not None
    assert (found.ppm == PPM).all()


def test_every_gas_has_its_name(tmp_path: Path) -> None:
    found = [moment(tmp_path, content("3.0", gas=code)).gas for code in range(-1, 14)]
    assert found == ["", *GASES]
    assert (found[1], found[2], found[14]) == ("ethanol", "methane", "smoke")


@pytest.mark.parametrize("version", ALL_VERSIONS)
def test_every_place_at_which_a_file_may_be_cut_off(tmp_path: Path, version: str) -> None:
    whole = content(version)
    each = 36 if version[0] == "1" or version in ("2.0", "2.3", "2.5") else 20
    head = len(whole) - 3 * each
    for length in range(len(whole)):
        if length >= head and version[0] != "3" and (length - head) % each == 0:
            continue  # a whole number of filaments
        told = refused(tmp_path, whole[:length])
        if length >= head:
            assert told.startswith("filaments: ")
            assert f"{each} bytes for each filament" in told
        else:
            assert "bytes, but the file ends after" in told


@pytest.mark.parametrize(
    ("version", "length", "told"),
    [
        ("1", 3, "version: wanted 4 bytes, but the file ends after 3"),
        ("1", 30, "highest corner: wanted 24 bytes, but the file ends after 2"),
        ("1", 60, "cells: wanted 12 bytes, but the file ends after 8"),
        ("2.3", 6, "minor version: wanted 4 bytes, but the file ends after 2"),
        ("2.3", 50, "place of the source: wanted 12 bytes, but the file ends after 2"),
        ("2.3", 62, "gas: wanted 4 bytes, but the file ends after 2"),
        ("2.3", 79, "moles of a filament and of air: wanted 16 bytes, but the file ends after 15"),
        ("2.6", 57, "number of the wind: wanted 4 bytes, but the file ends after 1"),
        ("3.0", 50, "length of the shape of the source: wanted 8 bytes, but the file ends after 2"),
        ("3.0", 60, "shape of the source: wanted 5 bytes, but the file ends after 4"),
        ("3.0", 92, "length of the mode: wanted 8 bytes, but the file ends after 3"),
        ("3.0", 100, "mode: wanted 9 bytes, but the file ends after 3"),
        ("3.0", 110, "number of filaments: wanted 8 bytes, but the file ends after 4"),
        ("3.0", 150, "filaments: 36 bytes are left; wanted 60, 20 bytes for each filament of 3"),
    ],
)
def test_where_a_file_is_cut_off_is_said_by_the_field(
    tmp_path: Path, version: str, length: int, told: str
) -> None:
    assert refused(tmp_path, content(version)[:length]) == told


@pytest.mark.parametrize("version", ALL_VERSIONS)
def test_bytes_too_many_are_told(tmp_path: Path, version: str) -> None:
    assert refused(tmp_path, content(version) + b"\0").startswith("filaments: ")


@pytest.mark.parametrize(
    ("field", "told"),
    [
        ({"version": "4.0"}, "version: 4.0; wanted 1, 2.x or 3.x"),
        ({"cells": (6, 0, 4)}, "cells: (6, 0, 4); wanted at least 1 each, 16,777,216 in all"),
        ({"cells": (-6, -5, 4)}, "cells: (-6, -5, 4); wanted at least 1 each, 16,777,216 in all"),
        ({"cells": (9999, 9999, 9999)}, "cells: (9999, 9999, 9999); wanted at least 1 each, 16,777,216 in"),
        ({"side": 0.0}, "side of a cell: 0; wanted a number above 0"),
        ({"side": float("nan")}, "(nan, nan, nan); wanted finite numbers"),
        ({"low": (float("inf"), 0, 0)}, "lowest corner: (inf, 0.0, 0.0); wanted finite numbers"),
        ({"shape": "cone"}, "shape of the source: 'cone'; wanted point, box, line, sphere, cylinder"),
        ({"shape": "p" * 40}, "length of the shape of the source: 40; wanted at most 32"),
        ({"source": (0, float("nan"), 0)}, "place of the source: (0.0, nan, 0.0); wanted finite numbers"),
        ({"gas": 14}, "gas: 14; wanted -1 to 13"),
        ({"gas": -2}, "gas: -2; wanted -1 to 13"),
        ({"air": 0.0}, "moles of a filament and of air: 0.0002 and 0; wanted numbers above 0"),
        ({"moles": -1.0}, "moles of a filament and of air: -1 and 4.089e-05; wanted numbers above 0"),
        ({"mode": "clouds"}, "mode: 'clouds'; wanted 'filaments' or 'concentrations'"),
        ({"filaments": [(1, 1, 1, 5), (1, 1, 1, 0)]}, "filament 1: x, y, z, σ: [1.0, 1.0, 1.0, 0.0]; wanted"),
        ({"filaments": [(1, float("nan"), 1, 5)]}, "filament 0: x, y, z, σ: [1.0, nan, 1.0, 5.0]; wanted"),
        ({"ppm": PPM[1:]}, "number of concentrations: 90; wanted 120, one a cell"),
        ({"ppm": -PPM}, "concentrations: wanted finite numbers from 0"),
        ({"ppm": PPM * np.float32("nan")}, "concentrations: wanted finite numbers from 0"),
    ],
    ids=str,
)
def test_a_field_that_is_wrong_is_named(tmp_path: Path, field: Any, told: str) -> None:
    assert told in refused(tmp_path, content(**({"version": "3.0"} | field)))


def test_corners_that_do_not_fit_the_cells_are_told(tmp_path: Path) -> None:
    data = bytearray(content("2.3"))
    struct.pack_into("<f", data, 8 + 12 + 12, 4.0)  # x of the highest corner
    assert refused(tmp_path, bytes(data)) == "corners: -1 to 4 along x; wanted 6 cells of 0.5 m"


def test_a_file_is_one_whole_zlib_stream(tmp_path: Path) -> None:
    whole = writers.packed(content())
    assert refused(tmp_path, content(), packed=False).endswith("; wanted one zlib stream")
    assert refused(tmp_path, b"", packed=False) == "the zlib stream is cut off, after 0 bytes of its content"
    assert refused(tmp_path, whole + b"more", packed=False) == "4 bytes follow the zlib stream; wanted none"
    for length in range(len(whole)):
        assert refused(tmp_path, whole[:length], packed=False).startswith("the zlib stream is cut off, after")
    broken = bytearray(whole)
    broken[-1] ^= 1
    assert "incorrect data check" in refused(tmp_path, bytes(broken), packed=False)


def test_a_bomb_takes_no_more_memory_than_a_frame_may(tmp_path: Path) -> None:
    bomb = zlib.compressobj(9)
    data = content("2.3", filaments=[])
    packed = bomb.compress(data) + b"".join(bomb.compress(bytes(2**20)) for _ in range(65)) + bomb.flush()
    assert len(packed) < 100_000
    assert refused(tmp_path, packed, packed=False) == "more than 64 MiB in it; wanted fewer"


def test_a_file_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"iteration_9: No such file or directory$"):
        read(tmp_path / "iteration_9")
