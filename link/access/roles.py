"""The roles: whom a certificate names, and which rules of the router follow from the table of keys."""

import re
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

ROUTER = "router"
VEHICLE, ESTIMATOR, AGENT, PAYLOAD, BRIDGE = "vehicle", "estimator", "agent", "payload", "bridge"
ROS2 = "ros2"
OPERATOR, OBSERVER = "operator", "observer"
# Roles of one vehicle: each vehicle has a certificate for each of them. The others are one for all
# vehicles.
OF_A_VEHICLE = (VEHICLE, ESTIMATOR, AGENT, PAYLOAD, BRIDGE, ROS2)
# In a search by several vehicles estimator and agent are the search's, the others each vehicle's.
OF_A_SEARCH = (ESTIMATOR, AGENT)
ON_BOARD = tuple(role for role in OF_A_VEHICLE if role not in OF_A_SEARCH)
# Nodes of ROS 2, which `plumeward ros2` speaks with. They have no right to the keys of vehicles.
ROS = "ros"
# Roles that may read every key of every vehicle. Only operators command.
OF_ALL_VEHICLES = (OPERATOR, OBSERVER)
EVERYBODY = (*OF_A_VEHICLE, *OF_ALL_VEHICLES)
FOR_ALL = (*OF_ALL_VEHICLES, ROS)  # roles whose one certificate is used by many
# The services of each role: those whose health it may publish.
SERVICES = {
    VEHICLE: ("uav",),
    ESTIMATOR: ("estimator",),
    AGENT: ("agent",),
    PAYLOAD: ("payload",),
    BRIDGE: ("bridge",),
    ROS2: ("ros2",),
    OPERATOR: ("view", "mission"),
    OBSERVER: ("recorder", "status"),
}
# The rules admit uav/1 to uav/64, and search/1 to search/8 with up to 8 vehicles each; the CA decides which
# of them there are.
MOST_VEHICLES, MOST_SEARCHES, MOST_IN_A_SEARCH = 64, 8, 8
NAMESPACES = tuple(f"uav/{number}" for number in range(1, MOST_VEHICLES + 1))
SEARCHES = tuple(f"search/{number}" for number in range(1, MOST_SEARCHES + 1))
SEARCHERS = tuple(f"{search}/{space}" for search in SEARCHES for space in NAMESPACES[:MOST_IN_A_SEARCH])
# What ROS may ask of a vehicle, and the highest of its domains, as DDS has it.
ROS_COMMANDS, MOST_DOMAIN = ("goal_pose", "pause", "abort"), 232
ROS_TOKENS = "@ros2_lv"  # tokens of its graph begin with it
# Kinds of Zenoh messages that publishers and subscribers send, advanced ones and liveliness included.
PUBLISHING = ("put", "declare_queryable", "liveliness_token", "reply")
SUBSCRIBING = ("declare_subscriber", "query", "declare_liveliness_subscriber", "liveliness_query")


EVERYTHING = ["**", "**/@adv/**", f"{ROS_TOKENS}/**"]


class Rights(NamedTuple):
    """A key, and who has which right to it; OF_ALL_VEHICLES may always receive it."""

    key: str
    writers: tuple[str, ...]
    readers: tuple[str, ...]
    own: bool  # whether each vehicle of a search has its own


def role_of(service: str) -> str:
    """Return the role of a service; a stranger is an observer."""
    return next((role for role, services in SERVICES.items() if service in services), OBSERVER)


def is_search(space: str) -> bool:
    """Whether a space of keys is a search by several vehicles, or one of these."""
    return space.startswith("search/")


def common_name(role: str, space: str | None) -> str:
    """Return the name in a role's certificate, such as uav/1/agent, search/1/uav/2/vehicle or operator.

    It is also where its files are.  space: the keys that it speaks for.
    """
    return f"{space}/{role}" if role in OF_A_VEHICLE else role


def spaces_of(role: str) -> tuple[str, ...]:
    """Return the spaces of keys that a role may have a certificate for; empty if it is one for all."""
    if role not in OF_A_VEHICLE:
        return ()
    return (*NAMESPACES, *(SEARCHES if role in OF_A_SEARCH else SEARCHERS))


def ros_namespace(namespace: str) -> str:
    """Return the ROS namespace of a vehicle's: `/uav_1` of `uav/1`.

    A part of a ROS name may not begin with a digit, so the parts become one. What is neither letter nor
    digit becomes an underscore, of which ROS allows no two in a row and none at the end.
    """
    name = re.sub(r"[^A-Za-z0-9]+", "_", namespace).strip("_")
    return f"/{name}" if name[:1].isalpha() else f"/vehicle_{name}".rstrip("_")


