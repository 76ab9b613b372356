"""Which rows of a test `make test` runs, and which process of pytest-xdist runs what: the longest tests first, and what
shares a costly fixture in one process.
"""

from collections import Counter
from functools import cache
from pathlib import Path

import pytest
from xdist.scheduler import LoadScopeScheduling

ROOT = Path(__file__).parents[1]
LONGEST = (
    "tests/system/test_install.py",
    "tests/system/test_same_bits.py",
    "tests/system/test_containers.py",
)
"""They begin before all others: the last test of a run costs its whole length."""
LONG = (
    "tests/system/",
    "tests/test_docs.py",
    "tests/view/",
    "tests/clients/",
    "tests/benchmarks/",
    "tests/fuzz/",
)
"""They begin next. The rest takes a second a test at most."""


def rank(node: str) -> int:
    """The place of a test: those of a lower one begin sooner."""
    return next(
        (place for place, path in enumerate(LONGEST + LONG) if node.startswith(path)), len(LONGEST + LONG)
    )


def mark_rows(items: list[pytest.Item]) -> None:
    """Mark the rows of a test `one_in(n)` that are left to `make test-all`: all but the first and each n-th after it."""
    seen: Counter[str] = Counter()
    for item in items:
        if mark := item.get_closest_marker("one_in"):
            test = item.nodeid.partition("[")[0]
            if seen[test] % mark.args[0]:
                item.add_marker(pytest.mark.full)
            seen[test] += 1


ONE_BY_ONE = ("tests/system/test_ray.py",)
"""Their tests meet what another of them has up: `--ray auto` joins any cluster on the machine."""


@cache
def shares(file: str) -> bool:
    """Whether the tests of a file share what was made once for all of them: an environment, a mission, a browser."""
    return 'scope="module"' in (ROOT / file).read_text()


def unit(node: str) -> str:
    """What one process runs without a break: a long test, or a file of short ones, of those that share, or
    of those that must not meet.
    """
    file = node.partition("::")[0]
    alone = file.startswith(LONGEST + LONG) and not file.startswith(ONE_BY_ONE) and not shares(file)
    return node if alone else file


class Units(LoadScopeScheduling):
    """Gives each process the next unit, in the order of the collection."""

    def _split_scope(self, nodeid: str) -> str:
        return unit(nodeid)
