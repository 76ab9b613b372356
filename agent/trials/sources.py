"""What a mission's result depends on beside its settings: sources and files, as digests."""

import hashlib
from collections.abc import Iterator, Sequence
from functools import cache
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path

import numba
import numpy as np

from agent.policies import OURS, PLUGINS, bundle_path
from plume.worlds.names import named

PACKAGES = ("plume", "link", "scene", "estimator", "agent")
ROOT = Path(__file__).parents[2]


@cache
def code() -> str:
    """Digest of our sources and of the numpy and numba versions."""
    sources = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
    return _digest([f"{np.__version__} {numba.__version__}".encode(), *map(Path.read_bytes, sources)])


def of_policy(name: str) -> str:
    """Digest of a bundle, or of the package that plugs a policy in; empty for our own planners."""
    if path := bundle_path(name):
        return _digest([path.read_bytes()])
    plugins = () if name in OURS else entry_points(group=PLUGINS, name=name)
    return _digest([path.read_bytes() for plugin in plugins for path in _sources(plugin.module)])


def of_world(name: str) -> str:
    """Digest of the package that plugs a world in, and of the files that it names; empty without both.

    A recording may have gigabytes: of files, the times and sizes count.
    """
    world = named(name)
    texts = [text for text in world.parameters.values() if isinstance(text, str) and text]
    states = [_state(path) for text in texts for path in _files(Path(text))]
    return _digest([*states, *map(Path.read_bytes, _sources(getattr(world.make, "__module__", "")))])


def _sources(module: str) -> Iterator[Path]:
    """The sources of the package of a module, or of the module if it has none; of our own packages none."""
    top = module.partition(".")[0]
    spec = find_spec(top) if top and top not in PACKAGES else None
    if spec and spec.submodule_search_locations:
        for folder in spec.submodule_search_locations:
            yield from sorted(Path(folder).rglob("*.py"))
    elif spec and spec.has_location and spec.origin:
        yield Path(spec.origin)


def _files(path: Path) -> list[Path]:
    """The file of a path, or all those of a folder; none where there is neither."""
    return sorted(each for each in (path, *path.rglob("*")) if each.is_file())


def _state(path: Path) -> bytes:
    state = path.stat()
    return f"{path} {state.st_mtime_ns} {state.st_size}\n".encode()


def _digest(parts: Sequence[bytes]) -> str:
    return hashlib.blake2b(b"".join(parts), digest_size=8).hexdigest() if parts else ""
