"""Opens a recorded plume, whichever kind it is."""

from pathlib import Path

from plume.recorded import gaden, hdf5, npy, zarr
from plume.recorded.footage import Footage

KINDS = "a .npy or .h5 movie, a folder of Zarr, or the folder of GADEN's iteration_0, iteration_1, …"


def opened(path: Path, gas: str = "") -> Footage:
    """Open a recorded plume. Raises ValueError.

    gas: what GADEN's gas is, where its results do not say, or say wrongly.
    """
    is_gaden = path.is_dir() and any(path.glob("iteration_*"))
    if gas and not is_gaden:
        raise ValueError(f"gas is {gas!r}; wanted it of GADEN's results only: gain turns a movie into g/m³")
    try:
        if is_gaden:
            return gaden.GadenRun(path, gas)
        if path.is_dir() and any((path / name).exists() for name in (".zgroup", ".zattrs", "zarr.json")):
            return zarr.movie(path)
        if path.is_file() and path.suffix == ".npy":
            return npy.movie(path)
        if path.is_file() and path.suffix in (".h5", ".hdf5"):
            return hdf5.movie(path)
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror or error}") from None
    raise ValueError(f"{path}: {'not a recorded plume' if path.exists() else 'no such file'}; wanted {KINDS}")
