"""Protects access: a router with certificates lets each role of each vehicle do what the table says, and
nothing else, and says so.
"""

import argparse
import contextlib
import datetime
import itertools
import json
import os
import re
import socket
import ssl
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import pytest
import zenoh

from ground.desk import status
from ground.view.live import Roster
from link.access.authority import make
from link.access.crowds import MOST_FOR_ALL, MOST_OF_A_PART, Crowds
from link.bus.keys import BELIEF, HEALTH, KEYS, MAVLINK_IN, READING, STOP, Key
from link.bus.opening import NoRouter, open_router
from link.bus.session import Arrival, Bus
from link.record.tap import Tap
from tests.link.access.certificates import REFUSED_MS, endpoint_of, rogue, session

pytestmark = pytest.mark.slow

ROLES = {
    "vehicle": "uav",
    "estimator": "estimator",
    "agent": "agent",
    "payload": "payload",
    "bridge": "bridge",
    "ros2": "ros2",
}
"""The roles of a vehicle and their services; operator and observer are of all vehicles."""
REMOTE = zenoh.Locality.REMOTE
"""What a session hears of itself, in its own process, never reaches the router."""
EVERYBODY = (*ROLES, "operator", "observer")
RIGHTS = {  # by hand: who publishes, and who receives beside operators and observers
    "mavlink/out": ({"vehicle", "bridge"}, {"bridge", "ros2"}),
    "mavlink/in": ({"bridge", "operator", "ros2"}, {"vehicle", "bridge"}),
    "waypoint": ({"agent"}, {"vehicle"}),
    "reading": ({"vehicle"}, {"estimator", "ros2"}),
    "belief": ({"estimator"}, {"agent", "vehicle", "ros2"}),
    "agdc/stop": ({"estimator"}, {"vehicle", "agent", "payload", "bridge", "ros2"}),
    "departure": ({"estimator", "agent"}, {"estimator", "agent", "vehicle"}),
    "leave-out": ({"operator"}, {"estimator"}),
    "join": ({"vehicle"}, {"estimator"}),
    "latecomer": ({"estimator", "agent"}, {"estimator", "agent", "vehicle"}),
    "health/estimator": ({"estimator"}, set(EVERYBODY)),
    "health/uav": ({"vehicle"}, set(EVERYBODY)),
    "payload/in": ({"vehicle"}, {"payload"}),
    "payload/out": ({"payload"}, {"vehicle"}),
}
NAMES = {key.name.replace("<service>", "estimator") for key in KEYS}
TABLED = [name for name in RIGHTS if name in NAMES or name == "health/uav"]


def name_of(role: str, vehicle: int = 1) -> str:
    return f"uav/{vehicle}/{role}" if role in ROLES else role


OF_THE_SEARCH = {
    *("waypoint", "belief", "agdc/stop", "departure", "leave-out", "latecomer", "health/estimator")
}
"""What a search of several has one of; of all else each of its vehicles has its own."""


def in_a_search(role: str, vehicle: int = 1, search: int = 1) -> str:
    """The name of a certificate in a search of several."""
    if role not in ROLES:
        return role
    own = "" if role in ("estimator", "agent") else f"/uav/{vehicle}"
    return f"search/{search}{own}/{role}"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("certificates")
    make(path, [1, 2])
    make(path, [1, 2], search=1)
    make(path, [1], search=2)
    return path


@pytest.fixture(scope="module")
def secure(folder: Path) -> Iterator[str]:
    """The endpoint of a router with certificates."""
    router, endpoint = open_router("tcp/127.0.0.1:0", folder)
    with router:
        yield endpoint


EACH_OF_TWO = [name_of(role, vehicle) for vehicle in (1, 2) for role in EVERYBODY]
KEYS_OF_ONE = [f"uav/1/{key}" for key in TABLED]


