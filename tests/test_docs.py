"""Protects README and docs: every command and example on these pages runs, what they show is what is
printed, every link leads somewhere.

The commands run in a copy of the checkout. Long commands run smaller. Commands that stay up run until they
have said what they should. The tables below say how; a line of a table that no page needs fails, too.
"""

import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache, partial
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from ruamel.yaml import YAML

from plume.walls.buildings import read
from sitl.script.script import load
from tests.clients.installed import free_udp_port, python_of
from tests.kernels import copy_kernels

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
LANGUAGES = {"sh", "console", "python", "yaml", "toml", "text", "mermaid"}
"""sh: commands. console: commands behind `$ `, each with what it prints below it. text and mermaid:
nothing to run.
"""
RUNS = ("python ", "make ", "plumeward ", "pip ", "docker ", "podman ", "source ", "tensorboard ")
"""Code spans in sentences that begin with one of these are commands, too."""
OURS = r"(plumeward|python -m (sitl|agent))"
SHORTER = {
    rf"{OURS} (fly|uav)\b(?!.* --vehicle ).*": "--speedup 0",
    rf"{OURS} view\b(?! -).*": "--port 0",
    rf"{OURS} evaluate\b.*": "--scenarios 2",
    rf"{OURS} train\b.*": "--steps 1 --scenarios 0",
}
"""Commands that take less time with more flags; the last flag of a name counts."""
TIMEOUT_S = 600
"""A command that takes longer hangs."""
RELIED_ON = {
    "README.md: make mission",
    "README.md: plumeward rollout --seed 4 --policy infotaxis --world wind-30 --assume paper",
    "docs/services.md: plumeward router --listen tcp/127.0.0.1:7447",
}
"""What `make test` runs, beside all that prints help: a page, and the first command of a block. `make
test-all` runs the others.
"""
SHORT = {"README.md", "physics.md", "policies.md"}
"""Pages whose examples in Python `make test` runs."""

