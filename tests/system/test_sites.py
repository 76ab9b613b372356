"""Protects missions between two sites, each with a router of its own: they are one bus, and outlast a cut
between them.
"""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from sitl.launch.mission import Launch, agent_arguments, estimator_arguments
from sitl.launch.relay import Relay
from sitl.script.script import Script

SEED = 11


@pytest.mark.full
def test_a_mission_over_two_sites_outlasts_a_cut_between_them_and_is_the_same(
    start, wait_until: Callable, tmp_path: Path
) -> None:
    undisturbed = start("agent", "rollout", "--seed", str(SEED), "--json", "--trace")
    field = start("sitl", "router", "--listen", "tcp/127.0.0.1:0")
    wait_until(lambda: field.out)
    radio = Relay(field.out[0].strip())
    office = start("sitl", "router", "--listen", "tcp/127.0.0.1:0", "--connect", radio.endpoint)
    wait_until(lambda: office.out)
    mission = Launch(script=Script().changed({"seed": SEED}))
    for service, words in (("estimator", estimator_arguments(mission)), ("agent", agent_arguments(mission))):
        start(service, "--connect", office.out[0].strip(), *words)
    words = "--connect", field.out[0].strip(), "--seed", str(SEED), "--speedup", "20", "--json", "--trace"
    flight = start("sitl", "fly", *words, cwd=tmp_path)
    watch = start(
        "sitl", "status", "--connect", field.out[0].strip(), "--json", "--watch", "--parts", "uav,estimator"
    )

    def parts() -> dict[str, dict]:
        return json.loads(watch.out[-1])["parts"] if watch.out else {}

    wait_until(lambda: parts().get("uav", {}).get("step", -1) >= 2)
    radio.cut()
    wait_until(lambda: parts()["estimator"]["status"] in ("missing", "stale"))
    at = parts()["uav"]["step"]
    radio.restore()
    assert flight.ended() == 0, "".join(flight.err)
    assert undisturbed.ended() == 0
    one, other = (json.loads(part.out[-1]) for part in (undisturbed, flight))
    assert {**one, "search_time_s": 0, "policy": ""} == {**other, "search_time_s": 0, "policy": ""}
    assert at < one["steps"]  # it was cut in mid-search
    radio.close()


def test_a_secured_router_joins_no_other(start) -> None:
    part = start("sitl", "router", "--connect", "tcp/127.0.0.1:1", "--secure", "certificates")
    assert part.ended() == 2
    assert part.err == ["error: --connect: not with --secure, whose rules admit no other router\n"]
