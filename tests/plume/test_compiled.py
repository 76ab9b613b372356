"""Protects the cache of compiled kernels: no change in what a kernel is made of goes unseen, and what is
unchanged is not compiled.
"""

import importlib
import itertools
import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from numba.core import config

from plume.compiled import fingerprint

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
PLAIN = """
from plume.compiled import kernel
from tiny.helper import *

@kernel("float64(float64)")
def said(x):
    return use(x)
"""
"""A kernel that calls whatever `helper.py` says."""
JITTED = "from numba import njit\n"


@pytest.fixture(autouse=True)
def no_bytecode(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Python's own cache knows sources by their time, to a second: too coarse for sources that a test
    writes twice.
    """
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(config, "CACHE_DIR", "")
    yield
    forget()


def forget() -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == "tiny"]:
        del sys.modules[name]


def write(folder: Path, helper: str, loops: str = PLAIN) -> None:
    """Put the package `tiny` into a folder."""
    (folder / "tiny").mkdir(exist_ok=True)
    for name, source in (("__init__", ""), ("helper", helper), ("loops", loops)):
        (folder / "tiny" / f"{name}.py").write_text(source)


def run(place: Path, x: float = 2.0) -> tuple[float, bool]:
    """What the kernel in a folder says, as if in a new process, and whether it came from the cache."""
    forget()
    sys.path.insert(0, str(place))
    try:
        importlib.invalidate_caches()
        said: Any = importlib.import_module("tiny.loops").said
    finally:
        sys.path.remove(str(place))
    hits, misses = (sum(counts.values()) for counts in (said.stats.cache_hits, said.stats.cache_misses))
    assert hits + misses == 1
    return said(x), hits == 1


HELPERS = {
    "a constant": ("RATE = 3.0\n@njit\ndef use(x): return RATE * x", "3.0", "5.0", 6.0, 10.0),
    "a constant's type": ("RATE = 3\n@njit\ndef use(x): return 7 // RATE * x", "3", "3.5", 4.0, 4.0),
    "a body": ("@njit\ndef use(x): return x + 1", "x + 1", "x - 1", 3.0, 1.0),
    "a body two calls down": (
        "@njit\ndef low(x): return x + 1\n@njit\ndef use(x): return low(x)",
        "x + 1",
        "x - 1",
        3.0,
        1.0,
    ),
    "a default": ("@njit\ndef use(x, by=3.0): return x * by", "3.0", "5.0", 6.0, 10.0),
    "an array": (
        "import numpy as np\nTABLE = np.array([3.0, 4.0])\n@njit\ndef use(x): return TABLE[0] * x",
        "3.0",
        "5.0",
        6.0,
        10.0,
    ),
    "a numpy number": (
        "import numpy as np\nWORD = np.uint64(3)\n@njit\ndef use(x): return float(WORD) * x",
        "(3)",
        "(5)",
        6.0,
        10.0,
    ),
    "a tuple": ("PAIR = (1.0, 3.0)\n@njit\ndef use(x): return PAIR[1] * x", "3.0", "5.0", 6.0, 10.0),
    "which of two functions has a name": (
        "@njit\ndef one(x): return x\n@njit\ndef two(x): return 2 * x\nzero = one\n@njit\ndef use(x): return "
        "one(x) - two(x) + zero(x)",
        "zero = one",
        "zero = two",
        0.0,
        2.0,
    ),
    "a closure": (
        "def times(by):\n    @njit\n    def use(x): return by * x\n    return use\nuse = times(3.0)",
        "3.0",
        "5.0",
        6.0,
        10.0,
    ),
    "a function within a function": (
        "@njit\ndef use(x):\n    def inner(y): return y + 1\n    return inner(x)",
        "y + 1",
        "y - 1",
        3.0,
        1.0,
    ),
    "a recursive function": (
        "@njit\ndef use(x): return x if x > 9 else use(x * 3.0)",
        "3.0",
        "4.0",
        18.0,
        32.0,
    ),
    "options of a function": (
        "@njit(error_model='numpy')\ndef inverse(x): return 1 / x\n@njit\ndef use(x):\n    try:\n        "
        "return inverse(x - 2)\n"
        "    except Exception:\n        return 1.0",
        "error_model='numpy'",
        "error_model='python'",
        float("inf"),
        1.0,
    ),
    "the signature of another kernel": (
        "from plume.compiled import kernel\n@kernel('float64(float64)')\ndef use(x): return x / 3",
        "('float64(",
        "('float32(",
        2 / 3,
        pytest.approx(2 / 3, rel=1e-7),
    ),
    "a function that is compiled wherever it is used": (
        "from numba.extending import register_jitable\n@register_jitable\ndef use(x): return x + 1",
        "x + 1",
        "x - 1",
        3.0,
        1.0,
    ),
    "an intrinsic": (
        "import numba\nfrom numba.extending import intrinsic\n@intrinsic\ndef use(_context, x):\n"
        "    return numba.float64(numba.float64), lambda _c, builder, _s, args: builder.fadd(args[0], "
        "args[0])",
        "builder.fadd",
        "builder.fmul",
        4.0,
        4.0,
    ),
}
"""Name: a helper, what is changed in it, and what it says of 2 before and after."""


@pytest.mark.parametrize(("helper", "old", "new", "before", "after"), HELPERS.values(), ids=HELPERS)
def test_a_change_of_what_a_kernel_calls_is_seen_and_undone(
    tmp_path: Path, helper: str, old: str, new: str, before: float, after: float
) -> None:
    assert helper.count(old) == 1
    write(tmp_path, JITTED + helper)
    assert run(tmp_path) == (before, False)
    assert run(tmp_path) == (before, True)
    write(tmp_path, JITTED + helper.replace(old, new))
    assert run(tmp_path) == (after, False)
    write(tmp_path, JITTED + helper)
    assert run(tmp_path) == (before, True)


HEAD = "from plume.compiled import kernel\nfrom tiny import helper\nimport tiny.helper\n"
KERNELS = {
    "a constant of a module": ("RATE = 3.0", "3.0", "5.0", "return helper.RATE * x"),
    "a constant of a module of a package": ("RATE = 3.0", "3.0", "5.0", "return tiny.helper.RATE * x"),
    "a function of a module": (
        JITTED + "@njit\ndef use(x): return 3.0 * x",
        "3.0",
        "5.0",
        "return helper.use(x)",
    ),
    "an array of a module": (
        "import numpy as np\nTABLE = np.array([3.0])",
        "3.0",
        "5.0",
        "return helper.TABLE[0] * x",
    ),
    "an intrinsic of a module": (
        "import numba\nfrom numba.extending import intrinsic\n@intrinsic\ndef use(_context, x):\n"
        "    return numba.float64(numba.float64), lambda _c, b, _s, args: b.fmul(args[0], args[0].type(3.0))",
        "3.0",
        "5.0",
        "return helper.use(x)",
    ),
}


@pytest.mark.parametrize(("helper", "old", "new", "body"), KERNELS.values(), ids=KERNELS)
def test_a_change_of_what_a_kernel_takes_from_a_module_is_seen(
    tmp_path: Path, helper: str, old: str, new: str, body: str
) -> None:
    loops = f"{HEAD}\n@kernel('float64(float64)')\ndef said(x):\n    {body}\n"
    write(tmp_path, helper, loops)
    assert run(tmp_path) == (6.0, False)
    assert run(tmp_path) == (6.0, True)
    write(tmp_path, helper.replace(old, new), loops)
    assert run(tmp_path) == (10.0, False)


def test_a_change_of_a_kernels_own_options_is_seen(tmp_path: Path) -> None:
    loops = (
        "from plume.compiled import kernel\n@kernel('float64(float64)', error_model='numpy')\ndef "
        "said(x): return 1 / (x - 2)\n"
    )
    write(tmp_path, "", loops)
    assert run(tmp_path) == (float("inf"), False)
    write(tmp_path, "", loops.replace("'numpy'", "'python'"))
    with pytest.raises(ZeroDivisionError):
        run(tmp_path)
    write(tmp_path, "", loops)
    assert run(tmp_path) == (float("inf"), True)


def test_a_kernel_that_calls_itself_is_kept_too(tmp_path: Path) -> None:
    loops = (
        "from plume.compiled import kernel\n@kernel('int64(int64)')\ndef said(n): return 1 if n < 2 "
        "else n * said(n - 1)\n"
    )
    write(tmp_path, "", loops)
    assert [run(tmp_path, 5), run(tmp_path, 5)] == [(120, False), (120, True)]
    write(tmp_path, "", loops.replace("n * said", "n + said"))
    assert run(tmp_path, 5) == (15, False)


USE = JITTED + "@njit\ndef use(x): return x + 1"

TWO_KERNELS = f"{PLAIN}\n@kernel('float64(float64)')\ndef more(x): return x\n"


def test_a_process_that_compiles_says_so_once_and_one_that_need_not_says_nothing(tmp_path: Path) -> None:
    write(tmp_path, USE, TWO_KERNELS)
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join((str(tmp_path), str(ROOT))),
        "NUMBA_CACHE_DIR": "",
    }
    said = [
        subprocess.run(
            [sys.executable, "-c", "import tiny.loops"],
            env=environment,
            capture_output=True,
            text=True,
            check=True,
        )
        for _ in range(2)
    ]
    assert [(process.stdout, process.stderr.count("compiling kernels, once")) for process in said] == [
        ("", 1),
        ("", 0),
    ]
    assert said[0].stderr.count("\n") == 1


def test_comments_and_another_place_change_nothing(tmp_path: Path) -> None:
    (tmp_path / "one").mkdir()
    write(tmp_path / "one", USE)
    assert run(tmp_path / "one") == (3.0, False)
    write(tmp_path / "one", f"# Why it is so.\n\n\n{USE}", f"# And this, too.\n{PLAIN}")
    assert run(tmp_path / "one") == (3.0, True)
    shutil.copytree(tmp_path / "one", tmp_path / "two")
    assert run(tmp_path / "two") == (3.0, True)


def test_what_the_cache_cannot_follow_is_refused_by_name(tmp_path: Path) -> None:
    write(tmp_path, f"{JITTED}class Odd: pass\nodd = Odd()\n@njit\ndef use(x): return odd and x")
    with pytest.raises(TypeError, match="use uses odd: a Odd, which no cache of kernels can follow"):
        run(tmp_path)


def kept(folder: Path) -> list[Path]:
    """Numba's files below a folder."""
    return [path for path in folder.rglob("*") if path.suffix in (".nbi", ".nbc")]


def test_kernels_are_kept_where_one_says_else_beside_the_code_else_with_the_user_else_nowhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (code := tmp_path / "code").mkdir()
    user, chosen = tmp_path / "user", tmp_path / "chosen"
    monkeypatch.setenv("XDG_CACHE_HOME", str(user))
    write(code, USE)
    monkeypatch.setattr(config, "CACHE_DIR", str(chosen))
    assert [run(code), run(code), len(kept(chosen))] == [(3.0, False), (3.0, True), 2]
    monkeypatch.setattr(config, "CACHE_DIR", "")
    assert [run(code), run(code), len(kept(code))] == [(3.0, False), (3.0, True), 2]
    shutil.rmtree(code / "tiny" / "__pycache__")
    (code / "tiny" / "__pycache__").touch()  # no folder, and none can be made
    assert [run(code), run(code), len(kept(user))] == [(3.0, False), (3.0, True), 2]
    shutil.rmtree(user)
    user.touch()
    assert [run(code), run(code)] == [(3.0, False), (3.0, False)]


def test_kernels_of_a_zipped_package_are_kept_with_the_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "user"))
    write(tmp_path, USE)
    with zipfile.ZipFile(tmp_path / "all.zip", "w") as archive:
        for path in (tmp_path / "tiny").iterdir():
            archive.write(path, f"tiny/{path.name}")
    assert [run(tmp_path / "all.zip"), run(tmp_path / "all.zip")] == [(3.0, False), (3.0, True)]
    assert len(kept(tmp_path / "user")) == 2


