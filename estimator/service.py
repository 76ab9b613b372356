"""The estimator service: readings in, beliefs out, one stop."""

import time
from collections.abc import Iterator

from estimator.belief import belief, stop
from estimator.filter import Config, assimilate, prior
from link.bus import Arrival, Bus
from link.keys import BELIEF, READING, STOP
from link.mavlink import BadFrame, Reading, unpack_reading
from link.messages import pack_particles


def run(bus: Bus, config: Config) -> None:
    """Serve until interrupted. It starts with the readings published before it joined: that is the whole recovery."""
    posterior = prior(config)
    latest, particles = None, b""
    stopped = False
    for reading in _readings(bus, config):
        if latest is not None and reading.time_boot_ms < latest.time_boot_ms:
            bus.refuse(READING, f"time_boot_ms {reading.time_boot_ms} is before {latest.time_boot_ms}", "late")
            continue
        if latest is None or reading.time_boot_ms > latest.time_boot_ms:
            began = time.perf_counter()
            posterior = assimilate(posterior, reading, config)
            latest, array = belief(posterior, reading, config)
            particles = pack_particles(array)
            bus.tally.compute_s += time.perf_counter() - began
            bus.tally.step = latest.step
            if latest.ceased and not stopped:
                bus.publish(STOP, stop(latest, config))
                bus.log.info(f"ceased at step {latest.step}: ({latest.mean[0]:.2f}, {latest.mean[1]:.2f}) ± {latest.spread:.2f} m")
                stopped = True
        # A reading that comes again was not answered: whatever was lost on the way, saying the same belief again mends it.
        bus.publish(BELIEF, latest, particles)
        bus.publish_health()


def _readings(bus: Bus, config: Config) -> Iterator[Reading]:
    bus.subscribe(READING)
    bus.publish_health()
    bus.log.info(
        f"ready: {config.particles} particles, stop below {config.threshold_m:g} m; assuming q {config.rate:g} g/s, "
        f"d {config.diffusivity:g} m²/s, tau {config.lifetime:g} s"
    )
    while True:
        arrival: Arrival = bus.receive()
        try:
            reading = unpack_reading(arrival.payload)
        except BadFrame as error:
            bus.refuse(READING, str(error), "malformed")
            continue
        if not all(0.0 <= value <= config.area_m for value in reading.position):
            bus.refuse(
                READING, f"position {reading.position} is outside the area [0, {config.area_m:g}] x [0, {config.area_m:g}] m", "outside"
            )
            continue
        yield reading
