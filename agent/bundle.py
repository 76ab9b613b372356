"""A learned policy as data: a zip file of an ONNX graph and a JSON page.

Flying a bundle needs neither torch nor pickle: a file from a stranger can only steer, not run code.
"""

import zipfile
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from agent.facts import site_in, site_of
from agent.planning.moves import Headings, Move, Reach
from link.bus.messages import Belief, Particles
from link.files import whole
from plume.elementary import Array
from plume.problem import AREA, Problem
from plume.problems.names import named

FORMAT = 1
GRAPH, PAGE = "policy.onnx", "bundle.json"
MOST_BYTES = 64 * 2**20  # most bytes of the graph; a bundle that claims more is refused
MOST_PAGE_BYTES = 4 * 2**20  # most bytes of the page; in memory it takes many times that
MOST_HEADINGS = 1024
MOST_STEP_M = 10.0
ANYWHERE = {("polar-2", 2)}  # observations, with their versions, that know no problem of their own


class BundleError(ValueError):
    """The bundle cannot be flown; the text is one line."""


class CurvePoint(msgspec.Struct, frozen=True):
    """A point of the training curve: figures over the missions that ended since the previous point."""

    steps: int
    ceased: float
    located: float
    mtd_m: float | None


class Page(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The description of a bundle, its JSON page."""

    format: int
    algorithm: str
    schema: Annotated[str, Meta(description="name of the observation")]
    schema_version: int
    observation: Annotated[int, Meta(gt=0, description="numbers in an observation")]
    move: Move
    seed: int
    training: dict[str, Any]  # the recipe: all settings of the training run
    curve: list[CurvePoint]
    # Figures with intervals, by number of particles, in the form of `evaluate`; empty until evaluated.
    evaluation: dict[str, Any]


class _Format(msgspec.Struct):
    format: int


class Bundle:
    """A learned policy, ready to fly."""

    def __init__(self, page: Page, data: bytes) -> None:
        """Open the graph.

        Raises BundleError if it does not match its page, or this version of the project.
        """
        from agent import graphs  # both compile: a bundle that is only looked into does not need them
        from agent.observation import SCHEMAS

        if page.schema not in SCHEMAS:
            raise BundleError(f"observation {page.schema[:60]!r} is not known; wanted {' or '.join(SCHEMAS)}")
        self.page, self._schema = page, SCHEMAS[page.schema]
        if (page.schema_version, page.observation) != (self._schema.version, self._schema.size):
            raise BundleError(
                f"observation {page.schema!r} version {page.schema_version} of {page.observation} numbers; "
                f"wanted version {self._schema.version} of {self._schema.size}: train it anew"
            )
        _check(page.move)
        # What the observation knows of the problem: that of training, or, None, the one that is flown.
        self._site = None if self._schema.anywhere else site_of(trained_for(page))
        try:
            self._layers = graphs.read(data, page.observation)
        except graphs.GraphError as error:
            raise BundleError(f"{GRAPH} {error}") from error
        said = self.said(np.zeros(page.observation, np.float32))
        if said.shape != (1, page.move.outputs):
            raise BundleError(
                f"{GRAPH} gives arrays of {[list(said.shape)]}; wanted one, of [1, {page.move.outputs}]"
            )
        # Moves are compiled when the first is made: now, not in flight.
        page.move.waypoints(np.zeros((1, 2)), np.zeros((1, 3)), page.move.action(said), AREA)

    def said(self, observation: NDArray[np.float32]) -> Array:
        """Return the network's output for an observation (F,): (1, A).

        Raises BundleError on NaN: argmax would silently pick one.
        """
        from agent.network import said  # compiled when it is imported

        output = said(self._layers, observation).astype(np.float64)
        if np.isnan(output).any():
            raise BundleError(f"{GRAPH} gives NaN; wanted numbers")
        return output[None]

    def waypoint(
        self, belief: Belief, particles: Particles, reach: Reach, _rng: np.random.Generator
    ) -> tuple[float, float]:
        """Return the next waypoint (x, y) m.

        A learned policy always takes its best action and draws no random numbers.
        """
        site = site_in(reach.area, reach.step) if self._site is None else self._site
        observation, frame = self._schema.look(belief, particles, site)
        move = self.page.move
        action, longest = move.action(self.said(observation)), reach.longest_m(belief.spread)
        places = move.waypoints(np.array([belief.position]), frame[None], action, reach.area, longest)
        x, y = places[0].tolist()
        return x, y


def flies_anywhere(page: Page) -> bool:
    """Whether a policy flies in any area, with any step and prior, and not only as it was trained."""
    return (page.schema, page.schema_version) in ANYWHERE


def trained_for(page: Page) -> Problem:
    """Return the problem that a policy was trained for. Raises BundleError."""
    env = page.training.get("env")
    said = env.get("problem", "paper") if isinstance(env, dict) else "paper"
    try:
        if said != "paper" and not str(said).startswith("{"):
            raise ValueError("it is no JSON object")  # and no file: a bundle from a stranger names none
        return named(said)
    except ValueError as error:
        raise BundleError(f"its problem cannot be used: {_line(error)}") from error


def _check(move: Move) -> None:
    if isinstance(move, Headings) and not 2 <= move.count <= MOST_HEADINGS:
        raise BundleError(f"move of {move.count} headings; wanted from 2 to {MOST_HEADINGS}")
    if not 0 < move.step_m <= MOST_STEP_M:
        raise BundleError(f"move of {move.step_m:g} m; wanted above 0 up to {MOST_STEP_M:g}")


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]


def read(path: Path) -> tuple[Page, bytes]:
    """Read a bundle's page and graph. Raises BundleError if the file is not a valid bundle."""
    if path.exists() and not path.is_file():  # a pipe may never end
        raise BundleError(f"not a bundle: it is not a file; wanted a zip file of {PAGE} and {GRAPH}")
    try:
        with zipfile.ZipFile(path) as file:
            page, graph = (_member(file, name) for name in (PAGE, GRAPH))
    except BundleError:
        raise
    except FileNotFoundError as error:
        raise BundleError("there is no such file") from error
    except Exception as error:  # the exceptions of zipfile and zlib on a broken file have no common base
        raise BundleError(f"not a bundle: {_line(error)}; wanted a zip file of {PAGE} and {GRAPH}") from error
    try:
        # Checked first: another format may explain why the rest does not fit.
        version = msgspec.json.decode(page, type=_Format).format
        if version != FORMAT:
            raise BundleError(f"bundle format {version}; wanted {FORMAT}")
        return msgspec.json.decode(page, type=Page), graph
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise BundleError(f"{PAGE}: {_line(error)}") from error


def _member(file: zipfile.ZipFile, name: str) -> bytes:
    if name not in file.namelist():
        raise BundleError(f"not a bundle: it has no {name}; wanted a zip file of {PAGE} and {GRAPH}")
    info = file.getinfo(name)
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise BundleError(f"{name} is compressed by method {info.compress_type}; wanted deflate, or none")
    most = MOST_PAGE_BYTES if name == PAGE else MOST_BYTES
    if info.file_size > most:
        raise BundleError(f"{name} is larger than {most >> 20} MiB")
    # Without a size, a member that is larger than it claims would be unpacked in full.
    with file.open(info) as member:
        return member.read(info.file_size)


def load(path: Path) -> Bundle:
    """Read and open a bundle. Raises BundleError."""
    return Bundle(*read(path))


def write(path: Path, page: Page, graph: bytes) -> None:
    """Write a bundle, whole or not at all; equal parts give equal bytes."""
    with whole(path) as partial, zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as file:
        for name, part in ((PAGE, msgspec.json.format(msgspec.json.encode(page))), (GRAPH, graph)):
            file.writestr(zipfile.ZipInfo(name), part, zipfile.ZIP_DEFLATED)
