"""The agent service: beliefs in, one waypoint for each out."""

import time

from agent.moves import Reach
from agent.policies import choose
from agent.policies import policy as find_policy
from link.bus import Arrival, Bus
from link.keys import BELIEF, MAVLINK_IN
from link.mavlink import ONBOARD_COMPUTER, Codec, waypoint_message
from link.messages import Belief, Particles, unpack_particles
from plume.sensor import parse


def run(bus: Bus, policy: str, seed: int, budget: int, system: int, reach: Reach) -> None:
    """Serve until interrupted: answer each belief, except where the search has ceased or the budget is spent."""
    find_policy(policy)  # compiles or loads what it needs before the first belief comes
    codec = Codec(system, ONBOARD_COMPUTER)
    bus.subscribe(BELIEF)
    bus.publish_health()
    bus.log.info(f"ready: {policy}")
    answered = -1
    waypoint = (0.0, 0.0)
    while True:
        received = _newest_belief(bus)
        if received is None:
            continue
        belief, particles = received
        if belief.ceased or belief.step >= budget or belief.time_boot_ms < answered:
            continue
        if belief.time_boot_ms > answered:
            began = time.perf_counter()
            waypoint = choose(policy, belief, particles, seed, reach)
            bus.tally.compute_s += time.perf_counter() - began
            bus.tally.step = belief.step
            answered = belief.time_boot_ms
        # A belief that comes again means that our waypoint did not arrive: the same one is sent again.
        bus.publish(MAVLINK_IN, codec.pack(waypoint_message(system, belief.time_boot_ms, waypoint, belief.altitude_m)))
        bus.publish_health()


def _newest_belief(bus: Bus) -> tuple[Belief, Particles] | None:
    """Wait for a belief; of several that wait, the newest wins."""
    arrival: Arrival = bus.receive()
    while (later := bus.receive(timeout_s=0)) is not None:
        arrival = later
    belief = bus.decode(arrival, Belief)
    if belief is None:
        return None
    try:
        parse(belief.sensor)
        return belief, unpack_particles(arrival.attachment, len(belief.unknowns))
    except ValueError as error:
        bus.refuse(BELIEF, str(error), "malformed")
        return None
