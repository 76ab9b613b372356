"""The world that one mission flies in: it knows the source, and says what instruments read."""

import math
import traceback
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import replace
from functools import cached_property, partial
from itertools import chain
from pathlib import Path

import msgspec
import numpy as np

from plume.elementary import Array, direction, float32
from plume.flight import usual_s
from plume.parameters import MOST
from plume.problem import PAPER, Place, Problem
from plume.randomness import Abreast, Keyed, derived_seed, keyed, seed_of, uniform
from plume.scenario import AS_MODELLED, BrokenFile, NoRelease, Scenario, WorldError, draw
from plume.sensors.instruments import Instrument
from plume.sensors.names import GAUSSIAN, Sensor
from plume.sensors.sensor import Hits, Threshold
from plume.worlds.air import Air, Both, Steady, gas_of
from plume.worlds.errors import second
from plume.worlds.exposure import Before, is_timed, met
from plume.worlds.names import Named, named

HOUR_S = 3600.0
WindVector = tuple[float, float]  # (u cos φ, u sin φ) m/s, float32: points to where it comes from

DRAWN_ANEW = 100  # times that a source is drawn until gas can leave there


class World:
    """A scenario, its air, the noise of its sensor, and how the truth differs from what is told.

    It answers with what instruments would read.

    `wind` is the wind as told, (u cos φ, u sin φ) in m/s, and points to where it comes from; `start` is
    where the search begins, (x, y) in metres.

    Examples:
        >>> world = plumeward.World(plumeward.draw(7), seed=7)
        >>> round(world.gas((12.0, 15.0), step=0), 2)  # the first reading, g/m³
        0.51
    """

    def __init__(
        self,
        scenario: Scenario,
        seed: int,
        sensor: Sensor = GAUSSIAN,
        name: str = AS_MODELLED,
        problem: Problem = PAPER,
    ) -> None:
        """Take the mission's seed: the noise of reading k is keyed by (seed, k).

        Raises ValueError on a name that is none.

        scenario, sensor: what the estimator is told. name: of a world, as `--world` takes it, which says how
        the gas moves and how the truth differs.  problem: of which the scenario has been drawn.
        """
        self.scenario = scenario
        self.problem = problem
        self.seed = seed
        self.sensor = sensor
        self.name = name
        chosen = named(name)
        self.errors = wrong = chosen.errors(seed, problem)
        # The scenario as it truly is, by which missions are judged.
        self.truth = msgspec.structs.replace(
            scenario,
            source=wrong.source or scenario.source,
            q=wrong.q * scenario.q,
            u=wrong.speed * scenario.u,
            phi=scenario.phi + math.radians(wrong.direction_deg),
            d=wrong.d * scenario.d,
            tau=wrong.tau * scenario.tau,
        )
        source, self.air = self._released(chosen, self.truth.source, seed, self._sources(chosen))
        self.truth = msgspec.structs.replace(self.truth, source=source)
        if wrong.second:
            other_seed = derived_seed(seed, "second source")
            others = (
                second(derived_seed(seed, f"second source {number}"), problem, source)
                for number in range(DRAWN_ANEW)
            )
            place, other = self._released(chosen, wrong.second, other_seed, others)
            self.truth = msgspec.structs.replace(self.truth, second=place)
            self.air = Both(self.air, other)
        told = scenario.wind
        self.wind: WindVector = (float32(told[0]), float32(told[1]))
        self.start = (float32(scenario.start[0]), float32(scenario.start[1]))
        # What turns the true wind into the measured one; and that one, where the wind is steady.
        cosine, sine = direction(wrong.direction_deg / 360.0) if wrong.direction_deg else (1.0, 0.0)
        self._anemometer = float(cosine), float(sine), wrong.speed
        self._steady = self._measured(*self.air.wind) if isinstance(self.air, Steady) else None
        # Of an instrument, gas that fluctuates is drawn before its element follows it.
        of_time = isinstance(sensor, Instrument)
        self._cv = sensor.cv if wrong.cv is None and isinstance(sensor, Instrument) else wrong.cv
        self._instrument = sensor, wrong.cv is None or of_time
        if wrong.noise != 1 and not isinstance(sensor, Hits):
            noisy = replace(
                sensor,
                sensor_noise=wrong.noise * sensor.sensor_noise,
                environment_noise=wrong.noise * sensor.environment_noise,
            )
            self._instrument = noisy, wrong.cv is None or of_time
        self._strengths: list[float] = []

    def _released(
        self, chosen: Named, source: Place, seed: int, others: Iterable[Place]
    ) -> tuple[Place, Air]:
        """Return a source and its air: the first of the others where gas can leave, if it cannot there.

        Raises NoRelease if it can nowhere.
        """
        for place in chain([source], others):
            with suppress(NoRelease):
                return place, self._air_of(chosen, place, seed)
        return source, self._air_of(chosen, source, seed)

    def _air_of(self, chosen: Named, source: Place, seed: int) -> Air:
        """Return the air with the source there. Raises NoRelease or WorldError."""
        try:
            return chosen.air(msgspec.structs.replace(self.truth, source=source), seed)
        except NoRelease:
            raise
        except (Exception, SystemExit) as error:  # it may be anybody's code
            raise _failure(self.name, chosen, error) from error

    def _sources(self, chosen: Named) -> Iterator[Place]:
        """Draw the source anew, as it was drawn; never, if the scenario says where it is."""
        problem, scenario, rng = self.problem, self.scenario, keyed(self.seed, "source drawn anew")
        if not self.errors.source and scenario.source != draw(self.seed, problem).source:
            return
        low, high = problem.spans
        for number in range(DRAWN_ANEW):
            other_seed = derived_seed(self.seed, f"source drawn anew {number}")
            if place := self.errors.source and chosen.errors(other_seed, problem).source:
                yield place
                continue
            x, y = uniform(rng, low[:2], high[:2]).tolist()
            yield problem.allowed(other_seed, (x, y), scenario.start)[0]

    @property
    def is_steady(self) -> bool:
        """Whether what is measured at a place does not depend on the time, but for its noise."""
        return self._steady is not None and not isinstance(self.sensor, Instrument)

    def of_vehicle(self, vehicle: int) -> "World":
        """Return this world as another vehicle of a fleet measures it; the first one's is this.

        Its noise is drawn by (seed, vehicle, step). What is wrong in this world is so for all vehicles.
        """
        if vehicle == 1:
            return self
        other = copy(self)
        other.seed = seed_of(self.seed, vehicle)
        other._strengths = []
        return other

    def gas(self, position: tuple[float, float], step: int, time_s: float | None = None) -> float:
        """Take gas reading number `step` (0 at the start) at a position (x, y) m.

        Returns a float32 value in the sensor's unit. time_s: of the mission; by default that of a search in
        steps of the usual length.
        """
        return self.measure(position, step, time_s)[0]

    def measure(
        self,
        position: tuple[float, float],
        step: int,
        time_s: float | None = None,
        before: Before | None = None,
    ) -> tuple[float, WindVector]:
        """Take reading number `step`: the gas, as `gas` does, and the wind that an anemometer reads there.

        before: the reading before, for a sensor that lags; without one it has been in clean air.
        """
        sensor, noise = self.sensor, self._noise
        at_s = usual_s(step) + (step + 1) * sensor.dwell if time_s is None else time_s
        if not is_timed(sensor):
            gas, winds = readings_of([self], np.array([position]), [step], np.array([at_s]), noise)
            return gas.tolist()[0], tuple(winds[0].tolist())
        strength = self._strength(step, noise) if isinstance(sensor, Instrument) else 1.0
        gain = strength * self.errors.gain
        there = met(partial(_asked_along, self), sensor, gain, position, at_s, before)
        _, wind = _asked(self, np.array([[*position, 0.0]]), np.array([at_s]))
        value = _read([self], np.array([there]), [step], [at_s], noise)[0]
        return float32(value), self._gusty(step, self._measured(*wind), noise)

    def warms_up(self, time_s: float) -> bool:
        """Whether the sensor has no value yet at this time of the mission."""
        return isinstance(self.sensor, Instrument) and time_s < self.sensor.warmup

    def _gusty(self, step: int, wind: WindVector, noise: Keyed) -> WindVector:
        """Return what an anemometer with errors of its own in each reading says of a measured wind."""
        wrong = self.errors
        if not (wrong.wind_std_deg or wrong.wind_std):
            return wind
        turned, grown = noise.at(self.seed, "anemometer", step).standard_normal(2).tolist()
        cosine, sine = direction(wrong.wind_std_deg * turned / 360.0)
        factor = max(1.0 + wrong.wind_std * grown, 0.0)
        east, north = wind
        return (
            float32(factor * float(cosine * east - sine * north)),
            float32(factor * float(sine * east + cosine * north)),
        )

    def _measured(self, east: float, north: float) -> WindVector:
        """Return what the anemometer reads of the true wind, m/s."""
        cosine, sine, speed = self._anemometer
        return (
            float32((cosine * east + sine * north) / speed),
            float32((cosine * north - sine * east) / speed),
        )

    def loses(self, step: int) -> bool:
        """Whether reading number `step` has no value at first.

        The one then taken in its place is that of `gas`.
        """
        return (
            step > 0
            and self.errors.lost > 0
            and bool(self._noise.at(self.seed, "lost reading", step).random() < self.errors.lost)
        )

    def _strength(self, step: int, noise: Keyed) -> float:
        """The gas that reading `step` meets, by the plume's mean.

        It is gamma-distributed with mean 1 and standard deviation cv. Correlated gas follows the beta-gamma
        autoregressive process of Lewis, McKenzie and Hugus (1989), whose marginals are gamma, too:
        X_n = B_n X_(n−1) + G_n with B ~ Beta(k ρ, k (1 − ρ)), G ~ Gamma(k (1 − ρ)) and k = 1/cv² has the
        autocorrelation ρ^lag.
        """
        cv, correlation = self._cv, self.errors.correlation
        if not cv:
            return 1.0
        shape = 1 / (cv * cv)
        if not correlation:
            return noise.at(self.seed, "gas", step).standard_gamma(shape) / shape
        while (number := len(self._strengths)) <= step:
            rng = noise.at(self.seed, "gas", number)
            kept = (
                rng.beta(shape * correlation, shape * (1 - correlation)) * self._strengths[-1]
                if number
                else 0.0
            )
            self._strengths.append(
                kept + rng.standard_gamma(shape * (1 - correlation) if number else shape) / shape
            )
        return self._strengths[step]

    def _stuck(self, step: int, noise: Keyed) -> float:
        """The reading of a stuck sensor."""
        wrong = self.errors
        return self._shown(
            wrong.stuck_at + wrong.stuck_std * noise.at(self.seed, "stuck", step).standard_normal()
        )

    def _shown(self, value: float) -> float:
        """What the sensor shows for a false value, one that it could give.

        A count is whole, below its threshold a sensor reads 0, and an instrument saturates; the resistance of
        a metal oxide is never above that in clean air.
        """
        match self.sensor:
            case Instrument():
                return min(value, self.sensor.saturation, self.sensor.air or math.inf)
            case Hits():
                return max(round(value), 0)
            case Threshold(threshold) if value < threshold:
                return 0.0
        return value

    def _drifted(self, sensor: Instrument, value: float, time_s: float, noise: Keyed) -> float:
        """What an instrument shows of a value at this time of the mission."""
        share = sensor.drift * noise.at(self.seed, "drift").standard_normal() * time_s / HOUR_S
        return min(value * (1.0 + share), sensor.saturation)

    @cached_property
    def _noise(self) -> Keyed:
        return Keyed()


