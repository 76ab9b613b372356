"""The agent service: takes beliefs, answers each with one waypoint."""

import math
import time
from collections.abc import Mapping
from types import MappingProxyType

import msgspec
import numpy as np

from agent import policies
from agent.planning.moves import Reach
from agent.together import choose_all
from link.bus.keys import BELIEF, DEPARTURE, LATECOMER, STOP, WAYPOINT
from link.bus.mavlink import ONBOARD_COMPUTER, Codec, elapsed_ms, waypoint_message
from link.bus.messages import (
    Belief,
    Departure,
    Latecomer,
    Particles,
    RoundReading,
    unpack_particles,
)
from link.bus.session import Arrival, Bus
from plume.elementary import float32
from plume.parameters import MOST, PARAMETERS
from plume.problem import ALTITUDE_M, Area
from plume.problems.fleet import MOST_VEHICLES, Place
from plume.scenario import SEPARATION_M
from plume.sensors.names import numbers, parse


def waypoints(text: str, within: Reach) -> dict[int, tuple[float, float]]:
    """Read STEP:X,Y;X,Y;... as waypoints (x, y) m, float32 as on the wire, by the step of their beliefs.

    Raises ValueError.
    """
    first, _, rest = text.partition(":")
    east, north = within.wire.high
    try:
        points = [tuple(map(float, point.split(","))) for point in rest.split(";")]
        path = {
            int(first) + number: (float32(min(x, east)), float32(min(y, north)))
            for number, (x, y) in enumerate(points)
        }
        if min(path) >= 0 and all(map(within.area.holds, points)):
            return path
    except ValueError:
        pass
    raise ValueError(
        f"--waypoints: {text!r} is not allowed; wanted STEP:X,Y;X,Y;... with places in the area, "
        f"{within.area.text}"
    )


def run(
    bus: Bus,
    policy: str,
    seed: int,
    budget: int,
    system: int | None,
    reach: Reach,
    scripted: Mapping[int, tuple[float, float]] = MappingProxyType({}),
    separation_m: float = SEPARATION_M,
) -> None:
    """Serve until interrupted: answer each belief, unless the search has ceased or the budget is spent.

    Of several vehicles, say again who has left or come late: an estimator that starts again learns of it.

    system: the vehicle's MAVLink system id; None: the one that comes with the belief. Those of several do.
    scripted: waypoints of one vehicle that replace the policy's, by the step of the belief they answer.
    separation_m: the least distance between the ways of several vehicles, m.
    """
    policies.policy(policy)  # loads or compiles the policy before the first belief arrives
    _rehearse(policy, reach)
    bus.subscribe(BELIEF, newest=True)
    bus.subscribe(STOP, DEPARTURE, LATECOMER)
    told = system or 1
    codec = Codec(told, ONBOARD_COMPUTER)
    bus.tally.about = policy
    bus.publish_health()
    bus.log.info(f"ready: {policy}")
    answered: Belief | None = None
    waypoints: list[Place] = []
    said: set[tuple[int, int]] = set()
    while True:
        arrival: Arrival = bus.receive()
        if arrival.key is DEPARTURE or arrival.key is LATECOMER:
            _say_again(bus, arrival, said)
        received = _belief(bus, arrival, reach.area)
        if received is None:
            continue
        belief, particles = received
        if system is None and not belief.readings and told != (own := belief.system or 1):
            told, codec = own, Codec(own, ONBOARD_COMPUTER)
        taken = belief.readings or (_alone(belief, told),)
        later = 1 if answered is None else _later(answered, belief)
        if belief.ceased or belief.step >= budget or later < 0:
            continue
        if later or len(waypoints) != len(taken):
            began = time.perf_counter()
            if len(taken) == 1 and belief.step in scripted:
                waypoints = [scripted[belief.step]]
            else:
                places, gases = [each.position for each in taken], [each.gas for each in taken]
                numbers = [each.vehicle for each in taken]
                waypoints = choose_all(
                    policy, belief, particles, seed, reach, places, gases, separation_m, numbers
                )
            bus.tally.compute_s += time.perf_counter() - began
            bus.tally.did(belief.step)
            answered = belief
        # A repeated belief means that our waypoint did not arrive: send the same one again.
        frames = [
            waypoint_message(each.system, each.time_boot_ms, place, each.altitude_m)
            for each, place in zip(taken, waypoints, strict=True)
        ]
        bus.publish(WAYPOINT, codec.pack(*frames))
        bus.answered()


def _rehearse(policy: str, reach: Reach) -> None:
    """Answer a belief of two vehicles that nobody has said, and forget it: so the first takes no longer.

    Policies of others are not asked: they may remember it.
    """
    if policy not in policies.OURS:
        return
    (x, y), (east, north) = reach.area.low, reach.area.high
    unit, particles = (1.0, 1.0), np.array([(x, y, 0.5), (east, north, 0.5)], np.float32)
    said = Belief(
        *(0, 0, (x, y), ALTITUDE_M, 0.0, unit, "gaussian", 1.0, 1.0, 1.0, ALTITUDE_M, ("x", "y")),
        *((x, y), unit, (x, y), (1.0, 0.0, 1.0), 1.0, 2.0, 1.0, False),
    )
    choose_all(policy, said, particles, 0, reach, [(x, y), (east, north)], [0.0, 0.0], SEPARATION_M)


