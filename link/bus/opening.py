"""How a Zenoh session, the router, and a key's publishers and subscribers are opened: their settings."""

import contextlib
import json
import re
import resource
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zenoh
import zenoh.ext

from link.access.identity import Identity, is_refused, secured, why_not
from link.access.reach import can_be_called, host_and_port
from link.access.roles import ROUTER, Rights, access_control
from link.bus.keys import BELIEF, KEYS, MIB, Delivery

DEFAULT_ROUTER = "tcp/127.0.0.1:7447"
CONNECT_TIMEOUT_S = 5.0
# How much longer a part tries to join unless it is refused: over a link that drops packets it takes several
# seconds.
SLOW_CONNECT_S = 15.0
# Frequent retries bring a restarted router back in 0.5 s instead of 3.5 s.
RETRY = {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2}
# How long a router waits for a client whose queue is full before it cuts the link. Meanwhile the others wait
# too: Zenoh forwards to one client after the other (its issues 1876 and 2585). Its default is 5 s: the stop
# would be that late.
FULL_S = 0.02

# Most bytes of a message: a belief of a million particles with all unknowns has 56 MB. Receivers drop a
# larger one, and keep the link.
MOST_MESSAGE = BELIEF.most_mib * MIB
# Fewest files that a process must be allowed to open: with less than half of them Zenoh panics.
FEWEST_FILES = 64


MOST_QUERY = MIB  # most bytes that a query may carry; ours carry none
MOST_SESSIONS = 1000
# Most connections that join a router at once, and how long each may take. With Zenoh's 100, that many silent
# ones would keep all others out.
MOST_JOINING, JOINING_S = 1000, 10.0


SETTINGS: dict[str, Any] = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "scouting/delay": 0,  # nobody to scout for: a router opens at once instead of after 0.5 s
    "transport/link/tx/lease": 2000,  # a cut link is noticed in 2 s
    # A belief of 4,000 particles is larger than the two batches that wait by default: where the other side is
    # slow, it would be dropped. More of the other priorities wait, too: a router that finds their queue full
    # cuts the link.
    "transport/link/tx/queue/size/interactive_high": 16,
    "transport/link/tx/queue/size/data": 16,
    "transport/link/tx/queue/size/data_low": 16,
    # Shared memory is no faster, wakes each process 20 times a second, loses messages silently where a
    # receiver hangs, and leaves files behind where a process is killed.
    "transport/shared_memory/enabled": False,
}


class BusError(Exception):
    """The bus cannot be joined or opened; the text is one line."""


class NoRouter(BusError):
    """No router answers at the given endpoint."""


def priority(how: Delivery) -> zenoh.Priority:
    """Return the priority of a key's messages.

    Each has a queue of its own on each link, and higher ones overtake lower ones.

    What must not be dropped never waits behind what may be: on a slow link a full queue of telemetry would
    hold up the router, which then cuts that link (FULL_S).
    """
    if how.realtime:
        return zenoh.Priority.REAL_TIME
    return zenoh.Priority.INTERACTIVE_HIGH if how.blocking else zenoh.Priority.DATA


def declare_publisher(session: zenoh.Session, name: str, how: Delivery) -> Any:
    """Return a publisher of a key, which delivers as the table says."""
    options: dict[str, Any] = {
        "reliability": zenoh.Reliability.RELIABLE if how.reliable else zenoh.Reliability.BEST_EFFORT,
        "congestion_control": zenoh.CongestionControl.BLOCK if how.blocking else zenoh.CongestionControl.DROP,
        "priority": priority(how),
        "express": how.express,
    }
    if not how.kept:
        return session.declare_publisher(name, **options)
    return zenoh.ext.declare_advanced_publisher(
        session,
        name,
        cache=zenoh.ext.CacheConfig(
            max_samples=max(how.kept, how.recovered),
            # By default replies are dropped if history is requested while many new messages are published.
            replies_config=zenoh.ext.RepliesConfig(
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=priority(how) if how.blocking else zenoh.Priority.DATA_LOW,
            ),
        ),
        publisher_detection=True,
        sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=0.5, sporadic_heartbeat=None),
        **options,
    )