INSTEAD = {
    "make test": "make test FLAGS=tests/plume/test_geodesy.py",
    "make test-all": "make --dry-run test-all",
    "make lint": "make --dry-run lint",  # .ci/run runs it
    "make fuzz": "make --dry-run fuzz",  # tests/fuzz gives each decoder its first inputs
    "make site": "make --dry-run site",  # tests/test_site.py builds it
    "make bench": "make bench FLAGS='--missions 1'",
    "make bench-page": "make bench-page FLAGS='--duration 3'",
    "make bench-env": "python -c 'from benchmarks import env as b; b.PARTICLES, b.BATCHES, b.MISSIONS, b.REPEATS = (500,), (1,), 1, 1; b.main()'",
    "make bench-filter": "python -c 'from benchmarks import filter as b; b.SIZES, b.BATCHES, b.MISSIONS = (1000,), (1,), 1; b.main()'",
    "make bench-planners": "python -c 'from benchmarks import planners as b; b.SIZES, b.MISSIONS, b.REPEATS = (100,), 1, 1; b.main()'",
    "make train": "make train LEARNERS=ddpg FLAGS='--steps 1 --scenarios 0'",
    "make results": "make results POLICIES=greedy BOARD=greedy LEARNED=ppo FLAGS='--scenarios 2'",
    "make mismatch": "make mismatch FLAGS='--missions 1 --policy homing --assume paper --world as-modelled'",
    "make chaos": "make chaos FLAGS='--missions 1 --first-seed 5 --json'",
    "python -m tests.system.bits": "python -m tests.system.bits golden",  # tests/system/test_same_bits.py prints all
    "make golden": "python -c 'from tests.golden.__main__ import renew; print(renew(\"greedy-hits\"))'",
    "python benchmarks/floor.py": "python benchmarks/floor.py --missions 2 --threshold 0.9",
    "python benchmarks/floor.py --fly": "python benchmarks/floor.py --missions 2 --threshold 0.9 --fly",
    "python benchmarks/floor.py --missions 200 --threshold 0.1 0.3 0.5 0.9 --convergence": "python benchmarks/floor.py --missions 1 --threshold 0.9 --convergence",
    "python -m benchmarks.trust --world wind-30 --policy homing": "python -m benchmarks.trust --world wind-30 --policy homing --assume paper --missions 1",
    "python benchmarks/obstacles.py": "python benchmarks/obstacles.py --missions 1",
    "python -m benchmarks.moves": "python -m benchmarks.moves --searches 1",
    "python -m benchmarks.puffs": "python -m benchmarks.puffs --missions 2",
    "python -m benchmarks.sensors": "python -m benchmarks.sensors --missions 1",
    "python -m benchmarks.together --fly": "python -m benchmarks.together --fly --missions 1 --vehicles 2",
    "python -m benchmarks.together --wide --fly": "python -m benchmarks.together --wide --fly --missions 1 --vehicles 2",
    "python -m benchmarks.load": "python -m benchmarks.load --vehicles 2 --missions 1",
    "python -m benchmarks.dwell": "python -m benchmarks.dwell --world as-modelled --missions 1",
    "python -m benchmarks.findings": "python -m benchmarks.findings --missions 1 --world as-modelled --workers 1 --results few",
    "python -m benchmarks.laws": "python -m benchmarks.laws --worlds cv-1 --missions 1 --workers 1",
    "python -m benchmarks.recorded": "python -m benchmarks.recorded --missions 1 --length 2 --workers 1",
    "python -m benchmarks.otto": "python -m benchmarks.otto --cases isotropic-19x19 --runs 2 --workers 1",
    "python -m benchmarks.otto_value": "python -m benchmarks.otto_value --iterations 2",
    "python benchmarks/loop.py --secure": "python benchmarks/loop.py --secure --missions 1",
    "python -m benchmarks.soak": "python -m benchmarks.soak --steps 1000 || test $? = 1",  # too short to tell whether anything grows
    "python -m benchmarks.fleet": "python -m benchmarks.fleet --vehicles 1 --seconds 5",
    "python -m benchmarks.stop": "python -m benchmarks.stop --trials 10",
    "python -m benchmarks.record": "python -m benchmarks.record --comparisons 1 --stretch 10",
    "plumeward report": "mkdir few && plumeward evaluate --scenarios 2 --missions few/rows.csv && plumeward report --results few --out few",
    "pip install .": "python -m pip install --quiet --no-index --no-deps --no-build-isolation --target site .",
    "pip install ./heaviest": "python -m pip install --quiet --no-index --no-deps --no-build-isolation --target site .",
    "python -m hatchling build": "python -m hatchling build --target wheel",
    "plumeward status": "plumeward status --connect tcp/127.0.0.1:7447",
    "plumeward view --foxglove 8765": "plumeward view --foxglove 0 --port 0",
    "plumeward uav --out udpin:127.0.0.1:14550": "plumeward uav --out udpin:127.0.0.1:7447",
    "plumeward uav --out udpin:127.0.0.1:14550 --sign fleet.key": "plumeward uav --out udpin:127.0.0.1:7447 --sign fleet.key",
    "plumeward bridge udpin:127.0.0.1:14550 tcp:127.0.0.1:5760 --connect tcp/127.0.0.1:7447": "plumeward bridge udpin:127.0.0.1:7447 tcp:127.0.0.1:1 --connect tcp/127.0.0.1:7447",
    "plumeward payload --payload serial:/dev/ttyUSB0:9600 --connect tcp/127.0.0.1:7447": "plumeward payload --payload serial:nothing:9600 --connect tcp/127.0.0.1:7447",
    "plumeward replay flight.tlog --gas CH4*0.000656 --wind 2.5,270": "plumeward replay flight.tlog --gas gas*1.0 --wind 2.5,270",
    "plumeward uav --out udpout:127.0.0.1:14540": "plumeward uav --out udpout:127.0.0.1:7447",
    "plumeward uav --out udpout:127.0.0.1:14540 --seed 3000950": "plumeward uav --out udpout:127.0.0.1:7447 --seed 3000950 --speedup 10",
    "plumeward fly --vehicle udpin:127.0.0.1:14540 --seed 3000950 --speedup 1 --record px4.mcap": "plumeward fly --vehicle udpin:127.0.0.1:7447 --seed 3000950 --speedup 10 --record px4.mcap",
    "plumeward uav --out udpout:127.0.0.1:14540 --seed 4": "plumeward uav --out udpout:127.0.0.1:7447 --seed 4 --speedup 10",
    "plumeward fly --vehicles 2 --from corners --vehicle udpin:127.0.0.1:14540 --home 47.397742,8.545594,488,0 --seed 4 --speedup 1 --record mixed.mcap": "plumeward fly --vehicles 2 --from corners --vehicle udpin:127.0.0.1:7447 --home 47.397742,8.545594,488,0 --seed 4 --speedup 10 --record mixed.mcap",
    "plumeward fly --vehicle tcp:127.0.0.1:5760 --seed 11": "plumeward fly --vehicle tcp:127.0.0.1:1 --seed 11",
    "plumeward fly --vehicle udpin:127.0.0.1:14540 --seed 11": "plumeward fly --vehicle udpin:127.0.0.1:7447 --seed 11",
    "plumeward view --connect tcp/127.0.0.1:7447": "plumeward view --connect tcp/127.0.0.1:7447 --port 0",
    "plumeward fly --vehicle udpin:127.0.0.1:14540 --payload serial:gas-sensor --sensor gaussian:0.3,0.02 --wind 2.5,270 --budget 5 --record bench.mcap": "plumeward fly --vehicle udpin:127.0.0.1:7447 --payload serial:gas-sensor --sensor gaussian:0.3,0.02 --wind 2.5,270 --budget 5 --record bench.mcap",
    "plumeward fly --vehicle udpin:127.0.0.1:14540 --seed 3000950 --record rehearsal.mcap": "plumeward fly --vehicle udpin:127.0.0.1:7447 --seed 3000950 --speedup 10 --record rehearsal.mcap",
    "tensorboard --logdir runs/train": "tensorboard --logdir runs/train --port 0",
}
"""What is run in place of a command: one that takes less time, or needs nothing that only others have."""
STAYS = {
    "plumeward router --listen tcp/127.0.0.1:7447": "tcp/127.0.0.1:",
    "plumeward router --listen tls/127.0.0.1:7447 --secure certs": "tls/127.0.0.1:",
    "plumeward estimator --connect tls/127.0.0.1:7447 --secure certs": "ready: ",
    "plumeward agent --connect tls/127.0.0.1:7447 --secure certs": "ready: ",
    "plumeward uav --seed 7 --connect tcp/127.0.0.1:7447": "its agent: ",
    "plumeward uav --out udpout:127.0.0.1:14540": "MAVLink to ",
    "plumeward uav --out udpout:127.0.0.1:14540 --seed 3000950": "MAVLink to ",
    "plumeward uav --out udpout:127.0.0.1:14540 --seed 4": "MAVLink to ",
    "plumeward uav --out udpin:127.0.0.1:14550": "MAVLink to ",
    "plumeward uav --out udpin:127.0.0.1:14550 --sign fleet.key": "MAVLink to ",
    "plumeward bridge udpin:127.0.0.1:14550 tcp:127.0.0.1:5760 --connect tcp/127.0.0.1:7447": "it is tried again",
    "plumeward ros2 --connect tcp/127.0.0.1:7447": "is /uav_1 in ROS domain",
    "plumeward payload --payload serial:/dev/ttyUSB0:9600 --connect tcp/127.0.0.1:7447": "ready: serial:",
    "plumeward payload --payload iio:gas --connect tcp/127.0.0.1:7447": "ready: iio:gas",
    "plumeward fly --vehicle tcp:127.0.0.1:5760 --seed 11": "Waiting for the autopilot: no HEARTBEAT",
    "plumeward fly --vehicle udpin:127.0.0.1:14540 --seed 11": "Waiting for the autopilot: no HEARTBEAT",
    "python docs/examples/fake_sensor.py": "a sensor in clean air",
    "plumeward estimator --namespace uav/1 --connect tcp/127.0.0.1:7447": "ready: ",
    "plumeward estimator --namespace uav/2 --connect tcp/127.0.0.1:7447": "ready: ",
    "plumeward agent --namespace uav/1 --connect tcp/127.0.0.1:7447": "ready: ",
    "plumeward agent --namespace uav/2 --connect tcp/127.0.0.1:7447": "ready: ",
    "plumeward estimator --namespace search/1 --vehicles 2 --connect tcp/127.0.0.1:7447": "ready: ",
    "plumeward agent --namespace search/1 --connect tcp/127.0.0.1:7447": "ready: ",
    "plumeward uav --vehicles 2 --number 1 -I 0 --from corners --seed 4 --connect tcp/127.0.0.1:7447": "agent: ",
    "plumeward uav --vehicles 2 --number 2 -I 1 --from corners --seed 4 --connect tcp/127.0.0.1:7447": "agent: ",
    "plumeward view --connect tcp/127.0.0.1:7447": "page at http://127.0.0.1:",
    "plumeward status --watch --connect tcp/127.0.0.1:7447": "uav/2 at tcp/",
    "plumeward fly --vehicle serial:/dev/ttyAMA0:921600 --payload serial:/dev/ttyUSB0:9600 --sensor gaussian:0.3,0.02 --dwell 2 --record site.mcap --findings flight-findings --view": "Waiting for the autopilot: no HEARTBEAT",
    "plumeward record bus.mcap --connect tcp/127.0.0.1:7447": "bus.mcap",
    "plumeward fly --seed 11 --view": "page stays open at",
    "plumeward fly --view": "page stays open at",
    "plumeward view first.mcap": "page at http://127.0.0.1:",
    "plumeward view": "page at http://127.0.0.1:",
    "plumeward view --foxglove 8765": "Foxglove at ws://127.0.0.1:",
    "plumeward view runs/NAME.mcap": "page at http://127.0.0.1:",
    "plumeward estimator --connect tcp/127.0.0.1:7447": "ready: ",
    "plumeward estimator --connect tcp/127.0.0.1:7447 --rate 364.9238897255652 --diffusivity 5.890049834047215": "ready: ",
    "plumeward agent --connect tcp/127.0.0.1:7447 --policy homing": "ready: ",
    "plumeward agent --connect tcp/127.0.0.1:7447": "ceased at step",  # says the estimator: a whole mission is flown
    "tensorboard --logdir runs/train": "http://",
}
"""Commands that stay up, and what each must print before the next command of the block runs. At the end
they are interrupted.
"""
VARIES = re.compile(
    r"router at|runs/\d|begun 20|messages in|^time=|^(belief|health|mavlink|reading|waypoint)|replayed "
    r"in|^plumeward \d"
)
"""Lines of output whose figures differ between runs: times, rates, ports, names."""


