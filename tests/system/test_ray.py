"""Protects sweeps on a Ray cluster: two nodes give the same results as local cores, an interrupt loses
nothing, errors are clear.
"""

import contextlib
import json
import os
import re
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path

import msgspec
import pytest

from agent.trials.evaluate import read_csv
from agent.trials.figures import MissionRow
from agent.trials.sources import PACKAGES

pytestmark = [pytest.mark.full, pytest.mark.skipif(find_spec("ray") is None, reason="ray is not installed")]

SWEEP = (
    "agent",
    "evaluate",
    "--policy",
    "greedy,thompson",
    "--particles",
    "100",
    "--budget",
    "40",
    "--threshold",
    "0.5,2",
)
START = (
    "--num-cpus=1",
    "--block",
    "--object-store-memory=100000000",
    "--include-log-monitor=false",
    "--disable-usage-stats",
)
UP, LATE = "will now block", "timed out during startup"


class Cluster:
    """`ray start` as on several machines, all of them this one."""

    def __init__(self, folder: Path, wait_until: Callable) -> None:
        self.folder = folder
        self.wait_until = wait_until
        self.nodes: list[subprocess.Popen] = []

    def add(self, name: str, *flags: str, **environment: str) -> str:
        """Start a node; returns its output. It gives up after 30 s, which a busy machine may need: again."""
        while True:
            node, said = self._started(name, flags, environment)
            self.nodes.append(node)
            self.wait_until(lambda said=said, node=node: UP in said() or node.poll() is not None)
            if node.poll() is None or LATE not in said():
                assert node.poll() is None, said()
                return said()

    def _started(
        self, name: str, flags: tuple[str, ...], environment: dict[str, str]
    ) -> tuple[subprocess.Popen, Callable[[], str]]:
        """Start a node; returns it, and what tells its output."""
        log = self.folder / f"{name}.log"
        with log.open("w") as file:
            node = subprocess.Popen(
                [
                    sys.executable,
                    "-m",
                    "ray.scripts.scripts",
                    "start",
                    *flags,
                    *START,
                    f"--temp-dir={self.folder / name}",
                ],
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=file,
                cwd=self.folder,
                env=os.environ | environment,
                start_new_session=True,
            )
        return node, log.read_text

    def head(self, **environment: str) -> str:
        """Start the first node; returns the address of the cluster."""
        with socket.create_server(("", 0)) as server:
            free = server.getsockname()[1]
        said = self.add(
            "head",
            "--head",
            "--port=0",
            f"--ray-client-server-port={free}",
            "--include-dashboard=false",
            **environment,
        )
        return re.search(r"--address='(\S+)'", said)[1]

    def flew(self, name: str) -> bool:
        """True if a worker of this node has done a task of a sweep: its log names the task."""
        return any(
            ":task_name:fly_there\n" in log.read_text()
            for log in self.folder.glob(f"{name}/session_2*/logs/worker-*.out")
        )

    def stop(self) -> None:
        for node in reversed(self.nodes):
            node.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                node.wait(20)
            with contextlib.suppress(ProcessLookupError):
                os.killpg(node.pid, signal.SIGKILL)
            node.wait()


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch, wait_until: Callable) -> Iterator[Cluster]:
    """A cluster without nodes yet; nobody else can join it."""
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    monkeypatch.setenv("RAY_AUTH_TOKEN", secrets.token_hex())
    folder = Path(tempfile.mkdtemp(prefix="ray-", dir="/tmp"))  # a socket's path has at most 107 bytes
    cluster = Cluster(folder, wait_until)
    try:
        yield cluster
    finally:
        cluster.stop()
        shutil.rmtree(folder)


def untimed(path: Path) -> list[MissionRow]:
    """Rows without the measured times."""
    return [
        msgspec.structs.replace(row, search_time_s=0.0, decision_ms=0.0, update_ms=0.0)
        for row in read_csv(path)
    ]


