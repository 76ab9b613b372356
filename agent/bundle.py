"""A learned policy as data: one zip file of an ONNX graph and a page of JSON that says what it sees, how it moves and how it was made.

Flying one needs onnxruntime: no torch, and no pickle, so that a file from a stranger can only steer, not run code.
"""

import os
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from agent.planning.moves import Headings, Move, Reach
from link.bus.messages import Belief, Particles

if TYPE_CHECKING:
    from agent.observation import Schema

FORMAT = 1
GRAPH, PAGE = "policy.onnx", "bundle.json"
MOST_BYTES = 64 * 2**20
"""Of either part: a bundle that claims more is not read."""
MOST_HEADINGS = 1024
MOST_STEP_M = 10.0


class BundleError(ValueError):
    """A bundle that cannot be flown, in one line."""


class Point(msgspec.Struct, frozen=True):
    """How training stood: over the missions that ended since the point before."""

    steps: int
    ceased: float
    located: float
    mtd_m: float | None


class Page(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a bundle says of itself."""

    format: int
    algorithm: str
    schema: Annotated[str, Meta(description="name of the observation")]
    schema_version: int
    observation: Annotated[int, Meta(gt=0, description="numbers in an observation")]
    move: Move
    seed: int
    training: dict[str, Any]
    """The recipe: every setting that the run was made with."""
    curve: list[Point]
    evaluation: dict[str, Any]
    """Figures with intervals, by number of particles, as `evaluate` gives them; empty before."""


class _Format(msgspec.Struct):
    format: int


class Bundle:
    """A learned policy, ready to fly."""

    def __init__(self, page: Page, graph: bytes) -> None:
        """Open the graph. Raises BundleError where it does not fit what the page says, or this version of the project."""
        import onnxruntime

        self.page = page
        self._schema = _schema_of(page)
        _check(page.move)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1  # a decision is too small to share
        options.log_severity_level = 4  # what is wrong is said by the exception
        options.add_session_config_entry("session.model_external_initializers_file_folder_path", os.devnull)  # weights of other files: none
        try:
            self._session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's own kinds have no common base
            raise BundleError(f"{GRAPH} is no graph that onnxruntime can run: {_line(error)}") from error
        ports = (("takes", self._session.get_inputs(), page.observation), ("gives", self._session.get_outputs(), page.move.outputs))
        for verb, arrays, size in ports:
            shapes = [array.shape for array in arrays]
            if len(shapes) != 1 or len(shapes[0]) != 2 or shapes[0][1] != size:
                raise BundleError(f"{GRAPH} {verb} arrays of {shapes}; wanted one, of [1, {size}]")
        self._input = self._session.get_inputs()[0].name
        self._say(np.zeros(page.observation, np.float32))

    def _say(self, observation: NDArray[np.float32]) -> NDArray[np.float64]:
        """What the network says, (1, A), never NaN: of that even a best one could be chosen."""
        try:
            said = np.asarray(self._session.run(None, {self._input: observation[None]})[0], np.float64)
        except Exception as error:
            raise BundleError(f"{GRAPH} does not run: {_line(error)}") from error
        if said.shape != (1, self.page.move.outputs):
            raise BundleError(f"{GRAPH} gives {list(said.shape)}; wanted [1, {self.page.move.outputs}]")
        if np.isnan(said).any():
            raise BundleError(f"{GRAPH} says NaN; wanted numbers")
        return said

    def waypoint(self, belief: Belief, particles: Particles, reach: Reach, _rng: np.random.Generator) -> tuple[float, float]:
        """Return the next waypoint (x, y) m; no randomness is used: a learned policy flies its best guess."""
        observation, frame = self._schema.see(belief, particles)
        move = self.page.move
        action = move.action(self._say(observation))
        x, y = move.waypoints(np.array([belief.position]), frame[None], action, reach.area_m)[0].tolist()
        return x, y


def _schema_of(page: Page) -> "Schema":
    from agent.observation import SCHEMAS  # compiles: a bundle that is only looked into does not need it

    schema = SCHEMAS.get(page.schema)
    if schema is None:
        raise BundleError(f"observation {page.schema!r} is not known; wanted {' or '.join(SCHEMAS)}")
    if (page.schema_version, page.observation) != (schema.version, schema.size):
        raise BundleError(
            f"observation {page.schema!r} version {page.schema_version} of {page.observation} numbers; "
            f"wanted version {schema.version} of {schema.size}: train it anew"
        )
    return schema


def _check(move: Move) -> None:
    if isinstance(move, Headings) and not 2 <= move.count <= MOST_HEADINGS:
        raise BundleError(f"move of {move.count} headings; wanted from 2 to {MOST_HEADINGS}")
    if not 0 < move.step_m <= MOST_STEP_M:
        raise BundleError(f"move of {move.step_m:g} m; wanted above 0 up to {MOST_STEP_M:g}")


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]


def read(path: Path) -> tuple[Page, bytes]:
    """Read a bundle's parts. Raises BundleError with what is wrong with the file."""
    try:
        with zipfile.ZipFile(path) as file:
            said, graph = (_member(file, name) for name in (PAGE, GRAPH))
    except BundleError:
        raise
    except FileNotFoundError as error:
        raise BundleError("there is no such file") from error
    except Exception as error:  # what zipfile and zlib raise on a broken file has no common base
        raise BundleError(f"no bundle: {_line(error)}; wanted a zip file of {PAGE} and {GRAPH}") from error
    try:
        version = msgspec.json.decode(said, type=_Format).format  # first, so that it is named where it is why the rest does not fit
        if version != FORMAT:
            raise BundleError(f"bundle format {version}; wanted {FORMAT}")
        return msgspec.json.decode(said, type=Page), graph
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise BundleError(f"{PAGE}: {_line(error)}") from error


def _member(file: zipfile.ZipFile, name: str) -> bytes:
    if name not in file.namelist():
        raise BundleError(f"no bundle: it has no {name}; wanted a zip file of {PAGE} and {GRAPH}")
    info = file.getinfo(name)
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise BundleError(f"{name} is compressed by method {info.compress_type}; wanted deflate, or none")
    if info.file_size > MOST_BYTES:
        raise BundleError(f"{name} is larger than {MOST_BYTES >> 20} MiB")
    with file.open(info) as member:
        return member.read(info.file_size)  # without a size, all is unpacked before it is seen to be more than was claimed


def load(path: Path) -> Bundle:
    """Read and open a bundle. Raises BundleError."""
    return Bundle(*read(path))


def write(path: Path, page: Page, graph: bytes) -> None:
    """Write a bundle, whole or not at all; the same parts give the same bytes."""
    partial = path.with_name(f"{path.name}.partial")
    with zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as file:
        for name, part in ((PAGE, msgspec.json.format(msgspec.json.encode(page))), (GRAPH, graph)):
            file.writestr(zipfile.ZipInfo(name), part, zipfile.ZIP_DEFLATED)
    partial.replace(path)