def declare_subscriber(
    session: zenoh.Session, name: str, how: Delivery, handler: Any, origin: zenoh.Locality
) -> Any:
    """Return a subscriber of a key; if messages are kept, it gets them first.

    That of several keys (`*`) gets new messages only: Zenoh would let it drop those of one key for what
    another's publisher says of itself.
    """
    if not how.kept or "*" in name:
        return session.declare_subscriber(name, handler, allowed_origin=origin)
    return zenoh.ext.declare_advanced_subscriber(
        session,
        name,
        handler,
        allowed_origin=origin,
        # detect_late_publishers loses history in half of the joins to a busy publisher
        history=zenoh.ext.HistoryConfig(max_samples=how.kept if how.recovered else None),
        recovery=zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
    )


def ask_for_kept(
    session: zenoh.Session, name: str, most: int, received: Any, where: zenoh.Locality = zenoh.Locality.ANY
) -> Any:
    """Ask the publishers of a key for their newest `most` messages. received: the handler of the replies."""
    return session.get(
        f"{name}/@adv/**?_max={most}",
        received,
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
        accept_replies=zenoh.ReplyKeyExpr.ANY,
        allowed_destination=where,
    )


def kept_of(session: zenoh.Session, name: str, how: Delivery) -> list[tuple[bytes, bytes | None]]:
    """Return the messages of a key that this session itself keeps, oldest first, with their attachments."""
    if not (most := how.kept):
        return []
    return [
        (sample.payload.to_bytes(), sample.attachment.to_bytes() if sample.attachment else None)
        for reply in ask_for_kept(
            session, name, most, zenoh.handlers.FifoChannel(most), zenoh.Locality.SESSION_LOCAL
        )
        if (sample := reply.ok)
    ]


def zenoh_config(mode: str, endpoints: dict[str, list[str]], **settings: Any) -> zenoh.Config:
    """Return Zenoh's configuration for a mode and what each flag names, such as `connect`.

    Raises BusError. settings: others of Zenoh's.
    """
    most_files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if 0 <= most_files < FEWEST_FILES:
        raise BusError(
            f"only {most_files} files may be open at a time; wanted {FEWEST_FILES} at least (set it with: "
            "ulimit -n 1024)"
        )
    config = zenoh.Config()
    usual = {"mode": mode, **SETTINGS, "transport/link/rx/max_message_size": MOST_MESSAGE}
    for name, value in usual.items():
        config.insert_json5(name, json.dumps(value))
    for kind, urls in endpoints.items():
        try:
            config.insert_json5(f"{kind}/endpoints", json.dumps(urls))
        except zenoh.ZError:
            raise BusError(
                f"--{kind}: {', '.join(urls)!r} is not a Zenoh endpoint; wanted one like {DEFAULT_ROUTER}"
            ) from None
        if kind == "connect" and (odd := [url for url in urls if not can_be_called(url)]):
            raise BusError(
                f"--{kind}: {odd[0]!r} is not allowed; wanted one like {DEFAULT_ROUTER}, with a host and a "
                "port from 1 to 65535"
            )
    for name, value in settings.items():
        try:
            config.insert_json5(name.replace("__", "/"), json.dumps(value))
        except zenoh.ZError:
            raise BusError(
                f"--{name}: {value!r} is not allowed; wanted words separated by single slashes, without "
                "* $ ? #, like uav/1"
            ) from None
    return config


def join(connect: str, within_s: float, **settings: Any) -> zenoh.Session:
    """Join a router, with an id of Zenoh's choice.

    Raises zenoh.ZError if none admits us in time, BusError if it is not an endpoint.
    """
    in_time = {"connect__timeout_ms": round(1000 * within_s), "connect__retry": RETRY}
    return zenoh.open(zenoh_config("client", {"connect": [connect]}, **in_time | settings))


