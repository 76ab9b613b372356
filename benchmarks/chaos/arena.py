"""Where a mission flies: namespaces of its own, a second machine behind a link that loses packets, a clock
that can be stepped.
"""

import contextlib
import mmap
import os
import shutil
import signal
import struct
import subprocess
from pathlib import Path

ISOLATED = "CHAOS_ISOLATED"
"""Set in the environment of a mission that has its own network, mounts and shared memory."""
UNSHARE = ("unshare", "--user", "--map-root-user", "--net", "--mount", "--propagation", "private", "--")
NEAR, FAR = "10.99.0.1", "10.99.0.2"
"""The two machines' addresses."""
SHARED_MEMORY = Path("/dev/shm")
SHIM = Path(__file__).with_name("clock.c")


def lacking() -> dict[str, str]:
    """Return what this system cannot do, by kind of fault, and why; the key "" stands for isolation."""
    missing: dict[str, str] = {}
    tries = (
        ("", ("true",), "no namespaces: `unshare --user --net` is not permitted"),
        (
            "split",
            ("sh", "-c", "ip link add one type veth peer name two && nft add table inet x"),
            "needs ip and nft, and their rights",
        ),
        ("disk", ("mount", "-t", "tmpfs", "tmpfs", "/mnt"), "needs leave to mount a small disk"),
    )
    for what, command, reason in tries:
        if (
            shutil.which("unshare") is None
            or subprocess.run([*UNSHARE, *command], capture_output=True, check=False).returncode
        ):
            missing[what] = reason
    if shutil.which("cc") is None:
        missing["clock"] = "needs a C compiler, cc"
    return missing


def enter() -> None:
    """Prepare the namespaces of this process, if it has its own."""
    if os.environ.get(ISOLATED):
        _run("ip", "link", "set", "lo", "up")
        _run("mount", "-t", "tmpfs", "tmpfs", str(SHARED_MEMORY))


def _run(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True, stdin=subprocess.DEVNULL)


class FarMachine:
    """A network namespace behind a link whose packets can be dropped, in both directions, where they
    arrive.
    """

    def __init__(self) -> None:
        """Make it. The namespace lives as long as a process in it."""
        self._anchor = subprocess.Popen(["unshare", "--net", "sleep", "infinity"], stdin=subprocess.DEVNULL)
        self.prefix = ["nsenter", f"--net=/proc/{self._anchor.pid}/ns/net", "--"]
        """Put before a command, runs it there."""
        own = os.stat("/proc/self/ns/net").st_ino
        while os.stat(f"/proc/{self._anchor.pid}/ns/net").st_ino == own:
            if self._anchor.poll() is not None:
                raise OSError("cannot make a network namespace")
        _run(
            "ip", "link", "add", "near", "type", "veth", "peer", "name", "far", "netns", str(self._anchor.pid)
        )
        for there, link, address in (([], "near", NEAR), (self.prefix, "far", FAR)):
            _run(*there, "ip", "address", "add", f"{address}/30", "dev", link)
            _run(*there, "ip", "link", "set", link, "up")
            _run(*there, "ip", "link", "set", "lo", "up")
            _run(
                *there,
                "nft",
                "add table inet chaos; add chain inet chaos arriving { type filter hook input priority 0; }",
            )

    def drop(self, share: float) -> None:
        """Drop this share of the packets from now on: 0 none, 1 all."""
        percent = round(100 * share)
        some = f"numgen random mod 100 < {percent} " if percent < 100 else ""
        rule = f"; add rule inet chaos arriving iifname {{ near, far }} {some}drop" if percent else ""
        for there in ([], self.prefix):
            _run(*there, "nft", f"flush chain inet chaos arriving{rule}")

    def close(self) -> None:
        """Let it go."""
        self._anchor.kill()
        self._anchor.wait()


class SteppedClock:
    """A wall clock for processes that can be stepped. Other clocks are the system's."""

    def __init__(self, folder: Path) -> None:
        """Compile it."""
        self._library, offset = folder / "clock.so", folder / "clock.ns"
        _run("cc", "-shared", "-fPIC", "-O1", "-o", str(self._library), str(SHIM), "-ldl")
        offset.write_bytes(struct.pack("q", 0))
        with offset.open("r+b") as file:
            self._page = mmap.mmap(file.fileno(), 8)
        self.environment = {"LD_PRELOAD": str(self._library), "STEPPED_CLOCK": str(offset)}

    def step(self, by_s: float) -> None:
        """Step it, from where it is at the beginning."""
        self._page[:] = struct.pack("q", round(by_s * 1e9))


def processes(marker: str) -> dict[int, str]:
    """Return the running processes whose environment holds a text, with their command lines; this one is
    left out.
    """
    found = {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit() and int(folder.name) != os.getpid():
            with contextlib.suppress(OSError):  # it is not ours, or has ended
                if marker.encode() in (folder / "environ").read_bytes():
                    found[int(folder.name)] = (folder / "cmdline").read_text().replace("\0", " ").strip()
    return found


def sockets(port: int) -> list[str]:
    """Return the TCP sockets that still listen or carry data at a port, of this network namespace."""
    left = []
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        for line in Path(table).read_text().splitlines()[1:]:
            words = line.split()
            if words[1].endswith(f":{port:04X}") and words[3] in ("01", "0A"):  # established, listening
                left.append(f"socket {words[1]} in state {words[3]}")
    return left


def shared_memory() -> list[str]:
    """Return the files in shared memory that this process does not use, where the memory is this mission's
    own.
    """
    used = Path("/proc/self/maps").read_text()
    return (
        sorted(str(path) for path in SHARED_MEMORY.iterdir() if str(path) not in used)
        if os.environ.get(ISOLATED)
        else []
    )


def open_files(pid: int) -> set[str]:
    """Return the files that a process has open."""
    found = set()
    with contextlib.suppress(OSError):
        for link in Path(f"/proc/{pid}/fd").iterdir():
            with contextlib.suppress(OSError):
                found.add(os.readlink(link))
    return found


def send(pid: int, number: signal.Signals) -> None:
    """Signal a process, if it is still there."""
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, number)
