"""Protects that several vehicles fly side by side as PX4's instances do: each with ports, a system id and
a home of its own.
"""

import itertools
import math

import pytest
from pymavlink import mavutil

from tests.system.live import run_sitl

FIRST = 200
"""Number of the first vehicle: the ports of low numbers may be in use."""


def test_three_vehicles_at_once_are_each_found_by_a_client_of_their_own(start) -> None:
    clients = [mavutil.mavlink_connection(f"udpin:127.0.0.1:{14540 + FIRST + n}") for n in range(3)]
    for n in range(3):
        sysid = ["--sysid", "7"] if n == 2 else []
        start("sitl", "uav", "-I", str(FIRST + n), "--out", "udpout:127.0.0.1", *sysid)
    homes = []
    for client, system in zip(clients, (FIRST + 1, FIRST + 2, 7), strict=True):
        at = client.recv_match(type="GLOBAL_POSITION_INT", blocking=True, timeout=400)
        assert at.get_srcSystem() == system
        homes.append((at.lat / 1e7, at.lon / 1e7))
        client.close()
    metres_a_degree = math.radians(6_371_000) * math.cos(math.radians(47.397742))
    steps_m = [(east[1] - west[1]) * metres_a_degree for west, east in itertools.pairwise(homes)]
    assert steps_m == pytest.approx([40.0, 40.0], abs=0.1)
    assert [lat for lat, _ in homes] == pytest.approx([47.397742] * 3, abs=1e-3)
    assert homes[0][1] == pytest.approx(8.545594 + 40 * FIRST / metres_a_degree, abs=1e-4)


def test_a_link_speaks_to_several_places_and_a_home_that_is_chosen_stays(start) -> None:
    clients = [mavutil.mavlink_connection("udpin:127.0.0.1:0") for _ in range(2)]
    outs = [
        word for client in clients for word in ("--out", f"udpout:127.0.0.1:{client.port.getsockname()[1]}")
    ]
    start("sitl", "uav", "-I", "5", "--home=-35.36,149.16,584,90", *outs)
    for client in clients:
        at = client.recv_match(type="GLOBAL_POSITION_INT", blocking=True, timeout=400)
        assert (at.get_srcSystem(), at.lat, at.lon, at.hdg) == (6, -353600000, 1491600000, 9000)
        client.close()


def test_a_vehicle_that_no_client_can_reach_says_first_how_one_could(start, wait_until) -> None:
    uav = start("sitl", "uav", "-I", str(FIRST))
    wait_until(lambda: uav.err)
    assert (
        f"--out udpout:127.0.0.1:{14540 + FIRST} is for MAVSDK: udpin://0.0.0.0:{14540 + FIRST}" in uav.err[0]
    )
    assert "QGroundControl: port 14550" in uav.err[0]


def test_of_vehicles_that_search_together_each_has_the_system_id_of_its_number(start) -> None:
    clients = {number: mavutil.mavlink_connection("udpin:127.0.0.1:0") for number in (1, 2)}
    for number, client in clients.items():
        out = f"udpout:127.0.0.1:{client.port.getsockname()[1]}"
        start("sitl", "uav", "--vehicles", "2", "--number", str(number), "--out", out)
    for number, client in clients.items():
        assert client.wait_heartbeat(timeout=400).get_srcSystem() == number
        client.close()


OF_THREE = "whose system ids follow each other"


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (
            "uav --vehicles 3 --number 3 -I 1",
            f"-I: 1 is not allowed for vehicle 3 of 3, {OF_THREE}; wanted 2 to 254",
        ),
        ("uav --vehicles 3 -I 4", "-I: 4 is not allowed without --number; wanted 0 to 2 (--vehicles)"),
        (
            "uav --vehicles 3 --number 3 --sysid 2",
            f"--sysid: 2 is not allowed for vehicle 3 of 3, {OF_THREE}; wanted 3 to 255",
        ),
        (
            "uav --vehicles 3 --number 1 --sysid 255",
            f"--sysid: 255 is not allowed for vehicle 1 of 3, {OF_THREE}; wanted 1 to 253",
        ),
        ("uav --secure certs -I 64", "-I: 64 is not allowed with --secure; wanted 0 to 63"),
        (
            "uav --secure certs --vehicles 3 --number 2 -I 9",
            "-I: 9 is not allowed with --secure; wanted 0 to 8",
        ),
        (
            "fly --vehicles 3 -I 253",
            f"-I: 253 is not allowed for vehicle 1 of 3, {OF_THREE}; wanted 0 to 252",
        ),
        (
            "fly --vehicles 3 --sysid 254",
            f"--sysid: 254 is not allowed for vehicle 1 of 3, {OF_THREE}; wanted 1 to 253",
        ),
        ("fly --secure certs --vehicles 3 -I 8", "-I: 8 is not allowed with --secure; wanted 0 to 7"),
        ("fly --secure certs -I 64", "-I: 64 is not allowed with --secure; wanted 0 to 63"),
    ],
)
def test_what_gives_one_of_several_no_system_id_or_certificate_is_refused_as_it_was_typed(
    words: str, told: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    status, _, err = run_sitl(monkeypatch, capsys, *words.split())
    assert (status, err) == (2, [f"error: {told}"])


def test_a_chosen_system_id_goes_with_any_number_and_instance(start) -> None:
    client = mavutil.mavlink_connection("udpin:127.0.0.1:0")
    out = f"udpout:127.0.0.1:{client.port.getsockname()[1]}"
    start("sitl", "uav", "--vehicles", "3", "--number", "3", "-I", "1", "--sysid", "9", "--out", out)
    assert client.wait_heartbeat(timeout=400).get_srcSystem() == 9
    client.close()