def _say_again(bus: Bus, arrival: Arrival, known: set[tuple[int, int]]) -> None:
    """Say again, once each, that a vehicle has left, and how far one that comes late has come."""
    kind: type[Departure | Latecomer] = Departure if arrival.key is DEPARTURE else Latecomer
    said = bus.decode(arrival, kind)
    if said is None or said.vehicle > MOST_VEHICLES:
        return
    what = said.vehicle, said.says if isinstance(said, Latecomer) else -1
    if what not in known:
        known.add(what)
        bus.publish(arrival.key, arrival.payload, arrival.attachment or None)


def _later(answered: Belief, belief: Belief) -> int:
    """Return by how much a belief is later than the answered one: 0 if it is that one again.

    By time, of one vehicle. Of several each has a clock of its own, and the last one of a round may change:
    by rounds.
    """
    if answered.readings and belief.readings:
        return belief.step - answered.step
    return elapsed_ms(answered.time_boot_ms, belief.time_boot_ms)


def _alone(belief: Belief, system: int) -> RoundReading:
    """Return the reading of one vehicle, which its belief is about."""
    return RoundReading(1, system, belief.time_boot_ms, belief.position, belief.altitude_m, belief.gas)


def _belief(bus: Bus, arrival: Arrival, area: Area) -> tuple[Belief, Particles] | None:
    """Return the belief of a message.

    An invalid one, which no policy could answer, is refused and gives None; so does all else.
    """
    if arrival.key is STOP:
        bus.take_stop(arrival)
    if arrival.key is not BELIEF:
        return None
    belief = bus.decode(arrival, Belief)
    if belief is None:
        return None
    try:
        check(belief, area)
        particles = unpack_particles(arrival.attachment, len(belief.unknowns))
        if np.abs(particles).max() > MOST:
            raise ValueError(f"a particle holds a number beyond ±{MOST:g}")
        return belief, particles
    except ValueError as error:
        bus.refuse(BELIEF, str(error), "malformed")
        return None


def check(belief: Belief, area: Area) -> None:
    """Raise ValueError unless a belief is one that an agent can plan with."""
    names = belief.unknowns
    if not set(names) <= set(PARAMETERS) or len(set(names)) < len(names):
        raise ValueError(f"unknowns {' '.join(names)!r} are not distinct names of {' '.join(PARAMETERS)}")
    if not len(names) == len(belief.means) == len(belief.stds):
        raise ValueError(f"{len(belief.means)} means and {len(belief.stds)} stds of {len(names)} unknowns")
    _check_readings(belief)
    read_at = (each.position for each in belief.readings or ())
    stands = (each.place for each in belief.stands or ())
    for position in (belief.position, *read_at, *stands, *_left(belief)):
        if not area.holds(position):
            raise ValueError(f"position {position} is outside the area {area.text}")
    positive = belief.rate, belief.diffusivity, belief.lifetime
    others = (
        *numbers(parse(belief.sensor)).values(),
        *belief.wind,
        belief.gas,
        belief.altitude_m,
        belief.z,
        *belief.mean,
        *belief.covariance,
        belief.spread,
        *(value for each in belief.readings or () for value in (each.gas, each.altitude_m)),
    )
    if max(map(abs, (*positive, *others))) > MOST or min(positive) < 1 / MOST:
        raise ValueError(
            f"the belief holds a number beyond ±{MOST:g}, "
            f"or one within {1 / MOST:g} of 0 that must be above 0"
        )
    xx, xy, yy = belief.covariance
    if min(xx, yy) < 0 or abs(xy) > 1.001 * math.sqrt(xx * yy) + 1e-9:
        raise ValueError(f"{belief.covariance} is not a covariance (xx, xy, yy)")


def _left(belief: Belief) -> list[Place]:
    """Return where those have read that have left. Raises ValueError if they are too many."""
    if len(left := belief.left_at or ()) >= MOST_VEHICLES:
        raise ValueError(f"{len(left)} vehicles have left; wanted fewer than {MOST_VEHICLES}")
    return [place for each in left for place in (each.first, each.last)]


def _check_readings(belief: Belief) -> None:
    """Raise ValueError unless the readings of a round are those of different vehicles, in their order.

    The last one's has to be the belief's own.
    """
    readings = belief.readings or ()
    if belief.readings is not msgspec.UNSET and not 1 <= len(readings) <= MOST_VEHICLES:
        raise ValueError(f"{len(readings)} readings in a round; wanted 1 to {MOST_VEHICLES}")
    numbers = [each.vehicle for each in readings]
    if numbers != sorted(set(numbers)) or max(numbers, default=1) > MOST_VEHICLES:
        raise ValueError(
            f"the readings of a round are of vehicles {' '.join(map(str, numbers))}; wanted each once, in "
            f"their order, up to {MOST_VEHICLES}"
        )
    standing = [each.vehicle for each in belief.stands or ()]
    if belief.stands is not msgspec.UNSET and standing != numbers:
        said, wanted = (" ".join(map(str, each)) for each in (standing, numbers))
        raise ValueError(f"the stands of a round are of vehicles {said}; wanted {wanted}, as the readings")
    if readings and readings[-1].time_boot_ms != belief.time_boot_ms:
        raise ValueError("the time of a belief is not that of the last reading of its round")
