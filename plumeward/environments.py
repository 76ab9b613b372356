"""The gymnasium environments by their names."""

import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType

# The name of each, and whether its actions are continuous.
ENVIRONMENTS = {"plumeward/SourceSearch-v0": False, "plumeward/SourceSearchContinuous-v0": True}


def register() -> None:
    """Register the environments, once: now if gymnasium has been loaded, else as soon as it is.

    It takes long to load.
    """
    if "gymnasium" in sys.modules:
        _register()
    else:
        sys.meta_path.insert(0, _WhenImported())


def _register() -> None:
    import gymnasium

    for name, continuous in ENVIRONMENTS.items():
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point="agent.learn.env:SourceSearch",
                vector_entry_point="agent.learn.env:SourceSearchVector",
                kwargs={"continuous": continuous},
            )


class _WhenImported:
    """Finds gymnasium where Python would, and registers the environments once it is loaded.

    Then it goes out of the way.
    """

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return how gymnasium is loaded, for all who import it or only look for it.

        None for any other module.
        """
        if name != "gymnasium":
            return None
        others = [finder for finder in sys.meta_path if finder is not self]
        spec = next((spec for finder in others if (spec := finder.find_spec(name, path, target))), None)
        if spec and spec.loader:
            load = spec.loader.exec_module

            def load_and_register(module: ModuleType) -> None:
                load(module)
                if self in sys.meta_path:
                    sys.meta_path.remove(self)
                _register()

            spec.loader.exec_module = load_and_register  # type: ignore[method-assign]
        return spec
