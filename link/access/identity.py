"""A service's own certificate: found, checked and given to Zenoh; and why a router was not reached."""

import datetime
import errno
import socket
import ssl
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from link.access.reach import host_and_port
from link.access.roles import (
    NAMESPACES,
    OF_A_SEARCH,
    OF_A_VEHICLE,
    ROUTER,
    SEARCHERS,
    SEARCHES,
    SERVICES,
    common_name,
    is_search,
    role_of,
    spaces_of,
)

if TYPE_CHECKING:
    from cryptography.x509 import Certificate

PROBE_S = 1.0  # how long a router that does not answer is asked why


class AccessError(Exception):
    """A certificate is missing, or cannot be made or used; the text is one line."""


class Identity(NamedTuple):
    """A certificate that may be used now."""

    folder: Path
    role: str
    name: str  # its common name, such as uav/1/agent
    tls: dict[str, Any]  # zenoh's `transport/link/tls`
    until: datetime.datetime  # when it expires, or its CA does

    def expiry(self) -> str:
        """Return that it has expired, which closes its link, and what to do then.

        Empty if it is still valid.
        """
        words = (
            f"the certificate {self.name} expired on {self.until:%Y-%m-%d}: renew it with plumeward "
            "certs, and start this part again"
        )
        return words if datetime.datetime.now(datetime.UTC) > self.until else ""

    def lack(self, roles: tuple[str, ...], what: str, service: str | None = None) -> str:
        """Return which right it lacks to do `what`, if only these roles may; empty if none.

        With a service, it must be of its role too.
        """
        may = self.role in roles and (service is None or service in SERVICES[self.role])
        return "" if may else f"the certificate {self.name} has no right to {what}: the router drops it"


def secured(
    flag: str, endpoint: str, folder: Path | None, service: str, namespace: str | None
) -> tuple[str, Identity | None]:
    """Return the endpoint and the certificate to use for it, None without --secure.

    Raises AccessError if they do not fit.
    """
    if folder is None:
        if endpoint.startswith("tls/"):
            raise AccessError(f"{flag}: {endpoint!r} is not allowed without --secure DIR")
        return endpoint, None
    protocol, _, address = endpoint.partition("/")
    if protocol not in ("tcp", "tls"):
        raise AccessError(f"{flag}: {endpoint!r} is not allowed with --secure; wanted tls/HOST:PORT")
    return f"tls/{address}", identity(folder, service, namespace)


def identity(folder: Path, service: str, namespace: str | None) -> Identity:
    """Return the certificate of a service, or of the router; raises AccessError if it cannot be used."""
    role = ROUTER if service == ROUTER else role_of(service)
    if role in OF_A_VEHICLE and namespace not in spaces_of(role):
        of_one, of_several = NAMESPACES, SEARCHES if role in OF_A_SEARCH else SEARCHERS
        raise AccessError(
            f"--namespace: {namespace!r} is not allowed with --secure; wanted "
            f"{of_one[0]} to {of_one[-1]}, in a search of several {of_several[0]} to {of_several[-1]}"
        )
    name = common_name(role, namespace)
    until = _check(folder, name, namespace if role in OF_A_VEHICLE else None)
    side = "listen" if role == ROUTER else "connect"
    tls = {
        "root_ca_certificate": str(folder / "ca.pem"),
        f"{side}_certificate": str(folder / f"{name}.pem"),
        f"{side}_private_key": str(folder / f"{name}.key"),
        "enable_mtls": True,
        "close_link_on_expiration": True,
        # Zenoh's clients also trust the public CAs of browsers: only the router's name keeps their
        # certificates out.
        "verify_name_on_connect": True,
    }
    return Identity(folder, role, name, tls, until)


