"""Certificates for the tests of access: a folder of a CA's, and raw Zenoh sessions that use any of them,
past all our own checks.
"""

import json
from pathlib import Path

import zenoh

TIMEOUT_MS = 20_000
"""For who is admitted: on a busy machine that takes seconds."""
REFUSED_MS = 400
"""For who is not: Zenoh tries until the time is over."""


def session(
    endpoint: str, folder: Path | None, name: str | None, namespace: str = "", **settings: object
) -> zenoh.Session:
    """Join a router with a certificate of a folder, or with none; raises zenoh.ZError."""
    config = zenoh.Config()
    tls: dict[str, object] = {"enable_mtls": name is not None, "verify_name_on_connect": False}
    if folder:
        tls["root_ca_certificate"] = str(folder / "ca.pem")
    if folder and name:
        tls |= {
            "connect_certificate": str(folder / f"{name}.pem"),
            "connect_private_key": str(folder / f"{name}.key"),
        }
    values: dict[str, object] = {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": TIMEOUT_MS,
        "scouting/multicast/enabled": False,
        **({"transport/link/tls": tls} if folder else {}),
        **({"namespace": namespace} if namespace else {}),
        **settings,
    }
    for key, value in values.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def rogue(folder: Path, name: str) -> zenoh.Session:
    """A router with a certificate of a folder, whatever it is meant for, and without rules."""
    config = zenoh.Config()
    tls = {
        "listen_certificate": str(folder / f"{name}.pem"),
        "listen_private_key": str(folder / f"{name}.key"),
    }
    for key, value in {
        "mode": "router",
        "listen/endpoints": ["tls/127.0.0.1:0"],
        "scouting/multicast/enabled": False,
        "adminspace/enabled": True,
        "transport/link/tls": tls,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def endpoint_of(router: zenoh.Session) -> str:
    """Where a router of this process listens."""
    replies = [
        json.loads(reply.ok.payload.to_bytes())
        for reply in router.get(f"@/{router.zid()}/router")
        if reply.ok
    ]
    return str(replies[0]["locators"][0])