class Block(NamedTuple):
    """A fenced block of a page."""

    page: Path
    line: int
    language: str
    text: str


class Command(NamedTuple):
    """A command as a page has it, and the lines that the page says it prints."""

    text: str
    shown: tuple[str, ...] = ()


class Session(NamedTuple):
    """The commands of a block, in order, or those of a whole tutorial, or the one of a sentence."""

    page: Path
    commands: tuple[Command, ...]

    def __str__(self) -> str:
        return f"{self.page.relative_to(ROOT)}: {self.commands[0].text}"


@cache
def blocks(page: Path) -> list[Block]:
    """All fenced blocks of a page."""
    found, lines = [], page.read_text().splitlines()
    fences = [number for number, line in enumerate(lines) if line.startswith("```")]
    for begin, end in zip(fences[::2], fences[1::2], strict=True):
        found.append(
            Block(page, begin + 1, lines[begin].removeprefix("```"), "\n".join(lines[begin + 1 : end]) + "\n")
        )
    return found


def of(language: str) -> list[Block]:
    return [block for page in PAGES for block in blocks(page) if block.language == language]


def named(block: Block) -> str:
    """The file name in a block's first line; empty if there is none."""
    first = re.match(r"# ([\w.-]+\.(py|toml|yaml))\n", block.text)
    return first[1] if first else ""


