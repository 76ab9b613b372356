"""Protects the development CA: what its certificates are good for, who can read its keys, and that nothing
is overwritten unasked.
"""

import datetime
import os
import shutil
import ssl
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from link.access.authority import host, make
from link.access.identity import AccessError

ROLES = ["vehicle", "estimator", "agent", "payload", "bridge", "ros2"]


def shakes_hands(folder: Path, server: str, client: str | None, name: str = "127.0.0.1") -> bool:
    """Whether Python's own TLS accepts both sides, each by the CA of the folder."""
    ours, theirs = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT), ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    theirs.verify_mode = ssl.CERT_REQUIRED
    for context, who in ((ours, client), (theirs, server)):
        context.load_verify_locations(folder / "ca.pem")
        if who:
            context.load_cert_chain(folder / f"{who}.pem", folder / f"{who}.key")
    wires = ssl.MemoryBIO(), ssl.MemoryBIO()
    sides = [ours.wrap_bio(*wires, server_hostname=name), theirs.wrap_bio(*reversed(wires), server_side=True)]
    for _ in range(4):
        for side in tuple(sides):
            try:
                side.do_handshake()
                sides.remove(side)
            except ssl.SSLWantReadError:
                pass
            except ssl.SSLError:
                return False
    return not sides


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("certificates")
    make(path, [1, 2])
    return path


@pytest.mark.parametrize(
    "client",
    ["operator", "observer", "ros", *(f"uav/{number}/{role}" for number in (1, 2) for role in ROLES)],
)
def test_each_role_of_each_vehicle_is_let_in_by_the_router(folder: Path, client: str) -> None:
    assert shakes_hands(folder, "router", client)


@pytest.mark.parametrize(
    ("server", "client", "name"),
    [
        ("router", None, "127.0.0.1"),  # no certificate
        ("router", "router", "127.0.0.1"),  # a router's serves for no client
        ("uav/1/vehicle", "uav/1/agent", "127.0.0.1"),  # and a client's for no router
        ("router", "uav/1/agent", "127.0.0.2"),  # not an address of the router
    ],
)
def test_a_certificate_serves_for_nothing_else(
    folder: Path, server: str, client: str | None, name: str
) -> None:
    assert not shakes_hands(folder, server, client, name)


def test_another_ca_is_a_stranger(folder: Path, tmp_path: Path) -> None:
    make(tmp_path, [1])
    for file in ("ca.pem", "router.pem", "router.key"):
        (tmp_path / file).write_bytes((folder / file).read_bytes())
    assert shakes_hands(tmp_path, "router", None) is False
    assert shakes_hands(tmp_path, "router", "uav/1/agent") is False


def test_only_their_owner_can_read_the_keys(folder: Path) -> None:
    keys = sorted(folder.rglob("*.key"))
    assert len(keys) == 1 + 4 + 2 * len(ROLES)
    assert {stat.S_IMODE(key.stat().st_mode) for key in keys} == {0o600}


def test_certificates_and_keys_are_on_the_disk_before_they_have_their_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept: list[tuple[str, int]] = []
    monkeypatch.setattr(
        os, "fsync", lambda file: kept.append((os.readlink(f"/proc/self/fd/{file}"), os.fstat(file).st_size))
    )
    make(tmp_path, [1])
    whole = {path: path.stat().st_size for path in tmp_path.rglob("*") if path.is_file()}
    assert {Path(name.removesuffix(f".{os.getpid()}.partial")): size for name, size in kept} == whole


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_what_is_there_stays_and_what_is_missing_is_made_by_the_same_ca(tmp_path: Path) -> None:
    make(tmp_path, [1])
    before = contents(tmp_path)
    for file in ("agent.pem", "agent.key"):
        (tmp_path / "uav" / "1" / file).unlink()
    made = make(tmp_path, [1, 2])
    assert [one.name for one in made if one.new] == ["uav/1/agent", *(f"uav/2/{role}" for role in ROLES)]
    after = contents(tmp_path)
    assert {name for name in before if after[name] != before[name]} == {"uav/1/agent.pem", "uav/1/agent.key"}
    assert shakes_hands(tmp_path, "router", "uav/1/agent")


