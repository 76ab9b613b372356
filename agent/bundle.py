"""A learned policy as data: one zip file of an ONNX graph and a page of JSON that says what it sees, how it moves and how it was made.

Flying one needs onnxruntime: no torch, and no pickle, so that a file from a stranger can only steer, not run code.
"""

import zipfile
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from agent.moves import Move, Reach
from agent.observation import SCHEMAS, Schema
from link.messages import Belief, Particles

FORMAT = 1
GRAPH, PAGE = "policy.onnx", "bundle.json"
MOST_BYTES = 64 * 2**20
"""Of either part: a bundle that claims more is not read."""


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


class Bundle:
    """A learned policy, ready to fly."""

    def __init__(self, page: Page, graph: bytes) -> None:
        """Open the graph. Raises BundleError where it does not fit what the page says, or this version of the project."""
        import onnxruntime

        self.page = page
        self._schema = _schema_of(page)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1  # a decision is too small to share
        options.log_severity_level = 4  # what is wrong is said by the exception
        try:
            self._session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's own kinds have no common base
            raise BundleError(f"{GRAPH} is no graph that onnxruntime can run: {_line(error)}") from error
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        shapes = [port.shape[-1] if len(port.shape) == 2 else port.shape for port in (*inputs, *outputs)]
        if shapes != [page.observation, page.move.outputs]:
            raise BundleError(f"{GRAPH} has ports {shapes}; wanted (1, {page.observation}) in and (1, {page.move.outputs}) out")
        self._input = inputs[0].name
        said = self._say(np.zeros(page.observation, np.float32))
        if said.shape != (page.move.outputs,):
            raise BundleError(f"{GRAPH} gives {said.shape}; wanted ({page.move.outputs},)")

    def _say(self, observation: NDArray[np.float32]) -> NDArray[np.float64]:

        try:
            return np.asarray(self._session.run(None, {self._input: observation[None]})[0][0], np.float64)
        except Exception as error:
            raise BundleError(f"{GRAPH} does not run: {_line(error)}") from error

    def waypoint(self, belief: Belief, particles: Particles, reach: Reach, _rng: np.random.Generator) -> tuple[float, float]:
        """Return the next waypoint (x, y) m; no randomness is used: a learned policy flies its best guess."""
        observation, frame = self._schema.see(belief, particles)
        move = self.page.move
        action = move.action(self._say(observation)[None])
        x, y = move.waypoints(np.array([belief.position]), frame[None], action, reach.area_m)[0].tolist()
        return x, y


def _schema_of(page: Page) -> Schema:
    if page.format != FORMAT:
        raise BundleError(f"bundle format {page.format}; wanted {FORMAT}")
    schema = SCHEMAS.get(page.schema)
    if schema is None:
        raise BundleError(f"observation {page.schema!r} is not known; wanted {' or '.join(SCHEMAS)}")
    if (page.schema_version, page.observation) != (schema.version, schema.size):
        raise BundleError(
            f"observation {page.schema!r} version {page.schema_version} of {page.observation} numbers; "
            f"wanted version {schema.version} of {schema.size}: train it anew"
        )
    return schema


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]


def read(path: Path) -> tuple[Page, bytes]:
    """Read a bundle's parts. Raises BundleError with what is wrong with the file."""
    try:
        with zipfile.ZipFile(path) as file:
            for name in (PAGE, GRAPH):
                if file.getinfo(name).file_size > MOST_BYTES:
                    raise BundleError(f"{name} is larger than {MOST_BYTES >> 20} MiB")
            return msgspec.json.decode(file.read(PAGE), type=Page), file.read(GRAPH)
    except FileNotFoundError as error:
        raise BundleError("there is no such file") from error
    except KeyError as error:
        raise BundleError(f"no bundle: {_line(error)}; wanted {PAGE} and {GRAPH}") from error
    except msgspec.DecodeError as error:
        raise BundleError(f"{PAGE}: {_line(error)}") from error
    except (OSError, zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError, ValueError) as error:
        raise error if isinstance(error, BundleError) else BundleError(f"no bundle: {_line(error)}") from error


def load(path: Path) -> Bundle:
    """Read and open a bundle. Raises BundleError."""
    return Bundle(*read(path))


def write(path: Path, page: Page, graph: bytes) -> None:
    """Write a bundle; the same parts give the same bytes."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, part in ((PAGE, msgspec.json.format(msgspec.json.encode(page))), (GRAPH, graph)):
            file.writestr(zipfile.ZipInfo(name), part, zipfile.ZIP_DEFLATED)
