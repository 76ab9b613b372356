"""Protects that one signal, or the death of a thread, ends a command, whatever it does just then, without
a word of Python's.
"""

import os
import pty
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from link.early import INTERRUPTED

pytestmark = pytest.mark.slow


def run(program: str, folder: Path) -> tuple[int, str, str]:
    """Run a program that finds modules in a folder; returns its status, stdout and stderr."""
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, (str(folder), os.environ.get("PYTHONPATH")))),
    }
    ran = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=400
    )
    return ran.returncode, ran.stdout, ran.stderr


def test_an_interrupt_that_is_lost_in_a_destructor_comes_again(tmp_path: Path) -> None:
    program = """
import os, signal, time
from link import cli

class Kept:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGTERM)

def command():
    kept = Kept()
    del kept
    print("goes on", flush=True)
    time.sleep(600)

cli.run(command)
"""
    assert run(program, tmp_path) == (INTERRUPTED, "goes on\n", "")


@pytest.mark.parametrize("then", ["", "time.sleep(600)"], ids=["a moment", "for ever"])
def test_an_interrupt_while_a_module_is_loaded_is_not_lost(tmp_path: Path, then: str) -> None:
    (tmp_path / "swallows.py").write_text(
        "import os, signal, time\ntry:\n    os.kill(os.getpid(), signal.SIGTERM)\n    "
        f"time.sleep(0)\nexcept:\n    pass\n{then}\n"
    )
    program = (
        "import time\nfrom link import cli\ndef command():\n    import swallows\n    "
        "time.sleep(600)\ncli.run(command)"
    )
    assert run(program, tmp_path) == (INTERRUPTED, "", "")


def test_a_command_that_was_interrupted_while_it_loaded_its_last_module_has_not_succeeded(
    tmp_path: Path,
) -> None:
    (tmp_path / "last.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGINT)\n")
    assert run("from link import cli\ndef command():\n    import last\ncli.run(command)", tmp_path) == (
        INTERRUPTED,
        "",
        "",
    )


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_each_signal_ends_a_command_with_its_own_last_line(tmp_path: Path, number: signal.Signals) -> None:
    program = f"""
import os, signal, time
from link import cli

def command():
    try:
        os.kill(os.getpid(), {int(number)})
        time.sleep(600)
    except KeyboardInterrupt:
        print("interrupted")
        raise

cli.run(command)
"""
    assert run(program, tmp_path) == (INTERRUPTED, "interrupted\n", "")


def test_a_hangup_that_nohup_has_ignored_stays_ignored(tmp_path: Path) -> None:
    program = """
import os, signal
from link import cli
from link.early import end_at_once
from link.interrupts import uninterrupted

signal.signal(signal.SIGHUP, signal.SIG_IGN)
end_at_once()

def command():
    os.kill(os.getpid(), signal.SIGHUP)
    with uninterrupted() as ends:
        os.kill(os.getpid(), signal.SIGHUP)
        print("goes on", ends)

cli.run(command)
"""
    assert run(program, tmp_path) == (0, "goes on []\n", "")


def test_a_command_whose_terminal_is_closed_still_cleans_up() -> None:
    """Writing there would fail."""
    program = """
import os, sys, time
from link import cli

def command():
    try:
        print("begun", flush=True)
        time.sleep(600)
    except KeyboardInterrupt:
        print("interrupted", flush=True)
        print("interrupted", file=sys.stderr, flush=True)
        os.write(int(sys.argv[1]), b"cleaned up")
        raise

cli.run(command)
"""
    read, write = os.pipe()
    pid, terminal = pty.fork()
    if pid == 0:
        os.set_inheritable(write, True)
        os.execv(sys.executable, [sys.executable, "-c", program, str(write)])
    os.close(write)
    said = b""
    while b"begun" not in said:
        said += os.read(terminal, 1000)
    os.close(terminal)
    assert os.read(read, 100) == b"cleaned up"
    os.close(read)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == INTERRUPTED


WAITS = {
    "for ever": "time.sleep(600)",
    "for signals of its own": "ends = []; on_end(ends.append)\n    while not ends: time.sleep(0.01)",
    "where nothing may interrupt it": "with uninterrupted() as ends:\n        while not ends: "
    "time.sleep(0.01)",
}


@pytest.mark.parametrize("wait", WAITS.values(), ids=WAITS)
def test_a_command_one_of_whose_threads_dies_cleans_up_and_fails_with_a_line_that_says_which_and_why(
    tmp_path: Path, wait: str
) -> None:
    program = f"""
import threading, time
from link import cli
from link.interrupts import on_end, uninterrupted

def work():
    raise RuntimeError("no room\\nlevel=info forged")

def wait():
    {wait}

def command():
    try:
        for _ in range(2):
            threading.Thread(target=work, name="drainer").start()
        wait()
    finally:
        print("cleaned up")

cli.run(command)
"""
    status, out, err = run(program, tmp_path)
    assert (status, out) == (1, "cleaned up\n")
    assert err == "error: thread 'drainer' has died: RuntimeError: no room\\nlevel=info forged (<string>:7)\n"


def test_a_thread_that_exits_ends_nothing_else(tmp_path: Path) -> None:
    program = """
import sys, threading
from link import cli

def command():
    thread = threading.Thread(target=sys.exit)
    thread.start()
    thread.join()
    print("goes on")

cli.run(command)
"""
    assert run(program, tmp_path) == (0, "goes on\n", "")


COMMANDS = [
    [str(Path(sys.executable).parent / "plumeward"), "--help"],
    [str(Path(sys.executable).parent / "plumeward"), "status"],
    *(
        [sys.executable, "-m", package, "--help"]
        for package in ("plumeward", "sitl", "agent", "estimator", "link")
    ),
]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("command", COMMANDS, ids=lambda words: " ".join(words[-2:]))
def test_a_command_answers_signals_before_it_loads_what_takes_long(
    tmp_path: Path, command: list[str], number: signal.Signals
) -> None:
    """argparse is the first of it: each command loads it, and this one is a trap."""
    (tmp_path / "argparse.py").write_text(
        f"import os, time\nos.kill(os.getpid(), {int(number)})\ntime.sleep(600)\n"
    )
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, (str(tmp_path), os.environ.get("PYTHONPATH")))),
    }
    ran = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=400)
    assert (ran.returncode, ran.stdout, ran.stderr) == (INTERRUPTED, "", "")


@pytest.mark.parametrize("launched", [True, False])
def test_a_part_knows_its_launcher_and_what_it_starts_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, launched: bool
) -> None:
    monkeypatch.delenv("PLUMEWARD_LAUNCHER", raising=False)
    if launched:
        monkeypatch.setenv("PLUMEWARD_LAUNCHER", str(os.getpid()))
    program = (
        "import os\nfrom link import cli\nfrom link.interrupts import is_launched\n"
        "def command():\n    print(is_launched(), 'PLUMEWARD_LAUNCHER' in os.environ)\ncli.run(command)"
    )
    assert run(program, tmp_path) == (0, f"{launched} False\n", "")
