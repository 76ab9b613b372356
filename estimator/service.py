"""The estimator service: takes readings, publishes one belief for each, and one stop."""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace

import msgspec

from estimator.admission import refusal
from estimator.belief import belief, contributions, left_at, stop, stuck, warning
from estimator.filter import Config, Posterior, assimilate, forget, prior, renewed
from estimator.gathering import Gathering
from estimator.roll import OVERDUE_S, Roll
from estimator.watch import SensorWatch
from link.bus.keys import BELIEF, READING, STOP
from link.bus.mavlink import BadFrame, Reading, split, unpack_reading
from link.bus.messages import Belief, RoundReading, Stand, pack_particles
from link.bus.session import Bus
from link.bus.tally import REPEATED
from plume.problem import ALTITUDE_M
from plume.problems.fleet import Place
from plume.sensors.instruments import Instrument

QUIET_S = 0.1  # real time after a belief in which the agent may need the processor
UNFIT = "its readings do not fit those of the others"  # why one is left out by rule


def run(
    bus: Bus,
    config: Config,
    systems: Sequence[int | None],
    overdue_s: float = OVERDUE_S,
    leave_out: bool = False,
) -> None:
    """Serve until interrupted.

    The first readings are those published before it joined: this alone recovers a restarted estimator.

    systems: the MAVLink system id of each vehicle that searches; None: that of its first reading that is
    admitted.  overdue_s: the real time for which a round waits for one of several; 0: without end.
    leave_out: whether one of several whose sensor seems to lie leaves the search.
    """
    _rehearse(config)
    known, rounds = list(systems), Gathering(len(systems))
    roll = Roll(bus, rounds, known, config, overdue_s)
    _begin(bus, config, roll)
    ahead = Ahead(prior(config))
    watch = SensorWatch(config, len(systems) if len(systems) > 1 else 0)
    summary, particles = None, b""
    read_at: dict[int, tuple[Place, Place]] = {}  # where each vehicle has read, first and last
    stopped, forgotten = False, frozenset[int]()
    while True:
        arrival, refused = roll.receive(QUIET_S if watch.waiting else math.inf), None
        if arrival is None:
            began = time.perf_counter()
            ahead.renew(config)
            bus.tally.compute_s += time.perf_counter() - began
            watch.look()
            bus.tally.about = _about(config, roll)
        else:
            own = arrival.vehicle - 1
            try:
                reading = unpack_reading(arrival.payload, known[own])._replace(vehicle=arrival.vehicle)
            except BadFrame as error:
                bus.refuse(READING, str(error), error.kind)
                continue
            if refused := refusal(reading, rounds.newest[own], config):
                kind, reason = refused
                bus.refuse(READING, reason, kind)
                if kind != REPEATED:
                    continue
            else:
                rounds.take(reading)
                roll.took(arrival.vehicle, arrival.payload)
                known[own] = known[own] or split(arrival.payload)[0].system
        while True:
            began = time.perf_counter()
            if (gone := roll.forgotten(rounds.number)) != forgotten:
                watch.look()
                forgotten = gone
                ahead = Ahead(forget(ahead.begin, forgotten, config))
                watch.forget(forgotten)
            ahead.take(rounds.begun(), config)
            if not (taken := rounds.whole()):
                bus.tally.compute_s += time.perf_counter() - began
                break
            posterior = ahead.posteriors[-1]
            watch.look()
            for before, after, each in zip(ahead.posteriors, ahead.posteriors[1:], taken, strict=False):
                if len(systems) > 1 and not stopped:
                    watch.take(before, after, each)
            ahead = Ahead(posterior)
            summary, array = belief(posterior, taken[-1], config)
            if len(systems) > 1:
                doubted = sorted({*stuck(posterior, config), *watch.doubted})
                for each in taken:
                    read_at[each.vehicle] = read_at.get(each.vehicle, [each.position])[0], each.position
                summary = _of_all(summary, taken, known, doubted, read_at, roll.joining(rounds.number - 1))
                summary = msgspec.structs.replace(summary, step=rounds.number - 1)
            elif known[0] not in (None, 1):
                summary = msgspec.structs.replace(summary, system=known[0])
            particles = pack_particles(array)
            bus.tally.compute_s += time.perf_counter() - began
            bus.tally.did(summary.step)
            _judge(bus, summary, config)
            if summary.ceased and not stopped:
                claim = stop(summary, config)
                if len(systems) > 1:
                    claim = msgspec.structs.replace(claim, measured=contributions(posterior))
                bus.publish(STOP, claim)
                bus.log.info(
                    f"ceased at step {summary.step}: ({summary.mean[0]:.2f}, {summary.mean[1]:.2f}) ± "
                    f"{summary.spread:.2f} m"
                )
                stopped = bus.tally.ceased = True
            bus.publish(BELIEF, summary, particles)
            bus.answered()
            if leave_out and summary.doubted and not stopped:
                for vehicle in summary.doubted[: len(rounds.left()) - 1]:
                    roll.leave_out(vehicle, UNFIT)
                bus.tally.about = _about(config, roll)
        # A repeated reading means that no answer arrived. Publishing the same belief again recovers from any
        # lost message. One that waits for those of other vehicles has no answer yet.
        if arrival and refused and summary is not None and not rounds.waits(arrival.vehicle):
            bus.publish(BELIEF, summary, particles)
            bus.answered()