class Clients:
    """A raw session for each role, and one that hears everything: none of them checks its own rights."""

    def __init__(
        self,
        endpoint: str,
        folder: Path,
        names: Iterable[str] = EACH_OF_TWO,
        keys: Iterable[str] = KEYS_OF_ONE,
    ) -> None:
        self.sessions = {name: session(endpoint, folder, name) for name in dict.fromkeys(names)}
        self.heard: list[tuple[str, str]] = []
        self._lock = threading.Lock()
        witness = self.sessions["observer"]
        self._held = [
            witness.declare_subscriber(
                key, lambda sample: self._hear("observer", sample), allowed_origin=REMOTE
            )
            for key in keys
        ]
        self.settle("observer")  # or what is said at once would reach the router before its subscriptions

    def _hear(self, who: str, sample: zenoh.Sample) -> None:
        with self._lock:
            self.heard.append((who, sample.payload.to_string()))

    def settle(self, name: str) -> None:
        """Wait until the router has handled all that a session has sent, and the session all that the
        router has.
        """
        space = name.rpartition("/")[0] or "uav/1"
        for _ in self.sessions[name].get(f"{space}/nobody", timeout=60):
            pass

    def subscribe(self, name: str, key: str) -> None:
        self._held.append(
            self.sessions[name].declare_subscriber(
                key, lambda sample: self._hear(name, sample), allowed_origin=REMOTE
            )
        )
        self.settle(name)

    def publish(self, name: str, key: str, text: str) -> None:
        self.sessions[name].put(key, text, congestion_control=zenoh.CongestionControl.BLOCK)
        self.settle(name)

    def close(self) -> None:
        for one in self.sessions.values():
            one.close()


@pytest.fixture
def clients(secure: str, folder: Path) -> Iterator[Clients]:
    with contextlib.closing(Clients(secure, folder)) as those:
        yield those


def test_the_table_of_this_test_has_every_key() -> None:
    assert set(RIGHTS) >= NAMES
    assert all(key.writers for key in KEYS)


@pytest.mark.one_in(3)
@pytest.mark.parametrize("key", TABLED)
def test_only_the_roles_of_the_table_publish_a_key(
    clients: Clients, key: str, wait_until: Callable[..., None]
) -> None:
    writers = RIGHTS[key][0]
    for name in clients.sessions:
        clients.publish(name, f"uav/1/{key}", name)
    allowed = {name_of(role) for role in writers} - {"observer"}
    wait_until(lambda: {text for _, text in clients.heard} >= allowed)
    assert {text for _, text in clients.heard} == allowed


@pytest.mark.one_in(3)
@pytest.mark.parametrize("key", TABLED)
def test_only_the_roles_of_the_table_receive_a_key(
    clients: Clients, key: str, wait_until: Callable[..., None]
) -> None:
    writers, readers = RIGHTS[key]
    for name, key_expr in itertools.product(clients.sessions, (f"uav/1/{key}", f"*/*/{key}", "**")):
        clients.subscribe(name, key_expr)
    clients.publish(name_of(min(writers)), f"uav/1/{key}", "said")
    for name in clients.sessions:
        clients.settle(name)
    allowed = {name_of(role) for role in (readers | {"operator", "observer"}) - {min(writers)}}
    wait_until(lambda: {who for who, _ in clients.heard} >= allowed)
    assert {who for who, _ in clients.heard} == allowed


# ---- in a search of several vehicles ----

SEARCHERS = (
    *(in_a_search(role, vehicle) for vehicle in (1, 2) for role in EVERYBODY),
    *(name_of(role) for role in ROLES),
    *(in_a_search(role, search=2) for role in ROLES),
)
"""The certificates of a search with two vehicles, of a vehicle that is alone, and of another search."""


def key_in_a_search(key: str, vehicle: int = 1) -> str:
    return f"search/1/{key}" if key in OF_THE_SEARCH else f"search/1/uav/{vehicle}/{key}"


@pytest.fixture
def searchers(secure: str, folder: Path) -> Iterator[Clients]:
    keys = [key_in_a_search(key) for key in TABLED]
    with contextlib.closing(Clients(secure, folder, SEARCHERS, keys)) as those:
        yield those


def entitled(roles: Iterable[str], key: str) -> set[str]:
    """Who of these roles has a right to a key in a search: of a vehicle's own, vehicle 1."""
    vehicles = (1, 2) if key in OF_THE_SEARCH else (1,)
    return {in_a_search(role, vehicle) for role in roles for vehicle in vehicles}


