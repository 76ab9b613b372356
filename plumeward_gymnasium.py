"""Makes our environments known to gymnasium as soon as it is imported; plumeward_gymnasium.pth runs this at Python's start.

gymnasium had plug-ins for that until 1.0. This file is installed by itself, as plumeward_gymnasium: Python's start must not import more.
"""

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType


def register() -> None:
    """Register the names; nothing of ours is imported before one is made."""
    import gymnasium

    for name, continuous in (("SourceSearch", False), ("SourceSearchContinuous", True)):
        if f"plumeward/{name}-v0" not in gymnasium.registry:
            gymnasium.register(
                f"plumeward/{name}-v0",
                entry_point="agent.learn.env:SourceSearch",
                vector_entry_point="agent.learn.env:SourceSearchVector",
                kwargs={"continuous": continuous},
            )


class WhenImported(MetaPathFinder):
    """Waits until gymnasium is imported, then registers and is gone."""

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Find gymnasium as Python would have without this, and let it register when it has been run: to be found is not to be imported."""
        if name != "gymnasium":
            return None
        others = (finder.find_spec(name, path, target) for finder in sys.meta_path if finder is not self)
        spec = next((spec for spec in others if spec is not None), None)
        if spec is not None and spec.loader is not None:
            run = spec.loader.exec_module

            def run_and_register(module: ModuleType) -> None:
                sys.meta_path.remove(self)
                run(module)
                register()

            spec.loader.exec_module = run_and_register  # type: ignore[method-assign]
        return spec


def install() -> None:
    """Begin to wait, once: Python may read a .pth file twice."""
    if not any(isinstance(finder, WhenImported) for finder in sys.meta_path):
        sys.meta_path.insert(0, WhenImported())
