"""Protects `status` on real processes: health checks and scripts rely on its exit status."""

import json
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from link.bus.keys import STOP
from link.bus.messages import Stop
from link.bus.session import Bus
from tests.system.live import run_sitl
from tests.system.stranger import Stranger, belief

Status = Callable[..., tuple[int, dict[str, Any]]]


@pytest.fixture
def table(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, list[str], list[str]]]:
    """Run the command in this process; returns its exit status and the lines of its stdout and stderr."""
    return lambda router, *flags: run_sitl(monkeypatch, capsys, "status", "--connect", router, *flags)


@pytest.fixture
def status(table: Callable[..., tuple[int, list[str], list[str]]]) -> Status:
    """Run it with --json; returns its exit status and its JSON."""

    def said(router: str, *flags: str) -> tuple[int, dict[str, Any]]:
        code, out, err = table(router, "--json", *flags)
        assert err == []
        return code, json.loads(out[-1])

    return said


def verdicts(report: dict[str, Any]) -> dict[str, str]:
    return {name: part["status"] for name, part in report["parts"].items()}


@pytest.fixture
def stack(start, router: str, wait_until: Callable) -> dict[str, Any]:
    """Estimator and agent, ready, without a vehicle: a vehicle would take off as soon as both are there."""
    parts = {
        "estimator": start("estimator", "--connect", router),
        "agent": start("agent", "--connect", router),
    }
    wait_until(lambda: all(part.says("ready") for part in parts.values()))
    return parts


def test_a_stack_that_flies_is_well_and_each_part_tells_its_figures(
    start, router: str, stack: dict[str, Any], status: Status, wait_until: Callable
) -> None:
    assert status(router)[0] == 1
    uav = start("sitl", "uav", "--connect", router, "--seed", "7", "--speedup", "20")
    wait_until(lambda: uav.says("takes off when"))
    reports = []
    wait_until(lambda: reports.append(status(router)) or reports[-1][1]["parts"]["agent"]["step"] >= 2)
    code, report = reports[-1]
    assert (code, report["ok"], report["router"]) == (0, True, {"endpoint": router, "status": "ok"})
    assert verdicts(report) == {"uav": "ok", "estimator": "ok", "agent": "ok"}
    for part in report["parts"].values():
        assert part["step"] >= 2
        assert part["rate_hz"] > 0
        assert 0 < part["latency_s"] < 10
        assert part["uptime_s"] > 0
        assert {*part["refused"]} <= {
            "repeated"
        }  # on a busy machine an answer comes late, and is asked for again
        assert part["last_error"] == ""
    assert report["parts"]["agent"]["about"] == "homing"
    assert report["parts"]["uav"]["state"] == "searching"
    # The vehicle's latency includes both services and the way there and back.
    parts = report["parts"]
    assert parts["uav"]["compute_s"] > 0 < parts["estimator"]["compute_s"]


def test_a_part_that_was_killed_is_missing(router: str, stack: dict[str, Any], status: Status) -> None:
    assert status(router, "--parts", "estimator,agent")[0] == 0
    stack["estimator"].kill()
    code, report = status(router, "--parts", "estimator,agent")
    assert (code, verdicts(report)) == (1, {"estimator": "missing", "agent": "ok"})
    assert status(router, "--parts", "agent")[0] == 0


def test_a_part_that_hangs_is_stale_and_one_that_was_never_ready_is_starting(
    router: str, status: Status
) -> None:
    with Bus("estimator", router) as hangs, Bus("agent", router):
        hangs.publish_health()  # and never again: the service does not get to receive it
        code, report = status(router, "--parts", "estimator,agent")
    assert (code, verdicts(report)) == (1, {"estimator": "stale", "agent": "starting"})


def test_a_part_that_refuses_messages_is_refusing_and_says_why(
    router: str, stack: dict[str, Any], status: Status, wait_until: Callable
) -> None:
    with Stranger(router) as stranger:
        beliefs, publish = stranger.subscribe("belief"), stranger.publisher("reading")
        publish(stranger.reading(5000))
        assert belief(beliefs.get(timeout=400))["step"] == 0
        publish(stranger.reading(5000))  # a duplicate, as on any radio
        assert belief(beliefs.get(timeout=400))["step"] == 0
        assert status(router, "--parts", "estimator")[0] == 0
        publish(b"noise")
        wait_until(lambda: stack["estimator"].says("refused reading: malformed"))
        code, report = status(router, "--parts", "estimator")
        estimator = report["parts"]["estimator"]
        assert (code, estimator["status"]) == (1, "refusing")
        assert estimator["refused"] == {"repeated": 1, "malformed": 1}
        assert estimator["refused_lately"] == 1
        assert estimator["last_error"].startswith("refused reading: malformed")


def test_without_a_router_all_is_missing_and_the_last_line_says_how_to_get_one(table: Callable) -> None:
    code, out, err = table("tcp/127.0.0.1:1", "--parts", "estimator,agent")
    assert code == 1
    assert sum("missing" in line for line in out) == 3  # the router is, too
    assert err == ["error: --connect: no router at tcp/127.0.0.1:1 (start one with: plumeward router)"]


