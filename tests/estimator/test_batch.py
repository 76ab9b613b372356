"""Protects batch invariance: a mission's bits depend neither on the other missions nor on threads."""

import numpy as np
import pytest

from estimator.batch import Batch
from estimator.filter import Config, Posterior, assimilate, prior
from estimator.priors import Gamma, Normal
from link.bus.mavlink import Reading
from plume.scenario import draw
from plume.sensors.sensor import Hits
from plume.worlds.world import World

MISSIONS, STEPS = 21, 70


def missions(**knowledge: object) -> tuple[list[Config], list[list[Reading]]]:
    """Missions that fly straight at their sources, so that weights degenerate and readings are tempered."""
    configs, flights = [], []
    for seed in range(MISSIONS):
        s = draw(seed)
        config = Config(200, 0.5, seed, s.q, s.d, s.tau, **knowledge)
        world = World(s, seed, config.sensor)
        ways = np.linspace(world.start, s.source, STEPS).astype(np.float32).tolist()
        configs.append(config)
        flights.append(
            [Reading(k, (x, y), 5.0, world.wind, world.gas((x, y), k)) for k, (x, y) in enumerate(ways)]
        )
    return configs, flights


def together(configs: list[Config], flights: list[list[Reading]], threads: int) -> Batch:
    batch = Batch(configs, threads)
    for k in range(STEPS):
        batch.assimilate(
            np.array([config.row(flight[k]) for config, flight in zip(configs, flights, strict=True)])
        )
    return batch


def bits(posterior: Posterior) -> list[bytes]:
    return [b"" if value is None else value.tobytes() for value in vars(posterior).values()]


@pytest.mark.parametrize(
    "knowledge",
    [{}, {"priors": {"q": Gamma(2.0, 150.0), "phi": Normal(1.0, 2.0)}, "sensor": Hits()}],
    ids=["default", "more"],
)
def test_each_mission_of_a_batch_is_bit_identical_to_the_mission_alone(knowledge: dict) -> None:
    configs, flights = missions(**knowledge)
    batches = [together(configs, flights, threads) for threads in (1, 2, 3)]
    small = together(configs[5:7], flights[5:7], 1)
    for mission, (config, flight) in enumerate(zip(configs, flights, strict=True)):
        alone = prior(config)
        for reading in flight:
            alone = assimilate(alone, reading, config)
        for batch in batches:
            assert bits(batch.posterior(mission)) == bits(alone)
        if mission in (5, 6):
            assert bits(small.posterior(mission - 5)) == bits(alone)


def test_a_batch_tells_the_moments_of_each_mission() -> None:
    configs, flights = missions()
    batch = together(configs, flights, 2)
    posterior = batch.posterior(3)
    assert batch.means[3] == pytest.approx(np.average(posterior.particles, axis=1, weights=posterior.weights))
    assert batch.covariances[3] == pytest.approx(
        np.cov(posterior.particles, aweights=posterior.weights, ddof=0)
    )


def test_missions_that_do_not_fit_together_are_refused() -> None:
    with pytest.raises(ValueError, match="the same number of particles"):
        Batch([Config(100), Config(200)])
    with pytest.raises(ValueError, match="the same unknowns"):
        Batch([Config(100), Config(100, priors={"q": Gamma(2.0, 150.0)})])
