"""Protects the install: the contents of a release, and that its wheel flies in a fresh environment without
torch or the checkout.
"""

import email
import functools
import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from agent.policies import SHIPPED
from agent.trials.rollout import rollout
from plume import __version__
from plume.outcome import outcome_json
from tests.kernels import copy_kernels

pytestmark = pytest.mark.timeout(2000)  # environments are created and filled, and kernels compiled in them

ROOT = Path(__file__).parents[2]
PACKAGES = ("plume", "link", "estimator", "aircraft", "sitl", "scene", "agent", "ground", "plumeward")
CONSTRAINTS, HASHED = ROOT / "constraints.txt", ROOT / "requirements.txt"
OWN = f"{sys.version_info.major}.{sys.version_info.minor}"
VERSIONS = ("3.11", "3.12", "3.13")
ENVIRONMENT = {
    name: value
    for name, value in os.environ.items()
    if not name.startswith(("PYTHON", "VIRTUAL_ENV", "NUMBA_"))
}
"""Without what would show the checkout, or its environment, to another Python."""


def files(folder: Path) -> Iterator[Path]:
    return (path for path in folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts)


def build(source: Path, out: Path, *kinds: str) -> Path:
    """Build a release of a source tree, without network access."""
    command = [sys.executable, "-P", "-m", "hatchling", "build", *kinds, "-d", str(out)]
    built = subprocess.run(command, cwd=source, env=ENVIRONMENT, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    return out


@pytest.fixture(scope="module")
def release(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with the wheel and the sdist of this checkout."""
    return build(ROOT, tmp_path_factory.mktemp("release"))


@pytest.fixture(scope="module")
def wheel(release: Path) -> Path:
    (wheel,) = release.glob("*.whl")
    return wheel


@pytest.fixture(scope="module")
def sdist(release: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sdist's folder, unpacked."""
    (packed,) = release.glob("*.tar.gz")
    unpacked = tmp_path_factory.mktemp("sdist")
    with tarfile.open(packed) as archive:
        archive.extractall(unpacked, filter="data")
    return unpacked / packed.name.removesuffix(".tar.gz")


def contents(wheel: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(wheel) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def about(wheel: Path, name: str) -> str:
    """A file of the wheel's metadata."""
    (text,) = (
        content
        for path, content in contents(wheel).items()
        if re.fullmatch(rf"plumeward-[^/]+\.dist-info/{name}", path)
    )
    return text.decode()


def requirements(wheel: Path) -> list[Requirement]:
    return [
        Requirement(line)
        for line in email.message_from_string(about(wheel, "METADATA")).get_all("Requires-Dist", [])
    ]


def test_a_wheel_has_the_packages_the_missions_and_nothing_else(wheel: Path) -> None:
    held = {name: content for name, content in contents(wheel).items() if ".dist-info/" not in name}
    ours = {path.relative_to(ROOT).as_posix(): path for package in PACKAGES for path in files(ROOT / package)}
    missions = {f"sitl/missions/{path.name}": path for path in (ROOT / "missions").iterdir()}
    expected = {**ours, **missions}
    assert set(held) == set(expected)
    assert all(content == expected[name].read_bytes() for name, content in held.items())
    assert {path.relative_to(ROOT).as_posix() for path in SHIPPED.values()} <= set(held)
    assert {"sitl/missions/default-release.yaml", "sitl/missions/mission.schema.json"} <= set(held)


def test_an_sdist_has_what_the_wheel_is_made_of_and_no_records(sdist: Path) -> None:
    pages = {"README.md", "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "docs", "mkdocs.yml"}
    ours = {
        *PACKAGES,
        *pages,
        "missions",
        "pyproject.toml",
        "constraints.txt",
        "requirements.txt",
        "Makefile",
        "LICENSE",
    }
    assert {path.name for path in sdist.iterdir()} == ours | {"PKG-INFO", ".gitignore"}
    assert sum(path.stat().st_size for path in files(sdist)) < 6_000_000  # the records alone are more


def test_a_wheel_made_from_the_sdist_is_the_wheel_made_from_the_checkout(
    wheel: Path, sdist: Path, tmp_path: Path
) -> None:
    (other,) = build(sdist, tmp_path, "-t", "wheel").glob("*.whl")
    assert other.name == wheel.name
    assert contents(other) == contents(wheel)


def test_an_install_needs_no_torch_but_with_the_extra_that_trains(wheel: Path) -> None:
    extras = {
        name: set()
        for name in ("", "train", "view", "ray", "bench", "docs", "plumes", "ros2", "fuzz", "test")
    }
    for requirement in requirements(wheel):
        extras[
            next((extra for extra in extras if extra and f'extra == "{extra}"' in str(requirement)), "")
        ].add(requirement.name)
    learning = {"torch", "stable-baselines3", "gymnasium", "onnx", "pettingzoo", "tensorboard"}
    assert extras["train"] == learning
    assert extras["view"] == {"matplotlib", "pillow"}
    assert extras["ray"] == {"ray"}
    assert extras["plumes"] == {"h5py", "numcodecs"}
    assert extras["ros2"] == {"rosbags", "xxhash"}
    assert "stonesoup" in extras["bench"]
    assert extras["docs"] == {"mkdocs-material", "mkdocstrings"}
    assert (
        extras["test"] > extras["train"] | extras["view"] | extras["ray"] | extras["bench"] | extras["docs"]
    )
    assert not extras[""] & extras["test"]


def test_the_wheel_names_ranges_and_the_repository_pins_a_version_in_each(wheel: Path) -> None:
    pins = dict(
        line.split("#")[0].strip().split("==")
        for line in CONSTRAINTS.read_text().splitlines()
        if not line.startswith("#")
    )
    pinned = {canonicalize_name(name): version for name, version in pins.items()}
    for requirement in requirements(wheel):
        assert {each.operator for each in requirement.specifier} in ({">="}, {">=", "<"}), requirement
        assert requirement.specifier.contains(pinned[canonicalize_name(requirement.name)]), requirement


def test_the_wheel_gives_one_command_and_says_which_pythons_it_is_for(wheel: Path) -> None:
    assert about(wheel, "entry_points.txt").split("\n") == [
        "[console_scripts]",
        "plumeward = plumeward.__main__:command",
        "",
    ]
    metadata = email.message_from_string(about(wheel, "METADATA"))
    assert metadata["Requires-Python"] == ">=3.11"
    assert {f"Programming Language :: Python :: {version}" for version in VERSIONS} <= set(
        metadata.get_all("Classifier")
    )
    assert metadata["Version"] == __version__


class Installed:
    """A fresh environment with the wheel and the files that are pinned for a flight."""

    def __init__(self, python: str, wheel: Path, folder: Path) -> None:
        self.folder = folder
        subprocess.run([python, "-m", "venv", folder], env=ENVIRONMENT, check=True)
        pip = (
            "python",
            "-m",
            "pip",
            "install",
            "--quiet",
            "--disable-pip-version-check",
            "--no-compile",
            "--only-binary",
            ":all:",
        )
        self.pip = self(folder, *pip, "--require-hashes", "-r", str(HASHED))
        if self.pip.returncode == 0:
            self.pip = self(folder, *pip, "--no-deps", str(wheel))
        self.give_kernels("estimator", "agent")

    def give_kernels(self, *packages: str) -> None:
        """Spare the environment to compile these packages again; what else a flight needs it compiles itself."""
        for place in self.folder.glob("lib/python*/site-packages"):
            for source in [path for package in packages for path in files(ROOT / package)]:
                installed = place / source.relative_to(ROOT)
                if installed.exists():
                    shutil.copystat(source, installed)
            copy_kernels(ROOT, place, packages)

    def __call__(self, cwd: Path, command: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run a command of the installation in a folder."""
        words = [self.folder / "bin" / command, *arguments]
        return subprocess.run(words, cwd=cwd, env=ENVIRONMENT, capture_output=True, text=True, check=False)


def interpreter(version: str) -> str | None:
    """A Python of this version that can create environments, if the machine has one."""
    elsewhere = sorted(map(str, Path.home().glob(f".pyenv/versions/{version}.*/bin/python")))
    for candidate in (
        sys.executable if version == OWN else None,
        shutil.which(f"python{version}"),
        *elsewhere,
    ):
        usable = f"import sys, venv, ensurepip; sys.exit('%d.%d' % sys.version_info[:2] != {version!r})"
        if (
            candidate
            and subprocess.run(
                [candidate, "-c", usable], env=ENVIRONMENT, capture_output=True, check=False
            ).returncode
            == 0
        ):
            return candidate
    return None


@pytest.fixture(scope="module")
def install(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str], Installed]]:
    """Install the wheel for a version of Python, once; skips if the machine lacks it, or if a dependency
    has no wheel for it.
    """
    folders: list[Path] = []

    @functools.cache
    def once(version: str) -> Installed | str:
        python = interpreter(version)
        if python is None:
            return f"there is no Python {version} here that can make environments"
        folders.append(tmp_path_factory.mktemp(f"python{version}-"))
        installed = Installed(python, wheel, folders[-1])
        missing = re.search("No matching distribution found for .*|Cannot install .*", installed.pip.stderr)
        return missing[0] if missing and version != OWN else installed

    def install(version: str) -> Installed:
        installed = once(version)
        if isinstance(installed, str):
            pytest.skip(installed)
        assert installed.pip.returncode == 0, installed.pip.stderr
        return installed

    yield install
    for folder in folders:  # half a gigabyte each
        shutil.rmtree(folder)


@pytest.fixture
def own(install: Callable[[str], Installed]) -> Installed:
    return install(OWN)


def outcome(ran: subprocess.CompletedProcess[str]) -> dict:
    """The outcome that a mission printed, without the search time."""
    assert ran.returncode == 0, ran.stderr
    result = json.loads(ran.stdout.splitlines()[-1])
    del result["search_time_s"]
    return result


@pytest.fixture(scope="module")
def in_process() -> dict:
    """Seed 7 flown by ppo from the checkout, in this process."""
    result, trace = rollout(7, "ppo")
    result = json.loads(outcome_json(result, trace))
    del result["search_time_s"]
    return result


@pytest.mark.full
@pytest.mark.parametrize("version", VERSIONS)
def test_the_wheel_flies_a_shipped_policy_in_a_fresh_environment(
    install: Callable[[str], Installed], in_process: dict, tmp_path: Path, version: str
) -> None:
    installed = install(version)
    fly = "plumeward fly --policy ppo --seed 7 --speedup 0 --patience 1500 --json --trace"  # kernels compile on a busy machine
    first = installed(tmp_path, *fly.split())
    flown = outcome(first)
    assert (flown["steps"], flown["ceased"], flown["located"]) == (in_process["steps"], True, True)
    assert flown["estimate"] == pytest.approx(in_process["estimate"], abs=1e-4)
    assert flown["distance_m"] == pytest.approx(in_process["distance_m"])
    said, _, progress = first.stderr.partition("mission: ")  # kernels that were not given are compiled
    assert ("compiling kernels, once, 15 to 60 s\n" in said, "compiling" in progress) == (True, False)
    if version == OWN:
        assert flown == in_process
        second = installed(tmp_path, *fly.split())
        assert (outcome(second), "compiling" in second.stderr) == (flown, False)

    where = (
        f"import {', '.join(PACKAGES)}; "
        f"print(*({', '.join(f'{package}.__file__' for package in PACKAGES)}), sep='\\n')"
    )
    places = installed(tmp_path, "python", "-c", where).stdout.splitlines()
    assert [Path(place).is_relative_to(installed.folder) for place in places] == [True] * len(PACKAGES)
    for module in ("torch", "stable_baselines3", "gymnasium", "matplotlib", "ray", "pytest", "onnxruntime"):
        assert installed(tmp_path, "python", "-c", f"import {module}").stderr.endswith(
            f"ModuleNotFoundError: No module named '{module}'\n"
        )


@pytest.mark.full
@pytest.mark.parametrize("version", VERSIONS)
def test_the_pinned_files_are_all_that_the_wheel_needs(
    install: Callable[[str], Installed], tmp_path: Path, version: str
) -> None:
    checked = install(version)(tmp_path, "python", "-m", "pip", "--disable-pip-version-check", "check")
    assert (checked.returncode, checked.stdout) == (0, "No broken requirements found.\n")


@pytest.mark.full
def test_without_zenoh_it_flies_the_same_mission(own: Installed, in_process: dict, tmp_path: Path) -> None:
    rolled = own(
        tmp_path, "python", "-m", "agent", "rollout", "--policy", "ppo", "--seed", "7", "--json", "--trace"
    )
    assert outcome(rolled) == in_process


@pytest.mark.full
def test_a_shipped_mission_is_flown_by_its_name(own: Installed, tmp_path: Path) -> None:
    ran = own(tmp_path, "plumeward", "fly", "default-release", "--speedup", "0", "--json")
    flown = outcome(ran)
    assert flown["expectations"] == {"located": True}
    assert (flown["seed"], flown["scenario"]["q"], flown["scenario"]["d"], flown["scenario"]["tau"]) == (
        7,
        300,
        4.5,
        10,
    )
    assert (
        "a release with the estimator's default rate, diffusivity and lifetime\nmission: seed 7, homing, "
        in ran.stderr
    )


@pytest.mark.full
def test_files_of_the_folder_that_it_is_run_in_are_not_taken_for_parts_of_it(
    own: Installed, tmp_path: Path
) -> None:
    for package in PACKAGES:
        (tmp_path / f"{package}.py").write_text("raise SystemExit('not ours')")
    ran = own(tmp_path, "plumeward", "fly", "--budget", "2", "--speedup", "0", "--json")
    assert outcome(ran)["steps"] == 2
    assert list((tmp_path / "runs").glob("*.mcap"))
    (tmp_path / "plumeward.py").unlink()
    script = tmp_path / "mine.py"
    script.write_text("import plumeward")
    told = own(tmp_path, "python", "mine.py").stderr.splitlines()[-1]
    assert (
        told
        == f"ImportError: {tmp_path / 'plume.py'} hides plumeward's own package 'plume': rename this file or "
        "folder"
    )


@pytest.mark.full
def test_the_api_and_its_lists_work_where_nothing_but_a_flight_is_installed(
    own: Installed, tmp_path: Path
) -> None:
    code = (
        "import plumeward; print(plumeward.rollout(1, particles=100, budget=2)[0].steps, "
        "len(plumeward.evaluate('random', 1, budget=2)))"
    )
    assert own(tmp_path, "python", "-c", code).stdout == "2 1\n"
    listed = own(tmp_path, "plumeward", "list")
    assert (listed.returncode, listed.stderr) == (0, "")
    assert "  wind-shift " in listed.stdout


@pytest.mark.full
def test_a_mission_that_is_none_is_one_line_with_those_that_ship(own: Installed, tmp_path: Path) -> None:
    ran = own(tmp_path, "plumeward", "fly", "wnd-shift")
    missions = ", ".join(sorted(path.stem for path in (ROOT / "missions").glob("*.yaml")))
    assert ran.returncode == 2
    told = (
        "no such file and no shipped mission; did you mean 'wind-shift'? Wanted a mission script, or "
        f"one of {missions}"
    )
    assert ran.stderr == f"error: wnd-shift: {told}\n"


@pytest.mark.full
def test_the_command_and_the_module_take_the_same_command_lines(own: Installed, tmp_path: Path) -> None:
    for name in ("fly", "uav", "router", "status", "replay", "log", "record"):
        command, module = (
            own(tmp_path, "plumeward", name, "--help"),
            own(tmp_path, "python", "-m", "sitl", name, "--help"),
        )
        assert command.returncode == module.returncode == 0
        assert command.stdout.startswith(f"usage: plumeward {name} ")
        assert (
            command.stdout.split()
            == module.stdout.replace("usage: python -m sitl", "usage: plumeward").split()
        )
    command, module = (
        own(tmp_path, "plumeward", "fly", "--seed", "x"),
        own(tmp_path, "python", "-m", "sitl", "fly", "--seed", "x"),
    )
    assert command.returncode == module.returncode == 2
    assert command.stderr.startswith("plumeward fly: error: --seed: 'x' is not allowed; wanted ")
    assert command.stderr.replace("plumeward", "python -m sitl") == module.stderr


@pytest.mark.full
@pytest.mark.parametrize(
    ("words", "status", "told"),
    [
        (("report",), 1, "report needs matplotlib: pip install 'plumeward[view]'"),
        (
            ("train", "ppo"),
            2,
            "training needs torch, stable_baselines3, gymnasium, onnx, tensorboard: pip install "
            "'plumeward[train]'",
        ),
        (("evaluate", "--ray", "auto"), 2, "--ray: Ray is not installed; pip install 'plumeward[ray]'"),
    ],
    ids=["view", "train", "ray"],
)
def test_an_extra_that_is_missing_is_one_line(
    own: Installed, tmp_path: Path, words: tuple[str, ...], status: int, told: str
) -> None:
    ran = own(tmp_path, "python", "-m", "agent", *words)
    assert (ran.returncode, ran.stderr.splitlines()[-1]) == (status, f"error: {told}")
