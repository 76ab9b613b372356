"""`python -m tests.golden` flies the golden missions again, replaces the records whose answers changed,
and lists the changes.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from agent.policies import OURS
from ground.replay import verify
from ground.replay.verify import Answer, Difference, Rules
from link.record.reader import Recording, read

EXACTLY = Rules()
FOLDER = Path(__file__).parent
SENSORS = ("gaussian", "threshold", "hits")
FLAGS = ("--seed", "26", "--particles", "100", "--budget", "45", "--speedup", "0")
"""A small mission in which nearly all policies cease; the others use up their budget."""
PAPER = {
    f"{policy}-{sensor}": ("--policy", policy, "--sensor", sensor, "--assume", "paper", *FLAGS)
    for policy in OURS
    for sensor in SENSORS
}
"""Every policy with every sensor."""
FIELD = {
    f"{policy}-{sensor}-field": ("--policy", policy, "--sensor", sensor, "--assume", "field", *FLAGS)
    for policy, sensor in (
        *(("homing", sensor) for sensor in SENSORS),
        ("infotaxis", "gaussian"),
        ("ppo", "gaussian"),
        ("ddpg", "gaussian"),
    )
}
"""A few with little known: these take longer."""
GOLDEN: Mapping[str, tuple[str, ...]] = PAPER | FIELD


def path(name: str) -> Path:
    """The path of a golden record."""
    return FOLDER / f"{name}.mcap"


def beliefs(log: Recording) -> list[dict[str, Any]]:
    """All beliefs of a mission, by step."""
    return [answer.fields for (_, kind), answer in verify.said(log.entries).items() if kind == "belief"]


def lacks(log: Recording, result: Mapping[str, Any]) -> str:
    """What a record lacks: its end, a belief for each step, a waypoint between any two steps, the stop;
    empty if complete.
    """
    if not log.complete:
        return "its end"
    there = Counter(kind for _, kind in verify.said(log.entries))
    missing = (
        Counter(belief=result["steps"] + 1, waypoint=result["steps"], stop=int(result["ceased"])) - there
    )
    return ", ".join(f"{n} {kind}" for kind, n in missing.items())


def outcome(log: Recording) -> str:
    """The outcome of a mission, in one line."""
    last = beliefs(log)[-1]
    ceased = "ceased" if last["ceased"] else "not ceased"
    return (
        f"{ceased} after {last['step']} steps at ({last['mean'][0]:.2f}, {last['mean'][1]:.2f}) ± "
        f"{last['spread']:.2f} m"
    )


def compare(
    then: Mapping[tuple[int, str], Answer], now: Mapping[tuple[int, str], Answer], rules: Rules = EXACTLY
) -> Difference | None:
    """The first difference between the answers of two logs."""
    both = {**then, **now}
    for key in sorted(both, key=verify.place):
        step = verify.step_of(both.get((key[0], "belief")))
        if found := verify.difference(then.get(key), now.get(key), rules, step):
            return found
    return None


def changes(then: Recording, now: Recording) -> str:
    """The first difference between two records, in one line; empty if there is none."""
    if found := compare(verify.said(then.entries), verify.said(now.entries)):
        return f"{found.text()}; {outcome(then)} -> {outcome(now)}"
    for part, words in now.about["parts"].items():
        if words != (before := then.about["parts"][part]):
            return f"{part} was started with {' '.join(before)}, now with {' '.join(words)}"
    return ""


class NotFlown(Exception):
    """A golden mission could not be flown or fully recorded; the message gives the reason."""


def renew(name: str) -> str:
    """Fly a golden mission; returns what changed, and keeps the new record if anything did."""
    with tempfile.TemporaryDirectory(dir=FOLDER) as folder:
        flown = Path(folder) / "flown.mcap"
        command = [sys.executable, "-m", "sitl", "fly", *GOLDEN[name], "--json", "--record", str(flown)]
        mission = subprocess.run(command, cwd=folder, capture_output=True, text=True)
        if mission.returncode:
            raise NotFlown(mission.stderr.splitlines()[-1])
        now = read(flown)
        if missing := lacks(now, json.loads(mission.stdout)):
            raise NotFlown(f"the record lacks {missing}")
        what = changes(read(path(name)), now) if path(name).exists() else f"new: {outcome(now)}"
        if what:
            flown.replace(path(name))
    return what or "unchanged"


def main() -> int:
    """Renew all records and remove those that are no longer golden; returns the exit status."""
    status = 0
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for name, renewed in {name: pool.submit(renew, name) for name in GOLDEN}.items():
            try:
                print(f"{name}: {renewed.result()}", flush=True)
            except NotFlown as failure:
                print(f"{name}: NOT RENEWED: {failure}", flush=True)
                status = 1
    for stale in set(FOLDER.glob("*.mcap")) - set(map(path, GOLDEN)):
        stale.unlink()
        print(f"{stale.stem}: removed")
    return status


if __name__ == "__main__":
    sys.exit(main())