def folder(page: Path) -> str:
    """Where a page's blocks run: a page with files has a folder of its own for them."""
    return f"of-{page.stem}" if any(map(named, blocks(page))) else "."


def place(command: str, page: Path) -> str:
    """Where a command of a page runs: make and the virtual environment are those of the checkout."""
    return "." if command.startswith(("make ", "source ")) else folder(page)


def typed(text: str) -> Iterator[Command]:
    """The commands of a block, one a line, without prompts, comments and breaks."""
    for line in text.replace("\\\n", " ").splitlines():
        command = re.sub(r"(^|\s+)#\s.*", "", line).strip()
        if command:
            yield Command(command)


def watched(text: str) -> Iterator[Command]:
    """The commands of a console, each with the lines below it."""
    for part in re.split(r"^\$ ", text, flags=re.MULTILINE)[1:]:
        command, _, shown = part.partition("\n")
        yield Command(
            re.sub(r"\s+#\s.*", "", command), tuple(line for line in shown.splitlines() if line.strip())
        )


SHELLS = {"sh": typed, "console": watched}


def said_to_type(page: Path) -> list[tuple[Command, ...]]:
    """The commands of each block of a page; a tutorial is one story, each of its blocks needs those before
    it.
    """
    each = [tuple(SHELLS[block.language](block.text)) for block in blocks(page) if block.language in SHELLS]
    return [tuple(chain.from_iterable(each))] if page.parent.name == "tutorials" else each