class Ahead:
    """The posteriors after each of a round's readings that have come so far, while the others are awaited."""

    def __init__(self, begin: Posterior) -> None:
        """begin: that of the rounds before, not yet `renewed`."""
        self.posteriors = [begin]
        self._taken: list[Reading] = []
        self._is_renewed = False

    @property
    def begin(self) -> Posterior:
        """That of the rounds before."""
        return self.posteriors[0]

    def renew(self, config: Config) -> None:
        """Renew that of the rounds before, once: in the time that there is before a reading, or then."""
        if not self._is_renewed:
            self.posteriors[0], self._is_renewed = renewed(self.begin, config), True

    def take(self, readings: Sequence[Reading], config: Config) -> None:
        """Take the round's first readings, in their order. Those that it has taken are not assimilated again.

        If a vehicle has left or joined meanwhile, all readings from its place on are.
        """
        known = 0
        for taken, reading in zip(self._taken, readings, strict=False):
            if taken is not reading:
                break
            known += 1
        del self._taken[known:], self.posteriors[known + 1 :]
        if readings:
            self.renew(config)
        for reading in readings[known:]:
            self.posteriors.append(assimilate(self.posteriors[-1], reading, config))
            self._taken.append(reading)


def _of_all(
    said: Belief,
    taken: Sequence[Reading],
    systems: Sequence[int | None],
    doubted: Sequence[int],
    read_at: Mapping[int, tuple[Place, Place]],
    joining: Mapping[int, Place],
) -> Belief:
    """Return a round's belief with the readings that it answers, whose sensor seems to lie, and who has left.

    read_at: where each vehicle that has ever read has read, first and last.  joining: where each takes off
    that is about to join.
    """
    readings = tuple(
        RoundReading(
            vehicle=each.vehicle,
            system=systems[each.vehicle - 1] or each.vehicle,
            time_boot_ms=each.time_boot_ms,
            position=each.position,
            altitude_m=each.altitude_m,
            gas=each.gas,
        )
        for each in taken
    )
    return msgspec.structs.replace(
        said,
        readings=readings,
        stands=tuple(Stand(each.vehicle, read_at[each.vehicle][0]) for each in taken),
        doubted=tuple(doubted) if doubted else msgspec.UNSET,
        left_at=left_at(read_at, [each.vehicle for each in taken], joining),
    )


def _judge(bus: Bus, said: Belief, config: Config) -> None:
    """Warn while no stop would be honest: once a reason in the log, and in health as long as it lasts."""
    reason, question = warning(said, config) or ("", "")
    before = "".join(bus.tally.warnings)
    if reason and before.partition(" (")[0] != reason.partition(" (")[0]:
        bus.log.warning(f"{reason}: {question}")
    bus.tally.warnings = (reason,) if reason else ()


def _about(config: Config, roll: Roll) -> str:
    """Return what it runs with, for how many vehicles, and without whom."""
    parts = [f"{config.particles} particles", f"assume {config.assume}", f"stop {config.criterion.text}"]
    if roll.vehicles > 1:
        parts.append(f"{roll.vehicles} vehicles")
    if away := [
        *(each.vehicle for each in roll.left),
        *(k for k, late in roll.late.items() if late.says < 2),
    ]:
        parts.append(f"without {', '.join(f'uav/{vehicle}' for vehicle in away)}")
    return ", ".join(parts)


def _rehearse(config: Config) -> None:
    """Assimilate a reading that nobody took, in clean air, and forget it: so the first takes no longer."""
    few, sensor = replace(config, particles=min(config.particles, 100)), config.sensor
    clean = float(sensor.settled(0.0)) if isinstance(sensor, Instrument) else 0.0
    reading = Reading(0, config.area.low, ALTITUDE_M, (1.0, 0.0), clean, vehicle=2)
    belief(assimilate(prior(few), reading, few), reading, few)


def _begin(bus: Bus, config: Config, roll: Roll) -> None:
    bus.subscribe(READING)
    bus.tally.about = _about(config, roll)
    bus.publish_health()
    bus.announce()
    steady = config.assume == "field" and "cv" not in config.effective_priors
    bus.log.info(
        f"ready: {bus.tally.about}; unknown {' '.join(config.unknowns)}; "
        f"told q {config.rate:g} g/s, d {config.diffusivity:g} m²/s, tau {config.lifetime:g} s; "
        "sensor "
        f"{config.sensor_text}{', for which intermittency of the gas is not modelled' if steady else ''}"
    )
