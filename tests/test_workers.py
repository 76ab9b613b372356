"""Protects which tests run where: nothing costly is made twice, the longest begin first, and each row of a test runs
in one of `make test` and `make test-all`.
"""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.workers import LONG, LONGEST, ONE_BY_ONE, ROOT, rank, unit


@pytest.mark.parametrize(
    "file",
    [
        "tests/system/test_install.py",
        "tests/system/test_fly.py",
        "tests/plume/test_flight.py",
        *ONE_BY_ONE,
    ],
)
def test_what_shares_a_fixture_what_is_short_and_what_must_not_meet_stays_together(file: str) -> None:
    assert unit(f"{file}::test_a") == unit(f"{file}::test_b[1]") == file


@pytest.mark.parametrize(
    "file", ["tests/test_docs.py", "tests/system/test_parity.py", "tests/fuzz/test_decoders.py"]
)
def test_long_tests_go_to_whichever_process_is_free(file: str) -> None:
    assert unit(f"{file}::test_a[1]") != unit(f"{file}::test_a[2]")


def test_the_longest_begin_first() -> None:
    files = [
        "tests/plume/test_flight.py",
        "tests/test_docs.py",
        "tests/system/test_fly.py",
        "tests/system/test_install.py",
    ]
    assert sorted(files, key=rank) == [files[3], files[2], files[1], files[0]]


def test_all_that_is_named_is_there() -> None:
    assert [path for path in LONGEST + LONG + ONE_BY_ONE if not (ROOT / path).exists()] == []


def test_of_some_tests_each_nth_row_runs_at_once_and_all_others_in_test_all(tmp_path: Path) -> None:
    (tmp_path / "test_rows.py").write_text(
        "import pytest\n\n@pytest.mark.one_in(3)\n@pytest.mark.parametrize('row', 'abcdefg')\n"
        "def test_row(row): pass\n\ndef test_other(): pass\n"
    )
    rows = {}
    for mark in ("not full", "full"):
        asked = [sys.executable, "-m", "pytest", "-q", "--collect-only", "-m", mark, "--rootdir", str(ROOT)]
        words = ["-c", str(ROOT / "pyproject.toml"), "-p", "tests.conftest", "-o", "addopts=", str(tmp_path)]
        listed = subprocess.run([*asked, *words], cwd=ROOT, capture_output=True, text=True, timeout=600)
        rows[mark] = [line.partition("::")[2] for line in listed.stdout.splitlines() if "::" in line]
    assert rows == {
        "not full": ["test_row[a]", "test_row[d]", "test_row[g]", "test_other"],
        "full": [f"test_row[{row}]" for row in "bcef"],
    }
