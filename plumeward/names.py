"""Whether the packages that Python would import are ours, and not files of a user that have their names."""

import sys
from importlib.util import find_spec
from pathlib import Path

PACKAGES = ("plume", "link", "sitl", "estimator", "agent")
"""What `plumeward` consists of beside itself."""
ROOT = Path(__file__).parents[1]


def runs_as_command() -> bool:
    """Return whether this process is the command `plumeward`, by that name or as `python -m plumeward`."""
    if sys.argv[:1] == ["-m"]:  # what Python puts there until it has found the module
        at = sys.orig_argv.index("-m") if "-m" in sys.orig_argv else -1
        return at > 0 and sys.orig_argv[at + 1 : at + 2] == ["plumeward"]
    return bool(sys.argv) and Path(sys.argv[0]).stem == "plumeward" and not sys.argv[0].endswith(".py")


def leave_out_the_current_folder() -> None:
    """Take the folder that `python -m` puts first out of the module search path, unless our packages are in it."""
    if not sys.flags.safe_path and sys.argv[:1] == ["-m"] and Path(sys.path[0]).resolve() != ROOT:
        del sys.path[0]


def check() -> None:
    """Raise ImportError where a file of somebody else has the name of one of our packages and is found first."""
    for package in PACKAGES:
        spec = getattr(sys.modules.get(package), "__spec__", None) or find_spec(package)
        found = Path(spec.origin).resolve() if spec and spec.origin else None
        if found is None:
            raise ImportError(f"plumeward is not installed completely: there is no package {package!r} in {ROOT}")
        if found != ROOT / package / "__init__.py":
            raise ImportError(f"{found} hides plumeward's own package {package!r}: rename this file or folder")
