"""Protects the house: imports run the way the design draws them, truth stays away from estimate, every file says what it is."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MAY_IMPORT = {
    "plume": set(),
    "link": set(),
    "sitl": {"plume", "link"},
    "estimator": {"plume", "link"},
    "agent": {"plume", "link", "estimator"},
}
TRUTH = {"draw", "Scenario", "World"}
JUDGES = ("rollout.py", "missions.py", "floor.py")
"""Of the agent's: what flies missions in-process, and what they are judged by."""
FILES = sorted(path for package in MAY_IMPORT for path in (ROOT / package).rglob("*.py"))


def imports(path: Path) -> Iterator[tuple[str, str]]:
    """The (module, name) pairs that a file imports, wherever in it."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            yield from ((node.module, alias.name) for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from ((alias.name, "") for alias in node.names)


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_room_imports_only_the_rooms_below_it(path: Path) -> None:
    room = path.relative_to(ROOT).parts[0]
    ours = {module.split(".")[0] for module, _ in imports(path)} & set(MAY_IMPORT)
    assert ours <= MAY_IMPORT[room] | {room}


@pytest.mark.parametrize(
    "path",
    [path for path in FILES if path.parts[len(ROOT.parts)] in ("estimator", "agent") and path.name not in JUDGES],
    ids=str,
)
def test_nothing_that_estimates_or_plans_can_be_handed_the_truth(path: Path) -> None:
    assert not {name for module, name in imports(path) if module.startswith("plume")} & TRUTH


@pytest.mark.parametrize("path", sorted((*FILES, *(ROOT / "tests").rglob("*.py"), *(ROOT / "benchmarks").rglob("*.py"))), ids=str)
def test_every_file_says_in_its_first_line_what_it_is(path: Path) -> None:
    assert path.read_text().startswith('"""')


def test_the_services_get_neither_the_missions_seed_nor_its_source(monkeypatch: pytest.MonkeyPatch) -> None:
    import queue

    from plume.scenario import draw
    from sitl.launcher import Mission, start_parts
    from sitl.processes import Processes
    from sitl.script import Script

    started: dict[str, tuple[str, ...]] = {}

    class Out:
        def readline(self) -> str:
            return "tcp/127.0.0.1:7447\n"

    def start(_self: Processes, part: str, _module: str, *arguments: str) -> Out:
        started[part] = arguments
        return Out()

    monkeypatch.setattr(Processes, "start", start)
    scenario = draw(123456)
    mission = Mission(Script(seed=123456), uav_arguments=("--seed", "123456"), record=Path("record.mcap"))
    start_parts(Processes(queue.SimpleQueue()), mission, {})
    secrets = {"123456", *map(repr, scenario.source)}
    assert "123456" in started["uav"]
    for part in ("estimator", "agent"):
        assert not secrets & set(started[part])
