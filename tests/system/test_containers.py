"""Protects the containers: the claims of Dockerfile and compose file, and a mission flown in containers of
the built image.
"""

import ast
import json
import os
import re
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from pymavlink import mavutil
from ruamel.yaml import YAML

ROOT = Path(__file__).parents[2]
SERVICES: dict[str, dict[str, Any]] = YAML(typ="safe").load(ROOT / "compose.yaml")["services"]
ROUTER = "tcp/router:7447"
MOST_BYTES = 700_000_000

TOOLS = ("podman", "buildah", "runc", "debootstrap", "catatonit")
PODMAN = ("podman", "--runtime", "runc")
OURS = f"plumeward-test-{os.getpid()}"
"""What the names of all begin with that the tests make: images, containers, a volume."""
BASE, IMAGE = f"localhost/{OURS}-base", f"localhost/{OURS}"
HOST = (
    "--network=host",
    "--add-host=router:127.0.0.1",
    "--ulimit=nofile=4096:4096",
    "--ulimit=nproc=4096:4096",
)
"""In place of compose's network; and the limits, as a machine that is itself a container lets podman raise
none.
"""
OPTIONS: dict[str, Callable[[Any], list[str]]] = {
    "init": lambda _: ["--init"],
    "read_only": lambda _: ["--read-only", "--read-only-tmpfs=false"],
    "tmpfs": lambda paths: [f"--tmpfs={path}" for path in paths],
    "cap_drop": lambda names: [f"--cap-drop={name}" for name in names],
    "security_opt": lambda options: [f"--security-opt={option.removesuffix(':true')}" for option in options],
    "volumes": lambda mounts: [f"--volume={OURS}-{mount}" for mount in mounts],
}
"""What podman is told of a service of the compose file."""
ELSEWHERE = {"build", "image", "command", "depends_on", "healthcheck", "profiles", "ports"}
"""What is told of it otherwise: the ports are the host's here."""


class TestTheFiles:
    """Dockerfile and compose file, read as text."""

    def tool(self, name: str) -> str:
        """A program of the test environment."""
        return shutil.which(name, path=Path(sys.executable).parent) or pytest.skip(f"{name} is not installed")

    def test_the_compose_file_is_one(self) -> None:
        said(
            self.tool("check-jsonschema"),
            "--builtin-schema",
            "vendor.compose-spec",
            str(ROOT / "compose.yaml"),
        )

    def test_the_dockerfile_has_no_known_faults(self) -> None:
        said(self.tool("hadolint"), str(ROOT / "Dockerfile"))

    def test_the_router_is_of_the_minor_version_that_the_tests_are_run_with(self) -> None:
        (pinned,) = re.findall(
            r"^eclipse-zenoh==(\d+\.\d+)\.", (ROOT / "constraints.txt").read_text(), re.MULTILINE
        )
        assert re.fullmatch(rf"eclipse/zenoh:{re.escape(pinned)}\.\d+", SERVICES["router"]["image"])

    def test_all_parts_are_told_where_the_router_is_and_nobody_searches(self) -> None:
        listening = SERVICES["router"]["command"]
        assert listening[listening.index("--listen") + 1] == "tcp/0.0.0.0:7447"
        assert "--no-multicast-scouting" in listening
        for name in ("estimator", "agent", "uav"):
            command = SERVICES[name]["command"]
            assert command[command.index("--connect") + 1] == ROUTER

    def test_a_part_begins_when_those_before_it_are_healthy(self) -> None:
        waited_for = {name: service.get("depends_on", {}) for name, service in SERVICES.items()}
        assert {name: set(others) for name, others in waited_for.items()} == {
            "router": set(),
            "estimator": {"router"},
            "agent": {"router"},
            "uav": {"estimator", "agent"},
        }
        assert all(
            condition == {"condition": "service_healthy"}
            for others in waited_for.values()
            for condition in others.values()
        )
        assert all(service["healthcheck"]["test"][0] == "CMD" for service in SERVICES.values())

    def test_nobody_is_root_writes_to_the_image_or_gains_rights(self) -> None:
        for service in SERVICES.values():
            assert service["read_only"] is True
            assert service["cap_drop"] == ["ALL"]
            assert service["security_opt"] == ["no-new-privileges:true"]
        assert not SERVICES["router"]["user"].startswith("0")
        users = re.findall(r"^USER (\d+)", (ROOT / "Dockerfile").read_text(), re.MULTILINE)
        assert users
        assert users[-1] != "0"

    def test_plain_up_has_the_vehicle_in_it_and_the_services_profile_has_not(self) -> None:
        assert {name: service.get("profiles") for name, service in SERVICES.items()} == {
            "router": None,
            "estimator": None,
            "agent": None,
            "uav": ["mission"],
        }
        assert "COMPOSE_PROFILES=mission" in (ROOT / ".env").read_text().splitlines()

    def test_the_port_that_a_ground_station_calls_is_the_vehicles(self) -> None:
        assert "udpin:0.0.0.0:14550" in SERVICES["uav"]["command"]
        assert SERVICES["uav"]["ports"] == ["127.0.0.1:${MAVLINK_PORT:-14550}:14550/udp"]


