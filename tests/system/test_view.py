"""Protects the page's server on real processes: what a page sees of a mission and of records, and what it
may do.
"""

import contextlib
import http.client
import json
import re
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common as mavlink
from websockets import Subprotocol
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from link.bus.keys import BELIEF
from link.bus.messages import Belief, pack_particles
from link.bus.opening import open_router
from link.bus.session import Bus
from tests.conftest import wait_until
from tests.system.conftest import Part
from tests.system.pages import Browser, port_of
from tests.system.stranger import Stranger, messages

GOLDEN = Path(__file__).parents[1] / "golden" / "homing-gaussian-field.mcap"
OTHER = GOLDEN.with_name("random-gaussian.mcap")


def belief(step: int) -> Belief:
    return Belief(
        step,
        step,
        (1.0, 2.0),
        5.0,
        0.5,
        (1.0, 0.0),
        "gaussian",
        100.0,
        1.0,
        10.0,
        0.0,
        ("x", "y"),
        (5.0, 6.0),
        (1.0, 1.0),
        (5.0, 6.0),
        (1.0, 0.0, 1.0),
        1.4,
        2.0,
        0.5,
        False,
    )


@pytest.fixture
def view(start: type[Part], wait_until: Callable[..., None]) -> Callable[..., tuple[Part, int]]:
    """Start `sitl view` on a free port."""

    def begin(*words: str) -> tuple[Part, int]:
        part = start("sitl", "view", "--port", "0", *words)
        return part, port_of(part, wait_until)

    return begin


