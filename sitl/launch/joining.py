"""Missions whose router, estimator and agent run elsewhere: which scripts allow it, and the wait for them."""

import time
from collections.abc import Callable, Collection

from link.bus.keys import HEALTH, SEARCHERS
from link.bus.messages import Health
from link.bus.session import Arrival, Bus, LivelinessChange
from link.cli import BadInput
from sitl.launch.child import MissionFailed
from sitl.script.events import Cut, Kill, Lawnmower, Waypoints
from sitl.script.script import AgentPart, EstimatorPart, Script

USUAL = {"estimator": EstimatorPart(), "agent": AgentPart()}
SAY_AFTER_S = 1.0


def check_connect(script: Script, given: Collection[str]) -> None:
    """Raise BadInput if a script cannot be flown with services that run elsewhere.

    `given`: fields set by flags, such as agent.policy.
    """
    for part, usual in USUAL.items():
        chosen = getattr(script, part)
        for field in sorted(chosen.__struct_fields__):
            name = f"{part}.{field}"
            changed = name in given or getattr(chosen, field) != getattr(usual, field)
            if changed and name != "agent.budget":  # the launcher uses the budget, too: it ends the mission
                raise BadInput(
                    f"--connect: {name} cannot be chosen: the {part} runs elsewhere, with its own flags"
                )
    for number, event in enumerate(script.events):
        if isinstance(event, Kill | Cut | Waypoints | Lawnmower):
            tag = event.__struct_config__.tag
            raise BadInput(
                f"--connect: events[{number}], {tag}, cannot happen: it needs parts that this command starts"
            )


def await_services(bus: Bus, namespace: str, say: Callable[[str], None], wait_s: float) -> str:
    """Wait until estimator and agent are there; returns the agent's policy.

    `bus` has subscribed to HEALTH. Raises MissionFailed if one of them has already flown a mission or is
    not there after wait_s, or if another vehicle is there.
    """
    if "uav" in bus.services():
        raise MissionFailed(f"another uav is already on {namespace}")
    bus.watch_services()
    alive: set[str] = set()
    health: dict[str, Health] = {}
    told, until_s = False, time.monotonic() + wait_s
    while missing := SEARCHERS - (alive & set(health)):
        if time.monotonic() >= until_s:
            raise MissionFailed(f"no {' and '.join(sorted(missing))} on {namespace} in {wait_s:g} s (--wait)")
        item = bus.receive(SAY_AFTER_S)
        match item:
            case None if not told:
                say(f"waiting for {' and '.join(sorted(missing))} on {namespace}")
                told = True
            case LivelinessChange(service, there):
                (alive.add if there else alive.discard)(service)
                if not there:
                    health.pop(service, None)  # a restarted one has to report first
            case Arrival(key) if key is HEALTH:
                if (said := bus.decode(item, Health)) is not None:
                    health[said.service] = said
    for service in sorted(SEARCHERS):
        if health[service].step >= 0:
            raise MissionFailed(
                f"the {service} has already flown a mission, to step {health[service].step}: restart it"
            )
    return health["agent"].about