def readings_of(
    worlds: Sequence[World], positions: Array, steps: Sequence[int], times_s: Array, noise: Keyed
) -> tuple[Array, Array]:
    """Take one reading in each of M worlds: gas (M,) and measured wind (M, 2), float32 values.

    positions: (M, 2) m.  times_s: (M,) of each mission.  noise: the generator to draw with.
    """
    places = np.zeros((len(worlds), 3))
    places[:, :2] = positions
    gas, winds = _air(worlds, places, times_s)
    means = gas * [world.errors.gain for world in worlds]
    readings = _read(worlds, means, steps, times_s, noise)
    for number, (world, step) in enumerate(zip(worlds, steps, strict=True)):
        if world.errors.wind_std or world.errors.wind_std_deg:
            winds[number] = world._gusty(step, tuple(winds[number].tolist()), noise)
    return readings.astype(np.float32).astype(np.float64), winds


def _read(
    worlds: Sequence[World],
    means: Array,
    steps: Sequence[int],
    times_s: Sequence[float] | Array,
    noise: Keyed,
) -> Array:
    """Return the readings (M,) whose noise is added to these means (M,)."""
    readings = np.empty(len(worlds))
    alike: dict[tuple[Sensor, bool], list[int]] = {}
    for number, world in enumerate(worlds):
        alike.setdefault(world._instrument, []).append(number)
    for (sensor, gas_as_told), those in alike.items():
        draws = Abreast(noise, [(worlds[i].seed, "sensor", steps[i]) for i in those])
        drawn = None if gas_as_told else means[those] * [worlds[i]._strength(steps[i], noise) for i in those]
        readings[those] = sensor.measure(means[those], draws, drawn)
    for number, (world, step) in enumerate(zip(worlds, steps, strict=True)):
        for spiked, amount in world.errors.spikes:
            if step == spiked:
                readings[number] = world._shown(readings[number] + amount)
        if isinstance(world.sensor, Instrument):
            readings[number] = world._drifted(world.sensor, readings[number], times_s[number], noise)
        if step >= world.errors.stuck_from:
            readings[number] = world._stuck(step, noise)
    return readings