def spans(page: Path) -> Iterator[str]:
    """The code spans of a page's sentences."""
    prose = re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    for paragraph in prose.split("\n\n"):
        yield from (" ".join(span.split()) for span in re.findall(r"(?<!`)`([^`]+)`(?!`)", paragraph))


def is_a_repeat(session: Session, earlier: list[Session]) -> bool:
    """Whether all commands of a block were typed in the same folder before, and the block shows nothing
    that is printed.
    """
    there = {
        (command.text, place(command.text, other.page)) for other in earlier for command in other.commands
    }
    return all(
        (command.text, place(command.text, session.page)) in there and not command.shown
        for command in session.commands
    )


def mentioned(span: str) -> str:
    """The command of a code span: a name such as `plumeward fly` stands for its help."""
    return f"{span} --help" if re.fullmatch(r"plumeward [a-z0-9]+", span) else span


def sessions() -> list[Session]:
    """All sessions to run, without those that only repeat an earlier one."""
    found = [Session(page, commands) for page in PAGES for commands in said_to_type(page)]
    found = [session for number, session in enumerate(found) if not is_a_repeat(session, found[:number])]
    there = {command.text for session in found for command in session.commands}
    for page in PAGES:
        for span in filter(lambda span: span.startswith(RUNS), spans(page)):
            if not {span, mentioned(span)} & there:
                there.add(mentioned(span))
                found.append(Session(page, (Command(mentioned(span)),)))
    return found


SESSIONS = sessions()


def checkout_files() -> list[str]:
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    return [name for name in listed.stdout.split("\0") if name and (ROOT / name).is_file()]