def said(*command: str, **more: Any) -> str:
    """Run a command that must succeed; returns its output."""
    ran = subprocess.run(command, capture_output=True, text=True, check=False, **more)
    assert ran.returncode == 0, f"{command} failed: {ran.stdout[-2000:]} {ran.stderr[-4000:]}"
    return ran.stdout.strip()


def mirror() -> str:
    """The Debian mirror of this machine."""
    if shutil.which("apt-get"):
        targets = said(
            "apt-get",
            "indextargets",
            "--format",
            "$(REPO_URI) $(ORIGIN) $(COMPONENT)",
            "Created-By: Packages",
        ).splitlines()
        for target in targets:
            if target.endswith(" Debian main"):
                return target.split()[0]
    return "http://deb.debian.org/debian"


@pytest.fixture(scope="module")
def base() -> Iterator[str]:
    """A Debian image with Python in place of the Dockerfile's base image, because a Debian mirror is
    easier to reach than a registry.
    """
    if missing := [tool for tool in TOOLS if not shutil.which(tool)]:
        pytest.skip(f"no container can be built and run: {', '.join(missing)} not installed")
    if os.geteuid() != 0:
        pytest.skip("no container can be built and run: debootstrap wants root")
    with tempfile.TemporaryDirectory() as folder:
        try:
            include = "--include=python3,python3-venv,ca-certificates"
            said("debootstrap", "--variant=minbase", include, "bookworm", f"{folder}/base", mirror())
            packed = f"tar -C {folder}/base --exclude=./var/cache/apt --exclude=./var/lib/apt/lists -c ."
            said("sh", "-c", f"{packed} | podman import --quiet - {BASE}")
            said(*PODMAN, "run", "--rm", *HOST, BASE, "true")
        except AssertionError as error:
            remove()
            pytest.skip(f"no container can be run here: {error}")
    yield BASE
    remove()


def remove() -> None:
    """Remove everything that the tests created."""
    containers = said("podman", "ps", "--all", "--quiet", "--filter", f"name=^{OURS}-").split()
    for command in (
        ["podman", "rm", "--force", *containers],
        ["podman", "volume", "rm", "--force", f"{OURS}-runs"],
        ["podman", "rmi", "--force", IMAGE],
        ["podman", "rmi", "--force", BASE],
    ):
        subprocess.run(command, capture_output=True, check=False)


def pip_settings(folder: Path) -> list[str]:
    """Mount options for this machine's pip.conf and certificates, which the build needs to reach PyPI and
    the Dockerfile does not have.
    """
    settings = {}
    for line in said(sys.executable, "-m", "pip", "config", "list").splitlines():
        name, _, value = line.partition("=")
        settings[name.rpartition(".")[2]] = ast.literal_eval(value)
    wanted = {
        name: settings[name]
        for name in ("index-url", "cert", "proxy", "trusted-host", "default-timeout")
        if name in settings
    }
    conf = folder / "pip.conf"
    conf.write_text("\n".join(["[global]", *(f"{name} = {value}" for name, value in wanted.items())]) + "\n")
    mounts = [f"{conf}:/etc/pip.conf:ro", *(f"{cert}:{cert}:ro" for cert in [wanted.get("cert")] if cert)]
    return [f"--volume={mount}" for mount in mounts]


