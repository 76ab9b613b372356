"""The messages after a reading: the belief, its particles, and the stop (AGDC)."""

import math
from collections.abc import Collection, Mapping, Sequence
from types import MappingProxyType

import msgspec
import numpy as np

from estimator.dwell import advised_dwell, intermittency
from estimator.filter import Config, Posterior
from estimator.kernels.checks import log_likelihood_of_one_value, one_wind_p_value, uniformity_p_value
from estimator.kernels.densities import log_priors
from estimator.kernels.weights import effective_sample_size, moments, weighted_mean
from estimator.priors import Fixed
from link.bus.mavlink import Reading
from link.bus.messages import Belief, Contribution, LeftAt, Particles, Stop
from plume.elementary import Array, direction
from plume.parameters import CV, PARAMETERS
from plume.problems.fleet import Place
from plume.scenario import INCOMPATIBLE, SURE_OUTSIDE, stretch

RECENT = 30  # recent readings in the test of whether they fit the model
FEWEST = 8  # with fewer readings the test has no power: the p-value is 1
CLEAR = 5.0  # least `evidence` for a stop, nats
# This many bit-identical readings in a row mean that a noisy sensor is stuck. No stop comes before so many.
STUCK = 3
REPEATS = 10  # readings at two places in turn: of 240 searches in gas as modelled, none had so many
NOBODY: Mapping[int, Place] = MappingProxyType({})  # joins
SAME = 1 / 4  # of the way between the two: places that are nearer to each other are one


def belief(posterior: Posterior, reading: Reading, config: Config) -> tuple[Belief, Particles]:
    """Return the belief message after `reading`, with whether the search has ceased, and its particles.

    The particles are an array (N, D + 1). A row of the array, float32, is a particle: its D unknowns in the
    order of `Belief.unknowns`, then its weight; the weights sum to 1.

    Examples:
        >>> config = plumeward.Config(rate=250.0, diffusivity=3.0)
        >>> reading = plumeward.Reading(0, (8.0, 9.0), 5.0, (1.5, -0.5), 1.3)
        >>> posterior = plumeward.assimilate(plumeward.prior(config), reading, config)
        >>> said, particles = plumeward.belief(posterior, reading, config)
        >>> round(said.spread, 2), said.ceased, particles.shape  # m; may it stop?; x, y and weight
        (3.03, False, (1000, 3))
    """
    unknown_means, unknown_covariance = moments(posterior.particles, posterior.weights)
    means = every_mean(unknown_means, config)
    covariance = np.zeros((len(PARAMETERS), len(PARAMETERS)))
    covariance[np.ix_(config.unknown_indices, config.unknown_indices)] = unknown_covariance
    mean = dict(zip(PARAMETERS, means.tolist(), strict=True))
    std = dict(zip(PARAMETERS, np.sqrt(covariance.diagonal()).tolist(), strict=True))
    (xx, xy), (_, yy) = covariance[:2, :2].tolist()
    spread = math.sqrt(xx + yy)
    located = locates(posterior, spread, unknown_means, config)
    p_value, better = fit(posterior, config), evidence(posterior, config)
    outside = share_outside(posterior, config)
    gas = intermittency(posterior, config)
    summary = Belief(
        time_boot_ms=reading.time_boot_ms,
        step=max(len(posterior.readings[own]) for own in posterior.by_vehicle) - 1,
        position=reading.position,
        altitude_m=reading.altitude_m,
        gas=reading.gas,
        wind=_wind(mean, reading, config),
        sensor=config.sensor_text,
        rate=mean["q"],
        diffusivity=mean["d"],
        lifetime=mean["tau"],
        z=mean["z"] if "z" in config.priors else reading.altitude_m,
        unknowns=config.unknowns,
        means=tuple(mean[name] for name in config.unknowns),
        stds=tuple(std[name] for name in config.unknowns),
        mean=(mean["x"], mean["y"]),
        covariance=(xx, xy, yy),
        spread=spread,
        effective_sample_size=effective_sample_size(posterior.weights),
        p_value=p_value,
        evidence=better,
        ceased=may_claim(p_value, better, len(posterior.readings))
        and sure_enough(located, outside, std, config),
        assume=config.assume,
        stop=config.criterion.text,
        outside=outside,
        wind_p_value=one_wind(posterior, config),
        intermittency=gas,
        advised_dwell=advised_dwell(gas, config.sensor),
        back=_back(posterior),
        backs=_backs(posterior),
    )
    particles = np.empty((posterior.particles.shape[1], len(unknown_means) + 1), np.float32, order="F")
    particles[:, :-1] = posterior.particles.T
    particles[:, -1] = posterior.weights / posterior.weights.sum()
    return summary, particles


def _back(posterior: Posterior) -> tuple[float, float] | msgspec.UnsetType:
    place = way_back(posterior.readings[:, :2]) if posterior.vehicles is None else None
    return msgspec.UNSET if place is None else place


