"""Protects the demonstration that needs no autopilot: `plumeward uav --out`, without a bus, is flown by
`plumeward fly --vehicle`.
"""

import json
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from link.bus.mavlink import unpack_reading
from link.record.reader import read
from plume.scenario import draw
from plume.worlds.world import World
from tests.clients.installed import free_udp_port
from tests.system.conftest import Part
from tests.system.live import run_sitl

SPEEDUP = ("--speedup", "20")
SEED, ITS_SEED = 3000956, 7


@pytest.mark.full
def test_the_projects_own_vehicle_is_flown_to_the_source_in_its_own_wind_and_the_record_verifies(
    start: type[Part],
    tmp_path: Path,
    wait_until: Callable[..., None],
    family: Callable[[int], dict[str, int]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    port = free_udp_port()
    flown = (
        "--vehicle",
        f"udpin:127.0.0.1:{port}",
        "--seed",
        str(SEED),
        *SPEEDUP,
        "--json",
        "--record",
        "flight.mcap",
    )
    flight = start("sitl", "fly", *flown, cwd=tmp_path)
    vehicle = start(
        "sitl", "uav", "--out", f"udpout:127.0.0.1:{port}", "--seed", str(ITS_SEED), *SPEEDUP, cwd=tmp_path
    )
    flight.comes_to("step   0/300")
    parts = [*family(flight.process.pid).values(), flight.process.pid, vehicle.process.pid]
    assert len(parts) >= 7, (
        "router, recorder, estimator, agent, payload, uav of the search, and the other side"
    )
    assert flight.ended() == 0, "".join(flight.err)
    said = json.loads(flight.out[-1])
    assert said["located"] is True
    assert said["error_m"] <= 1.0
    assert said["source"] == pytest.approx(draw(SEED).source)
    readings = [
        unpack_reading(entry.payload)
        for entry in read(tmp_path / "flight.mcap").entries
        if entry.key == "reading"
    ]
    assert {reading.wind for reading in readings} == {World(draw(ITS_SEED), ITS_SEED).wind}
    vehicle.process.send_signal(signal.SIGINT)
    vehicle.ended()
    assert not vehicle.says("Traceback")
    assert not [pid for pid in parts if Path(f"/proc/{pid}").exists()]
    status, out, err = run_sitl(
        monkeypatch, capsys, "replay", str(tmp_path / "flight.mcap"), "--verify", "--speedup", "0", "--json"
    )
    assert status == 0, err
    assert json.loads(out[-1])["verified"]
