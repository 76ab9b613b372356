"""Protects the command line: bad input gives one line that names the flag, the value and what is allowed,
and status 2.
"""

import argparse
import errno
import os
import signal
import subprocess
import sys

import pytest

from link import cli
from link.bus.opening import open_router
from link.early import INTERRUPTED
from link.interrupts import uninterrupted

COMMANDS = [
    (
        ["agent", "rollout", "--policy", "clairvoyance"],
        ["--policy", "'clairvoyance'", "wanted infotaxis, entrotaxis"],
    ),
    (["agent", "rollout", "--particles", "-5"], ["--particles", "'-5'", "from 10 to 1000000"]),
    (["agent", "rollout", "--seed", "x"], ["--seed", "'x'", "whole number"]),
    (["agent", "--budget", "0"], ["--budget", "'0'", "from 1"]),
    (["estimator", "--threshold", "nan"], ["--threshold", "'nan'", "above 0"]),
    (["estimator", "--rate", "0"], ["--rate", "'0'", "from 0.001 up to 1e+06"]),
    (["estimator", "--connect", "nowhere"], ["--connect", "'nowhere'", "tcp/127.0.0.1:7447"]),
    (["estimator", "--vehicles", "8", "--sysid", "250"], ["--sysid", "250", "--vehicles 8", "1 to 248"]),
    (["sitl", "fly", "--particles", "-5"], ["--particles", "'-5'", "from 10 to 1000000"]),
    (["sitl", "--speedup", "-1"], ["--speedup", "'-1'", "from 0"]),
    (["sitl", "uav", "--out", "serial:/dev/tty"], ["--out", "'serial:/dev/tty'", "udpout:HOST:PORT"]),
    (["link", "certs", ""], ["DIR: '' is not allowed; wanted a path"]),
    (["agent", "report", "--out", ""], ["--out: '' is not allowed; wanted a path"]),
    (["sitl", "uav", "--home", "91,0,0,0"], ["--home", "'91,0,0,0'", "LAT within ±90"]),
    (["sitl", "fly", "--patience", "1"], ["--patience", "'1'", "from 5 up to inf"]),
    (["sitl", "juggle"], ["'juggle'", "fly", "uav", "router"]),
    (["sitl", "fyl"], ["python -m sitl: error: no command 'fyl'; did you mean 'fly'?"]),
    (["sitl", "fly", "--sed", "3"], ["python -m sitl fly: error: no flag '--sed'; did you mean '--seed'?"]),
    (
        ["sitl", "fly", "--policy", "homming", "--no-record"],
        ["'homming'", "did you mean 'homing'?", "Wanted infotaxis, "],
    ),
    (["agent", "rollout", "--policy", "/tmp"], ["--policy: '/tmp' is not allowed; wanted infotaxis, "]),
    (
        ["estimator", "--sensor", "hit:1,2"],
        ["'hit:1,2'", "did you mean 'hits'?", "Wanted gaussian, threshold, hits"],
    ),
    (["agent", "--polcy", "homing", "rollout"], ["no flag '--polcy'", "did you mean '--policy'?"]),
    (["agent", "evalute"], ["no command 'evalute'", "did you mean 'evaluate'?"]),
    (
        ["agent", "--log-level", "inf"],
        ["--log-level: 'inf'", "did you mean 'info'?", "Wanted debug, info, warning or error"],
    ),
]


@pytest.mark.one_in(3)
@pytest.mark.slow
@pytest.mark.parametrize(("arguments", "named"), COMMANDS, ids=lambda value: " ".join(value))
def test_bad_input_is_one_clear_line_and_status_2(arguments: list[str], named: list[str]) -> None:
    ended = subprocess.run([sys.executable, "-m", *arguments], capture_output=True, text=True, timeout=400)
    assert (ended.returncode, ended.stdout) == (2, "")
    said = [
        line for line in ended.stderr.splitlines() if not line.startswith("waiting for")
    ]  # progress, where the start is slow
    assert len(said) == 1, ended.stderr
    for words in named:
        assert words in said[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments",
    [
        ["sitl"],
        ["sitl", "fly"],
        ["sitl", "uav"],
        ["sitl", "router"],
        ["estimator"],
        ["agent"],
        ["agent", "rollout"],
    ],
)
def test_every_command_explains_itself(arguments: list[str]) -> None:
    ended = subprocess.run(
        [sys.executable, "-m", *arguments, "--help"], capture_output=True, text=True, timeout=400
    )
    assert ended.returncode == 0
    assert "usage: python -m " + " ".join(arguments) in " ".join(ended.stdout.split())