def _backs(posterior: Posterior) -> dict[int, tuple[float, float]] | msgspec.UnsetType:
    if posterior.vehicles is None:
        return msgspec.UNSET
    found = {
        int(posterior.vehicles[own][0]): place
        for own in posterior.by_vehicle
        if (place := way_back(posterior.readings[own, :2]))
    }
    return found or msgspec.UNSET


def way_back(places: Array) -> tuple[float, float] | None:
    """Return where a search that repeats itself would go next; None if it does not.

    places: (T, 2) m, where the readings were taken. The search repeats itself if the last REPEATS of them
    were taken at two places in turn. A vehicle that stays at one place does not.
    """
    last = places[-REPEATS:]
    if len(last) < REPEATS:
        return None
    moved = np.square(last[2:] - last[1:-1]).sum(axis=1)
    apart = np.square(last[2:] - last[:-2]).sum(axis=1)
    if not (apart < SAME * SAME * moved).all():
        return None
    x, y = last[-2].tolist()
    return x, y


def fit(posterior: Posterior, config: Config) -> float:
    """Return the p-value of the recent readings; 0 if the sensor is stuck.

    It tests whether their ranks in their predictive distributions are uniform. A sensor is stuck as long as
    its last reading is a recent one: its vehicle may have left.
    """
    ranks = posterior.ranks
    if stuck(posterior, config):
        return 0.0
    return 1.0 if len(ranks) < FEWEST else float(uniformity_p_value(ranks[-RECENT:]))


def left_at(
    read_at: Mapping[int, tuple[Place, Place]],
    numbers: Collection[int],
    joining: Mapping[int, Place] = NOBODY,
) -> tuple[LeftAt, ...] | msgspec.UnsetType:
    """Return where those may be that take no part in a round, but have or will; UNSET: there are none.

    read_at: the first and the last place, (x, y) m, of each vehicle that has ever read.  numbers: those of
    the round.  joining: where each takes off that is about to join, (x, y) m.
    """
    there = {**{number: (place, place) for number, place in joining.items()}, **read_at}
    away = [LeftAt(number, *places) for number, places in sorted(there.items()) if number not in numbers]
    return tuple(away) or msgspec.UNSET


def stuck(posterior: Posterior, config: Config) -> Sequence[int]:
    """Return the numbers of the vehicles whose sensor is stuck; 1 is that of one alone."""
    found: list[int] = []
    for own in posterior.by_vehicle:
        last = posterior.readings[own, 5][-STUCK:]
        if not isinstance(own, slice) and own[-1] < len(posterior.ranks) - RECENT:
            continue
        if len(last) == STUCK and (last == last[-1]).all() and config.sensor.is_noisy(float(last[-1])):
            found.append(1 if posterior.vehicles is None else int(posterior.vehicles[own][-1]))
    return found


def evidence(posterior: Posterior, config: Config) -> float:
    """Return by how many nats the belief explains the readings better than one value plus noise.

    The mean log-likelihood of all readings under the belief, less the greatest that any sensor gives them
    that shows one value plus noise. A sensor that hums at one value fits a distant source with a wide plume,
    so the model check is silent; but then this is near 0 or below.
    """
    log_likelihoods = posterior.log_targets - log_priors(posterior.particles, config.model)
    of_one_value = log_likelihood_of_one_value(posterior.readings, config.model.sensor, config.spikes)
    return weighted_mean(posterior.weights, log_likelihoods) - of_one_value


def one_wind(posterior: Posterior, config: Config) -> float:
    """Return the p-value of the measured winds under one wind; 1 if they are not used, or under `paper`.

    The model takes the wind of a reading to blow everywhere. Among buildings it does not, and the ranks of
    the readings hardly show it: the belief finds another place, from which a straight plume fits them.
    """
    if config.assume != "field" or {"u", "phi"} & set(config.priors):
        return 1.0
    winds = posterior.readings[:, 3:5]
    return float(one_wind_p_value(np.concatenate([winds[own] for own in posterior.by_vehicle])))


def may_claim(p_value: float, better: float, readings: int) -> bool:
    """True if a find may be claimed.

    There are enough readings, they fit the model (`fit`), and they need a plume (`evidence`).
    """
    return readings >= STUCK and p_value >= INCOMPATIBLE and better >= CLEAR


def met(posterior: Posterior, said: Belief, config: Config) -> bool:
    """Whether this belief meets the stop criterion of `config`, even if it was computed under another."""
    located = locates(posterior, said.spread, np.array(said.means), config)
    stds = dict(zip(said.unknowns, said.stds, strict=True))
    return may_claim(said.p_value, said.evidence, said.step + 1) and sure_enough(
        located, said.outside, stds, config
    )