def test_several_at_once_make_one_ca(tmp_path: Path) -> None:
    loaded = (
        "import sys; from pathlib import Path; from link.access.authority import make; print(flush=True); "
    )
    command = [sys.executable, "-c", loaded + "input(); make(Path(sys.argv[1]), [int(sys.argv[2])])"]
    makers = [
        subprocess.Popen(
            [*command, str(tmp_path / "new"), str(number)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for number in (1, 2, 3)
    ]
    for maker in makers:
        assert maker.stdout
        maker.stdout.readline()
    for maker in makers:
        assert maker.stdin
        maker.stdin.write("\n")
        maker.stdin.flush()
    for maker in makers:
        maker.communicate(timeout=400)
    assert [maker.returncode for maker in makers] == [0, 0, 0]
    assert not any(one.new for one in make(tmp_path / "new", [1, 2, 3]))  # which refuses those of another CA


def test_force_makes_all_but_the_ca_anew(tmp_path: Path) -> None:
    make(tmp_path, [1])
    before = contents(tmp_path)
    make(tmp_path, [1], force=True)
    after = contents(tmp_path)
    assert {name for name in before if after[name] == before[name]} == {"ca.pem", "ca.key"}
    assert shakes_hands(tmp_path, "router", "operator")


def test_certificates_end_when_they_are_said_to(tmp_path: Path) -> None:
    now = datetime.datetime(2030, 1, 31, 12, tzinfo=datetime.UTC)
    until = {one.name: one.until for one in make(tmp_path, [1], days=30, now=now)}
    assert until["router"] == until["uav/1/agent"] == datetime.datetime(2030, 3, 2, 12, tzinfo=datetime.UTC)
    late = make(tmp_path, [2], days=3650, now=now + datetime.timedelta(days=3000))
    assert max(one.until for one in late) == until["ca"]  # none outlasts the CA


def test_a_key_without_its_certificate_is_not_overwritten(tmp_path: Path) -> None:
    make(tmp_path, [1])
    (tmp_path / "operator.pem").unlink()
    with pytest.raises(
        AccessError, match=r"operator\.key is there without operator\.pem: delete it, or give --force"
    ):
        make(tmp_path, [1])


def test_where_only_the_certificate_of_the_ca_is_nothing_is_made_and_nobody_is_told_to_delete_it(
    tmp_path: Path,
) -> None:
    make(tmp_path, [1])
    (tmp_path / "ca.key").unlink()
    with pytest.raises(
        AccessError, match=r"ca\.pem is there without ca\.key: certificates are made where both are$"
    ):
        make(tmp_path, [2], force=True)


def test_a_certificate_of_another_ca_is_not_listed_as_kept(tmp_path: Path) -> None:
    make(tmp_path / "one", [1])
    make(tmp_path / "other", [1])
    for file in ("ca.pem", "ca.key"):
        shutil.copy(tmp_path / "other" / file, tmp_path / "one" / file)
    with pytest.raises(
        AccessError,
        match=r"router\.pem is not from the CA of .*ca\.pem: delete it and its key, or give --force",
    ):
        make(tmp_path / "one", [1])


@pytest.mark.parametrize(
    ("file", "content", "reason"),
    [
        ("ca.key", b"-", "is not the key of ca.pem"),
        ("ca.pem", b"-", "is not a certificate"),
        ("router.pem", b"-", "is not a certificate"),
    ],
)
def test_damaged_files_are_named(tmp_path: Path, file: str, content: bytes, reason: str) -> None:
    make(tmp_path, [1])
    (tmp_path / file).write_bytes(content)
    with pytest.raises(AccessError, match=reason) as refused:
        make(tmp_path, [1])
    assert file in str(refused.value)


def test_an_expired_ca_signs_nothing(tmp_path: Path) -> None:
    long_ago = datetime.datetime(2000, 1, 1, tzinfo=datetime.UTC)
    make(tmp_path, [1], now=long_ago)
    with pytest.raises(AccessError, match="has expired: make a new CA"):
        make(tmp_path, [2])


@pytest.mark.parametrize("text", ["localhost", "router", "drone-7.example.org", "10.0.0.1", "::1", "fe80::1"])
def test_names_and_addresses_of_a_router(text: str) -> None:
    assert host(text) == text


@pytest.mark.parametrize(
    "text", ["", "a b", "*", "-a", "a..b", "1.2.3", "256.1.1.1", "tls/router:7447", "router:7447"]
)
def test_what_is_no_name_of_a_router(text: str) -> None:
    with pytest.raises(ValueError, match="wanted a host name or an IP address"):
        host(text)