@pytest.mark.timeout(900)
def test_two_nodes_give_what_the_cores_give_and_an_interrupt_loses_nothing(
    start, cluster: Cluster, tmp_path: Path, wait_until: Callable
) -> None:
    address = cluster.head()
    cluster.add("second", f"--address={address}")
    few = (*SWEEP, "--first-seed", "7", "--scenarios", "50", "--json")
    for _ in range(
        3
    ):  # on a busy machine all is flown before a node's worker has started; the next time it is there
        on_ray = start(*few, "--ray", address, "--missions", "ray.csv", "--force", cwd=tmp_path)
        assert on_ray.ended() == 0, "".join(on_ray.err)
        if both := cluster.flew("head") and cluster.flew("second"):
            break
    assert both
    (figures,) = on_ray.out
    assert json.loads(figures)["greedy particles=100 threshold=0.5"]["missions"] == 50
    assert not on_ray.says("ray")  # none of Ray's own output
    on_cores = start(*few, "--workers", "2", "--missions", "cores.csv", cwd=tmp_path)
    assert on_cores.ended() == 0, "".join(on_cores.err)
    rows = untimed(tmp_path / "ray.csv")
    assert len(rows) == 2 * 2 * 50
    assert rows == untimed(tmp_path / "cores.csv")

    def journal() -> bytes:
        return b"".join(path.read_bytes() for path in tmp_path.glob("runs/*"))

    def interrupted(sign: signal.Signals) -> bytes:
        kept = journal()
        sweep = start(*SWEEP, "--scenarios", "3000", "--ray", address, cwd=tmp_path)
        wait_until(lambda: len(journal()) > len(kept) + 1)
        sweep.process.send_signal(sign)
        assert sweep.ended() == 130
        assert sweep.says("Run the command again: it resumes")
        assert not sweep.says("ray")
        assert journal().startswith(kept)
        return journal()

    first = interrupted(signal.SIGINT)
    assert len(interrupted(signal.SIGTERM)) > len(first)


@pytest.mark.timeout(900)
def test_a_node_with_other_code_is_refused(start, cluster: Cluster, tmp_path: Path) -> None:
    """Other code could give other results."""
    other = cluster.folder / "other"
    for package in PACKAGES:
        shutil.copytree(Path(__file__).parents[2] / package, other / package)
    address = cluster.head(PYTHONPATH=str(other))
    sweep = other / "agent" / "trials" / "sweep.py"
    for code in (f"{sweep.read_text()}# newer", "raise ImportError('no numba')"):
        sweep.write_text(code)
        refused = start(*SWEEP, "--scenarios", "2", "--ray", address, cwd=tmp_path)
        assert refused.ended() == 2
        assert refused.err[-1].startswith("error: --ray: node ")
        assert refused.err[-1].endswith(
            "has other versions of plumeward, numpy or numba; install those of this machine\n"
        )
        assert not refused.says("Traceback")


@pytest.mark.parametrize(
    ("address", "error"),
    [
        (
            "127.0.0.1:1",
            "cannot join '127.0.0.1:1' ([Errno 111] Connection refused); wanted HOST:PORT of a Ray cluster "
            "that this machine",
        ),
        ("local", "'local' is not allowed; wanted HOST:PORT of a Ray cluster's head, or auto"),
        ("", "'' is not allowed; wanted HOST:PORT of a Ray cluster's head, or auto"),
        (
            "ray://127.0.0.1:70000",
            "'ray://127.0.0.1:70000' is not allowed; wanted HOST:PORT of a Ray cluster's head, or auto",
        ),
        (
            "auto",
            "cannot join 'auto' (Could not find any running Ray instance); wanted HOST:PORT of a Ray cluster "
            "that this machine",
        ),
    ],
)
def test_where_there_is_no_cluster_one_line_says_so(
    start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, address: str, error: str
) -> None:
    if address == "auto":
        monkeypatch.delenv("RAY_ADDRESS", raising=False)
        if subprocess.run(["pgrep", "-x", "raylet"], stdout=subprocess.DEVNULL).returncode == 0:
            pytest.skip("a Ray cluster is running here")
    sweep = start(*SWEEP, "--ray", address, cwd=tmp_path)
    assert sweep.ended() == 2
    assert f"error: --ray: {error}" in sweep.err[-1]
    assert sweep.err[:-1] in ([], [f"joining the Ray cluster at {address}\n"])
    assert not list(tmp_path.iterdir())


def test_without_ray_one_line_says_what_to_install(start, tmp_path: Path) -> None:
    (tmp_path / "ray.py").write_text("raise ImportError")
    sweep = start(*SWEEP, "--ray", "auto", cwd=tmp_path)
    assert sweep.ended() == 2
    assert sweep.err[-1] == "error: --ray: Ray is not installed; pip install 'plumeward[ray]'\n"
