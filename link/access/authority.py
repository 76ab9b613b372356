"""The development CA: makes certificates for the router and all roles, each with a key of its own."""

import contextlib
import datetime
import fcntl
import ipaddress
import os
import re
import stat
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from link.access.identity import AccessError, contents, issued
from link.access.roles import FOR_ALL, OF_A_SEARCH, OF_A_VEHICLE, ON_BOARD, ROUTER, common_name

CA = "ca"
CA_DAYS = 3650
# Certificates hold from a little before now: the clocks of two machines differ.
EARLIER = datetime.timedelta(minutes=5)
ROUTER_NAMES = ("localhost", "127.0.0.1", "::1", "router")
REPLACE = "delete it and its key, or give --force"
HOST = re.compile(r"(?!-)[A-Za-z0-9-]{1,63}(?<!-)(\.(?!-)[A-Za-z0-9-]{1,63}(?<!-))*")


class Made(NamedTuple):
    """One certificate and whether it is new."""

    name: str
    until: datetime.datetime
    new: bool


class _Issuer(NamedTuple):
    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey


def host(text: str) -> str:
    """Return a host name or an IP address as it is; raises ValueError if it is neither."""
    try:
        ipaddress.ip_address(text)
    except ValueError:
        if not HOST.fullmatch(text) or re.fullmatch(r"[\d.]+", text):
            raise ValueError(f"{text!r} is not allowed; wanted a host name or an IP address") from None
    return text


def make(
    folder: Path,
    vehicles: Iterable[int],
    hosts: Sequence[str] = ROUTER_NAMES,
    days: int = 365,
    *,
    search: int | None = None,
    force: bool = False,
    now: datetime.datetime | None = None,
) -> list[Made]:
    """Make the CA and all certificates that are not there yet; with `force` all but the CA anew.

    Returns all of them.

    hosts: names and addresses at which clients reach the router.  days: how long the certificates hold.
    search: the number of the search in which the vehicles search together; None: each is alone.
    Raises AccessError if files are damaged or half there, OSError if they cannot be read or written.
    """
    begins = (now or datetime.datetime.now(datetime.UTC)) - EARLIER
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    with _alone_in(folder):
        if new := not _there(folder / CA, force=False):
            _make_ca(folder, begins)
        ca = _read_ca(folder)
        made = [Made(CA, ca.certificate.not_valid_after_utc, new)]
        names = [
            ROUTER,
            *FOR_ALL,
            *_of_vehicles(vehicles, search),
        ]
        until = min(begins + datetime.timedelta(days=days) + EARLIER, ca.certificate.not_valid_after_utc)
        if until <= begins:
            raise AccessError(f"{folder / 'ca.pem'} has expired: make a new CA, in another folder")
        for name in names:
            path = folder / name
            if new := not _there(path, force=force):
                path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
                _issue(path, name, hosts, ca, begins, until)
            certificate = _read(path)
            if not issued(certificate, ca.certificate):
                raise AccessError(f"{files(path)[0]} is not from the CA of {folder / 'ca.pem'}: {REPLACE}")
            made.append(Made(name, certificate.not_valid_after_utc, new))
        return made


@contextlib.contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Wait until no other process makes certificates in a folder: each would make a CA of its own."""
    opened = os.open(folder, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):  # a file system that knows no locks
            fcntl.flock(opened, fcntl.LOCK_EX)
        yield
    finally:
        os.close(opened)


def _of_vehicles(vehicles: Iterable[int], search: int | None) -> Iterable[str]:
    """Yield the names of the certificates of vehicles, and of the search by several."""
    if search is not None:
        yield from (common_name(role, f"search/{search}") for role in OF_A_SEARCH)
    for number in vehicles:
        space = f"uav/{number}" if search is None else f"search/{search}/uav/{number}"
        yield from (common_name(role, space) for role in (OF_A_VEHICLE if search is None else ON_BOARD))


def risks(folder: Path) -> list[str]:
    """Return the ways in which others could read or replace the keys in a folder, a line for each."""
    said = []
    there = folder.resolve()
    if there != Path(os.path.abspath(folder)):
        said.append(
            f"{folder} leads through a link to {there}: a user who may change the link chooses where keys are"
        )
    for place in (there, *there.parents):
        mode = place.stat().st_mode
        # In a sticky folder others cannot rename ours.
        if mode & stat.S_IWOTH and (place == there or not mode & stat.S_ISVTX):
            said.append(
                f"{place} may be written by everybody: others can replace certificates and keys (forbid it "
                f"with: chmod o-w {place})"
            )
    others = stat.S_IROTH | stat.S_IWOTH
    for key in sorted(filter(Path.is_file, there.rglob("*.key"))):
        if key.stat().st_mode & others and all(it.stat().st_mode & stat.S_IXOTH for it in key.parents):
            said.append(f"{key} is open to everybody (forbid it with: chmod o-rw {key})")
    return said


def unnamed(folder: Path, hosts: Iterable[str]) -> list[str]:
    """Return those of these hosts that the router's certificate in a folder does not name."""
    try:
        names = _read(folder / ROUTER).extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return list(hosts)
    return [text for text in hosts if _alternative(text) not in names]


