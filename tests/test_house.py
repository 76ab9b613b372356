"""Protects the house: each room imports what it says it may, nothing runs in a circle, truth stays away
from estimate.
"""

import ast
import itertools
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("plume", "link", "estimator", "aircraft", "sitl", "scene", "agent", "ground", "plumeward")
FILES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
TESTS = sorted((ROOT / "tests").rglob("*.py"))
TRUTH = {"draw", "Scenario", "World"}
JUDGES = ("agent.trials", "agent.learn")
"""What judges may hold the truth."""
MOST_FILES = 14


def name_of(path: Path) -> str:
    """The dotted name of a file or a folder."""
    return ".".join(path.relative_to(ROOT).with_suffix("").parts)


ROOMS = {name_of(path.parent): path for path in FILES if path.name == "__init__.py"}


def room_of(module: str) -> str:
    """The room that a module lies in."""
    while module not in ROOMS:
        module = module.rpartition(".")[0]
    return module


def may_import(room: str) -> set[str]:
    """The rooms that a room says it imports."""
    docstring = ast.get_docstring(ast.parse(ROOMS[room].read_text())) or ""
    said = re.search(r"Imports: (.+?)\.(?:\n|$)", docstring, re.DOTALL)
    assert said, f"{room} does not say what it imports"
    return set() if said[1] == "nothing of ours" else set(re.split(r",\s", said[1]))


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


def imports(path: Path) -> Iterator[tuple[str, str]]:
    """The (module, name) pairs that a file imports, wherever in it; a module that is imported from its
    room counts as that module.
    """
    yield from imported_by(ast.walk(tree_of(path)))


def imported_by(nodes: Iterable[ast.AST]) -> Iterator[tuple[str, str]]:
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                is_module = (ROOT / Path(*inner.split("."))).with_suffix(".py").exists()
                yield (inner, "") if is_module else (node.module, alias.name)
        elif isinstance(node, ast.Import):
            yield from ((alias.name, "") for alias in node.names)


@cache
def ours(path: Path) -> set[str]:
    """The rooms that a file imports from."""
    return {room_of(module) for module, _ in imports(path) if module.split(".")[0] in PACKAGES}


def test_a_file_imports_only_what_its_room_says() -> None:
    for path in FILES:
        room = name_of(path.parent)
        allowed = may_import(room) | {room}
        if path.name == "__main__.py":  # the command over a package's rooms
            package = room.split(".")[0]
            rooms = {name for name in ROOMS if name.split(".")[0] == package}
            allowed |= rooms.union(*map(may_import, rooms))
        assert ours(path) <= allowed, name_of(path)


def test_a_room_says_no_more_than_it_imports() -> None:
    for room, path in ROOMS.items():
        files = [other for other in path.parent.glob("*.py")]
        assert may_import(room) <= set().union(*map(ours, files)), room


def test_nothing_runs_in_a_circle() -> None:
    rooms = {room: may_import(room) - {room} for room in ROOMS}
    assert list(TopologicalSorter(rooms).static_order())  # raises CycleError


def test_no_file_imports_itself_round_a_circle() -> None:
    """Wherever in a file the import stands; what only a type checker imports is left out."""
    files = {name_of(path).removesuffix(".__init__"): path for path in FILES}
    graph: dict[str, set[str]] = {}
    for name, path in files.items():
        nodes = {id(node): node for node in ast.walk(tree_of(path))}
        for node in [*nodes.values()]:
            if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
                for unseen in itertools.chain(*map(ast.walk, node.body)):
                    nodes.pop(id(unseen), None)
        graph[name] = {module for module, _ in imported_by(nodes.values())} & files.keys() - {name}
    assert list(TopologicalSorter(graph).static_order())  # raises CycleError


def test_the_architecture_page_lists_the_rooms_from_the_ground_up() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text()
    rows = re.findall(r"^\| `([a-z0-9_/]+)/` \| .+ \| (.+) \|$", page, re.MULTILINE)
    listed = {
        room.replace("/", "."): set() if said == "nothing of ours" else set(said.split(", "))
        for room, said in rows
    }
    assert listed == {room: may_import(room) for room in ROOMS}
    above: set[str] = set()
    for room, below in listed.items():
        assert below <= above, room
        above.add(room)


@pytest.mark.parametrize(
    "page",
    sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")]),
    ids=name_of,
)
def test_a_file_that_a_page_names_is_there(page: Path) -> None:
    named = re.findall(
        r"`((?:plume|link|scene|sitl|aircraft|ground|estimator|agent|tests|benchmarks|docs|missions)/[\w./-]*)`",
        page.read_text(),
    )
    assert [name for name in named if "NAME" not in name and not (ROOT / name).exists()] == []


