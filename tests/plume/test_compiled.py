"""Protects the cache of compiled kernels: no change in what a kernel is made of goes unseen, what is
unchanged is not compiled, and whatever happens to the files, kernels run.
"""

import ast
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from plume.compiled import folder_of

ROOT = Path(__file__).parents[2]
PACKAGES = ("plume", "estimator", "agent")
HELPER = """
from numba import njit
RATE = 3.0

@njit
def low(x): return x + 1

@njit
def use(x): return RATE * low(x)
"""
KERNELS = """
from plume.compiled import kernel
from tiny.helper import *

@kernel("float64(float64)", error_model="numpy")
def said(x):
    return use(x)

@kernel("float64(float64)", error_model="numpy")
def inverse(x):
    return 1 / (x - 2)

@kernel("int64(int64)")
def factorial(n):
    return 1 if n < 2 else n * factorial(n - 1)
"""
LATE = """
from plume.compiled import kernel
from tiny.loops import said

@kernel("float64(float64)", error_model="numpy")
def twice(x):
    return 2 * said(x)
"""
CODE = """
from tiny.loops import factorial, inverse, said
hits = sum(sum(each.stats.cache_hits.values()) for each in (factorial, inverse, said))
print(said(2.0), inverse(4.0), factorial(5), hits)
"""


def write(folder: Path, helper: str = HELPER, kernels: str = KERNELS) -> None:
    """Put the package `tiny` into a folder."""
    (folder / "tiny").mkdir(parents=True, exist_ok=True)
    for name, source in (("__init__", ""), ("helper", helper), ("loops", kernels)):
        (folder / "tiny" / f"{name}.py").write_text(source)