def make_environment(copy: Path) -> None:
    """Give a copy a `.venv` that `make setup` leaves alone: the packages of the one that runs this test,
    commands of its own, no pip.
    """
    bin_ = copy / ".venv" / "bin"
    bin_.mkdir(parents=True)
    for there in Path(sys.prefix).iterdir():
        if there.name not in ("bin", ".flight", ".ready"):
            (copy / ".venv" / there.name).symlink_to(there)
    for there in (Path(sys.prefix) / "bin").iterdir():
        if not there.name.startswith("pip"):
            (bin_ / there.name).symlink_to(there)
    scripts = tomllib.loads((copy / "pyproject.toml").read_text())["project"].get("scripts", {})
    for name, (module, _, function) in {
        name: target.partition(":") for name, target in scripts.items()
    }.items():
        (bin_ / name).unlink(missing_ok=True)
        (bin_ / name).write_text(
            f"#!/usr/bin/env python\nfrom {module} import {function}\nif __name__ == '__main__':\n    "
            f"{function}()\n"
        )
        (bin_ / name).chmod(0o755)
    for layer in (".flight", ".ready"):
        (copy / ".venv" / layer).touch()


@pytest.fixture(scope="session")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A copy of the checkout to run in, as a user has it; it is removed afterwards."""
    copy = tmp_path_factory.mktemp("checkout")
    for name in checkout_files():
        (copy / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, copy / name)
    make_environment(copy)
    copy_kernels(ROOT, copy)
    for page in PAGES:
        for block in filter(named, blocks(page)):
            (copy / folder(page)).mkdir(exist_ok=True)
            (copy / folder(page) / named(block)).write_text(block.text)
    yield copy
    shutil.rmtree(copy)


@pytest.fixture
def said(tmp_path: Path) -> Path:
    """The file that collects what a session's processes print."""
    return tmp_path / "said.txt"


@contextmanager
def started(command: str, cwd: Path, copy: Path, said: Path) -> Iterator[subprocess.Popen]:
    """Run a command as a shell of the copy would; afterwards neither it nor a child of it is left."""
    environment = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(("PYTEST", "MAKE", "MFLAGS", "FLAGS"))
    }
    environment |= {
        "PATH": f"{copy / '.venv' / 'bin'}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": os.pathsep.join(map(str, (copy, cwd / "site"))),
        "COLUMNS": "160",
        "SB3_LOGDIR": str(copy / "sb3"),  # else an example's learner leaves a folder behind
    }
    with said.open("ab") as file:
        shell, null = ["bash", "-c", command], subprocess.DEVNULL
        process = subprocess.Popen(
            shell, cwd=cwd, env=environment, stdin=null, stdout=file, stderr=file, start_new_session=True
        )
    try:
        yield process
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def output(said: Path, before: int = 0) -> str:
    """What was printed from this size of the file on."""
    return said.read_bytes()[before:].decode(errors="replace") if said.exists() else ""


def has_spoken(process: subprocess.Popen, words: str, said: Path, before: int) -> bool:
    """Whether a command has said these words, or never will."""
    return words in output(said, before) or process.poll() is not None


def ended(command: str, cwd: Path, copy: Path, said: Path) -> int:
    with started(command, cwd, copy, said) as process:
        return process.wait(TIMEOUT_S)


@contextmanager
def staying(command: str, cwd: Path, copy: Path, said: Path) -> Iterator[subprocess.Popen]:
    """Keep a command up until the with block ends. If it is ours, Ctrl-C must end it, and nothing else
    may.
    """
    with started(f"exec {command}", cwd, copy, said) as process:
        yield process
        if " --view" in command and process.poll() == 0:
            return  # its page stays open no longer where nobody can press Ctrl-C
        assert process.poll() is None, f"{command}: did not stay up\n{output(said)}"
        if command.startswith("tensorboard "):
            return  # it sometimes ignores the signal
        process.send_signal(signal.SIGINT)
        assert process.wait(TIMEOUT_S) in (0, 130), (
            f"{command}: an interrupt did not end it cleanly\n{output(said)}"
        )


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def smaller(command: str) -> str:
    """What is run in place of a command."""
    if command in INSTEAD:
        return INSTEAD[command]
    return " ".join(
        (command, *(flags for pattern, flags in SHORTER.items() if re.fullmatch(pattern, command)))
    )


