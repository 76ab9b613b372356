"""Compiles the kernels of a checkout, before tests with time limits need them: it takes minutes on a busy machine."""

import subprocess
import sys
from pathlib import Path


def compile_kernels(root: Path) -> None:
    """Fill the cache of a checkout."""
    files = [
        path
        for folder in ("plume", "estimator", "agent", "benchmarks")
        for path in sorted((root / folder).rglob("*.py"))
    ]
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