@pytest.mark.one_in(3)
@pytest.mark.parametrize("key", TABLED)
def test_in_a_search_a_vehicle_speaks_for_itself_alone(
    searchers: Clients, key: str, wait_until: Callable[..., None]
) -> None:
    for name in searchers.sessions:
        searchers.publish(name, key_in_a_search(key), name)
    allowed = entitled(RIGHTS[key][0], key)
    wait_until(lambda: {text for _, text in searchers.heard} >= allowed)
    assert {text for _, text in searchers.heard} == allowed
    if key not in OF_THE_SEARCH:
        assert not [name for name in allowed if "uav/2" in name]


@pytest.mark.one_in(3)
@pytest.mark.parametrize("key", TABLED)
def test_in_a_search_only_the_roles_of_the_table_receive_a_key(
    searchers: Clients, key: str, wait_until: Callable[..., None]
) -> None:
    writers, readers = RIGHTS[key]
    place, writer = key_in_a_search(key), in_a_search(min(writers))
    for name, key_expr in itertools.product(searchers.sessions, (place, f"search/1/**/{key}", "**")):
        searchers.subscribe(name, key_expr)
    searchers.publish(writer, place, "said")
    for name in searchers.sessions:
        searchers.settle(name)
    allowed = entitled((readers | {"operator", "observer"}) - {min(writers)}, key)
    if key.startswith("health/"):  # all of a search hear who is there
        allowed = {name for name in SEARCHERS if name.startswith("search/1/")} | {"operator", "observer"}
    allowed.discard(writer)
    wait_until(lambda: {who for who, _ in searchers.heard} >= allowed)
    assert {who for who, _ in searchers.heard} == allowed


def test_our_own_vehicle_2_cannot_speak_as_vehicle_1_and_says_so(
    secure: str, folder: Path, wait_until: Callable[..., None]
) -> None:
    with (
        Bus("estimator", secure, "search/1", secure=folder, vehicles=(1, 2)) as estimator,
        Bus("uav", secure, "search/1", secure=folder, vehicles=(1,)) as first,
        Bus("uav", secure, "search/1", secure=folder, vehicles=(2,)) as second,
    ):
        estimator.subscribe(READING)
        estimator.settle(10)
        second.publish(READING, b"a lie", vehicle=1)
        second.publish(READING, b"of the second")
        second.settle(10)
        first.publish(READING, b"of the first")
        heard = [estimator.receive(10) for _ in range(2)]
        assert {(each.vehicle, each.payload) for each in heard} == {
            (1, b"of the first"),
            (2, b"of the second"),
        }
        assert estimator.services() == {"estimator", "uav/1", "uav/2"}


