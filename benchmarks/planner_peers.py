"""Two peer planners for the benchmark: plain vectorised NumPy, and Stone Soup's expected Kullback-Leibler
divergence.

Both have the same knowledge as our planners. Beliefs are over x and y, with the source at the height of
the flight (the default). Stone Soup is imported when its peer is created: importing this module does not
need it.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.planning.moves import Reach
from link.bus.messages import Belief, Particles
from plume.dispersion import concentration
from plume.randomness import keyed
from plume.sensors.names import parse
from plume.sensors.sensor import Gaussian

Array = NDArray[np.float64]
Scores = Callable[[Belief, Particles, Reach, np.random.Generator], Array]
"""(belief, particles, reach, keyed randomness) -> scores of the moves (A,); the move with the greatest
score is chosen.
"""


@dataclass(frozen=True)
class Imagined:
    """K hypothetical readings at one place, under N particles."""

    place: Array
    """(2,), m."""
    sources: Array
    """(N, 2): the particles' source positions, m."""
    weights: Array
    """(N,), sum one."""
    means: Array
    """(N,): concentration at the place, g/m³."""
    log_likelihoods: Array
    """(K, N)."""
    likelihoods: Array
    """(K, N)."""
    predictive: Array
    """(K,): predictive density of each reading under the belief."""


def imagine(
    belief: Belief, particles: Particles, reach: Reach, rng: np.random.Generator
) -> Iterator[Imagined]:
    """Draw readings at each reachable place from the predictive density there, the same draws as
    `agent.planning.predict.imagine`.
    """
    sensor = parse(belief.sensor)
    sources, weights = particles[:, :2].astype(np.float64), particles[:, 2].astype(np.float64)
    weights = weights / weights.sum()
    cumulative = np.cumsum(weights)
    strata = (np.arange(reach.measurements) + rng.random()) / reach.measurements * cumulative[-1]
    drawn = np.minimum(np.searchsorted(cumulative, strata, side="right"), len(cumulative) - 1)
    seed = int(rng.integers(2**63))
    for place in reach.moves(belief.position):
        means = concentration(
            place,
            sources,
            belief.wind,
            rate=belief.rate,
            diffusivity=belief.diffusivity,
            lifetime=belief.lifetime,
        )
        readings = sensor.measure(means[drawn], np.random.Generator(np.random.Philox(seed)))
        log_likelihoods = sensor.log_likelihood(readings[:, None], means)
        likelihoods = np.exp(log_likelihoods)
        yield Imagined(place, sources, weights, means, log_likelihoods, likelihoods, likelihoods @ weights)


def information(there: Imagined) -> float:
    """Kullback–Leibler divergence from the belief to the belief after a reading, nats; mean over readings."""
    after = (there.likelihoods * there.log_likelihoods) @ there.weights / there.predictive
    return float(np.mean(after - np.log(there.predictive)))


def infotaxis(belief: Belief, particles: Particles, reach: Reach, rng: np.random.Generator) -> Array:
    """Expected information of a reading about the source, nats."""
    return np.array([information(there) for there in imagine(belief, particles, reach, rng)])


def entrotaxis(belief: Belief, particles: Particles, reach: Reach, rng: np.random.Generator) -> Array:
    """Entropy of the reading, nats: its information about the source plus the entropy of the noise."""
    sensor = parse(belief.sensor)
    return np.array(
        [
            information(there) + there.weights @ sensor.entropy(there.means)
            for there in imagine(belief, particles, reach, rng)
        ]
    )


def dcee(belief: Belief, particles: Particles, reach: Reach, rng: np.random.Generator) -> Array:
    """Minus the expected squared distance to the source after a reading, m²."""

    def expected(there: Imagined) -> Array:
        squared = np.square(there.place - there.sources).sum(axis=1)
        return np.asarray(there.likelihoods @ (there.weights * squared) / there.predictive)

    return np.array([-np.mean(expected(there)) for there in imagine(belief, particles, reach, rng)])


NUMPY: dict[str, Scores] = {"infotaxis": infotaxis, "entrotaxis": entrotaxis, "dcee": dcee}
"""By our planners' names: the same means over the same draws, computed uncompiled from the definitions of
sensor and plume.
"""


def choose(policy: str, belief: Belief, particles: Particles, seed: int, reach: Reach) -> tuple[float, float]:
    """Return the next waypoint (x, y), m, computed with NumPy; the counterpart of `agent.policies.choose`."""
    scores = NUMPY[policy](belief, particles, reach, keyed(seed, policy, belief.step))
    x, y = reach.moves(belief.position)[np.argmax(scores)].tolist()
    return x, y


