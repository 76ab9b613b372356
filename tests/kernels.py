"""Compiles the kernels of a checkout before tests with time limits need them: on a busy machine this takes minutes."""

import shutil
import subprocess
import sys
from pathlib import Path

from numba.core.caching import UserProvidedCacheLocator

FOLDERS = ("plume", "estimator", "agent", "benchmarks")


def compile_kernels(root: Path) -> None:
    """Fill the cache of a checkout."""
    files = [path for folder in FOLDERS for path in sorted((root / folder).rglob("*.py"))]
    modules = [
        ".".join(path.relative_to(root).with_suffix("").parts)
        for path in files
        if "\n@kernel(" in path.read_text()
    ]
    # A module that cannot be imported fails its own tests.
    code = (
        f"import contextlib, importlib\nfor name in {modules}:\n    with contextlib.suppress(Exception): "
        "importlib.import_module(name)"
    )
    subprocess.run([sys.executable, "-c", code], cwd=root, check=False, timeout=3000)


def copy_kernels(root: Path, copy: Path) -> None:
    """Fill the cache of a copy of a checkout. Numba keeps kernels by the path of their sources."""
    for kept in [path for folder in FOLDERS for path in (root / folder).rglob("__pycache__/kernels-*/*")]:
        sources = copy / kept.parents[2].relative_to(root)
        place = UserProvidedCacheLocator.get_suitable_cache_subpath(str(sources / "any.py"))
        shutil.copytree(kept, sources / "__pycache__" / kept.parent.name / place)