def start(folder: Path, before: str = "", **variables: str) -> subprocess.Popen[str]:
    """A new process that loads the kernels of `tiny` in a folder; they are kept with the user in
    `folder/user` where they cannot be elsewhere.
    """
    kept = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    path = os.pathsep.join((str(folder), str(ROOT)))
    # Python's own cache knows sources by their time, to a second: too coarse for sources written twice.
    ours = {"PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1", "XDG_CACHE_HOME": str(folder / "user")}
    return subprocess.Popen(
        [sys.executable, "-c", before + CODE],
        env=kept | ours | variables,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def ended(process: subprocess.Popen[str]) -> tuple[list[str], int]:
    """What the kernels said, and how many of the three came from the cache."""
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    *said, hits = out.split()
    assert err.count("compiling kernels, once") == err.count("\n") == (hits != "3")  # once, or nothing
    return said, int(hits)


def run(folder: Path, before: str = "", **variables: str) -> tuple[list[str], int]:
    return ended(start(folder, before, **variables))


USUAL = ["9.0", "0.5", "120"]


def kept(folder: Path) -> list[Path]:
    """Numba's files below a folder."""
    return [path for path in folder.rglob("*") if path.suffix in (".nbi", ".nbc")]


@pytest.mark.full
@pytest.mark.slow
def test_a_change_of_what_a_kernel_uses_is_seen_and_undone(tmp_path: Path) -> None:
    write(tmp_path)
    assert [run(tmp_path), run(tmp_path)] == [(USUAL, 0), (USUAL, 3)]
    for file, old, new, said in (
        ("helper", "3.0", "5.0", ["15.0", "0.5", "120"]),  # a constant of another file
        ("helper", "x + 1", "x - 1", ["3.0", "0.5", "120"]),  # a function two calls down
        ("loops", "x - 2", "x - 3", ["9.0", "1.0", "120"]),  # the kernel itself
    ):
        write(tmp_path)
        path = tmp_path / "tiny" / f"{file}.py"
        path.write_text(path.read_text().replace(old, new))
        assert run(tmp_path) == (said, 0)
    write(tmp_path)
    assert run(tmp_path) == (USUAL, 3)


@pytest.mark.slow
def test_a_kept_kernel_is_loaded_without_what_only_compiling_needs(tmp_path: Path) -> None:
    write(tmp_path)
    tell = "import atexit, sys; atexit.register(lambda: print('numba.np.linalg' in sys.modules))\n"
    assert [start(tmp_path, tell).communicate(timeout=300)[0].split()[-2:] for _ in range(2)] == [
        ["0", "True"],
        ["3", "False"],
    ]


def test_the_first_call_of_a_kernel_waits_for_no_import() -> None:
    call = """
import sys
import numpy as np
from plume.numerics import exp_each
before = set(sys.modules)
exp_each(np.ones((2, 3)))
print(*(set(sys.modules) - before))
"""
    done = subprocess.run([sys.executable, "-c", call], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert not done.stdout.split()


@pytest.mark.slow
def test_a_kernel_may_call_one_that_was_kept(tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / "tiny" / "late.py").write_text(LATE)
    assert run(tmp_path) == (USUAL, 0)
    out, _ = start(tmp_path, "from tiny.late import twice; print(twice(2.0))\n").communicate(timeout=300)
    assert out.split() == ["18.0", *USUAL, "3"]


def test_a_change_of_a_table_is_seen(tmp_path: Path) -> None:
    folders = {}
    for name, table in (("one", b"1"), ("same", b"1"), ("other", b"2")):
        write(tmp_path / name)
        (tmp_path / name / "tiny" / "table.npy").write_bytes(table)
        folder = folder_of(tmp_path / name / "tiny")
        assert folder
        folders[name] = folder.name
    assert folders["one"] == folders["same"] != folders["other"]


def test_kernels_use_only_what_stands_in_their_folder_and_in_plume() -> None:
    """The sources that name their cache folder."""
    checked = 0
    for path in [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]:
        tree = ast.parse(path.read_text())
        where = {
            alias.asname or alias.name: node.module
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom) and node.module
            for alias in node.names
        }
        own = ".".join(path.relative_to(ROOT).parent.parts)
        for function in [node for node in tree.body if isinstance(node, ast.FunctionDef)]:
            decorators = " ".join(map(ast.unparse, function.decorator_list))
            if not any(word in decorators for word in ("njit", "kernel", "subroutine")):
                continue
            checked += 1
            names = {
                node.id
                for statement in function.body
                for node in ast.walk(statement)
                if isinstance(node, ast.Name)
            }
            foreign = {where[name] for name in names & where.keys() if where[name].split(".")[0] in PACKAGES}
            assert {
                module
                for module in foreign
                if module.rpartition(".")[0] not in (own, "plume", "plume.sensors")
            } == set(), function.name
    assert checked > 50


@pytest.mark.full
@pytest.mark.slow
def test_kernels_of_another_processor_or_library_are_not_run_and_stay_beside(tmp_path: Path) -> None:
    write(tmp_path)
    assert run(tmp_path) == (USUAL, 0)
    generic = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
    assert [run(tmp_path, **generic), run(tmp_path, **generic)] == [(USUAL, 0), (USUAL, 3)]
    other = "import llvmlite, numba; llvmlite.__version__ = '0.99'\n"
    assert [run(tmp_path, other), run(tmp_path, other)] == [(USUAL, 0), (USUAL, 3)]
    assert run(tmp_path) == (USUAL, 3)


@pytest.mark.full
@pytest.mark.slow
def test_kernels_are_kept_where_one_says_else_beside_the_code_else_with_the_user_else_nowhere(
    tmp_path: Path,
) -> None:
    write(tmp_path)
    chosen, beside, user = tmp_path / "chosen", tmp_path / "tiny" / "__pycache__", tmp_path / "user"
    ways: list[tuple[Path, dict[str, str], Callable[[], object]]] = [
        (chosen, {"NUMBA_CACHE_DIR": str(chosen)}, lambda: None),
        (beside, {}, lambda: shutil.rmtree(beside)),
    ]
    for place, variables, then in ways:
        assert [run(tmp_path, **variables), run(tmp_path, **variables)] == [(USUAL, 0), (USUAL, 3)]
        assert len(kept(place)) == 6
        then()
    beside.touch()  # no folder, and none can be made
    assert [run(tmp_path), run(tmp_path), len(kept(user))] == [(USUAL, 0), (USUAL, 3), 6]
    shutil.rmtree(user)
    user.touch()
    assert [run(tmp_path), run(tmp_path)] == [(USUAL, 0), (USUAL, 0)]


@pytest.mark.full
@pytest.mark.slow
def test_files_that_a_crash_cut_off_are_made_anew(tmp_path: Path) -> None:
    write(tmp_path)
    run(tmp_path)
    for suffix, share in ((".nbi", 0.0), (".nbi", 0.5), (".nbc", 0.0), (".nbc", 0.5)):
        for file in (path for path in kept(tmp_path) if path.suffix == suffix):
            whole = file.read_bytes()
            file.write_bytes(whole[: int(share * len(whole))])
        assert [run(tmp_path), run(tmp_path)] == [(USUAL, 0), (USUAL, 3)], (suffix, share)


@pytest.mark.full
@pytest.mark.slow
def test_a_full_disk_keeps_no_kernel_from_running(tmp_path: Path) -> None:
    write(tmp_path)
    assert run(tmp_path, "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))\n") == (
        USUAL,
        0,
    )
    assert [run(tmp_path), run(tmp_path)] == [(USUAL, 0), (USUAL, 3)]


@pytest.mark.full
@pytest.mark.slow
def test_processes_may_compile_at_once_whatever_their_hashes(tmp_path: Path) -> None:
    write(tmp_path)
    for process in [start(tmp_path, PYTHONHASHSEED=seed) for seed in ("1", "2")]:
        said, _ = ended(process)
        assert said == USUAL
    assert run(tmp_path, PYTHONHASHSEED="3") == (USUAL, 3)


@pytest.mark.slow
def test_what_cannot_be_compiled_says_why(tmp_path: Path) -> None:
    write(tmp_path, HELPER + "class Odd: pass\nodd = Odd()\n@njit\ndef use(x): return odd + x\n")
    _, err = start(tmp_path).communicate(timeout=300)
    assert "TypingError" in err


SORTS = {
    "sort": """
import numpy as np
from plume.compiled import kernel

@kernel("float64[::1](float64[::1])")
def sort(values):
    return np.sort(values)
""",
    "argsort": """
import numpy as np
from numba import njit
from plume.compiled import kernel

@njit
def one(values): return values
@njit
def two(values): return one(values)
@njit
def three(values): return two(values)

@kernel("int64[::1](float64[::1])")
def argsort(values):
    return np.argsort(three(values))
""",
}
"""Two kernels that use a function `run_quicksort` of numba's, each another one, of the same types. Three more
functions give it the same number in the processes that compile them.
"""


@pytest.mark.full
def test_kernels_that_were_compiled_in_two_processes_call_their_own_functions_in_a_third(
    tmp_path: Path,
) -> None:
    for name, source in SORTS.items():
        (tmp_path / f"of_{name}").mkdir()
        (tmp_path / f"of_{name}" / "__init__.py").write_text(source)
    ours = {"PYTHONPATH": os.pathsep.join((str(tmp_path), str(ROOT)))}

    def said(code: str) -> str:
        run = [sys.executable, "-c", code]
        return subprocess.run(
            run, env={**os.environ, **ours}, check=True, capture_output=True, text=True
        ).stdout

    said("import of_sort")
    said("import of_argsort")
    both = said(
        "import numpy as np; from of_argsort import argsort; from of_sort import sort; values = np.array([3.0, 1.0, 2.0])"
        "; print(argsort(values), sort(values), sum(argsort.stats.cache_hits.values()))"
    )
    assert both == "[1 2 0] [1. 2. 3.] 1\n"
