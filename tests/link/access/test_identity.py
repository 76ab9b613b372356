"""Protects the checks before a connection: a certificate that cannot be used is refused in one line that
names it.
"""

import datetime
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from link.access.authority import make
from link.access.identity import AccessError, secured, why_not

LONG_AGO = datetime.datetime(2000, 1, 1, tzinfo=datetime.UTC)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    make(tmp_path / "good", [1])
    return tmp_path / "good"


def copied(source: Path, folder: Path, name: str) -> None:
    for ending in ("pem", "key"):
        shutil.copy(source.with_name(f"{source.name}.{ending}"), folder / f"{name}.{ending}")


def anothers(folder: Path) -> None:
    copied(folder / "uav" / "1" / "estimator", folder, "uav/1/agent")


def of_another_ca(folder: Path) -> None:
    make(folder.parent / "other", [1])
    copied(folder.parent / "other" / "uav" / "1" / "agent", folder, "uav/1/agent")


def with_the_key_of_another(folder: Path) -> None:
    shutil.copy(folder / "operator.key", folder / "uav/1/agent.key")


def expired(folder: Path) -> None:
    shutil.rmtree(folder)
    make(folder, [1], now=datetime.datetime.now(datetime.UTC) - datetime.timedelta(days=400))


def expired_with_its_ca(folder: Path) -> None:
    shutil.rmtree(folder)
    make(folder, [1], now=LONG_AGO)


def of_tomorrow(folder: Path) -> None:
    shutil.rmtree(folder)
    make(folder, [1], now=datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=1))


def a_pipe(folder: Path) -> None:
    (folder / "uav/1/agent.key").unlink()
    os.mkfifo(folder / "uav/1/agent.key")


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (
            lambda folder: (folder / "uav/1/agent.pem").unlink(),
            r"cannot read .*uav/1/agent\.pem: No such file .*certs .* --vehicles 1\)",
        ),
        (
            lambda folder: (folder / "uav/1/agent.key").unlink(),
            r"cannot read .*uav/1/agent\.key: No such file",
        ),
        (a_pipe, r"cannot read .*uav/1/agent\.key: it is not a file"),
        (lambda folder: (folder / "ca.pem").unlink(), r"cannot read .*ca\.pem: No such file"),
        (
            lambda folder: (folder / "uav/1/agent.pem").write_text("-"),
            r"uav/1/agent\.pem or ca\.pem beside it is not a certificate",
        ),
        (anothers, r"uav/1/agent\.pem is the certificate of 'uav/1/estimator'; wanted that of 'uav/1/agent'"),
        (of_another_ca, r"uav/1/agent\.pem is not from the CA of .*ca\.pem"),
        (
            with_the_key_of_another,
            r"uav/1/agent\.key is not the key of .*uav/1/agent\.pem \(delete both and run: plumeward certs ",
        ),
        (
            lambda folder: (folder / "uav/1/agent.key").write_text("-"),
            r"uav/1/agent\.key is not the key of .*uav/1/agent\.pem",
        ),
        (expired, r"uav/1/agent\.pem expired on \d{4}-\d\d-\d\d \(delete it and run: plumeward certs "),
        (expired_with_its_ca, r"ca\.pem expired on 2009-12-2\d \(make a new CA"),
        (of_tomorrow, r"ca\.pem is not valid before "),
    ],
)
def test_a_certificate_that_cannot_be_used_is_named(
    folder: Path, spoil: Callable[[Path], None], reason: str
) -> None:
    assert secured("--connect", "tls/127.0.0.1:7447", folder, "agent", "uav/1")[1]
    spoil(folder)
    with pytest.raises(AccessError, match=rf"^--secure: .*{reason}"):
        secured("--connect", "tls/127.0.0.1:7447", folder, "agent", "uav/1")


@pytest.mark.parametrize("namespace", ["fleet/uav/1", "uav", "uav/0", "uav/65", "uav/01", ""])
def test_a_vehicle_has_a_number(folder: Path, namespace: str) -> None:
    with pytest.raises(
        AccessError, match=r"^--namespace: .* is not allowed with --secure; wanted uav/1 to uav/64"
    ):
        secured("--connect", "tls/127.0.0.1:7447", folder, "agent", namespace)


@pytest.mark.parametrize(
    ("service", "space", "wanted"),
    [
        ("estimator", "search/9", "search/1 to search/8"),
        ("estimator", "search/1/uav/1", "search/1 to search/8"),
        ("uav", "search/1", "search/1/uav/1 to search/8/uav/8"),
        ("uav", "search/1/uav/9", "search/1/uav/1 to search/8/uav/8"),
    ],
)
def test_a_search_and_its_vehicles_have_numbers(folder: Path, service: str, space: str, wanted: str) -> None:
    with pytest.raises(AccessError, match=f"'{space}' is not allowed .* in a search of several {wanted}$"):
        secured("--connect", "tls/127.0.0.1:7447", folder, service, space)


@pytest.mark.parametrize(
    ("service", "space", "flags"),
    [
        ("estimator", "search/2", "--search 2"),
        ("uav", "search/2/uav/3", "--search 2 --vehicles 3"),
    ],
)
def test_a_missing_certificate_of_a_search_is_named_with_what_makes_it(
    folder: Path, service: str, space: str, flags: str
) -> None:
    with pytest.raises(AccessError, match=rf"cannot read .*plumeward certs \S+ {flags}\)$"):
        secured("--connect", "tls/127.0.0.1:7447", folder, service, space)
    make(folder, [3], search=2)
    known = secured("--connect", "tls/127.0.0.1:7447", folder, service, space)[1]
    assert known
    assert known.name == f"{space}/{known.role}"


@pytest.mark.parametrize(
    ("service", "name"),
    [
        ("uav", "uav/1/vehicle"),
        ("estimator", "uav/1/estimator"),
        ("agent", "uav/1/agent"),
        ("payload", "uav/1/payload"),
        ("bridge", "uav/1/bridge"),
        ("view", "operator"),
        ("mission", "operator"),
        ("recorder", "observer"),
        ("status", "observer"),
        ("stranger", "observer"),
        ("router", "router"),
    ],
)
def test_each_service_shows_the_certificate_of_its_role(folder: Path, service: str, name: str) -> None:
    known = secured("--connect", "tls/127.0.0.1:7447", folder, service, "uav/1")[1]
    assert known
    assert known.name == name


def test_with_certificates_tcp_means_tls(folder: Path) -> None:
    assert secured("--connect", "tcp/127.0.0.1:7447", folder, "agent", "uav/1")[0] == "tls/127.0.0.1:7447"
    for endpoint in ("udp/127.0.0.1:7447", "quic/127.0.0.1:7447", "7447"):
        with pytest.raises(AccessError, match="is not allowed with --secure; wanted tls/HOST:PORT"):
            secured("--connect", endpoint, folder, "agent", "uav/1")


def test_tls_needs_certificates() -> None:
    with pytest.raises(
        AccessError, match=r"^--listen: 'tls/127\.0\.0\.1:7447' is not allowed without --secure DIR"
    ):
        secured("--listen", "tls/127.0.0.1:7447", None, "router", None)


def test_a_certificate_that_is_gone_when_the_router_is_asked_why_raises_nothing(folder: Path) -> None:
    known = secured("--connect", "tls/127.0.0.1:1", folder, "agent", "uav/1")[1]
    shutil.rmtree(folder)
    assert why_not("tls/127.0.0.1:1", known) == ""
