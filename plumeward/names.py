"""Makes sure that Python imports our packages, and not a user's files of the same names."""

import sys
from importlib.util import find_spec
from os import path  # `pathlib` takes longer to load than all the rest

# The packages beside `plumeward` itself.
PACKAGES = ("plume", "link", "estimator", "aircraft", "sitl", "scene", "agent", "ground")
ROOT = path.dirname(path.dirname(path.realpath(__file__)))


def leave_out_the_current_folder() -> None:
    """Under `python -m plumeward`, remove the current folder from the module search path.

    It stays if it holds our packages.
    """
    if sys.flags.safe_path or sys.argv[:1] != ["-m"]:  # "-m" stands there until Python has found the module
        return
    at = sys.orig_argv.index("-m") if "-m" in sys.orig_argv else -1
    if at > 0 and sys.orig_argv[at + 1 : at + 2] == ["plumeward"] and path.realpath(sys.path[0]) != ROOT:
        del sys.path[0]


def check() -> None:
    """Raise ImportError if Python would find a foreign file or folder in place of one of our packages."""
    for package in PACKAGES:
        spec = getattr(sys.modules.get(package), "__spec__", None) or find_spec(package)
        found = path.realpath(spec.origin) if spec and spec.origin else None
        if found is None:
            raise ImportError(
                f"plumeward is not installed completely: there is no package {package!r} in {ROOT}"
            )
        if found != path.join(ROOT, package, "__init__.py"):
            raise ImportError(
                f"{found} hides plumeward's own package {package!r}: rename this file or folder"
            )