def open_client(
    connect: str, known: Identity | None, say: Callable[[str], None], **settings: Any
) -> zenoh.Session:
    """Join a router. settings: Zenoh's, beside the usual ones or instead of them.

    Raises NoRouter if none admits us: within CONNECT_TIMEOUT_S, and if nobody has refused us within
    SLOW_CONNECT_S more. BusError if `connect` is not an endpoint.
    """
    try:
        return join(connect, CONNECT_TIMEOUT_S, **settings)
    except zenoh.ZError:
        if reason := why_not(connect, known):
            raise NoRouter(f"--connect: the router at {connect} cannot be joined: {reason}") from None
    if "connect__timeout_ms" not in settings and not is_refused(connect):
        say(f"the router at {connect} does not answer yet: trying for {SLOW_CONNECT_S:g} s more")
        with contextlib.suppress(zenoh.ZError):
            return join(connect, SLOW_CONNECT_S, **settings)
    raise NoRouter(f"--connect: no router at {connect} (start one with: plumeward router)")


def low_pass_filter() -> list[dict[str, Any]]:
    """Return Zenoh's `low_pass_filter` for a router: it drops messages that are larger than the table says.

    A small key stays small.
    """
    sizes = [(key.name, ["put", "delete", "reply"], f"**/{key.named()}", key.most_mib * MIB) for key in KEYS]
    return [
        {
            "id": name,
            "flows": ["ingress"],
            "messages": kinds,
            "key_exprs": [key, f"{key}/@adv/**"],
            "size_limit": size,
        }
        for name, kinds, key, size in [*sizes, ("queries", ["query"], "**", MOST_QUERY)]
    ]


def open_router(
    endpoint: str, secure: Path | None = None, connect: str | None = None
) -> tuple[zenoh.Session, str]:
    """Open a Zenoh router in this process.

    Returns it and its endpoint, which names the chosen port if port 0 was asked for.

    secure: the folder of its certificate; it then admits per role and vehicle.  connect: another router,
    of another site; it may come later, and come back. Raises BusError if it cannot listen on `endpoint`,
    AccessError if it cannot be secured.
    """
    endpoint, known = secured("--listen", endpoint, secure, ROUTER, None)
    rights = (Rights(key.name, key.writers, key.readers, key.own) for key in KEYS)
    rules = {"transport__link__tls": known.tls, "access_control": access_control(rights)} if known else {}
    limits = {
        "transport__link__tx__queue__congestion_control__block__wait_before_close": round(1e6 * FULL_S),
        "transport__unicast__max_sessions": MOST_SESSIONS,
        "transport__unicast__accept_pending": MOST_JOINING,
        "transport__unicast__accept_timeout": round(1000 * JOINING_S),
        "low_pass_filter": low_pass_filter(),
    }
    config = zenoh_config(
        "router",
        {"listen": [endpoint]} | ({"connect": [connect]} if connect else {}),
        adminspace__enabled=True,
        connect__retry=RETRY,
        **limits,
        **rules,
    )
    try:
        session = zenoh.open(config)
    except zenoh.ZError as error:
        reason = re.search(
            r"(Address already in use|Permission denied|Cannot assign requested address|[Ff]ailed to lookup)",
            str(error),
        )
        raise BusError(
            f"--listen: cannot listen on {endpoint}: "
            f"{reason.group(1) if reason else str(error).split(' at /')[0]}"
        ) from None
    for reply in session.get(f"@/{session.zid()}/router"):
        if reply.ok and (
            addresses := json.loads(reply.ok.payload.to_bytes())["locators"] or at_loopback(endpoint)
        ):
            return session, str(addresses[0])
    session.close()  # type: ignore[no-untyped-call]
    raise BusError(
        f"--listen: the router on {endpoint} does not report its address; wanted one with a port, like "
        f"{DEFAULT_ROUTER}"
    )


def at_loopback(endpoint: str) -> list[str]:
    """Return where a router on all addresses is reached if there is no interface but loopback.

    Zenoh then reports no address. Empty for port 0.
    """
    protocol, _, address = endpoint.partition("/")
    _, port = host_and_port(address)
    return [f"{protocol}/{'[::1]' if address.startswith('[') else '127.0.0.1'}:{port}"] if port != "0" else []