class StoneSoup:
    """Stone Soup's sensor management by expected Kullback–Leibler divergence, combined as in its own gas
    example.

    As in the example: a `GasIntensitySensor` on a `FixedPlatform` whose controller offers the moves; a
    `ParticleUpdater` without resampling and regularisation; no predictor (it does not change a source that
    stays); a deep copy of the platform for each move, which is part of the method's cost. The state has
    the model's own eight dimensions; the six known ones are equal in all particles.

    Differences from our planners, and from infotaxis:
    - With one measurement per move, `ExpectedKLDivergence`: the noise-free reading from a source at the
      belief's mean. With more, the
      example's `MultiUpdateExpectedKLDivergence`: particles are resampled for each move from NumPy's
      global random state, their noise lacks the environment's part, and the reward is the sum over
      measurements, not the mean.
    - The divergence is Σ w log(w/w') between the previous weights w and the updated weights w', in nats;
      infotaxis uses Σ w' log(w'/w).
      Particles with zero likelihood in double precision are left out of the sum; they should make it
      infinite.
    - σ is α m + β: the noises are added, not combined in quadrature. The sensing threshold is set below
      all
      readings; none is missed.
    - The controller is the library's `MaxSpeedActionableMovable`, with four or eight headings; the
      example's
      grid has four. The option
      to stay, which both offer, is skipped.

    The particle state and the platform are created here, not in `choose`, because a user of the library
    already holds them.
    """

    def __init__(self, belief: Belief, particles: Particles, reach: Reach, measurements: int = 1) -> None:
        """Set up the platform at the belief's position, the track that ends in the belief's particles, and
        the reward.
        """
        from stonesoup.movable.max_speed import MaxSpeedActionableMovable
        from stonesoup.platform import FixedPlatform
        from stonesoup.sensor.gas import GasIntensitySensor
        from stonesoup.sensormanager.reward import ExpectedKLDivergence, MultiUpdateExpectedKLDivergence
        from stonesoup.types.state import ParticleState, State, StateVectors
        from stonesoup.types.track import Track
        from stonesoup.updater.particle import ParticleUpdater

        noise = parse(belief.sensor)
        assert isinstance(noise, Gaussian)
        now = datetime(2000, 1, 1)
        self._then = now + timedelta(seconds=1)
        sensor = GasIntensitySensor(
            min_noise=noise.environment_noise,
            standard_deviation_percentage=noise.sensor_noise,
            missed_detection_probability=0,
            sensing_threshold=-np.inf,
        )
        controller = MaxSpeedActionableMovable(
            states=[State([[belief.position[0]], [belief.position[1]], [belief.altitude_m]], timestamp=now)],
            position_mapping=(0, 1, 2),
            action_mapping=(0, 1),
            action_space=np.array([*zip(reach.area.low, reach.area.high, strict=True)]),
            max_speed=reach.step,
            resolution=reach.step,
            angle_resolution=2 * np.pi / reach.headings,
        )
        self._platform: Any = FixedPlatform(movement_controller=controller, sensors=[sensor])
        x, y, weights = particles.T.astype(np.float64)
        wind_x, wind_y = belief.wind
        known = (
            belief.z,
            belief.rate,
            math.hypot(wind_x, wind_y),
            math.atan2(wind_y, wind_x),
            belief.diffusivity,
            belief.lifetime,
        )
        state = StateVectors(np.vstack([x, y, *(np.full(len(x), value) for value in known)]))
        with np.errstate(divide="ignore"):
            self._track: Any = Track(
                [ParticleState(state, log_weight=np.log(weights / weights.sum()), timestamp=now)]
            )
        updater = ParticleUpdater(measurement_model=None)
        if measurements == 1:
            self._reward: Any = ExpectedKLDivergence(updater=updater)
        else:
            self._reward = MultiUpdateExpectedKLDivergence(updater=updater, updates_per_track=measurements)

    def rewards(self) -> dict[tuple[float, float], float]:
        """Return the reward of each waypoint (x, y) m, nats."""
        (actions,) = self._platform.actions(self._then)
        result = {}
        for action in list(actions)[1:]:  # the first is to stay
            x, y, _ = action.target_value.ravel().tolist()
            result[x, y] = float(self._reward({self._platform: (action,)}, {self._track}, self._then))
        return result

    def choose(self) -> tuple[float, float]:
        """Return the waypoint (x, y) m with the greatest reward."""
        rewards = self.rewards()
        return max(rewards, key=rewards.__getitem__)