def is_whole(command: str) -> bool:
    """Whether what is run gives the command's own figures. At another speed-up a mission is the same, but not its
    telemetry, which goes by the computer's clock.
    """
    return smaller(command) in (command, f"{command} --speedup 0") and ".tlog" not in command


def words(line: str) -> str:
    """A line without its figures."""
    return " ".join(re.sub(r"\(?[\d.,:]*\d[\d.,:]*\)?", "", re.sub(r" \([0-9a-f]{12}\)", "", line)).split())


def lacking(shown: tuple[str, ...], printed: str, *, whole: bool) -> list[str]:
    """The lines that a page shows and a command did not print. Figures count if the command ran whole and
    they do not vary.
    """
    same, alike = (
        {" ".join(line.split()) for line in printed.splitlines()},
        set(map(words, printed.splitlines())),
    )
    return [
        line
        for line in shown
        if not (
            " ".join(line.split()) in same or ((VARIES.search(line) or not whole) and words(line) in alike)
        )
    ]


def put_in_place(command: str, copy: Path, said: Path) -> None:
    """Make the records that a command names: NAME is a mission's, flight.tlog another vehicle's."""
    if "NAME" in command and not (copy / "runs" / "NAME.mcap").exists():
        assert (
            ended(
                "plumeward fly missions/wind-shift.yaml --speedup 0 --record runs/NAME.mcap", copy, copy, said
            )
            == 0
        )
    if "flight.tlog" in command and not (copy / "flight.tlog").exists():
        put_in_place("NAME", copy, said)
        shutil.copy(copy / "runs" / "NAME.tlog", copy / "flight.tlog")


def first_or_last(session: Session) -> Any:
    """A session, marked for `make test-all` unless it is relied on: of several that begin alike the first."""
    relied_on = str(session) in RELIED_ON and session is next(
        each for each in SESSIONS if str(each) == str(session)
    )
    sooner = relied_on or session.commands[0].text.endswith(" --help")
    return pytest.param(session, id=str(session), marks=() if sooner else pytest.mark.full)


@pytest.mark.timeout(2 * TIMEOUT_S)
@pytest.mark.parametrize("session", list(map(first_or_last, SESSIONS)))
def test_what_a_page_says_to_type_works(
    session: Session, checkout: Path, said: Path, wait_until: Callable[..., None]
) -> None:
    port = str(free_port())
    with ExitStack() as up:
        for command, shown in session.commands:
            if command.startswith(("docker ", "podman ")):
                check_containers(command)
                continue
            if command.startswith("pip ") and command not in INSTEAD:
                check_install(command)
                continue
            put_in_place(command, checkout, said)
            cwd = checkout / place(command, session.page)
            before = said.stat().st_size if said.exists() else 0
            run = smaller(command).replace("7447", port)
            if command in STAYS:
                process = up.enter_context(staying(run, cwd, checkout, said))
                wait_until(partial(has_spoken, process, STAYS[command], said, before), TIMEOUT_S)
                assert STAYS[command] in output(said, before), f"{command}: ended\n{output(said, before)}"
            else:
                status = ended(run, cwd, checkout, said)
                assert status == 0, f"{command}: exit status {status}\n{output(said, before)}"
            printed = output(said, before)
            missing = "\n".join(lacking(shown, printed, whole=is_whole(command)))
            assert not missing, (
                f"{command}: the page shows what is not printed:\n{missing}\n\nprinted was:\n{printed}"
            )