def test_the_status_of_a_search_has_all_its_vehicles(
    secure: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with contextlib.ExitStack() as stack:
        for service, vehicles in (("estimator", (1, 2)), ("agent", ()), ("uav", (1,)), ("uav", (2,))):
            bus = Bus(service, secure, "search/1", secure=folder, vehicles=vehicles)
            stack.enter_context(bus).publish_health()
        command = argparse.ArgumentParser()
        status.add_arguments(command)
        words = ["--connect", secure, "--secure", str(folder), "--json"]
        status.run(command.parse_args(words))
        (said,) = capsys.readouterr().out.splitlines()
    report = json.loads(said)
    assert report["namespace"] == "search/1"
    heard = {name: part.get("state") for name, part in report["parts"].items()}
    assert heard == dict.fromkeys(("uav/1", "uav/2", "estimator", "agent"), "ready")


def test_who_may_not_publish_a_service_s_health_cannot_announce_it_either(clients: Clients) -> None:
    tokens = {
        name: one.liveliness().declare_token("uav/1/health/estimator")
        for name, one in clients.sessions.items()
    }
    for name in tokens:
        clients.settle(name)
    own = clients.sessions["operator"]
    tokens.pop("operator").undeclare()
    tokens.pop("uav/1/estimator").undeclare()
    clients.settle("uav/1/estimator")
    assert [str(reply.ok.key_expr) for reply in own.liveliness().get("uav/1/health/*") if reply.ok] == []


@pytest.mark.parametrize("kind", ["delete", "queryable"])
def test_nobody_deletes_and_nobody_answers_for_another(clients: Clients, kind: str) -> None:
    asked: list[str] = []
    for name, one in clients.sessions.items():
        if kind == "delete":
            one.delete("uav/1/belief")
        elif name != "uav/1/estimator":
            one.declare_queryable("uav/1/belief/@adv/pub/**", lambda query, name=name: asked.append(name))
        clients.settle(name)
    if kind == "queryable":
        for _ in clients.sessions["uav/1/agent"].get("uav/1/belief/@adv/pub/**", timeout=1):
            pass
    clients.settle("observer")
    assert clients.heard == []
    assert set(asked) <= {"uav/1/agent"}  # its own, in its own process


@pytest.mark.parametrize("mode", ["peer", "router"])
def test_a_certificate_has_no_more_rights_as_a_peer_or_a_router(
    secure: str, folder: Path, clients: Clients, mode: str, wait_until: Callable[..., None]
) -> None:
    heard: list[str] = []
    with session(secure, folder, "uav/1/agent", mode=mode, **{"listen/endpoints": []}) as agent:
        agent.declare_subscriber(
            "uav/1/reading", lambda sample: heard.append(str(sample.key_expr)), allowed_origin=REMOTE
        )
        agent.declare_subscriber(
            "**", lambda sample: heard.append(str(sample.key_expr)), allowed_origin=REMOTE
        )
        agent.declare_subscriber(
            "uav/1/belief", lambda sample: heard.append(str(sample.key_expr)), allowed_origin=REMOTE
        )

        def is_heard() -> bool:
            """A router learns in its own time who subscribes, so it says it until it is heard."""
            agent.put("uav/1/agdc/stop", "stop")
            agent.put("uav/1/waypoint", "waypoint")
            for _ in agent.get("uav/1/nobody", timeout=60):
                pass
            return any(text == "waypoint" for _, text in clients.heard)

        wait_until(is_heard)
        clients.publish("uav/1/vehicle", "uav/1/reading", "reading")
        clients.publish("uav/1/estimator", "uav/1/belief", "belief")
        for _ in agent.get("uav/1/nobody", timeout=60):
            pass
    wait_until(lambda: {text for _, text in clients.heard} >= {"reading", "belief"})
    assert set(heard) <= {"uav/1/belief"}
    assert {text for _, text in clients.heard} == {"waypoint", "reading", "belief"}


def test_nobody_reads_the_router_s_own_settings(clients: Clients) -> None:
    for one in clients.sessions.values():
        assert [reply for reply in one.get("@/*/router/**", timeout=2) if reply.ok] == []


@pytest.mark.parametrize("certificate", [None, pytest.param("observer", marks=pytest.mark.full)])
def test_connections_that_stay_silent_keep_nobody_out(
    folder: Path, certificate: str | None, capsys: pytest.CaptureFixture[str]
) -> None:
    router, endpoint = open_router(
        "tcp/127.0.0.1:0", folder
    )  # of its own: after each that goes, Zenoh admits nobody for 0.1 s
    host, _, port = endpoint.removeprefix("tls/").rpartition(":")
    tls = ssl.create_default_context(cafile=folder / "ca.pem")
    with router, contextlib.ExitStack() as silent:
        for _ in range(150):
            one = silent.enter_context(socket.create_connection((host, int(port))))
            if certificate:
                tls.load_cert_chain(folder / f"{certificate}.pem", folder / f"{certificate}.key")
                silent.enter_context(tls.wrap_socket(one, server_hostname=host))
        with Bus("agent", endpoint, secure=folder) as agent:
            assert agent.connected
            assert "does not answer yet" not in capsys.readouterr().err


def test_one_certificate_holds_so_many_sessions_and_no_more(
    folder: Path, wait_until: Callable[..., None]
) -> None:
    router, endpoint = open_router("tcp/127.0.0.1:0", folder)
    with router, contextlib.ExitStack() as stack:
        crowds = Crowds(router)
        agents = [
            stack.enter_context(session(endpoint, folder, "uav/1/agent")) for _ in range(MOST_OF_A_PART)
        ]
        wait_until(lambda: len(router.info.links()) == MOST_OF_A_PART)
        with contextlib.suppress(zenoh.ZError), contextlib.closing(session(endpoint, folder, "uav/1/agent")):
            wait_until(lambda: crowds.closed()["uav/1/agent"])
        with Bus("estimator", endpoint, secure=folder), session(endpoint, folder, "uav/2/agent") as other:
            wait_until(other.info.routers_zid)
            assert all(one.info.routers_zid() for one in agents)
        agents[0].close()
        with contextlib.closing(session(endpoint, folder, "uav/1/agent")) as late:
            wait_until(late.info.routers_zid)


@pytest.mark.full
def test_one_certificate_leaves_a_router_its_other_sessions(
    router: "Router", folder: Path, wait_until: Callable[..., None]
) -> None:
    with contextlib.ExitStack() as stack:
        for _ in range(MOST_FOR_ALL + 10):
            with contextlib.suppress(zenoh.ZError):
                stack.enter_context(session(router.endpoint, folder, "observer"))
        told = (
            r"level=warning .*refused sessions \(\d+\): the certificate observer already holds "
            rf"{MOST_FOR_ALL}"
        )
        wait_until(lambda: any(re.search(told, line) for line in router.said))
        with Bus("agent", router.endpoint, secure=folder) as agent:
            assert agent.connected


# ---- what our own sessions say ----

CALLS = {key.name: key for key in KEYS}


@pytest.mark.parametrize("key", KEYS, ids=lambda key: key.name)
@pytest.mark.parametrize("role", EVERYBODY)
def test_a_session_says_which_right_it_lacks(
    secure: str, folder: Path, capsys: pytest.CaptureFixture[str], key: Key, role: str
) -> None:
    if key is HEALTH:
        return  # each service has its own
    service = {**ROLES, "operator": "view", "observer": "recorder"}[role]
    writers, readers = RIGHTS[key.name]
    with Bus(service, secure, secure=folder) as bus:
        bus.publish(key, b"x")
        bus.subscribe(key)
        said = capsys.readouterr().err
        assert (
            bus.tally.last_error == ""
            or f"the certificate {name_of(role)} has no right to" in bus.tally.last_error
        )
    assert (f"has no right to publish {key.name}: the router drops it" in said) == (role not in writers)
    assert (f"has no right to receive {key.name}: the router drops it" in said) == (
        role not in readers | {"operator", "observer"}
    )


def test_a_service_of_no_role_hears_that_it_is_not_announced(
    secure: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with Bus("stranger", secure, secure=folder):
        assert "the certificate observer has no right to publish health/stranger" in capsys.readouterr().err


# ---- what must work as without ----


def test_kept_messages_reach_late_joiners_in_order(secure: str, folder: Path) -> None:
    with Bus("uav", secure, secure=folder) as uav, Bus("estimator", secure, secure=folder) as estimator:
        for number in range(300):
            uav.publish(READING, str(number).encode())
        estimator.publish(STOP, b"stop")
        with Bus("estimator", secure, secure=folder) as late, Bus("agent", secure, secure=folder) as agent:
            late.subscribe(READING)
            agent.subscribe(STOP)
            assert [late.receive(10).payload for _ in range(300)] == [
                str(number).encode() for number in range(300)
            ]
            assert agent.receive(10).payload == b"stop"


def test_a_recorder_hears_every_key_and_a_roster_every_vehicle(
    secure: str, folder: Path, wait_until: Callable[..., None]
) -> None:
    with (
        Tap("recorder", secure, secure=folder) as recorder,
        Roster(secure, folder) as roster,
        Bus("uav", secure, secure=folder) as uav,
        Bus("agent", secure, "uav/2", secure=folder),
    ):
        recorder.subscribe(*KEYS)
        recorder.settle(5)
        uav.publish(READING, b"reading")
        uav.publish_health()
        heard: set[str] = set()
        wait_until(
            lambda: (
                heard.update(message.name for message in recorder.take())
                or heard >= {"reading", "health/uav"}
            )
        )
        there: set[tuple[str, str]] = set()
        wanted = {("uav/1", "uav"), ("uav/2", "agent")}
        wait_until(
            lambda: (
                there.update((one.namespace, one.service) for one in roster.changes() if one.alive)
                or there >= wanted
            )
        )


def test_a_router_that_comes_back_admits_its_clients_again(
    folder: Path, wait_until: Callable[..., None]
) -> None:
    router, endpoint = open_router("tcp/127.0.0.1:0", folder)
    with (
        Bus("estimator", endpoint, secure=folder) as estimator,
        Bus("agent", endpoint, secure=folder) as agent,
    ):
        agent.subscribe(BELIEF, STOP)
        router.close()
        wait_until(lambda: not (estimator.connected or agent.connected))
        estimator.publish(STOP, b"meanwhile")
        router, _ = open_router(endpoint, folder)
        with router:
            arrived = agent.receive(20)
            assert isinstance(arrived, Arrival)
            assert arrived.payload == b"meanwhile"


# ---- who does not get in, and what both sides say of it ----


class Router:
    """`plumeward router --secure` as a process, and what it says."""

    def __init__(self, folder: Path) -> None:
        words = [
            sys.executable,
            "-m",
            "sitl",
            "router",
            "--listen",
            "tcp/127.0.0.1:0",
            "--secure",
            str(folder),
        ]
        self._process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert self._process.stdout
        self.endpoint = self._process.stdout.readline().strip()
        self.said: list[str] = []
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def _listen(self) -> None:
        assert self._process.stderr
        for line in self._process.stderr:
            self.said.append(line)

    def close(self) -> None:
        self._process.terminate()
        self._process.wait(120)
        self._thread.join(120)


@pytest.fixture(scope="module")
def router(folder: Path) -> Iterator[Router]:
    with contextlib.closing(Router(folder)) as running:
        yield running


@pytest.fixture(scope="module")
def strangers(
    folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, tuple[Path | None, str | None]]:
    """Folders and certificates that the router must refuse. Our own sessions would not even try: these are
    used with bare Zenoh.
    """
    other, old = tmp_path_factory.mktemp("other"), tmp_path_factory.mktemp("old")
    make(other, [1])
    (old / "ca.pem").write_bytes((folder / "ca.pem").read_bytes())
    (old / "ca.key").write_bytes((folder / "ca.key").read_bytes())
    make(old, [1], days=1, now=datetime.datetime.now(datetime.UTC) - datetime.timedelta(days=30))
    (other / "ca.pem").write_bytes(
        (folder / "ca.pem").read_bytes()
    )  # it accepts the router, which does not accept it
    return {
        "of another CA": (other, "uav/1/agent"),
        "no certificate": (folder, None),
        "expired": (old, "uav/1/agent"),
        "a router's": (folder, "router"),
        "plain TCP": (None, None),
    }


@pytest.mark.parametrize(
    ("who", "said"),
    [
        ("of another CA", "has a certificate of another CA"),
        ("no certificate", "has no certificate"),
        ("expired", "has an expired certificate"),
        ("a router's", "has a certificate that is not a client's"),
        ("plain TCP", "does not speak TLS"),
    ],
)
def test_a_stranger_stays_out_and_the_router_says_why(
    router: Router,
    strangers: dict[str, tuple[Path | None, str | None]],
    who: str,
    said: str,
    wait_until: Callable[..., None],
) -> None:
    folder, name = strangers[who]
    endpoint = router.endpoint if folder else router.endpoint.replace("tls/", "tcp/")
    with pytest.raises(zenoh.ZError):
        session(endpoint, folder, name, **{"connect/timeout_ms": REFUSED_MS})
    wait_until(
        lambda: any(
            re.search(rf"level=warning .*refused connections \(\d+\): the client {said}", line)
            for line in router.said
        )
    )


def test_the_router_says_who_joins_and_that_it_dropped_messages(
    router: Router, folder: Path, wait_until: Callable[..., None]
) -> None:
    with contextlib.closing(session(router.endpoint, folder, "uav/2/agent")) as agent:
        for _ in range(100):
            agent.put("uav/1/mavlink/in", b"disarm")
        wait_until(lambda: any("uav/2/agent joins from 127.0.0.1:" in line for line in router.said))
        wait_until(
            lambda: any(
                re.search(r"level=warning .*refused messages \(\d+\): the certificates", line)
                for line in router.said
            )
        )


def test_a_client_without_certificates_hears_that_the_router_wants_them(router: Router) -> None:
    with pytest.raises(NoRouter, match="cannot be joined: it wants TLS: give --secure DIR"):
        Bus("agent", router.endpoint.replace("tls/", "tcp/"), connect__timeout_ms=300)


def test_a_client_hears_why_the_router_refuses_it(folder: Path, tmp_path: Path) -> None:
    make(tmp_path, [1])
    with (
        contextlib.closing(Router(folder)) as running,
        pytest.raises(NoRouter, match=r"its certificate is not from the CA of .*ca\.pem"),
    ):
        Bus("agent", running.endpoint, secure=tmp_path, connect__timeout_ms=300)


@pytest.mark.parametrize(
    ("certificate", "theirs", "said"),
    [
        ("router", True, "its certificate is not from the CA of"),
        ("uav/1/vehicle", False, "its certificate is not (a router's|for 127.0.0.1)"),
    ],
)
def test_a_rogue_router_is_not_joined(
    folder: Path, tmp_path: Path, certificate: str, theirs: bool, said: str
) -> None:
    make(tmp_path, [1])
    with (
        rogue(tmp_path if theirs else folder, certificate) as router,
        pytest.raises(NoRouter, match=f"cannot be joined: {said}"),
    ):
        Bus("agent", endpoint_of(router), secure=folder, connect__timeout_ms=300)


def test_a_router_is_only_joined_by_a_name_of_its_certificate(tmp_path: Path) -> None:
    make(tmp_path, [1], ["router.example.org"])
    with (
        contextlib.closing(Router(tmp_path)) as running,
        pytest.raises(NoRouter, match=r"is not for 127\.0\.0\.1 .*--router 127\.0\.0\.1"),
    ):
        Bus("agent", running.endpoint, secure=tmp_path, connect__timeout_ms=300)


def test_a_router_without_tls_is_not_joined(folder: Path) -> None:
    router, endpoint = open_router("tcp/127.0.0.1:0")
    with router, pytest.raises(NoRouter, match="does not speak TLS: start it with --secure too"):
        Bus("agent", endpoint, secure=folder, connect__timeout_ms=300)


@pytest.mark.parametrize("listen", ["tcp/0.0.0.0:0", "tcp/[::]:0"])
def test_a_router_that_is_open_to_all_warns(listen: str) -> None:
    words = [sys.executable, "-m", "sitl", "router", "--listen", listen]
    with subprocess.Popen(
        words, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, env={**os.environ}
    ) as running:
        assert running.stderr
        assert (
            "level=warning service=router mission=- step=-1 "
            f"event={json.dumps(f'{listen} is open to other machines')[:-1]}" in (running.stderr.readline())
        )
        running.terminate()


def test_operators_command_every_vehicle_and_observers_none(
    secure: str, folder: Path, wait_until: Callable[..., None]
) -> None:
    with (
        Bus("uav", secure, "uav/2", secure=folder) as uav,
        Bus("view", secure, "uav/2", announced=False, secure=folder) as operator,
        Bus("status", secure, "uav/2", announced=False, secure=folder) as observer,
    ):
        uav.subscribe(MAVLINK_IN)
        uav.settle(5)
        observer.publish(MAVLINK_IN, b"from the observer")
        observer.settle(5)
        operator.publish(MAVLINK_IN, b"from the operator")
        assert uav.receive(10).payload == b"from the operator"


def test_a_part_whose_certificate_expires_says_so_once_when_the_router_closes_its_link(
    secure: str,
    folder: Path,
    tmp_path: Path,
    wait_until: Callable[..., None],
    capsys: pytest.CaptureFixture[str],
) -> None:
    for file in ("ca.pem", "ca.key"):
        (tmp_path / file).write_bytes((folder / file).read_bytes())
    until = datetime.datetime.now(datetime.UTC) + datetime.timedelta(seconds=3)
    make(tmp_path, [1], days=1, now=until - datetime.timedelta(days=1))
    with Bus("agent", secure, secure=tmp_path) as agent:
        assert agent.connected
        assert agent.expiry() == ""
        wait_until(lambda: agent.receive(timeout_s=0.0) is None and not agent.connected)
        agent.receive(timeout_s=0.0)
        assert agent.expiry().startswith("the certificate uav/1/agent expired on ")
        assert agent.tally.last_error == agent.expiry()
    assert capsys.readouterr().err.count("expired on") == 1
