"""Protects `fly --connect`: the vehicle joins services that run elsewhere, and the mission is identical."""

import json
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from link.bus.session import Bus
from sitl.launch.mission import Launch, agent_arguments, estimator_arguments
from sitl.script.script import load
from tests.system.live import run_sitl
from tests.system.stranger import Stranger

MISSION = """
seed: 7
speedup: 0
scenario: {q: 300, d: 4.5, tau: 10}
expect: located
"""


@pytest.fixture
def mission(tmp_path: Path) -> str:
    """A release with the estimator's default rate, diffusivity and lifetime."""
    (tmp_path / "mission.yaml").write_text(MISSION)
    return "mission.yaml"


@pytest.mark.full
def test_it_is_the_mission_that_a_launcher_of_all_parts_flies_to_the_last_bit(
    start, router: str, mission: str, tmp_path: Path
) -> None:
    whole = start("sitl", "fly", mission, "--policy", "homing", "--json", "--trace", cwd=tmp_path)
    assert whole.ended() == 0
    script = load(tmp_path / mission).changed({"agent.policy": "homing"})
    for service, words in (
        ("estimator", estimator_arguments(Launch(script=script))),
        ("agent", agent_arguments(Launch(script=script))),
    ):
        start(service, "--connect", router, *words)
    joined = start("sitl", "fly", mission, "--connect", router, "--json", "--trace", cwd=tmp_path)
    assert joined.ended() == 0, "".join(joined.err)
    one, other = (json.loads(part.out[-1]) for part in (whole, joined))
    assert (
        one["policy"] == other["policy"] == "homing"
    )  # reported by the agent: this command line does not name it
    assert {**one, "search_time_s": 0} == {**other, "search_time_s": 0}
    (summary,) = (tmp_path / "runs").glob("*-connected-*.json")
    assert json.loads(summary.read_text())["mission"]["agent"]["policy"] == "homing"
    assert len(list((tmp_path / "runs").glob("*-connected-*.mcap"))) == 1


@pytest.mark.full
def test_a_search_by_two_joins_services_elsewhere_to_the_last_bit(start, router: str, tmp_path: Path) -> None:
    fleet = "agent: {budget: 4}\nfleet: {vehicles: 2, formation: corners}\n"
    (tmp_path / "two.yaml").write_text(MISSION.replace("expect: located\n", fleet))
    chosen = ["two.yaml", "--json", "--trace", "--no-record"]
    whole = start("sitl", "fly", *chosen, cwd=tmp_path)
    whole.ended()
    mission = Launch(script=load(tmp_path / "two.yaml"))
    joining = ["--connect", router, "--namespace", "search/1"]
    start("estimator", *joining, *estimator_arguments(mission))
    start("agent", *joining, *agent_arguments(mission))
    joined = start("sitl", "fly", *chosen, "--connect", router, cwd=tmp_path)
    joined.ended()
    one, other = (json.loads(part.out[-1]) for part in (whole, joined))
    assert len(one["trace"]) == 10
    assert {**one, "search_time_s": 0} == {**other, "search_time_s": 0}


@pytest.mark.full
def test_an_expectation_that_does_not_hold_is_status_1_and_used_services_fly_no_second_mission(
    start, router: str, mission: str, tmp_path: Path
) -> None:
    services = [start("estimator", "--connect", router), start("agent", "--connect", router)]
    (tmp_path / mission).write_text(MISSION.replace("located", "not ceased"))
    first = start("sitl", "fly", mission, "--connect", router, cwd=tmp_path)
    assert first.ended() == 1
    assert first.out[-1] == "expected not ceased: NO\n"
    second = start("sitl", "fly", mission, "--connect", router, cwd=tmp_path)
    assert second.ended() == 1
    assert "has already flown a mission, to step" in second.err[-1]
    assert all(service.process.poll() is None for service in services)  # they are not ours to end


def test_it_waits_for_services_and_says_for_whom_whatever_else_is_said(
    start, router: str, mission: str, wait_until: Callable, tmp_path: Path
) -> None:
    flight = start("sitl", "fly", mission, "--connect", router, cwd=tmp_path)
    wait_until(lambda: flight.says("waiting for agent and estimator on uav/1"))
    with Stranger(router) as stranger:
        stranger.publisher("health/estimator")(b"noise")
        wait_until(lambda: flight.says("refused health/<service>: "))
    start("estimator", "--connect", router)
    start("agent", "--connect", router)
    assert flight.ended() == 0, "".join(flight.err[-20:] + flight.out[-20:])