def test_a_flag_may_still_be_shortened_and_take_a_negative_value() -> None:
    parser = cli.Parser(prog="it")
    parser.add_argument("--policy")
    parser.add_argument("--home")
    args = parser.parse_args(["--pol", "homing", "--home=-35.1,149"])
    assert (args.policy, args.home) == ("homing", "-35.1,149")


def test_flags_behind_a_command_are_that_commands() -> None:
    parser = cli.Parser(prog="it")
    parser.add_argument("--loud", action="store_true")
    fly = parser.add_subparsers(dest="command").add_parser("fly")
    fly.add_argument("--seed")
    args = parser.parse_args(["--loud", "fly", "--seed", "3"])
    assert (args.loud, args.command, args.seed) == (True, "fly", "3")


OPENING = """
import os, signal, sys, time
from link import cli
from link.bus.keys import BELIEF
from link.bus.session import Bus

def command():
    bus = Bus("interrupted", sys.argv[1], announced=False)
    bus.subscribe(BELIEF)  # nobody owns it yet, so nobody closes it
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(60)

cli.run(command)
"""


def test_an_interrupt_while_a_session_opens_ends_the_command() -> None:
    router, endpoint = open_router("tcp/127.0.0.1:0")
    try:
        ended = subprocess.run(
            [sys.executable, "-c", OPENING, endpoint], capture_output=True, text=True, timeout=400
        )
    finally:
        router.close()  # type: ignore[no-untyped-call]
    assert (ended.returncode, ended.stderr) == (INTERRUPTED, "")


def test_two_signals_at_once_end_a_command_without_a_word() -> None:
    """`timeout` sends two, microseconds apart; here the second comes as the first has been taken."""
    program = """
import os, signal
from link import cli
leave, signal_again = cli.leave, [True]
def twice():
    if signal_again:
        signal_again.clear()
        os.kill(os.getpid(), signal.SIGTERM)
    leave()
cli.leave = twice
cli.run(lambda: os.kill(os.getpid(), signal.SIGTERM))
"""
    ran = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=400, check=False
    )
    assert (ran.returncode, ran.stdout, ran.stderr) == (130, "", "")


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG])
def test_what_does_not_fit_on_the_disk_is_one_line(number: int) -> None:
    program = f"""
import os
from link import cli
def full():
    raise OSError({number}, os.strerror({number}))
cli.run(full)
"""
    ran = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=400, check=False
    )
    assert (ran.returncode, ran.stdout, ran.stderr) == (1, "", f"error: {os.strerror(number)}\n")


LAUNCHER = """
import os, subprocess, sys, time
subprocess.Popen([sys.executable, "-c", sys.argv[1]], env={**os.environ, "PLUMEWARD_LAUNCHER": str(os.getpid())})
time.sleep(600)
"""
LOSES = """
import time
from link import cli, interrupts

def command():
    print("begun", flush=True)
    for _ in range({lost}):
        try:
            time.sleep(600)
        except KeyboardInterrupt:
            pass
    time.sleep(600)

interrupts.AGAIN_S, interrupts.AGAIN_TIMES = 0.05, 10
cli.run(command)
"""


@pytest.mark.parametrize("lost", [0, 1, 1000])
def test_a_part_ends_with_its_launcher_however_often_the_signal_is_lost(lost: int) -> None:
    """An exception of a signal's handler is lost where Python ignores exceptions, as in a destructor."""
    launcher = subprocess.Popen(
        [sys.executable, "-c", LAUNCHER, LOSES.format(lost=lost)], stdout=subprocess.PIPE, text=True
    )
    assert launcher.stdout
    with launcher:
        assert launcher.stdout.readline() == "begun\n"
        launcher.kill()
        assert launcher.communicate(timeout=400) == ("", None)  # the part, which has its stdout, has ended


def test_what_comes_within_an_uninterrupted_block_is_told_there_and_interrupts_at_its_end() -> None:
    told: list[int] = []

    def block() -> None:
        with uninterrupted() as ends:
            os.kill(os.getpid(), signal.SIGTERM)
            os.kill(os.getpid(), signal.SIGINT)
            told.extend(ends)

    with pytest.raises(KeyboardInterrupt):
        block()
    assert told == [signal.SIGTERM, signal.SIGINT]


@pytest.mark.parametrize("value", ["-35.3,149.1", "-.5,2", "-1;2", "-7"])
def test_a_value_that_begins_with_a_minus_may_stand_behind_its_flag(value: str) -> None:
    parser = cli.Parser()
    parser.add_argument("--home")
    parser.add_argument("-I")
    assert parser.parse_args(["--home", value, "-I", "2"]) == argparse.Namespace(home=value, I="2")
    assert parser.parse_args(["--home", value, "-I2"]) == argparse.Namespace(home=value, I="2")