def _check(folder: Path, name: str, namespace: str | None) -> datetime.datetime:
    """Return until when a certificate is valid.

    Raise AccessError if it is missing, another's, of another CA or not valid now.
    """
    from cryptography import x509  # takes time to load, and only --secure needs it
    from cryptography.hazmat.primitives.serialization import load_pem_private_key
    from cryptography.x509.oid import NameOID

    path = folder / f"{name}.pem"
    try:
        *pems, secret = map(contents, (folder / "ca.pem", path, path.with_suffix(".key")))
    except OSError as error:
        more = _making(namespace) if namespace else ""
        raise AccessError(
            f"--secure: cannot read {error.filename}: {error.strerror} (make it with: plumeward certs "
            f"{folder}{more})"
        ) from None
    try:
        ca, own = map(x509.load_pem_x509_certificate, pems)
        (named,) = own.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    except ValueError:
        raise AccessError(f"--secure: {path} or ca.pem beside it is not a certificate") from None
    try:
        key = load_pem_private_key(secret, None)
    except (ValueError, TypeError):  # none, or one with a password
        key = None
    now = datetime.datetime.now(datetime.UTC)
    faults = [
        (named.value != name, f"{path} is the certificate of {named.value!r}; wanted that of {name!r}"),
        (not issued(own, ca), f"{path} is not from the CA of {folder / 'ca.pem'}"),
        (
            key is None or key.public_key() != own.public_key(),
            f"{path.with_suffix('.key')} is not the key of {path} (delete both and run: plumeward certs "
            f"{folder})",
        ),
    ]
    for it, where, remedy in (
        (ca, folder / "ca.pem", "make a new CA, in another folder"),
        (own, path, f"delete it and run: plumeward certs {folder}"),
    ):
        begins, ends = it.not_valid_before_utc, it.not_valid_after_utc
        faults += [
            (now > ends, f"{where} expired on {ends:%Y-%m-%d} ({remedy})"),
            (now < begins, f"{where} is not valid before {begins:%Y-%m-%d %H:%M} UTC"),
        ]
    for is_so, fault in faults:
        if is_so:
            raise AccessError(f"--secure: {fault}")
    return min(ca.not_valid_after_utc, own.not_valid_after_utc)


def contents(path: Path) -> bytes:
    """Return what a file holds. Raises OSError, also of a pipe or a device, which may never end."""
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "it is not a file", str(path))
    return path.read_bytes()


def _making(space: str) -> str:
    """Return the flags of `plumeward certs` that make the certificates of a space of keys."""
    search, _, number = space.removeprefix("search/").partition("/uav/")
    if not is_search(space):
        return f" --vehicles {space.removeprefix('uav/')}"
    return f" --search {search}" + f" --vehicles {number}" * bool(number)


def issued(certificate: "Certificate", ca: "Certificate") -> bool:
    """Whether a CA has signed a certificate."""
    from cryptography.exceptions import InvalidSignature

    try:
        certificate.verify_directly_issued_by(ca)
    except (ValueError, TypeError, InvalidSignature):
        return False
    return True


# ---- why a router was not reached ----


def why_not(endpoint: str, known: Identity | None) -> str:
    """Return why a router cannot be joined that somebody answers for; empty if nobody answers."""
    host, port = host_and_port(endpoint.partition("/")[2])
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = known is not None
    context.verify_mode = ssl.CERT_NONE if known is None else ssl.CERT_REQUIRED
    try:
        if known:
            context.load_verify_locations(known.tls["root_ca_certificate"])
            context.load_cert_chain(known.tls["connect_certificate"], known.tls["connect_private_key"])
        with socket.create_connection((host, int(port)), timeout=PROBE_S) as plain:
            return _handshake(context, plain, host, known)
    except (OSError, ValueError):
        return ""


def is_refused(endpoint: str) -> bool:
    """Whether nobody listens at an endpoint.

    Where packets are lost, or who listens is slow, nobody has refused yet.
    """
    host, port = host_and_port(endpoint.partition("/")[2])
    try:
        socket.create_connection((host, int(port)), timeout=PROBE_S).close()
    except TimeoutError:
        return False
    except (OSError, ValueError):
        return True
    return False


def _handshake(context: ssl.SSLContext, plain: socket.socket, host: str, known: Identity | None) -> str:
    try:
        secret = context.wrap_socket(plain, server_hostname=host)
    except ssl.SSLCertVerificationError as error:
        return _of_the_router(error.verify_message, host, known) if known else ""
    except OSError as error:
        if known is None:
            return ""
        flooded = "; or connections flood it" * isinstance(error, TimeoutError)
        return _refusal(error, known) or f"it does not speak TLS: start it with --secure too{flooded}"
    with secret:
        if known is None:
            return "it wants TLS: give --secure DIR"
        try:
            secret.recv(1)  # a refusal comes after the handshake
        except OSError as error:
            return _refusal(error, known)
        return ""


def _refusal(error: OSError, known: Identity) -> str:
    """Return what a router's alert says of our certificate; empty if there is none."""
    _, alert, said = (getattr(error, "reason", None) or "").partition("ALERT_")
    return f"it refuses the certificate {known.name}: {said.lower().replace('_', ' ')}" if alert else ""


def _of_the_router(said: str, host: str, known: Identity) -> str:
    meant = {
        "mismatch": f"is not for {host} (make one with: plumeward certs {known.folder} --router {host}, "
        "after deleting it)",
        "purpose": "is not a router's",
        "expired": "has expired",
        "": f"is not from the CA of {known.folder / 'ca.pem'}",  # whatever else is said
    }
    return f"its certificate {next(fault for word, fault in meant.items() if word in said)}"