@pytest.mark.full
def test_a_service_that_is_lost_is_told_and_the_mission_goes_on_when_it_is_back(
    start, router: str, mission: str, wait_until: Callable, tmp_path: Path
) -> None:
    start("estimator", "--connect", router)
    agent = start("agent", "--connect", router)
    patient = (
        "--patience",
        "300",
        "--silence",
        "300",
    )  # where the machine is busy, an agent takes its time to start
    flight = start("sitl", "fly", mission, "--connect", router, "--speedup", "20", *patient, cwd=tmp_path)
    wait_until(lambda: flight.says("step   0"))
    agent.kill()
    wait_until(lambda: flight.says("warning: the agent is gone"))
    start("agent", "--connect", router)
    wait_until(lambda: flight.says("the agent is back"))
    assert flight.ended() == 0, "".join(flight.err[-20:] + flight.out[-20:])


@pytest.mark.full
def test_ctrl_c_ends_the_vehicle_and_leaves_the_services(
    start, router: str, mission: str, wait_until: Callable, tmp_path: Path
) -> None:
    services = [start("estimator", "--connect", router), start("agent", "--connect", router)]
    flight = start("sitl", "fly", mission, "--connect", router, "--speedup", "1", cwd=tmp_path)
    wait_until(lambda: flight.says("step   0"))
    flight.process.send_signal(signal.SIGINT)
    assert flight.ended() == 130
    assert all(service.process.poll() is None for service in services)


def test_a_second_vehicle_in_the_same_namespace_is_refused(
    start, router: str, mission: str, tmp_path: Path
) -> None:
    with Bus("uav", router):
        flight = start("sitl", "fly", mission, "--connect", router, cwd=tmp_path)
        assert flight.ended() == 1
        assert flight.err[-1] == "error: another uav is already on uav/1\n"


@pytest.mark.one_in(2)
@pytest.mark.parametrize(
    ("services", "flying", "line"),
    [
        ([], ["--vehicles", "2"], "is for 1 vehicle, and 2 would fly: start it with --vehicles 2"),
        (
            ["--vehicles", "3"],
            ["--vehicles", "2"],
            "is for 3 vehicles, and 2 would fly: start it with --vehicles 2",
        ),
    ],
)
def test_an_estimator_for_another_number_of_vehicles_is_refused_on_the_ground(
    start, router: str, services: list[str], flying: list[str], line: str, tmp_path: Path
) -> None:
    joining = ["--connect", router, "--namespace", "search/1"]
    start("estimator", *joining, *services)
    start("agent", *joining)
    flight = start("sitl", "fly", *flying, "--connect", router, "--no-record", cwd=tmp_path)
    assert flight.ended() == 1
    assert flight.err[-1] == f"error: the estimator on search/1 {line}\n"


def test_another_vehicle_in_the_search_is_refused(start, router: str, tmp_path: Path) -> None:
    with Bus("uav", router, "search/1", vehicles=(2,)):
        flight = start("sitl", "fly", "--vehicles", "2", "--connect", router, "--no-record", cwd=tmp_path)
        assert flight.ended() == 1
        assert flight.err[-1] == "error: another uav/2 is already on search/1\n"


@pytest.mark.parametrize(
    ("flags", "line"),
    [
        (
            ["--policy", "ppo"],
            "--connect: agent.policy cannot be chosen: the agent runs elsewhere, with its own flags",
        ),
        (
            ["--particles", "500"],
            "--connect: estimator.particles cannot be chosen: the estimator runs elsewhere, with its own "
            "flags",
        ),
        (["--listen", "tcp/127.0.0.1:0"], "--listen: not with --connect, whose router runs elsewhere"),
        (
            ["missions/link-cut.yaml"],
            "--connect: events[0], cut, cannot happen: it needs parts that this command starts",
        ),
        (
            ["missions/unknown-rate.yaml"],
            "--connect: estimator.assume cannot be chosen: the estimator runs elsewhere, with its own flags",
        ),
        (
            ["--stop", "within:1,0.9"],
            "--connect: estimator.stop cannot be chosen: the estimator runs elsewhere, with its own flags",
        ),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_what_only_own_services_can_do_is_refused_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], flags: list[str], line: str
) -> None:
    assert run_sitl(monkeypatch, capsys, "fly", "--connect", "tcp/127.0.0.1:1", *flags) == (
        2,
        [],
        [f"error: {line}"],
    )


def test_without_a_router_it_is_one_line_and_status_2(start, tmp_path: Path) -> None:
    refused = start("sitl", "fly", "--connect", "tcp/127.0.0.1:1", cwd=tmp_path)
    assert refused.ended() == 2
    assert refused.err == [
        "error: --connect: no router at tcp/127.0.0.1:1 (start one with: plumeward router)\n"
    ]
    assert not (tmp_path / "runs").exists()