def _air(worlds: Sequence[World], places: Array, times_s: Array) -> tuple[Array, Array]:
    """Return the gas (M,) and the measured wind (M, 2), float32 values, each at one place of a world."""
    plumes = [world.air for world in worlds if isinstance(world.air, Steady)]
    if len(plumes) == len(worlds):
        return gas_of(plumes, places), np.array([world._steady for world in worlds])
    gas, winds = np.empty(len(worlds)), np.empty((len(worlds), 2))
    for i, world in enumerate(worlds):
        gas[i], wind = _asked(world, places[i : i + 1], times_s[i : i + 1])
        winds[i] = world._measured(*wind)
    return gas, winds


def _asked(world: World, places: Array, times_s: Array) -> tuple[float, tuple[float, float]]:
    """Return the gas and the true wind at one place."""
    gas, winds = _asked_along(world, places, times_s)
    east, north = winds[0].tolist()
    return float(gas[0]), (east, north)


def _asked_along(world: World, places: Array, times_s: Array) -> tuple[Array, Array]:
    """Return the gas (M,) and the true wind (M, 2) at places (M, 3) of a world, anybody's code.

    Raises WorldError.
    """
    try:
        said = world.air(places, times_s)
        gas = np.asarray(said[0], np.float64).reshape(len(places))
        winds = np.asarray(said[1], np.float64).reshape(len(places), 2)
    except (Exception, SystemExit) as error:  # it may be anybody's code
        raise _failure(world.name, named(world.name), error) from error
    sound = (np.abs(winds) <= MOST).all(axis=1) & (gas >= 0) & (gas <= MOST)  # false of NaN, too
    if not sound.all():
        wrong = int(np.argmin(sound))
        raise WorldError(
            f"world {world.name} said gas {gas[wrong]:g} and wind {winds[wrong].tolist()}; wanted gas from "
            f"0 to {MOST:g} g/m³, and a wind of such numbers"
        )
    return gas, winds


def _failure(name: str, chosen: Named, error: BaseException) -> WorldError:
    """Return what is to be raised where a world of this name has failed."""
    if isinstance(error, ValueError) and chosen.make.__module__.startswith("plume."):
        return BrokenFile(str(error))
    where = traceback.extract_tb(error.__traceback__)[-1]
    failure = WorldError(
        f"world {name} failed: {type(error).__name__}: {' '.join(str(error).split())[:200]} "
        f"({Path(where.filename).name}, line {where.lineno})"
    )
    failure.add_note("".join(traceback.format_exception(error)).rstrip())
    return failure
