"""What a launcher is to fly, and the command lines of the services that fly it."""

import itertools
import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from aircraft.payload.options import SIMULATED
from plume.randomness import derived_seed
from plume.scenario import Scenario
from plume.worlds import AS_MODELLED
from sitl.launch.watchdog import PATIENCE_S
from sitl.script.script import Expectation, Script

TRUTH_NEEDED: frozenset[Expectation] = frozenset({"located", "not located", "false stop"})
"""Expectations that need the source's true position."""


class Launch(NamedTuple):
    """What to fly, and with what."""

    script: Script
    instance: int = 0
    listen: str = "tcp/127.0.0.1:0"
    uav_arguments: Sequence[str] = ()
    """The script's file and the flags that change it: the uav reads them itself."""
    record: Path | None = None
    """The MCAP file to record to."""
    connect: str | None = None
    """A router whose estimator and agent fly it; None starts them."""
    log_level: str = "warning"
    patience_s: float = PATIENCE_S
    """Real time after which a silent part counts as hung."""
    sysid: int | None = None
    """MAVLink system id; None: that of the instance, or of the real autopilot."""
    vehicle: str | None = None
    """The URL of a real autopilot; None: the simulated vehicle."""
    payload: str = SIMULATED
    """The gas sensor of a real autopilot, in the form of --payload."""
    payload_arguments: Sequence[str] = ()
    """The arguments that say which plume a simulated one reads."""
    secure: Path | None = None
    """The folder of certificates; None: nothing is secured."""
    wait_s: float = math.inf
    """Real time in which services that run elsewhere have to be there."""

    @property
    def system(self) -> int | None:
        """The vehicle's MAVLink system id; None: a real autopilot's, which nobody knows yet."""
        return self.sysid or (None if self.vehicle else self.instance + 1)

    @property
    def truth(self) -> Scenario | None:
        """The scenario as it truly is; None where a real sensor measures a real plume."""
        return self.script.simulated().truth if self.vehicle is None or self.payload == SIMULATED else None

    @property
    def namespace(self) -> str:
        """The vehicle's key prefix."""
        return f"uav/{self.instance + 1}"


def unfit_for_payload(
    script: Script, vehicle: str | None, payload: str, given: Collection[str]
) -> str | None:
    """Return why a script cannot be flown with a payload, or None. `given`: the names of the flags on the
    command line.
    """
    if vehicle is None:
        return (
            "--payload: only with --vehicle; the simulated vehicle has a sensor of its own"
            if "payload" in given
            else None
        )
    if payload == SIMULATED:
        return None
    real = f"--payload {payload}"
    if script.world != AS_MODELLED:
        return f"--world: {script.world!r} is not allowed with {real}: its plume is real"
    release = script.scenario
    if drawn := [
        name for name in release.__struct_fields__ if name != "start" and getattr(release, name) is not None
    ]:
        return (
            f"MISSION: scenario.{drawn[0]} is not allowed with {real}: its plume is real; what the "
            "estimator is told is in its own part"
        )
    if judged := sorted(TRUTH_NEEDED & {*script.expectations}):
        return f"MISSION: expect: {judged[0]!r} is not allowed with {real}: nobody knows where the source is"
    return None


def estimator_arguments(mission: Launch) -> list[str]:
    """Return the estimator's flags: what it is told and assumes, and a seed of its own. The mission's seed
    would reveal the source.

    Of a real plume it is told what the script says, and takes its own defaults for the rest.
    """
    script, told = mission.script, mission.script.estimator
    release = script.release() if mission.truth else None
    q, d, tau = (release.q, release.d, release.tau) if release else (None, None, None)
    flags = {
        "--particles": told.particles,
        "--assume": told.assume,
        "--stop": told.criterion,
        "--sensor": script.sensor,
        "--stop-on": told.stop_on,
        "--rate": told.rate or q,
        "--diffusivity": told.diffusivity or d,
        "--lifetime": told.lifetime or tau,
        "--seed": derived_seed(script.seed, "estimator"),
        "--sysid": mission.system,
    }
    priors = [
        word
        for name, prior in told.prior.items()
        for word in ("--prior", f"{name}={prior}" if prior else name)
    ]
    return [*_words(flags), *priors]


def agent_arguments(mission: Launch) -> list[str]:
    """Return the agent's flags."""
    script, agent = mission.script, mission.script.agent
    flags = {
        "--policy": None if agent.policy == "none" else agent.policy,
        "--budget": script.budget,
        "--headings": agent.headings,
        "--step": agent.step_m,
        "--measurements": agent.measurements,
        "--seed": derived_seed(script.seed, "agent"),
        "--sysid": mission.system,
    }
    scripted = script.scripted()
    starts = [step for step in scripted if step - 1 not in scripted]
    paths = [_path(scripted, step) for step in sorted(starts)]
    return [*_words(flags), *(word for path in paths for word in ("--waypoints", path))]


def _path(scripted: Mapping[int, tuple[float, float]], start: int) -> str:
    """Format the waypoints from a step up to the first gap for the agent's --waypoints."""
    points = [scripted[step] for step in itertools.takewhile(scripted.__contains__, itertools.count(start))]
    return f"{start}:" + ";".join(
        f"{x:.9g},{y:.9g}" for x, y in points
    )  # 9 digits tell one float32 from the next


def _words(flags: Mapping[str, Any]) -> list[str]:
    return [word for flag, value in flags.items() if value is not None for word in (flag, str(value))]
