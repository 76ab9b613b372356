"""Compiles the kernels of a checkout before tests with time limits need them: on a busy machine this takes minutes."""

import shutil
import subprocess
import sys
from pathlib import Path

from numba.core.caching import UserProvidedCacheLocator

FOLDERS = ("plume", "estimator", "agent", "benchmarks")
HALVES = (("estimator",), ("plume", "agent", "benchmarks"))
"""Compiled side by side: the kernels of the estimator use each other and take half of the time. Of the others,
the last to be imported, which is the first by its name, imports them, too.
"""


def compile_kernels(root: Path) -> None:
    """Fill the cache of a checkout."""
    halves = []
    for folders in HALVES:
        modules = [
            ".".join(path.relative_to(root).with_suffix("").parts)
            for folder in folders
            for path in sorted((root / folder).rglob("*.py"), reverse=True)
            if "\n@kernel(" in path.read_text()
        ]
        # A module that cannot be imported fails its own tests.
        code = (
            f"import contextlib, importlib\nfor name in {modules}:\n    with contextlib.suppress(Exception): "
            "importlib.import_module(name)"
        )
        halves.append(subprocess.Popen([sys.executable, "-c", code], cwd=root))
    try:
        for half in halves:
            half.wait(timeout=3000)
    finally:
        for half in halves:
            half.kill()


def copy_kernels(root: Path, copy: Path, folders: tuple[str, ...] = FOLDERS) -> None:
    """Fill the cache of a copy of a checkout. Numba keeps kernels by the path of their sources, and uses
    those whose source is as old as it was. A checkout that was moved has those of its old path, too.
    """
    place = UserProvidedCacheLocator.get_suitable_cache_subpath
    for kept in [path for folder in folders for path in (root / folder).rglob("__pycache__/kernels-*/*")]:
        sources = copy / kept.parents[2].relative_to(root)
        if kept.name == place(str(kept.parents[2] / "any.py")):
            to = sources / "__pycache__" / kept.parent.name / place(str(sources / "any.py"))
            shutil.copytree(kept, to)


if __name__ == "__main__":
    compile_kernels(Path(__file__).parents[1])
    print("compiled")
