"""The estimator service: takes readings, publishes one belief for each, and one stop."""

import time

from estimator.admission import refusal
from estimator.belief import belief, stop, warning
from estimator.filter import Config, assimilate, prior
from link.bus.keys import BELIEF, READING, STOP
from link.bus.mavlink import BadFrame, split, unpack_reading
from link.bus.messages import Belief, pack_particles
from link.bus.session import Arrival, Bus
from link.bus.tally import REPEATED


def run(bus: Bus, config: Config, system: int | None) -> None:
    """Serve until interrupted.

    The first readings are those published before it joined: this alone recovers a restarted estimator.

    system: the vehicle's MAVLink system id; None: that of the first reading that is admitted.
    """
    _begin(bus, config)
    posterior = prior(config)
    latest, summary, particles = None, None, b""
    stopped = False
    while True:
        arrival: Arrival = bus.receive()
        try:
            reading = unpack_reading(arrival.payload, system)
        except BadFrame as error:
            bus.refuse(READING, str(error), error.kind)
            continue
        refused = refusal(reading, latest, config)
        if refused:
            kind, reason = refused
            bus.refuse(READING, reason, kind)
            if kind != REPEATED:
                continue
        else:
            began = time.perf_counter()
            posterior = assimilate(posterior, reading, config)
            summary, array = belief(posterior, reading, config)
            particles = pack_particles(array)
            bus.tally.compute_s += time.perf_counter() - began
            bus.tally.did(summary.step)
            latest, system = reading, system or split(arrival.payload)[0].system
            _judge(bus, summary, config)
            if summary.ceased and not stopped:
                bus.publish(STOP, stop(summary, config))
                bus.log.info(
                    f"ceased at step {summary.step}: ({summary.mean[0]:.2f}, {summary.mean[1]:.2f}) ± "
                    f"{summary.spread:.2f} m"
                )
                stopped = bus.tally.ceased = True
        # A repeated reading means that no answer arrived. Publishing the same belief again recovers from any
        # lost message.
        assert summary is not None
        bus.publish(BELIEF, summary, particles)
        bus.answered()


def _judge(bus: Bus, said: Belief, config: Config) -> None:
    """Warn while no stop would be honest: once a reason in the log, and in health as long as it lasts."""
    reason, question = warning(said, config) or ("", "")
    before = "".join(bus.tally.warnings)
    if reason and before.partition(" (")[0] != reason.partition(" (")[0]:
        bus.log.warning(f"{reason}: {question}")
    bus.tally.warnings = (reason,) if reason else ()


def _begin(bus: Bus, config: Config) -> None:
    bus.subscribe(READING)
    bus.tally.about = f"{config.particles} particles, assume {config.assume}, stop {config.criterion.text}"
    bus.publish_health()
    steady = config.assume == "field" and "cv" not in config.effective_priors
    bus.log.info(
        f"ready: {bus.tally.about}; unknown {' '.join(config.unknowns)}; "
        f"told q {config.rate:g} g/s, d {config.diffusivity:g} m²/s, tau {config.lifetime:g} s; "
        "sensor "
        f"{config.sensor_text}{', for which intermittency of the gas is not modelled' if steady else ''}"
    )