@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
@pytest.mark.parametrize("share", [0.0, 0.5])
def test_files_that_a_crash_cut_off_are_made_anew(tmp_path: Path, suffix: str, share: float) -> None:
    write(tmp_path, USE)
    run(tmp_path)
    (file,) = (path for path in kept(tmp_path) if path.suffix == suffix)
    whole = file.read_bytes()
    file.write_bytes(whole[: int(share * len(whole))])
    assert [run(tmp_path), run(tmp_path)] == [(3.0, False), (3.0, True)]


def test_a_full_disk_keeps_no_kernel_from_running(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path, USE)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("numba.core.caching.IndexDataCacheFile.save", full)
    assert run(tmp_path) == (3.0, False)


SETS = """
NAMES = frozenset(("x", "y", "z", "tau", "phi"))
def odd(name): return name in {"north", "east", "south", "west", "up"} or name in NAMES
"""
ELSEWHERE = (
    "from plume.compiled import fingerprint; from tiny import helper, loops; "
    "print(fingerprint(helper.odd), loops.said(2.0), sum(loops.said.stats.cache_hits.values()))"
)


def started(folder: Path, hash_seed: str) -> subprocess.Popen[str]:
    """Another process that loads the kernel, and says a fingerprint, a value and whether the kernel came
    from the cache.
    """
    env = {
        **os.environ,
        "PYTHONHASHSEED": hash_seed,
        "PYTHONPATH": f"{folder}{os.pathsep}{ROOT}",
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    env.pop("NUMBA_CACHE_DIR", None)
    return subprocess.Popen([sys.executable, "-c", ELSEWHERE], env=env, stdout=subprocess.PIPE, text=True)


def test_processes_agree_whatever_their_hashes_and_may_write_at_once(tmp_path: Path) -> None:
    write(tmp_path, USE + SETS)
    said = []
    for hash_seeds in ("1", "2"), ("3",):
        processes = [started(tmp_path, seed) for seed in hash_seeds]
        said += [process.communicate(timeout=300)[0].split() for process in processes]
        assert [process.returncode for process in processes] == [0] * len(processes)
    assert len({digest for digest, _, _ in said}) == 1
    assert {value for _, value, _ in said} == {"3.0"}
    assert said[-1][2] == "1"


def test_fingerprints_of_functions_that_differ_differ() -> None:
    def of(**constants: object) -> str:
        space: dict[str, Any] = dict(constants)
        exec("def f(x): return x * A + B", space)
        return fingerprint(space["f"])

    values = [1, 1.0, True, -0.0, 0.0, 2, None, "a", b"a", (1,), (1.0,), ((1,),), frozenset((1,)), 1j, ...]
    digests = [of(A=a, B=b) for a, b in itertools.product(values, repeat=2)]
    assert len(set(digests)) == len(digests)
    assert of(A=1, B=2) == of(B=2, A=1)


def test_a_fingerprint_takes_in_what_else_decides() -> None:
    def f(x: float) -> float:
        return x

    assert fingerprint(f) == fingerprint(f)
    assert (
        len(
            {
                fingerprint(f),
                fingerprint(f, "float64(float64)"),
                fingerprint(f, "float32(float32)"),
                fingerprint(f, {"nogil": True}),
            }
        )
        == 4
    )


def test_what_is_kept_is_loaded_without_what_only_compiling_needs(tmp_path: Path) -> None:
    """Of its start a part would otherwise spend the half on that."""
    body = "pair = np.empty(2)\n    pair[0], pair[1] = x, 1.0\n    return pair[0] + pair[1]"
    write(tmp_path, f"import numpy as np\n{JITTED}@njit\ndef use(x):\n    {body}")
    code = "import sys; from tiny.loops import said; print(said(2.0), 'numba.np.linalg' in sys.modules)"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(tmp_path), str(ROOT)))}
    for compiles in (True, False):
        told = subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
        ).stdout
        assert told == f"3.0 {compiles}\n"