def files(path: Path) -> tuple[Path, Path]:
    """Return the files of a certificate and of its key; `path` is without ending."""
    return path.with_name(f"{path.name}.pem"), path.with_name(f"{path.name}.key")


def _there(path: Path, *, force: bool) -> bool:
    """Return whether a certificate and its key exist and are to stay."""
    there = [file for file in files(path) if os.path.lexists(file)]
    if len(there) == 1 and not force:
        missing = next(file for file in files(path) if file != there[0])
        what = "certificates are made where both are" if path.name == CA else "delete it, or give --force"
        raise AccessError(f"{there[0]} is there without {missing.name}: {what}")
    return bool(there) and not force


def _read(path: Path) -> x509.Certificate:
    pem = files(path)[0]
    try:
        return x509.load_pem_x509_certificate(contents(pem))
    except ValueError:
        what = "make a new CA, in another folder" if path.name == CA else REPLACE
        raise AccessError(f"{pem} is not a certificate: {what}") from None


def _read_ca(folder: Path) -> _Issuer:
    certificate, file = _read(folder / CA), files(folder / CA)[1]
    try:
        key = serialization.load_pem_private_key(contents(file), None)
    except (ValueError, TypeError):
        key = None
    if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != certificate.public_key():
        raise AccessError(f"{file} is not the key of ca.pem")
    return _Issuer(certificate, key)


def _name(text: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)])


def _make_ca(folder: Path, begins: datetime.datetime) -> None:
    key, number = ec.generate_private_key(ec.SECP256R1()), x509.random_serial_number()
    # Its own name: it distinguishes one CA from another.
    name = _name(f"Plumeward development CA {number:x}"[:40])
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(number)
        .not_valid_before(begins)
        .not_valid_after(begins + datetime.timedelta(days=CA_DAYS))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(signs=True), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .sign(key, hashes.SHA256())
    )
    _write(folder / CA, key, certificate)


def _issue(
    path: Path,
    name: str,
    hosts: Sequence[str],
    ca: _Issuer,
    begins: datetime.datetime,
    until: datetime.datetime,
) -> None:
    """Make a certificate.

    A router's is for servers only, all others are for clients only: none can pose as the other.
    """
    key = ec.generate_private_key(ec.SECP256R1())
    serves = ExtendedKeyUsageOID.SERVER_AUTH if name == ROUTER else ExtendedKeyUsageOID.CLIENT_AUTH
    builder = (
        x509.CertificateBuilder()
        .subject_name(_name(name))
        .issuer_name(ca.certificate.subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(begins)
        .not_valid_after(until)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(signs=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage([serves]), critical=False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(ca.key.public_key()), critical=False
        )
    )
    if name == ROUTER:
        builder = builder.add_extension(
            x509.SubjectAlternativeName([_alternative(text) for text in hosts]), critical=False
        )
    _write(path, key, builder.sign(ca.key, hashes.SHA256()))


def _alternative(text: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(text))
    except ValueError:
        return x509.DNSName(text)


def _usage(*, signs: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=signs,
        crl_sign=signs,
        encipher_only=False,
        decipher_only=False,
    )


def _write(path: Path, key: ec.EllipticCurvePrivateKey, certificate: x509.Certificate) -> None:
    pem, secret = files(path)
    _put(
        secret,
        key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        ),
        0o600,
    )
    _put(pem, certificate.public_bytes(serialization.Encoding.PEM), 0o644)


def _put(path: Path, data: bytes, mode: int) -> None:
    """Write a file whole; nobody else can ever read a key."""
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        with os.fdopen(os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())  # else a power cut may leave an empty file
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