def access_control(table: Iterable[Rights]) -> Mapping[str, Any]:
    """Return Zenoh's `access_control` for a router: what is not allowed here is denied.

    What comes in is checked; what goes out was asked for by a subscription that has been checked.
    """
    rights = tuple(table)
    rules = [_rule("out", "egress", (*PUBLISHING, *SUBSCRIBING, "delete"), EVERYTHING)]
    subjects: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []

    def admit(name: str, writes: Iterable[str], reads: Iterable[str]) -> None:
        rules.extend(
            (
                _rule(f"{name} writes", "ingress", PUBLISHING, writes),
                _rule(f"{name} reads", "ingress", SUBSCRIBING, reads),
            )
        )
        subjects.append({"id": name, "cert_common_names": [name]})
        policies.append({"subjects": [name], "rules": ["out", f"{name} writes", f"{name} reads"]})

    for role in EVERYBODY:
        for space in spaces_of(role):
            of_ros = _of_ros(space) if role == ROS2 else ([], [])
            writes, reads = _written(role, space, rights), _read(role, space, rights)
            admit(common_name(role, space), [*writes, *of_ros[0]], [*reads, *of_ros[1]])
        if role in OF_ALL_VEHICLES:
            everywhere = "uav/*", "search/*"
            roster = _with_advanced(["**/health/*"])  # shows which vehicles there are
            admit(
                role,
                [key for space in everywhere for key in _written(role, space, rights)],
                [*roster, *(key for space in everywhere for key in _read(role, space, rights))],
            )
    domains = [f"{domain}/**{more}" for domain in range(MOST_DOMAIN + 1) for more in ("", "/@adv/**")]
    admit(ROS, [f"{ROS_TOKENS}/**", *domains], [f"{ROS_TOKENS}/**", *domains])
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _rule(name: str, flow: str, messages: Iterable[str], keys: Iterable[str]) -> dict[str, Any]:
    return {
        "id": name,
        "permission": "allow",
        "flows": [flow],
        "messages": list(messages),
        "key_exprs": list(dict.fromkeys(keys)),
    }


def _written(role: str, space: str, rights: Iterable[Rights]) -> list[str]:
    """Return the keys that a role may write in a space."""
    return _with_advanced(
        _place(space, key.replace("<service>", service), own or ("<service>" in key and role in ON_BOARD))
        for key, writers, _, own in rights
        if role in writers
        for service in SERVICES[role]
    )


def _read(role: str, space: str, rights: Iterable[Rights]) -> list[str]:
    """Return the keys that a role may read in a space."""
    search = space.partition("/uav/")[0]
    names = [
        # In a search each vehicle has services of its own, and all hear them.
        f"{search}/**/{every}" if is_search(space) and every != key else _place(space, every, own)
        for key, _, readers, own in rights
        if role in readers or role in OF_ALL_VEHICLES
        for every in [key.replace("<service>", "*")]
    ]
    nobody = dict.fromkeys([f"{space}/nobody", f"{search}/nobody"])
    return [*_with_advanced(names), *nobody]


def _place(space: str, key: str, own: bool) -> str:
    """Return where a key is that a space has.

    In a search it is `own` of each vehicle, or the search's.
    """
    search, _, number = space.partition("/uav/")
    if is_search(space) and own:
        return f"{search}/uav/{number or '*'}/{key}"
    return f"{search}/{key}"


def _of_ros(space: str) -> tuple[list[str], list[str]]:
    """Return the keys of ROS that the part which says a vehicle to ROS may write and read, in any domain."""
    name = ros_namespace(space).removeprefix("/")
    shared = ("tf", "tf_static", "clock")
    writes = [f"*/{topic}/**{more}" for topic in (name, *shared) for more in ("", "/@adv/**")]
    commands = [f"*/{name}/{command}/**" for command in ROS_COMMANDS]
    clocks = f"{ROS_TOKENS}/*/*/*/*/MP/*/*/*/%clock/**"  # who else tells the time
    return [*writes, f"{ROS_TOKENS}/*/*/*/*/*/%/%{name}/**"], [*commands, clocks]


def _with_advanced(keys: Iterable[str]) -> list[str]:
    """Return keys with those of their advanced publishers and subscribers, which `**` does not match."""
    return [f"{key}{more}" for key in keys for more in ("", "/@adv/**")]