STRANGERS = {
    "aircraft": {"sitl", "scene", "estimator", "agent", "ground"},
    "sitl": {"estimator", "agent"},
    "estimator": {"aircraft", "sitl", "ground"},
    "agent": {"aircraft", "sitl", "ground"},
    "ground": {"estimator", "agent"},
}
"""Houses that a house knows nothing of, whatever its rooms say."""


def test_vehicles_services_and_ground_do_not_know_each_other() -> None:
    for path in FILES:
        package, known = path.relative_to(ROOT).parts[0], {room.split(".")[0] for room in ours(path)}
        assert not known & STRANGERS.get(package, set()), path


def test_nothing_that_estimates_or_plans_can_be_handed_the_truth() -> None:
    for path in FILES:
        if name_of(path).startswith(("estimator", "agent")) and not name_of(path).startswith(JUDGES):
            assert not {name for module, name in imports(path) if module.startswith("plume")} & TRUTH, (
                name_of(path)
            )
            assert not [module for module, _ in imports(path) if module.startswith("plume.worlds")], name_of(
                path
            )


def test_every_file_says_in_its_first_line_what_it_is() -> None:
    for path in (*FILES, *TESTS, *(ROOT / "benchmarks").rglob("*.py")):
        assert path.read_text().startswith('"""'), path


