"""Protects users who have files named as our packages: the command ignores them, an import names them."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

PACKAGES = ("plume", "link", "estimator", "aircraft", "sitl", "scene", "agent", "ground", "plumeward")
COMMAND = str(Path(sys.executable).parent / "plumeward")
BRIEF = ("--budget", "2", "--speedup", "0", "--json")
PLAIN = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}


def folder(path: Path, *names: str) -> Path:
    for name in names:
        (path / f"{name}.py").write_text(f"raise SystemExit('{name}.py of the user was run')\n")
    return path


def run(cwd: Path, *command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=cwd, env=PLAIN, capture_output=True, text=True, timeout=300)


def result(ran: subprocess.CompletedProcess[str]) -> dict:
    assert ran.returncode == 0, ran.stderr
    said: dict = json.loads(ran.stdout.splitlines()[-1])
    return said


def test_the_command_flies_beside_files_with_the_names_of_its_packages(tmp_path: Path) -> None:
    folder(tmp_path, *PACKAGES, "random", "pickle")
    assert result(run(tmp_path, COMMAND, "fly", *BRIEF))["steps"] == 2


@pytest.mark.full
def test_so_do_the_workers_of_a_sweep(tmp_path: Path) -> None:
    folder(tmp_path, *PACKAGES, "random", "pickle")
    said = result(
        run(tmp_path, COMMAND, "evaluate", "--scenarios", "3", "--workers", "2", "--budget", "2", "--json")
    )
    assert said["homing"]["missions"] == 3


@pytest.mark.full
def test_the_parts_of_a_mission_that_a_module_flies_are_ours(tmp_path: Path) -> None:
    folder(tmp_path, "estimator", "agent", "plumeward")
    assert result(run(tmp_path, sys.executable, "-m", "sitl", "fly", *BRIEF))["steps"] == 2


@pytest.mark.full
def test_as_a_module_it_flies_beside_all_but_a_file_of_its_own_name(tmp_path: Path) -> None:
    folder(tmp_path, *PACKAGES[:-1])
    assert result(run(tmp_path, sys.executable, "-m", "plumeward", "fly", *BRIEF))["steps"] == 2
    said = result(
        run(
            tmp_path,
            sys.executable,
            "-m",
            "plumeward",
            "evaluate",
            "--scenarios",
            "2",
            "--workers",
            "2",
            "--budget",
            "2",
            "--json",
        )
    )
    assert said["homing"]["missions"] == 2


@pytest.mark.parametrize("package", PACKAGES[:-1])
def test_an_import_names_the_file_that_is_in_the_way(tmp_path: Path, package: str) -> None:
    (tmp_path / f"{package}.py").write_text("")
    script = tmp_path / "mine.py"
    script.write_text("import plumeward, gymnasium\ngymnasium.make('plumeward/SourceSearch-v0')\n")
    ran = run(tmp_path, sys.executable, str(script))
    wanted = (
        f"ImportError: {tmp_path / package}.py hides plumeward's own package {package!r}: rename this "
        "file or folder"
    )
    assert (ran.returncode, ran.stderr.splitlines()[-1]) == (1, wanted)


def test_so_it_does_for_a_folder_a_module_loaded_before_and_the_script_itself(tmp_path: Path) -> None:
    script = tmp_path / "agent.py"
    script.write_text("import plumeward\n")
    assert (
        f"ImportError: {script} hides plumeward's own package 'agent'"
        in run(tmp_path, sys.executable, "agent.py").stderr
    )
    package = tmp_path / "other" / "link" / "__init__.py"
    package.parent.mkdir(parents=True)
    package.write_text("")
    for code in ("import plumeward", "import link, sys; sys.path.remove(''); import plumeward"):
        ran = run(tmp_path / "other", sys.executable, "-c", code)
        assert ran.stderr.splitlines()[-1].startswith(
            f"ImportError: {package} hides plumeward's own package 'link'"
        )


def test_a_folder_that_is_no_package_is_not_in_the_way(tmp_path: Path) -> None:
    (tmp_path / "agent").mkdir()
    ran = run(tmp_path, sys.executable, "-c", "import plumeward; print(plumeward.draw(7).tau)")
    assert (ran.stdout, ran.stderr) == ("10.0\n", "")
