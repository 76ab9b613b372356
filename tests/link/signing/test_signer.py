"""Protects a signed link: what it refuses and why, what it lets through, and that refusals are told
without end to nobody.
"""

import hashlib
from collections.abc import Iterator
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common as mavlink

from link.bus.log import Log
from link.bus.tally import Tally
from link.signing.signature import link_and_timestamp, signed
from link.signing.signer import FAR_AHEAD, MOST_TOLD, OLD, UNSIGNED, WRONG, Signer, Signing
from link.signing.timestamps import clock

KEY = hashlib.sha256(b"passphrase").digest()
URL, ME = "udpin:127.0.0.1:14550", "127.0.0.1:54321"


@pytest.fixture
def log() -> Log:
    return Log("uav", "uav/1", Tally())


@pytest.fixture
def signer(tmp_path: Path, log: Log) -> Iterator[Signer]:
    (tmp_path / "fleet.key").write_text("passphrase\n")
    (tmp_path / "fleet.key").chmod(0o600)
    signing = Signing(str(tmp_path / "fleet.key"), "uav-1", log)
    yield signing.link(URL)
    signing.close()


def plain(message=None, mavlink1: bool = False, system: int = 255) -> bytes:
    message = message or mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
    return bytes(
        message.pack(mavlink.MAVLink(None, srcSystem=system, srcComponent=190), force_mavlink1=mavlink1)
    )


RADIO = mavlink.MAVLink_radio_status_message(1, 2, 3, 4, 5, 6, 7)


def told(capsys: pytest.CaptureFixture[str]) -> list[str]:
    return [
        line.partition("event=")[2].strip().strip('"')
        for line in capsys.readouterr().err.splitlines()
        if "level=warning" in line
    ]


def test_what_has_the_key_and_is_new_is_let_through(signer: Signer, log: Log) -> None:
    assert signer.admits(signed(plain(), KEY, 0, clock()), ME)
    assert signer.tell(log) == {}
    assert not log.tally.refused


@pytest.mark.parametrize("mavlink1", [False, True])
def test_what_is_not_signed_is_refused(mavlink1: bool, signer: Signer, log: Log) -> None:
    assert not signer.admits(plain(mavlink1=mavlink1), ME)
    assert signer.tell(log) == {UNSIGNED: 1}


def test_another_key_is_refused_and_does_not_move_the_timestamps(signer: Signer, log: Log) -> None:
    now = clock()
    assert not signer.admits(signed(plain(), b"?" * 32, 0, now + 10**9), ME)
    assert signer.tell(log) == {WRONG: 1}
    assert signer.admits(signed(plain(), KEY, 0, now), ME)
    assert link_and_timestamp(signer.sign(plain()))[1] < now + 10**9


def test_a_repeated_frame_is_refused(signer: Signer, log: Log) -> None:
    captured = signed(plain(), KEY, 0, clock())
    assert signer.admits(captured, ME)
    assert not signer.admits(captured, "10.0.0.66:1")
    assert signer.tell(log) == {OLD: 1}


def test_a_frame_of_the_far_future_is_refused_and_named_and_signing_goes_on(
    signer: Signer, log: Log, capsys: pytest.CaptureFixture[str]
) -> None:
    assert not signer.admits(signed(plain(), KEY, 0, 2**48 - 1), ME)
    assert signer.tell(log) == {FAR_AHEAD: 1}
    assert told(capsys) == [
        f"{URL}: {ME}: frames with a timestamp more than 10 minutes ahead of this machine's clock are refused"
    ]
    assert signer.admits(signed(plain(), KEY, 0, clock()), ME)
    assert abs(link_and_timestamp(signer.sign(plain()))[1] - clock()) < 60 * 100_000


def test_own_frames_that_a_stranger_plays_back_are_refused_also_after_a_restart(
    tmp_path: Path, log: Log
) -> None:
    (tmp_path / "key").write_text("passphrase")
    said: list[bytes] = []
    for _ in range(2):
        signing = Signing(str(tmp_path / "key"), "bridge-uav-1", log)
        station_link, vehicle_link = (
            signing.link("udpin:127.0.0.1:14550"),
            signing.link("udpout:10.0.0.1:14550"),
        )
        assert not any(link.admits(frame, ME) for frame in said for link in (station_link, vehicle_link))
        said += [link.sign(plain(system=255)) for link in (station_link, vehicle_link) for _ in range(3)]
        assert not any(link.admits(frame, ME) for frame in said for link in (station_link, vehicle_link))
        signing.close()


@pytest.mark.parametrize("mavlink1", [False, True])
def test_a_radio_needs_no_signature_but_a_wrong_one_is_refused(mavlink1: bool, signer: Signer) -> None:
    assert signer.admits(plain(RADIO, mavlink1=mavlink1), ME)
    assert not signer.admits(signed(plain(RADIO), b"?" * 32, 0, clock()), ME)


def test_mavlink_1_is_not_sent(signer: Signer) -> None:
    assert signer.sign(plain(mavlink1=True)) == b""


def test_each_link_of_a_process_has_an_id_of_its_own_and_all_share_one_order_in_time(
    tmp_path: Path, log: Log
) -> None:
    (tmp_path / "key").write_text("passphrase")
    signing = Signing(str(tmp_path / "key"), "uav-1", log)
    said = [
        link_and_timestamp(link.sign(plain()))
        for link in [signing.link(f"udpin:h:{port}") for port in range(256)]
    ]
    signing.close()
    assert len({number for number, _ in said}) == 256
    assert [at for _, at in said] == sorted({at for _, at in said})


def test_each_sender_is_named_once_for_each_reason_and_all_frames_are_counted(
    signer: Signer, log: Log, capsys: pytest.CaptureFixture[str]
) -> None:
    for _ in range(5):
        signer.admits(plain(), ME)
    signer.admits(signed(plain(), b"?" * 32, 0, 1), ME)
    signer.tell(log)
    signer.admits(plain(), ME)
    signer.tell(log)
    assert told(capsys) == [
        f"{URL}: {ME}: frames without a signature are refused",
        f"{URL}: {ME}: frames with a wrong signature are refused",
    ]
    assert log.tally.refused == {f"without a signature ({URL})": 6, f"with a wrong signature ({URL})": 1}
    assert log.tally.refused_lately == 7


def test_a_flood_of_forged_senders_fills_neither_the_log_nor_memory(
    signer: Signer, log: Log, capsys: pytest.CaptureFixture[str]
) -> None:
    for port in range(1000):
        signer.admits(plain(), f"10.0.0.66:{port}")
    signer.tell(log)
    lines = told(capsys)
    assert len(lines) == MOST_TOLD + 1
    assert lines[-1] == f"{URL}: more senders are refused; they are only counted from now on"
    assert log.tally.refused == {f"without a signature ({URL})": 1000}


def test_a_key_that_all_may_read_and_a_clock_that_was_set_back_are_warned_of_in_a_line_each(
    tmp_path: Path, log: Log, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "fleet.key"
    path.write_text("passphrase")
    path.chmod(0o644)
    first = Signing(str(path), "uav-1", log)
    assert told(capsys) == [f"'{path}' is open to every user of this machine: chmod 600 {path}"]
    first.link(URL).admits(signed(plain(), KEY, 0, clock() + 9 * 60 * 100_000), ME)
    first.close()
    Signing(str(path), "uav-1", log).close()
    assert "s ahead of the clock" in told(capsys)[-1]