def test_a_class_name_means_one_thing() -> None:
    classes = Counter(
        node.name
        for path in FILES
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    assert [name for name, count in classes.items() if count > 1] == []


def test_no_room_is_crowded() -> None:
    for room, path in ROOMS.items():
        files = [other for other in path.parent.glob("*.py") if other.name != "__init__.py"]
        assert len(files) <= MOST_FILES, room


def test_the_services_get_neither_the_missions_seed_nor_its_source(monkeypatch: pytest.MonkeyPatch) -> None:
    import queue

    from plume.scenario import draw
    from sitl.launch.launcher import start_parts
    from sitl.launch.mission import Launch
    from sitl.launch.processes import Processes
    from sitl.script.script import Script

    started: dict[str, tuple[str, ...]] = {}

    class Out:
        def readline(self) -> str:
            return "tcp/127.0.0.1:7447\n"

    def start(_self: Processes, part: str, _module: str, *arguments: str, **_kind: object) -> Out:
        started[part] = arguments
        return Out()

    monkeypatch.setattr(Processes, "start", start)
    script = Script(seed=123456, world="all-at-once")
    truth = script.simulated().truth
    mission = Launch(
        script=script,
        uav_arguments=("--seed", "123456", "--world", "all-at-once"),
        record=Path("record.mcap"),
    )
    start_parts(Processes(queue.SimpleQueue()), mission, {})
    secrets = {
        "123456",
        "all-at-once",
        *map(repr, (*truth.source, truth.q, truth.d, truth.tau, truth.u, truth.phi)),
    }
    assert {"123456", "all-at-once"} <= set(started["uav"])
    assert str(draw(123456).q) in started["estimator"]  # what it is told
    for part in ("estimator", "agent"):
        assert not secrets & set(started[part])


INEXACT = {
    *(
        "exp",
        "exp2",
        "expm1",
        "log",
        "log2",
        "log10",
        "log1p",
        "logaddexp",
        "sin",
        "cos",
        "tan",
        "arcsin",
        "arccos",
        "arctan",
        "arctan2",
    ),
    *(
        "asin",
        "acos",
        "atan",
        "atan2",
        "sinh",
        "cosh",
        "tanh",
        "hypot",
        "power",
        "pow",
        "cbrt",
        "erf",
        "erfc",
        "gamma",
        "lgamma",
    ),
    *("dot", "vdot", "inner", "matmul", "einsum", "tensordot", "linalg"),
}
"""Functions of NumPy, BLAS and the C library whose last bits depend on the processor."""
SAMPLERS = {"uniform", "normal", "gamma", "beta", "lognormal", "exponential"}
"""Methods of a generator that compute with what they draw, in compiled code."""
MAY_BE_INEXACT = {
    "plume.geodesy": "latitude and longitude for ground stations, rounded to 1e-7° on the wire; nothing "
    "estimates from them",
    "plume.sensors.sensor": "the definition of the likelihoods, with which tests and benchmarks compare the kernels; "
    "no flight calls it",
    "plume.sensors.instruments": "the definition of their likelihoods, as of plume.sensors.sensor",
    "plume.worlds.world": "beta draws of correlated gas, rounded to float32 with the reading",
    "agent.learn.render": "a picture",
    "agent.learn.train": "training, which promises the same policy on the same machine only",
    "agent.trials.report.drawing": "a picture",
}
"""Why a module may use them all the same."""


def inexact(path: Path) -> Iterator[str]:
    """What a file uses that is not plain IEEE arithmetic in a fixed order. Python's own x ** y is the C
    library's `pow`; numba's is not.
    """
    tree = ast.parse(path.read_text())
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    compiled = {
        id(node)
        for function in functions
        if function.decorator_list
        for node in ast.walk(function)
        if is_compiled(function)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            if (node.value.id in ("np", "math") and node.attr in INEXACT) or (
                node.value.id == "rng" and node.attr in SAMPLERS
            ):
                yield f"{node.value.id}.{node.attr}"
        elif isinstance(node, ast.ImportFrom) and node.module in ("math", "numpy"):
            yield from {alias.name for alias in node.names} & INEXACT
        elif isinstance(node, ast.BinOp | ast.AugAssign) and isinstance(node.op, ast.MatMult):
            yield "@"
        elif (
            isinstance(node, ast.BinOp)
            and isinstance(node.op, ast.Pow)
            and id(node) not in compiled
            and not is_exact(node.left)
        ):
            yield "**"


def is_exact(base: ast.expr) -> bool:
    """True if whole powers of a number are exact."""
    return isinstance(base, ast.Constant) and base.value in (0.5, 2, 10)


def is_compiled(function: ast.FunctionDef) -> bool:
    """True if numba compiles the function."""
    return any(
        word in ast.unparse(decorator)
        for decorator in function.decorator_list
        for word in ("njit", "kernel", "subroutine")
    )


def test_what_estimates_or_plans_uses_plain_arithmetic_in_a_fixed_order() -> None:
    used: dict[str, set[str]] = {}
    for path in FILES:
        if path.relative_to(ROOT).parts[0] in ("plume", "estimator", "agent") and (
            found := set(inexact(path))
        ):
            module = name_of(path)
            used[next((name for name in MAY_BE_INEXACT if module.startswith(name)), module)] = found
    assert {module: found for module, found in used.items() if module not in MAY_BE_INEXACT} == {}
    assert set(MAY_BE_INEXACT) - {"agent.learn.train"} <= set(used)  # no exception outlives its reason


TUPLES = {"_replace", "_asdict", "_fields", "_make"}
"""What named tuples offer to all, whatever its first letter."""
MAY_SLEEP = {
    "conftest.py": "polls",
    "link/bus/test_inbox.py": "a signal's handler that takes long",
    "system/stranger.py": "looks whether nothing comes",
    "system/wires.py": "a serial line, which is read again and again",
}
"""Why a file of tests sleeps all the same."""
HEAVY = {
    *(
        "torch",
        "tensorboard",
        "stable_baselines3",
        "stonesoup",
        "particles",
        "scipy",
        "sklearn",
        "joblib",
        "matplotlib",
        "rerun",
    ),
    *("onnxruntime", "ray", "playwright", "nbclient", "nbformat"),
}
"""Packages that take long to import: every process of a test run would."""


def private(tree: ast.Module) -> Iterator[str]:
    """The private names of others that a file uses."""
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Attribute)
            and node.attr.startswith("_")
            and not node.attr.startswith("__")
            and node.attr not in TUPLES
        ):
            if not (isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")):
                yield ast.unparse(node)
        elif isinstance(node, ast.ImportFrom):
            yield from (
                alias.name
                for alias in node.names
                if alias.name.startswith("_") and not alias.name.startswith("__")
            )


def at_once(nodes: Iterable[ast.AST]) -> Iterator[ast.AST]:
    """The statements that run when a file is imported."""
    for node in nodes:
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            yield from at_once(node.orelse)
        elif isinstance(node, ast.If | ast.Try | ast.With | ast.ClassDef):
            yield from at_once(ast.iter_child_nodes(node))
        else:
            yield node


@cache
def loads(path: Path) -> frozenset[str]:
    """All modules that are imported with a file, and by those of ours among them."""
    found: set[str] = set()
    to_do = [path]
    while to_do:
        for module, _ in imported_by(at_once(tree_of(to_do.pop()).body)):
            parts = module.split(".")
            for name in {".".join(parts[: count + 1]) for count in range(len(parts))} - found:
                found.add(name)
                file = ROOT.joinpath(*name.split("."))
                to_do += [
                    there for there in (file.with_suffix(".py"), file / "__init__.py") if there.is_file()
                ]
    return frozenset(found)


def test_a_test_looks_at_things_from_outside() -> None:
    used = {name_of(path): found for path in TESTS if (found := set(private(tree_of(path))))}
    assert used == {}


def test_a_test_awaits_what_happens_and_does_not_sleep() -> None:
    sleeps = {
        str(path.relative_to(ROOT / "tests"))
        for path in TESTS
        for node in ast.walk(tree_of(path))
        if isinstance(node, ast.Call) and ast.unparse(node.func) in ("time.sleep", "sleep")
    }
    assert sleeps == set(MAY_SLEEP)


def test_what_takes_long_to_import_is_imported_where_a_test_needs_it() -> None:
    heavy = {name_of(path): found for path in TESTS if (found := loads(path) & HEAVY)}
    assert heavy == {}
