"""Protects completion in a shell, by the protocol that bash speaks with argcomplete: the line in, choices
out on file descriptor 8.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

COMMAND = Path(sys.executable).parent / "plumeward"


def completed(line: str, cwd: Path) -> set[str]:
    """What a shell would offer at the end of a line."""
    asked = {
        "_ARGCOMPLETE": "1",
        "_ARGCOMPLETE_IFS": "\n",
        "COMP_LINE": line,
        "COMP_POINT": str(len(line)),
        "COMP_TYPE": "9",
    }
    read, write = os.pipe()
    shell = ["bash", "-c", f'exec "$0" 8>&{write} 9>/dev/null', str(COMMAND)]
    ran = subprocess.run(
        shell, cwd=cwd, env=os.environ | asked, pass_fds=[write], capture_output=True, text=True, timeout=300
    )
    os.close(write)
    with os.fdopen(read) as offered:
        assert (ran.stdout, ran.stderr) == ("", "")
        return {word.strip() for word in offered.read().splitlines()}


@pytest.mark.one_in(4)
@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("plumeward ev", {"evaluate"}),
        ("plumeward re", {"replay", "record", "report"}),
        ("plumeward fly --pol", {"--policy"}),
        ("plumeward fly --policy ho", {"homing"}),
        ("plumeward fly --policy m", {"mine.zip"}),
        ("plumeward fly wind", {"wind-shift"}),
        ("plumeward fly m", {"mine.yaml"}),
        ("plumeward uav wind", {"wind-shift"}),
        ("plumeward fly --sensor t", {"threshold", "tgs2600", "tgs2611", "tgs2620", "tdlas"}),
        ("plumeward fly --payload si", {"simulated"}),
        ("plumeward payload --payload se", {"serial"}),
        ("plumeward payload --world tau-h", {"tau-halved"}),
        ("plumeward uav --world tau-h", {"tau-halved"}),
        ("plumeward rollout --world wind", {"wind-10", "wind-30", "wind-noisy"}),
        ("plumeward evaluate --world cv-1,so", {"cv-1,source-outside", "cv-1,source-beyond"}),
        ("plumeward fly --assume f", {"field"}),
        ("plumeward rollout --policy lo", {"lookahead"}),
        ("plumeward evaluate --policy homing,gr", {"homing,greedy"}),
        ("plumeward agent --policy dd", {"ddpg"}),
        ("plumeward estimator --part", {"--particles"}),
        ("plumeward list p", {"policies"}),
        ("plumeward wo", {"worlds"}),
        ("plumeward worlds s", {"show"}),
        ("plumeward train d", {"dqn", "ddpg"}),
        ("plumeward report --out", {"--out"}),
    ],
)
def test_names_flags_and_files_are_completed(tmp_path: Path, line: str, offered: set[str]) -> None:
    for name in ("mine.zip", "mine.yaml", "mine.txt"):
        (tmp_path / name).write_text("")
    assert completed(line, tmp_path) == offered


def test_all_commands_are_offered(tmp_path: Path) -> None:
    offered = completed("plumeward ", tmp_path)
    assert {
        "fly",
        "rollout",
        "list",
        "status",
        "log",
        "evaluate",
        "train",
        "router",
        "--help",
        "--version",
    } <= offered