@pytest.mark.full
def test_without_a_router_json_says_that_it_and_its_parts_are_missing(status: Status) -> None:
    code, report = status("tcp/127.0.0.1:1", "--parts", "estimator")
    assert (code, report["router"]["status"], verdicts(report)) == (1, "missing", {"estimator": "missing"})


def test_the_table_names_parts_verdicts_and_figures(
    router: str, stack: dict[str, Any], table: Callable
) -> None:
    code, out, _ = table(router)
    assert code == 1
    rows = {line.split()[0]: line.split() for line in out[2:]}
    assert rows["router"][1] == rows["estimator"][1] == rows["agent"][1] == "ok"
    assert rows["uav"][1] == "missing"
    assert rows["agent"][2:4] == ["ready:", "homing"]


def test_every_vehicle_on_the_router_is_shown_and_one_that_is_not_well_is_status_1(
    router: str, stack: dict[str, Any], status: Status, table: Callable
) -> None:
    with Bus("agent", router, "uav/10") as other:
        other.publish_health()
        parts = ("--parts", "agent")
        code, report = status(router, *parts)
        assert (code, report["ok"], report["namespace"]) == (1, False, "uav/1")
        assert list(report["vehicles"]) == ["uav/1", "uav/10"]
        assert report["parts"] == report["vehicles"]["uav/1"]["parts"]
        assert verdicts(report["vehicles"]["uav/1"]) == {"agent": "ok"}
        assert verdicts(report["vehicles"]["uav/10"]) == {"agent": "stale"}
        lines = table(router, *parts)[1]
        assert [line.split()[0] for line in lines if " at tcp/" in line] == ["uav/1", "uav/10"]
        code, report = status(router, *parts, "--namespace", "uav/1")
        assert (code, list(report["vehicles"])) == (0, ["uav/1"])


@pytest.mark.full
def test_status_and_every_part_say_that_the_search_has_ceased(
    start, wait_until: Callable, tmp_path: Path, status: Status, table: Callable
) -> None:
    router = start("sitl", "router", "--listen", "tcp/127.0.0.1:0")
    wait_until(lambda: router.out)
    to = ("--connect", router.out[0].strip())
    parts = {
        "agent": start("agent", *to),
        "uav": start("sitl", "uav", *to, "--speedup", "0"),
        "recorder": start("sitl", "record", str(tmp_path / "record.mcap"), *to),
        "bridge": start("sitl", "bridge", "udpout:127.0.0.1:9", *to),
        "payload": start("sitl", "payload", *to),
    }
    wait_until(lambda: {*status(to[1])[1]["parts"]} >= {*parts})
    assert not status(to[1])[1]["ceased"]
    with Bus("estimator", to[1]) as estimator:
        estimator.publish(STOP, Stop(9000, 7, (23.5, 24.25), (0.1, 0.0, 0.1), 0.45, 0.5))
        words = "the search has ceased at step 7: source at (23.50, 24.25) m, spread 0.45 m"
        wait_until(lambda: [name for name, part in parts.items() if part.says(words)] == [*parts])
        wait_until(lambda: router.says(f"uav/1: {words}"))
        report = status(to[1])[1]
        assert report["ceased"]
        assert {name for name, part in report["parts"].items() if part.get("ceased")} == {*parts}
        assert any(
            "the search has ceased, say uav, agent, bridge, payload, recorder" in line
            for line in table(to[1])[1]
        )


@pytest.mark.full
def test_a_watch_follows_who_comes_and_goes_until_interrupted(
    start, router: str, stack: dict[str, Any], wait_until: Callable
) -> None:
    watch = start("sitl", "status", "--connect", router, "--json", "--watch", "--parts", "estimator,agent")

    def last() -> dict[str, Any]:
        return json.loads(watch.out[-1]) if watch.out else {"parts": {}}

    wait_until(lambda: verdicts(last()) == {"estimator": "ok", "agent": "ok"})
    stack["agent"].kill()
    wait_until(lambda: verdicts(last()) == {"estimator": "ok", "agent": "missing"})
    start("agent", "--connect", router)
    wait_until(lambda: verdicts(last()) == {"estimator": "ok", "agent": "ok"})
    watch.process.send_signal(signal.SIGINT)
    assert watch.ended() == 130
    assert watch.err == []


def test_a_watch_outlives_the_router(start, wait_until: Callable) -> None:
    router = start("sitl", "router", "--listen", "tcp/127.0.0.1:0")
    wait_until(lambda: router.out)
    endpoint = router.out[0].strip()
    watch = start("sitl", "status", "--connect", endpoint, "--json", "--watch")

    def router_is(verdict: str) -> bool:
        return bool(watch.out) and json.loads(watch.out[-1])["router"]["status"] == verdict

    wait_until(lambda: router_is("ok"))
    start("estimator", "--connect", endpoint, "--namespace", "search/1", "--vehicles", "2")
    fleet = ["uav/1", "uav/2", "estimator", "agent"]

    def shows_the_fleet() -> bool:
        return list(json.loads(watch.out[-1])["vehicles"].get("search/1", {"parts": {}})["parts"]) == fleet

    wait_until(shows_the_fleet)
    router.kill()
    wait_until(lambda: router_is("missing"))
    assert shows_the_fleet()
    start("sitl", "router", "--listen", endpoint)
    wait_until(lambda: router_is("ok"))
    assert shows_the_fleet()
