"""The roles: whom a certificate names, and which rules of the router follow from the table of keys."""

import re
from collections.abc import Iterable, Mapping
from typing import Any

ROUTER = "router"
VEHICLE, ESTIMATOR, AGENT, PAYLOAD, BRIDGE = "vehicle", "estimator", "agent", "payload", "bridge"
ROS2 = "ros2"
OPERATOR, OBSERVER = "operator", "observer"
# Roles of one vehicle: each vehicle has a certificate for each of them. The others are one for all
# vehicles.
OF_A_VEHICLE = (VEHICLE, ESTIMATOR, AGENT, PAYLOAD, BRIDGE, ROS2)
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
# The rules admit uav/1 to uav/64; the CA decides which of them there are. Each takes a router about 1 ms to
# start, and 0.2 MB.
MOST_VEHICLES = 64
NAMESPACES = tuple(f"uav/{number}" for number in range(1, MOST_VEHICLES + 1))
# What ROS may ask of a vehicle, and the highest of its domains, as DDS has it.
ROS_COMMANDS, MOST_DOMAIN = ("goal_pose", "pause", "abort"), 232
ROS_TOKENS = "@ros2_lv"  # tokens of its graph begin with it
# Kinds of Zenoh messages that publishers and subscribers send, advanced ones and liveliness included.
PUBLISHING = ("put", "declare_queryable", "liveliness_token", "reply")
SUBSCRIBING = ("declare_subscriber", "query", "declare_liveliness_subscriber", "liveliness_query")


EVERYTHING = ["**", "**/@adv/**", f"{ROS_TOKENS}/**"]

# A key, and the roles that may publish and receive it; OF_ALL_VEHICLES may always receive it.
Rights = tuple[str, tuple[str, ...], tuple[str, ...]]


def role_of(service: str) -> str:
    """Return the role of a service; a stranger is an observer."""
    return next((role for role, services in SERVICES.items() if service in services), OBSERVER)


def common_name(role: str, namespace: str | None) -> str:
    """Return the name in a role's certificate, such as uav/1/agent or operator.

    It is also where its files are.
    """
    return f"{namespace}/{role}" if role in OF_A_VEHICLE else role


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

    def admit(name: str, writes: list[str], reads: list[str]) -> None:
        rules.extend(
            (
                _rule(f"{name} writes", "ingress", PUBLISHING, writes),
                _rule(f"{name} reads", "ingress", SUBSCRIBING, reads),
            )
        )
        subjects.append({"id": name, "cert_common_names": [name]})
        policies.append({"subjects": [name], "rules": ["out", f"{name} writes", f"{name} reads"]})

    for role in EVERYBODY:
        sees_all = role in OF_ALL_VEHICLES
        roster = ["**/health/*"] * sees_all  # shows which vehicles there are
        written = dict.fromkeys(
            key.replace("<service>", service)
            for key, writers, _ in rights
            if role in writers
            for service in SERVICES[role]
        )
        read = [key.replace("<service>", "*") for key, _, readers in rights if sees_all or role in readers]
        for space in ("uav/*",) if sees_all else NAMESPACES:
            of_ros = _of_ros(space) if role == ROS2 else ([], [])
            admit(
                common_name(role, space),
                [*_within(space, written), *of_ros[0]],
                [*_within(space, read), f"{space}/nobody", *roster, *of_ros[1]],
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


def _rule(name: str, flow: str, messages: Iterable[str], keys: list[str]) -> dict[str, Any]:
    return {"id": name, "permission": "allow", "flows": [flow], "messages": list(messages), "key_exprs": keys}


def _of_ros(space: str) -> tuple[list[str], list[str]]:
    """Return the keys of ROS that the part which says a vehicle to ROS may write and read, in any domain."""
    name = ros_namespace(space).removeprefix("/")
    shared = ("tf", "tf_static", "clock")
    writes = [f"*/{topic}/**{more}" for topic in (name, *shared) for more in ("", "/@adv/**")]
    commands = [f"*/{name}/{command}/**" for command in ROS_COMMANDS]
    clocks = f"{ROS_TOKENS}/*/*/*/*/MP/*/*/*/%clock/**"  # who else tells the time
    return [*writes, f"{ROS_TOKENS}/*/*/*/*/*/%/%{name}/**"], [*commands, clocks]


def _within(space: str, keys: Iterable[str]) -> list[str]:
    """Return the keys in a namespace, with those of their advanced publishers and subscribers.

    `**` does not match the latter.
    """
    return [f"{space}/{key}{more}" for key in keys for more in ("", "/@adv/**")]