@pytest.fixture(scope="module")
def replay(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """The port of a server that shows two records."""
    part = Part("sitl", "view", "--port", "0", str(GOLDEN), str(OTHER))
    wait_until(lambda: part.out)
    yield int(part.out[0].rpartition(":")[2].split("/")[0])
    part.kill()


def test_a_page_whose_browser_cannot_be_started_says_so_and_stays(
    view: Callable[..., tuple[Part, int]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    wait_until: Callable[..., None],
) -> None:
    (tmp_path / "firefox").write_bytes(b"\0")  # no program
    (tmp_path / "firefox").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.delenv("BROWSER", raising=False)
    part, port = view("--open", str(GOLDEN))
    wait_until(lambda: part.says(f"warning: --open: no browser shows http://127.0.0.1:{port}"))
    connection = http.client.HTTPConnection("127.0.0.1", port)
    connection.request("GET", "/")
    assert connection.getresponse().status == 200
    connection.close()


# ---- a mission ----


def test_a_mission_is_seen_from_its_first_reading_to_its_outcome_and_its_page_stays(
    start: type[Part], wait_until: Callable[..., None], record_property: Callable[[str, object], None]
) -> None:
    fly = start(
        "sitl", "fly", "--seed", "3", "--speedup", "0", "--no-record", "--view", "--particles", "4000"
    )
    wait_until(lambda: fly.says("page at"))
    port = int(re.search(r":(\d+)/", next(line for line in fly.err if "page at" in line))[1])
    with Browser(port) as page:
        assert page.hello["live"] is True
        assert page.hello["may_command"] is True
        page.until(lambda: "uav/1" in page.vehicles)
        assert page.vehicles["uav/1"]["title"] == "homing, seed 3"
        assert page.vehicles["uav/1"]["has_truth"] is True
        page.show("uav/1", truth=True)
        page.until(lambda: page.bye)
        scene = page.scenes["uav/1"]
        assert scene["ending"]["verdict"] == "located"
        assert page.steps["uav/1"] == sorted(
            set(page.steps["uav/1"])
        )  # a belief may be lost on the way: only the newest is kept
        assert f"after {page.steps['uav/1'][-1]} steps" in scene["ending"]["text"]
        assert page.particles["uav/1"] == 4000
        assert page.verdicts() == {"uav": "ok", "estimator": "ok", "agent": "ok"}  # as the mission left them
        wait_until(lambda: fly.says("page stays open at"))
        assert fly.process.poll() is None
        answer = page.order("hold")
        assert (answer["accepted"], answer["reason"]) == (False, "the mission is over")
        record_property("behind_ms", sorted(page.behind_ms)[len(page.behind_ms) // 2])
        with Browser(port) as late:  # loaded again
            late.show("uav/1")
            late.until(lambda: late.bye and "uav/1" in late.scenes)
            assert late.scenes["uav/1"]["ending"] == scene["ending"]
            assert late.steps == page.steps
    assert fly.ended() == 0  # its last page is closed
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.1", port))


@pytest.mark.full
def test_an_interrupt_ends_a_page_that_stays(start: type[Part], wait_until: Callable[..., None]) -> None:
    fly = start(
        "sitl", "fly", "--seed", "3", "--speedup", "0", "--no-record", "--view", "--budget", "2", "--json"
    )
    wait_until(lambda: fly.out and fly.says("page stays open at"))
    assert json.loads(fly.out[-1])["steps"] == 2
    fly.process.send_signal(signal.SIGINT)
    assert fly.ended() == 0  # the mission was flown


@pytest.mark.full
def test_a_page_that_dies_is_a_warning(
    start: type[Part], wait_until: Callable[..., None], family: Callable[[int], dict[str, int]]
) -> None:
    import os

    fly = start("sitl", "fly", "--seed", "3", "--speedup", "5", "--no-record", "--view", "--budget", "12")
    wait_until(lambda: fly.says("step   0"))
    os.kill(family(fly.process.pid)["view"], signal.SIGKILL)
    assert fly.ended() == 0
    assert fly.says("warning: the page ended")
    assert not fly.says("stays open")


@pytest.mark.full
def test_an_operator_holds_resumes_and_sees_what_is_refused(
    start: type[Part], router: str, view: Callable[..., tuple[Part, int]], wait_until: Callable[..., None]
) -> None:
    uav = start("sitl", "uav", "--connect", router, "--seed", "3", "--speedup", "10")
    _, port = view("--connect", router, "--seed", "3")
    with Browser(port) as page:
        page.until(lambda: "uav/1" in page.vehicles)
        page.show("uav/1")
        page.until(lambda: "uav/1" in page.scenes)
        assert page.order("return") == {
            "vehicle": "uav/1",
            "command": "return",
            "accepted": False,
            "reason": "Return refused: on the ground",
        }
        assert page.order("resume")["reason"] == "Offboard refused: no setpoint received yet"
        assert page.order("hold", "uav/9")["reason"] == "there is no vehicle 'uav/9'"
        services = [start(part, "--connect", router) for part in ("estimator", "agent")]
        page.until(lambda: page.steps.get("uav/1", [-1])[-1:] >= [3])
        assert page.order("hold")["accepted"] is True
        page.until(lambda: page.scenes["uav/1"]["craft"]["mode"] == "HOLD")
        held = len(page.steps["uav/1"])
        assert page.order("resume")["accepted"] is True
        page.until(lambda: len(page.steps["uav/1"]) >= held + 3)
        services[1].kill()
        page.until(lambda: page.verdicts()["agent"] == "missing")
        assert "agent: is gone" in page.happened["uav/1"]
        assert page.order("land")["accepted"] is True
        page.until(lambda: page.scenes["uav/1"]["craft"]["mode"] == "LAND")
        uav.kill()
        page.until(lambda: page.verdicts()["uav"] == "missing")
        assert page.order("hold")["reason"] == "no answer within 2 s"


def test_another_system_on_the_vehicles_bus_gets_no_command_and_changes_no_picture(
    start: type[Part], router: str, view: Callable[..., tuple[Part, int]]
) -> None:
    with Stranger(router) as stranger:
        stranger.mav.srcSystem, stranger.mav.srcComponent = 42, 1
        commands, say = stranger.subscribe("mavlink/in"), stranger.publisher
        _, port = view("--connect", router)
        start("sitl", "uav", "--connect", router, "--seed", "3", "--speedup", "10")
        with Browser(port) as page:
            page.until(lambda: "uav/1" in page.vehicles)
            page.show("uav/1")
            page.until(lambda: page.scenes.get("uav/1", {}).get("craft"))
            put = say("mavlink/out")
            for second in range(50, 0, -2):  # two vehicles, each of which seems to start again and again
                place = mavlink.MAVLink_local_position_ned_message(1000 * second, 20.0, 20.0, -9.0, 0, 0, 0)
                put(stranger.frames(mavlink.MAVLink_heartbeat_message(2, 12, 128, 6 << 16, 4, 3), place))
                page.until(lambda received=page.received: page.received > received)
            assert page.order("land")["reason"] == "Land refused: on the ground"
            assert "uav: a new mission begins" not in page.happened["uav/1"]
            assert page.scenes["uav/1"]["craft"]["y"] == pytest.approx(0.0, abs=0.1)
        told = [message.target_system for message in messages(commands.get(timeout=400)).values()]
        assert told == [1]


def test_vehicles_appear_and_go_and_two_are_seen_at_once(
    router: str, view: Callable[..., tuple[Part, int]]
) -> None:
    _, port = view("--connect", router)
    with Bus("estimator", router, "uav/1") as first, Browser(port) as page:
        page.until(lambda: "uav/1" in page.vehicles)
        with Bus("estimator", router, "fleet/uav/2") as second:
            page.until(lambda: "fleet/uav/2" in page.vehicles)
            page.show("uav/1", "fleet/uav/2")
            for bus, count in ((first, 2), (second, 3)):
                bus.publish(BELIEF, belief(0), pack_particles(_particles(count)))
            page.until(lambda: page.particles.get("uav/1") == 2 and page.particles.get("fleet/uav/2") == 3)
        page.until(lambda: not page.vehicles["fleet/uav/2"]["here"])
        assert page.vehicles["uav/1"]["here"]
        assert page.order("hold", "fleet/uav/2")["reason"] == "fleet/uav/2 is not there"


def _particles(count: int):
    import numpy as np

    return np.full((count, 3), 1 / count, np.float32)


def test_it_waits_for_a_router_and_survives_its_restart_and_garbage(
    view: Callable[..., tuple[Part, int]],
) -> None:
    session, endpoint = open_router("tcp/127.0.0.1:0")
    session.close()
    part, port = view("--connect", endpoint)
    with Browser(port) as page:
        page.until(lambda: page.notice)
        assert page.notice == f"no router at {endpoint}: waiting for one"
        session, _ = open_router(endpoint)
        with Bus("estimator", endpoint) as estimator:
            page.until(lambda: "uav/1" in page.vehicles)
            assert page.notice == ""
            page.show("uav/1")
            for garbage in (b"", b"\xff\xfe", b"[" * 5000, b"{}", b'{"step":-1}'):
                estimator.publish(BELIEF, garbage, b"odd")
            estimator.publish(BELIEF, belief(0), b"odd")
            page.until(lambda: page.steps.get("uav/1") == [0])
            session.close()
            page.until(lambda: "is gone" in page.notice)
            session, _ = open_router(endpoint)
            page.until(lambda: page.notice == "" and page.vehicles["uav/1"]["here"])
            step = 1
            while page.steps["uav/1"] == [0]:  # until the subscription is known again
                estimator.publish(BELIEF, belief(step), pack_particles(_particles(5)))
                step += 1
                received = page.received
                page.until(lambda received=received: page.received > received)
            assert "estimator: is gone" not in page.happened["uav/1"]
        session.close()
    assert [line for line in part.err if "Traceback" in line] == []
    lost = sum(
        "is gone: waiting for it" in line for line in part.err
    )  # a busy machine may lose the link by itself
    assert lost >= 1
    assert sum("waiting for" in line for line in part.err) == 1 + lost


# ---- records ----


def test_two_records_are_seen_on_one_time_line(replay: int) -> None:
    with Browser(replay) as page:
        page.until(lambda: page.vehicles)
        assert page.hello["live"] is False
        assert page.hello["why_not"] == "a record takes no commands"
        assert list(page.vehicles) == [GOLDEN.stem, OTHER.stem]
        first = page.vehicles[GOLDEN.stem]
        assert first["readings_s"] == sorted(first["readings_s"])
        assert first["begin_s"] <= first["readings_s"][0] < first["readings_s"][-1] <= first["end_s"]
        assert first["moments"]
        page.show(GOLDEN.stem, OTHER.stem)
        page.until(lambda: len(page.scenes) == 2)
        assert page.scenes[GOLDEN.stem]["ending"]["verdict"] == "located"
        assert len(page.steps[GOLDEN.stem]) == len(first["readings_s"])
        page.show(GOLDEN.stem, at_s=first["readings_s"][4])
        page.until(lambda: page.steps[GOLDEN.stem] == [0, 1, 2, 3, 4])
        assert page.scenes[GOLDEN.stem]["ending"] is None
        page.show(GOLDEN.stem, at_s=-1.0)
        page.until(lambda: page.steps[GOLDEN.stem] == [])
        assert page.particles[GOLDEN.stem] == 0
        assert page.order("hold", GOLDEN.stem)["reason"] == "a record takes no commands"


@pytest.mark.parametrize("name", ["README.md", "nothing.mcap"])
def test_a_file_that_is_no_record_is_named_in_one_line(start: type[Part], name: str) -> None:
    part = start("sitl", "view", "--port", "0", name)
    assert part.ended() == 2
    assert len(part.err) == 1
    assert name in part.err[0]


def test_a_port_that_is_taken_is_named_in_one_line(start: type[Part], replay: int) -> None:
    part = start("sitl", "view", "--port", str(replay))
    assert part.ended() == 2
    assert part.err == [f"error: --port: cannot serve on 127.0.0.1 port {replay}: Address already in use\n"]


def test_foxglove_is_served_on_a_port_of_this_machine_alone_and_one_that_is_taken_is_named(
    start: type[Part], router: str, wait_until: Callable[..., None]
) -> None:
    part = start("sitl", "view", "--port", "0", "--connect", router, "--foxglove", "0")
    wait_until(lambda: len(part.out) == 2)
    address = part.out[1].removeprefix("Foxglove at ").strip()
    with connect(address, subprotocols=[Subprotocol("foxglove.sdk.v1")]) as viewer:
        assert json.loads(viewer.recv(60))["name"] == "plumeward"
    port = int(address.rpartition(":")[2])
    if sys.platform == "linux":
        rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()]
        bound = [row[1] for row in rows if row[3] == "0A" and row[1].endswith(f":{port:04X}")]
        assert bound == [f"0100007F:{port:04X}"]
    other = start("sitl", "view", "--port", "0", "--connect", router, "--foxglove", str(port))
    assert other.ended() == 2
    taken = f"cannot serve on 127.0.0.1 port {port}: Address already in use"
    assert other.err == [f"error: --foxglove: {taken}\n"]


def test_an_empty_address_is_refused_in_one_line(start: type[Part]) -> None:
    part = start("sitl", "view", "--port", "0", "--host", "")
    assert part.ended() == 2
    assert part.err == ["error: --host: '' is not allowed; wanted an address of this machine\n"]


# ---- who may look and command ----


def asked(port: int, path: str = "/static/none", **headers: str) -> tuple[int, http.client.HTTPMessage]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.putrequest("GET", path, skip_host=True)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    response = connection.getresponse()
    response.read()
    connection.close()
    return response.status, response.headers


def test_requests_for_another_host_are_refused(replay: int) -> None:
    assert asked(replay, Host=f"127.0.0.1:{replay}")[0] == 404
    assert asked(replay, Host="evil.example")[0] == 403
    assert asked(replay, Host=f"evil.example:{replay}")[0] == 403
    assert asked(replay, Host="127.0.0.1")[0] == 403


def test_every_answer_forbids_what_the_page_does_not_need(replay: int) -> None:
    for host in (f"localhost:{replay}", "evil.example"):
        _, headers = asked(replay, Host=host)
        policy = headers["content-security-policy"]
        assert "default-src 'self'" in policy
        assert "frame-ancestors 'none'" in policy
        assert "unsafe" not in policy
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["referrer-policy"]


def test_no_file_beside_the_pages_own_is_served(replay: int) -> None:
    for path in ("/static/../server.py", "/static/%2e%2e/server.py", "/static/..%2fserver.py", "/server.py"):
        assert asked(replay, path, Host=f"127.0.0.1:{replay}")[0] == 404


@pytest.mark.parametrize("origin", ["http://evil.example", "null", None])
def test_another_page_gets_no_scenes(replay: int, origin: str | None) -> None:
    with pytest.raises(InvalidStatus) as refused:
        Browser(replay, origin=origin)
    assert refused.value.response.status_code == 403


def test_elsewhere_only_the_word_of_the_token_file_commands(
    view: Callable[..., tuple[Part, int]], router: str, tmp_path: Path
) -> None:
    file = tmp_path / "word"
    with Bus("uav", router):
        _, open_to_all = view("--connect", router, "--host", "0.0.0.0")
        with Browser(open_to_all) as page:
            assert page.hello["may_command"] is False
            assert (
                page.order("land")["reason"]
                == page.hello["why_not"]
                == "read-only: the page is served on 0.0.0.0 without --token-file"
            )
        part, guarded = view("--connect", router, "--host", "0.0.0.0", "--token-file", str(file))
        word = file.read_text().strip()
        assert file.stat().st_mode & 0o777 == 0o600
        with (
            Browser(guarded) as page,
            Browser(guarded, word) as right,
            Browser(guarded, "a wrong word") as wrong,
        ):
            assert [(each.hello["may_command"], each.hello["word"]) for each in (page, right, wrong)] == [
                (False, "wanted"),
                (True, ""),
                (False, "wrong"),
            ]
            assert "--token-file" in page.order("land")["reason"]
        assert word not in "".join(
            [*part.out, *part.err, *Path(f"/proc/{part.process.pid}/cmdline").read_text().split("\0")]
        )


def test_a_word_in_the_arguments_is_refused_with_what_to_use_and_not_repeated(start: type[Part]) -> None:
    part = start("sitl", "view", "--port", "0", "--token", "secret-word")
    assert part.ended() == 2
    (line,) = part.err
    assert "error: --token: not allowed any more" in line
    assert "wanted --token-file FILE" in line
    assert "secret-word" not in line


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    ("flags", "told"),
    [
        (
            ("--token-file", "empty"),
            "error: --token-file: 'empty' is empty; wanted a file with a word of at least 8 characters in "
            "one",
        ),
        (
            ("--token-file", "short"),
            "error: --token-file: 'short' holds a word of 7 characters; wanted a file with a word of at "
            "least 8 ",
        ),
        (
            ("--token-file", "none/word"),
            "error: --token-file: 'none/word': No such file or directory; wanted a file with a word",
        ),
        (("--token-file", "."), "error: --token-file: '.' is not a file; wanted a file with a word"),
        (
            ("--origin", "drone.example"),
            "error: --origin: 'drone.example' is not an origin; wanted the beginning of an address",
        ),
        (
            ("--origin", "https://drone.example/page"),
            "error: --origin: 'https://drone.example/page' is not an origin",
        ),
    ],
)
def test_a_word_or_an_origin_that_cannot_be_used_is_named_in_one_line(
    tmp_path: Path, flags: tuple[str, str], told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "empty").touch()
    (tmp_path / "short").write_text("seven77\n")
    part = Part("sitl", "view", "--port", "0", *flags, cwd=tmp_path)
    assert part.ended() == 2
    (line,) = part.err
    assert told in line


def test_a_word_that_others_can_read_is_warned_of(start: type[Part], tmp_path: Path) -> None:
    file = tmp_path / "word"
    file.write_text("a long secret\n")
    file.chmod(0o640)
    part = start("sitl", "view", "--port", "0", "--token-file", str(file), str(GOLDEN))
    wait_until(lambda: part.out)
    assert part.err == [f"warning: {str(file)!r} is open to other users of this machine: chmod 600 {file}\n"]


def test_a_proxy_is_admitted_by_origin_alone_and_then_commands_need_the_word(
    view: Callable[..., tuple[Part, int]], router: str, replay: int
) -> None:
    proxy, name = "https://drone.example", "drone.example"
    with Bus("uav", router):
        _, port = view("--connect", router, "--origin", proxy, "--origin", "http://other.example:8080")
        for origin, host in ((proxy, ""), (proxy, name), ("http://other.example:8080", "other.example:8080")):
            with Browser(port, origin=origin, host=host) as page:
                assert page.hello["why_not"] == "read-only: the page is open to --origin without --token-file"
        for origin, host in (
            ("https://evil.example", ""),
            ("http://drone.example", name),
            (proxy, "evil.example"),
        ):
            with pytest.raises(InvalidStatus, match="403"):
                Browser(port, origin=origin, host=host)
    for host in ("", name):
        with pytest.raises(InvalidStatus, match="403"):
            Browser(replay, origin=proxy, host=host)


# ---- clients that misbehave ----


@pytest.mark.parametrize(
    "message",
    [
        "",
        "nonsense",
        "[]",
        "{}",
        '{"show": 1}',
        '{"show": ["a", "b", "c"]}',
        '{"drawn": "x"}',
        '{"command": "explode", "vehicle": "uav/1"}',
        '{"drawn": 1, "more": 2}',
        '{"show": ["uav/1"], "at_s": NaN}',
        "[" * 4000,
        b"\xff",
        "x" * 5000,
    ],
)
def test_nonsense_is_answered_by_closing(replay: int, message: str | bytes) -> None:
    with Browser(replay) as page:
        page.socket.send(message)
        with pytest.raises(ConnectionClosed) as closed:
            page.until(lambda: False)
        assert closed.value.rcvd.code in (1007, 1008, 1009)


def test_a_page_that_does_not_draw_gets_one_scene_a_second_and_delays_nobody(replay: int) -> None:
    with Browser(replay) as idle, Browser(replay) as page:
        name, began, scenes = GOLDEN.stem, time.monotonic(), 0
        for socket_ in (idle.socket, page.socket):
            socket_.send(json.dumps({"show": [name], "at_s": 0.0}))
        for step in range(60):  # it asks for more, but never says that it has drawn
            idle.show(name, at_s=float(step))
            before = page.received
            page.show(name, at_s=float(step))
            page.until(lambda before=before: page.received > before)
        with contextlib.suppress(TimeoutError):
            while idle.socket.recv(0.5):
                scenes += 1
        assert 1 <= scenes <= 2 + time.monotonic() - began


def test_the_twenty_first_page_is_told_why_it_is_refused(view: Callable[..., tuple[Part, int]]) -> None:
    _, port = view(str(GOLDEN))
    pages = [Browser(port) for _ in range(20)]
    try:
        with pytest.raises(ConnectionClosed) as closed:
            Browser(port)
        assert closed.value.rcvd.code == 1013
        assert "20 pages are open" in closed.value.rcvd.reason
    finally:
        for page in pages:
            page.close()


def test_who_has_the_word_commands_past_twenty_pages_that_look_and_connections_that_say_nothing(
    view: Callable[..., tuple[Part, int]], router: str, tmp_path: Path
) -> None:
    with Bus("uav", router), contextlib.ExitStack() as held:
        file = tmp_path / "word"
        _, port = view("--connect", router, "--token-file", str(file))
        for _ in range(20):
            held.enter_context(Browser(port))
        for _ in range(150):
            held.enter_context(socket.create_connection(("127.0.0.1", port)))
        assert asked(port, "/static/app.js", Host=f"127.0.0.1:{port}")[0] == 200
        with pytest.raises(ConnectionClosed):
            Browser(port)
        with Browser(port, file.read_text().strip()) as page:
            page.until(lambda: "uav/1" in page.vehicles)
            assert page.order("land")["reason"] == "uav/1 has not said which system it is"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it_at_once_with_pages_open(view: Callable[..., tuple[Part, int]], number: int) -> None:
    part, port = view(str(GOLDEN))
    with Browser(port) as page, socket.create_connection(("127.0.0.1", port)):  # one that never says anything
        page.show(GOLDEN.stem)
        part.process.send_signal(number)
        assert part.ended() == 130
    assert part.err == []