@pytest.fixture(scope="module")
def image(base: str, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The image, built from this checkout."""
    settings = pip_settings(tmp_path_factory.mktemp("pip"))
    environment = {
        **os.environ,
        "BUILDAH_ISOLATION": "chroot",
    }  # the isolation that works on a machine which is itself a container
    said(
        "buildah", "bud", *settings, "--build-arg", f"BASE={base}", "--tag", IMAGE, str(ROOT), env=environment
    )
    return IMAGE


def free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def listens(port: int) -> bool:
    with socket.socket() as caller:
        return caller.connect_ex(("127.0.0.1", port)) == 0


class Containers:
    """The compose file's services as containers on the host's network, on free ports."""

    def __init__(self, image: str, wait_until: Callable[..., None]) -> None:
        self._image = image
        self._wait_until = wait_until
        self.router_port = free_port(socket.SOCK_STREAM)
        self.mavlink_port = free_port(socket.SOCK_DGRAM)

    def _words(self, words: list[str]) -> list[str]:
        ports = {"7447": str(self.router_port), "14550": str(self.mavlink_port)}
        return [re.sub(r"(?<=:)(7447|14550)$", lambda port: ports[port[0]], word) for word in words]

    def start(self, name: str, *more: str, service: dict[str, Any] | None = None) -> None:
        """Start a service as in the compose file, with extra arguments to its command."""
        service = service or SERVICES[name]
        assert set(service) <= OPTIONS.keys() | ELSEWHERE, "the compose file says what this test does not do"
        options = [word for key, option in OPTIONS.items() if key in service for word in option(service[key])]
        command = [*self._words(service["command"]), *more]
        said(
            *PODMAN,
            "run",
            "--detach",
            "--replace",
            f"--name={OURS}-{name}",
            *HOST,
            *options,
            self._image,
            *command,
        )

    def start_router(self) -> None:
        """Start our own router in place of the compose file's image."""
        words = ["plumeward", "router", *SERVICES["router"]["command"][:2]]
        self.start("router", service={**SERVICES["estimator"], "command": words})
        self._wait_until(lambda: listens(self.router_port))

    def healthy(self, name: str) -> bool:
        """True if a service's health check passes now."""
        check = self._words(SERVICES[name]["healthcheck"]["test"][1:])
        return (
            subprocess.run(
                ("podman", "exec", f"{OURS}-{name}", *check), capture_output=True, check=False
            ).returncode
            == 0
        )

    def start_services(self) -> None:
        """Start the services that the vehicle waits for, and wait until they are healthy."""
        for name in SERVICES["uav"]["depends_on"]:
            self.start(name)
        for name in SERVICES["uav"]["depends_on"]:
            self._wait_until(lambda name=name: self.healthy(name))

    def execute(self, name: str, *command: str) -> str:
        """Run a command within a service's container."""
        return said("podman", "exec", f"{OURS}-{name}", *command)

    def status(self, name: str) -> int:
        """Wait for a service to end; returns its exit status."""
        return int(said("podman", "wait", f"{OURS}-{name}", timeout=900))

    def log(self, name: str) -> str:
        """A service's output so far."""
        command = ("podman", "logs", f"{OURS}-{name}")
        return subprocess.run(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=True
        ).stdout


def hears_the_vehicle(port: int) -> bool:
    """True if a ground station that connects to the port receives heartbeats."""
    station = mavutil.mavlink_connection(f"udpout:127.0.0.1:{port}", source_system=255)
    try:
        station.mav.heartbeat_send(
            mavutil.mavlink.MAV_TYPE_GCS, mavutil.mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 0
        )
        heartbeat = station.recv_match(type="HEARTBEAT", blocking=True, timeout=1)
        return heartbeat is not None and heartbeat.get_srcSystem() == 1
    except ConnectionError:
        return False
    finally:
        station.close()


@pytest.mark.full
@pytest.mark.timeout(3600)
def test_the_image_is_small_and_without_torch_and_flies_missions_that_exit_with_their_status(
    image: str, wait_until: Callable
) -> None:
    assert int(said("podman", "image", "inspect", image, "--format", "{{.Size}}")) < MOST_BYTES
    within = [*PODMAN, "run", "--rm", *HOST, "--read-only", "--tmpfs=/tmp", image]
    user = said(*within, "id", "--user")
    assert user != "0"
    assert (
        said(*within, "stat", "--format=%u", "/data/runs") == user
    )  # so a new volume there belongs to the user too
    assert (
        said(
            *within[:-1],
            "--user=0",
            image,
            "find",
            "/",
            "-xdev",
            "-name",
            "torch",
            "-o",
            "-name",
            "libtorch*",
        )
        == ""
    )

    containers = Containers(image, wait_until)
    containers.start_router()
    containers.start_services()
    containers.start("uav")
    assert containers.status("uav") == 0, containers.log("uav")
    assert "expected located: yes" in containers.log("uav")
    runs = Path(said("podman", "volume", "inspect", f"{OURS}-runs", "--format", "{{.Mountpoint}}"))
    (summary,) = runs.glob("*.json")
    assert json.loads(summary.read_text())["outcome"]["located"]
    assert [record.stat().st_size > 0 for record in runs.glob("*.mcap")] == [True]
    for service in ("estimator", "agent"):
        containers.execute(
            service, "diff", "-r", "/opt/kernels", "/tmp/kernels"
        )  # no kernel had to be compiled

    containers.start_services()  # restart: these have already flown a mission
    containers.start(
        "uav", "--speedup", "3", "--silence", "1"
    )  # slow enough to observe, and soon home without an estimator
    wait_until(lambda: hears_the_vehicle(containers.mavlink_port))
    wait_until(lambda: containers.healthy("uav"))
    wait_until(lambda: "step " in containers.log("uav"))
    said("podman", "kill", f"{OURS}-estimator")
    assert containers.status("uav") == 1, containers.log("uav")
    assert "expected located: NO" in containers.log("uav")