def warning(said: Belief, config: Config) -> tuple[str, str] | None:
    """Return why a stop would not be honest now, and the question that it raises; None if it would be.

    A belief that is not narrow yet gives no warning for want of evidence: most searches begin so.
    """
    narrow_m = config.within[0] if config.within else config.threshold_m
    if said.doubted:
        whose = " and ".join(f"uav/{vehicle}" for vehicle in said.doubted)
        return (
            f"the readings of {whose} do not fit those of the others",
            "is the sensor stuck, dead or wrong?",
        )
    if said.p_value < INCOMPATIBLE:
        return (
            f"the readings do not fit the model (p = {said.p_value:.1g} over the last {RECENT})",
            "is the sensor stuck, is the model right?",
        )
    if said.wind_p_value < INCOMPATIBLE:
        return (
            f"the wind is not the same at all readings (p = {said.wind_p_value:.1g})",
            "do buildings bend the plume, does the wind turn?",
        )
    if said.spread < narrow_m and said.evidence < CLEAR:
        return "one value plus noise explains the readings as well as a plume does", "does the sensor hum?"
    return None


def every_mean(means: Array, config: Config) -> Array:
    """Return the mean of every parameter, (15,): that of an unknown is among `means` (D,)."""
    every = config.prior_rows[:, 1].copy()  # values of the known
    every[config.unknown_indices] = means
    return every


def locates(posterior: Posterior, spread: float, means: Array, config: Config) -> bool:
    """True if the stop criterion's claim of the location is met, also when neighbouring readings are alike.

    spread and means (D,) are those of the posterior, which errors may exceed by `stretch`.
    """
    wider = stretch(float(every_mean(means, config)[CV]))
    if config.within is None:
        return spread * wider < config.threshold_m
    radius_m, wanted = config.within
    return share_within(radius_m / wider, posterior, means, config) >= wanted


def share_within(radius_m: float, posterior: Posterior, means: Array, config: Config) -> float:
    """Return the share of the belief's weight within a radius of the estimate, of which means (D,) tell.

    A known x or y is the estimate's own.
    """
    weights = posterior.weights
    squares = np.zeros(len(weights))
    for row, mean, name in zip(posterior.particles, means, config.unknowns, strict=True):
        if name in ("x", "y"):
            squares += np.square(row - mean)
    return float(weights[squares <= radius_m * radius_m].sum() / weights.sum())


def share_outside(posterior: Posterior, config: Config) -> float:
    """Return the share of the belief's weight outside the area."""
    if config.margin == 0:
        return 0.0
    outside = np.zeros(len(posterior.weights), bool)
    for row, name in zip(posterior.particles, config.unknowns, strict=True):
        if name in ("x", "y"):
            axis = "xy".index(name)
            outside |= (row < config.area.low[axis]) | (row > config.area.high[axis])
    return float(posterior.weights[outside].sum() / posterior.weights.sum()) if outside.any() else 0.0


def sure_enough(located: bool, outside: float, stds: Mapping[str, float], config: Config) -> bool:
    """True if the stop criterion is met, or the source is outside the area, where no search can meet it.

    The criterion is met where the location is known (`locates`), if required, and standard deviations are
    below their limits.  outside: as of `share_outside`.
    """
    met = (located or not config.stop_on_location) and all(
        stds[name] < limit for name, limit in config.stop_limits.items()
    )
    return met or outside >= SURE_OUTSIDE


def _wind(mean: dict[str, float], reading: Reading, config: Config) -> tuple[float, float]:
    """Return the assumed wind, (u cos φ, u sin φ) m/s.

    Its speed and direction are the reading's, or their means if they have a prior. Known errors of the
    measurement are corrected. Unknown ones are not: each particle has its own.
    """
    known = {name: prior.value for name, prior in config.priors.items() if isinstance(prior, Fixed)}
    if not {"u", "phi"} & set(config.priors) and not {"wind-speed", "wind-direction"} & set(known):
        return reading.wind
    east, north = reading.wind
    measured = math.sqrt(east * east + north * north)
    speed = mean["u"] if "u" in config.priors else measured * known.get("wind-speed", 1.0)
    turns = mean["phi"] / math.tau if "phi" in config.priors else known.get("wind-direction", 0.0) / 360
    x, y = (1.0, 0.0) if "phi" in config.priors or not measured else (east / measured, north / measured)
    cosine, sine = map(float, direction(turns))
    return speed * (x * cosine - y * sine), speed * (x * sine + y * cosine)


def contributions(posterior: Posterior) -> tuple[Contribution, ...]:
    """Return what each vehicle has measured of the readings behind a posterior."""
    vehicles = [1] if posterior.vehicles is None else np.unique(posterior.vehicles).tolist()
    return tuple(
        Contribution(vehicle, len(gas := posterior.readings[own, 5]), float(gas.max()))
        for vehicle, own in zip(vehicles, posterior.by_vehicle, strict=True)
    )


def stop(ceased: Belief, config: Config) -> Stop:
    """Return the stop message that a ceased belief claims."""
    return Stop(
        time_boot_ms=ceased.time_boot_ms,
        step=ceased.step,
        estimate=ceased.mean,
        covariance=ceased.covariance,
        spread=ceased.spread,
        threshold=0.0 if config.within else config.threshold_m,
        stop=config.criterion.text,
        outside=ceased.outside,
    )