def check_install(command: str) -> None:
    """An install names a wheel of this version and extras that exist. It is not run here."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    version = re.search(r'__version__ = "(.+)"', (ROOT / "plume" / "__init__.py").read_text())
    assert version
    for word in [word for word in shlex.split(command)[2:] if not word.startswith("-")]:
        what, _, extras = word.rstrip("]").partition("[")
        assert what in (".", "plumeward", f"dist/plumeward-{version[1]}-py3-none-any.whl"), (
            f"{command}: {what} is not ours"
        )
        assert set(filter(None, extras.split(","))) <= set(project["optional-dependencies"]), (
            f"{command}: no such extra"
        )


def check_containers(command: str) -> None:
    """A compose command names services and profiles that compose.yaml has; tests/system/test_containers.py
    flies with them.
    """
    text = (ROOT / "compose.yaml").read_text()
    services = YAML(typ="safe").load(text)["services"]
    said = shlex.split(command)
    assert said[1] == "compose"
    for flag, value in pairwise(said):
        if flag in ("--exit-code-from", "cp"):
            assert value.partition(":")[0] in services, f"{command}: no service {value}"
        if flag == "--profile":
            assert f"--profile {value}" in text, f"{command}: compose.yaml says nothing of this profile"


def short_or_long(block: Block) -> Any:
    """An example, marked for `make test-all` unless its page is short."""
    return pytest.param(
        block,
        id=f"{block.page.name}:{block.line}",
        marks=() if block.page.name in SHORT else pytest.mark.full,
    )


@pytest.mark.parametrize("block", list(map(short_or_long, of("python"))))
def test_an_example_in_python_runs(block: Block, checkout: Path, said: Path, tmp_path: Path) -> None:
    script = tmp_path / "example.py"
    script.write_text(block.text)
    status = ended(f"python {shlex.quote(str(script))}", checkout / folder(block.page), checkout, said)
    assert status == 0, output(said)


@pytest.mark.full
def test_the_example_for_mavsdk_4_flies(checkout: Path, said: Path, tmp_path: Path) -> None:
    text = (ROOT / "docs" / "examples" / "offboard.py").read_text()
    script = tmp_path / "example.py"
    script.write_text(text.replace("14540", str(free_udp_port())))
    command = f"{shlex.quote(python_of('mavsdk4'))} {shlex.quote(str(script))}"
    assert ended(command, checkout, checkout, said) == 0, output(said)


def test_the_page_says_with_which_python_its_example_for_mavsdk_4_runs() -> None:
    text = " ".join((ROOT / "docs" / "mavlink.md").read_text().split())
    assert "run the example with `.venv/clients/mavsdk4/bin/python`" in text
    assert "`.venv` has version 3" in text
    assert "\nmavsdk==3." in (ROOT / "constraints.txt").read_text()


@pytest.mark.parametrize("block", of("yaml"), ids=lambda block: f"{block.page.name}:{block.line}")
def test_an_example_in_yaml_is_a_mission_or_a_site_that_can_be_flown(block: Block, tmp_path: Path) -> None:
    script = tmp_path / "example.yaml"
    script.write_text(block.text)
    if "buildings:" in block.text:
        assert read(str(script)).buildings
    else:
        load(script)


@pytest.mark.parametrize("block", of("toml"), ids=lambda block: f"{block.page.name}:{block.line}")
def test_an_example_in_toml_can_be_read(block: Block) -> None:
    tomllib.loads(block.text)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_block_says_what_it_is(page: Path) -> None:
    unknown = [
        f"{page.name}:{block.line}: {block.language!r}"
        for block in blocks(page)
        if block.language not in LANGUAGES
    ]
    assert not unknown, f"allowed are {', '.join(sorted(LANGUAGES))}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_and_every_page_that_is_named_is_there(page: Path) -> None:
    text = page.read_text()
    links = [link.partition("#")[0] for link in re.findall(r"\]\(([^)\s]+)\)", text) if "://" not in link]
    gone = [link for link in filter(None, links) if not (page.parent / link).exists()]
    gone += [
        name for name in re.findall(r"docs/[\w-]+\.(?:md|svg|png|py)", text) if not (ROOT / name).exists()
    ]
    assert not gone


def test_the_tables_of_this_test_hold_nothing_that_no_page_says() -> None:
    there = {command.text for session in SESSIONS for command in session.commands}
    assert not (set(INSTEAD) | set(STAYS)) - there
    assert not RELIED_ON - set(map(str, SESSIONS))
