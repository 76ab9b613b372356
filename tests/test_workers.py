"""Protects the distribution of tests to processes: nothing costly is made twice, and the longest tests begin first."""

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
