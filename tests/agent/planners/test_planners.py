"""Protects moves and planners: each score against the same quantity, integrated numerically with
independent formulas.
"""

import math

import msgspec
import numpy as np
import pytest

from agent.planners.registry import PLANNERS, planner, reach
from agent.planning import kernels
from agent.planning.moves import Reach
from agent.planning.predict import (
    Cloud,
    Imagined,
    cloud,
    concentrations,
    entropy_spread,
    imagine,
    imagine_along,
    variances,
)
from link.bus.messages import Belief, Particles
from plume.dispersion import concentration
from plume.elementary import Array
from plume.problem import square
from plume.sensors.names import GAUSSIAN, Sensor, text
from plume.sensors.sensor import Gaussian, Hits, Threshold

RATE, DIFFUSIVITY, LIFETIME, WIND = 270.0, 4.2, 10.0, (1.5, -1.0)
HERE = (14.0, 13.0)
FOUR = Reach()


def chosen_by(name: str, belief: Belief, particles: Particles, reach: Reach, rng: np.random.Generator) -> int:
    """Which of its moves a planner makes."""
    return planner(name)(belief, particles, reach.moves(belief.position), reach, rng)


def belief_at(
    position: tuple[float, float], sensor: Sensor = GAUSSIAN, mean: tuple[float, float] = (15.0, 15.0)
) -> Belief:
    return Belief(
        time_boot_ms=0,
        step=0,
        position=position,
        altitude_m=5.0,
        gas=0.0,
        wind=WIND,
        rate=RATE,
        diffusivity=DIFFUSIVITY,
        lifetime=LIFETIME,
        z=5.0,
        sensor=text(sensor),
        unknowns=("x", "y"),
        means=mean,
        stds=(1.0, 1.0),
        mean=mean,
        covariance=(1.0, 0.0, 1.0),
        spread=1.4,
        effective_sample_size=10.0,
        p_value=0.5,
        ceased=False,
    )


def particles_of(count: int, seed: int, low: float = 5.0, high: float = 25.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(low, high, (count, 2)), rng.dirichlet(np.ones(count))]).astype(
        np.float32
    )


def mean_and_std(place: np.ndarray, x: float, y: float) -> tuple[float, float]:
    """Mean and noise of a reading at a place for a source at (x, y), by the paper's section 2."""
    dx, dy = place[0] - x, place[1] - y
    r = max(math.hypot(dx, dy), 0.1)
    u2 = WIND[0] ** 2 + WIND[1] ** 2
    lam = math.sqrt(DIFFUSIVITY * LIFETIME / (1 + u2 * LIFETIME / (4 * DIFFUSIVITY)))
    m = (
        RATE
        / (4 * math.pi * DIFFUSIVITY * r)
        * math.exp(-r / lam - (dx * WIND[0] + dy * WIND[1]) / (2 * DIFFUSIVITY))
    )
    return m, math.sqrt(0.09 * m * m + 0.04)


class Exact:
    """The effect of a reading at a place on a belief, by a fine sum over all possible readings."""

    def __init__(self, particles: np.ndarray, place: np.ndarray) -> None:
        x, y, weights = particles.astype(float).T
        weights = weights / weights.sum()
        spots = [mean_and_std(place, *at) for at in zip(x, y, strict=True)]
        # A fine grid where the noise is small (σ ≥ 0.2), a coarse one where it is large (σ about 0.3 z).
        grid = np.concatenate([np.arange(-3, 20, 0.01), 20 * np.exp(np.arange(0, 4.5, 0.001))])
        steps = np.gradient(grid)
        densities = np.array(
            [np.exp(-0.5 * ((grid - m) / s) ** 2) / (s * math.sqrt(2 * math.pi)) for m, s in spots]
        )
        mixture = weights @ densities
        seen = mixture > 1e-300
        share, densities, self._mixture = (steps * mixture)[seen], densities[:, seen], mixture[seen]
        assert share.sum() == pytest.approx(1.0, abs=1e-4)
        posteriors = weights[:, None] * densities / self._mixture
        self.entropy = -float(share @ np.log(self._mixture))
        of_noise = sum(
            w * 0.5 * math.log(2 * math.pi * math.e * s * s) for w, (_, s) in zip(weights, spots, strict=True)
        )
        self.information = self.entropy - of_noise  # I(z; source) = H(z) − H(z | source)
        means = np.stack([x @ posteriors, y @ posteriors])
        traces = (x**2 + y**2) @ posteriors - (means**2).sum(axis=0)
        self.variance = float(share @ traces)
        self.squared_distance = float(share @ (((place[:, None] - means) ** 2).sum(axis=0) + traces))
        logs = np.log(np.where(posteriors > 0, posteriors, 1.0))
        self.entropy_of_weights = float(share @ -(posteriors * logs).sum(axis=0))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_scores_converge_to_their_integrals(seed: int) -> None:
    particles, moves = particles_of(12, seed), FOUR.moves(HERE)
    exact = [Exact(particles, place) for place in moves]
    hypotheses = cloud(belief_at(HERE), particles)
    values = np.vstack(
        [hypotheses.places, np.square(hypotheses.places).sum(axis=0), np.log(hypotheses.weights)]
    )

    def draws(seed: int) -> Imagined:
        return imagine(hypotheses, moves, 40_000, np.random.default_rng(seed), values)

    said = draws(seed)
    # Information and entropy of one hypothetical reading scatter by about 1 nat: 4 standard errors of 40,000
    # are 0.02.
    assert said.gains.mean(axis=1) == pytest.approx([e.information for e in exact], abs=0.02)
    assert -said.log_predictive.mean(axis=1) == pytest.approx([e.entropy for e in exact], abs=0.02)
    noise = GAUSSIAN.entropy(said.means) @ hypotheses.weights
    assert said.gains.mean(axis=1) + noise == pytest.approx([e.entropy for e in exact], abs=0.02)
    mean_x, mean_y, squares, log_weights = said.expectations.transpose(2, 0, 1)
    left = said.log_predictive - said.log_likelihood - log_weights
    assert left.mean(axis=1) == pytest.approx([e.entropy_of_weights for e in exact], abs=0.02)
    # Variances of about 30 m² have a standard deviation of about 30 m²: 4 standard errors are 0.6 m².
    assert variances(hypotheses, moves, 40_000, np.random.default_rng(seed)).mean(axis=1) == pytest.approx(
        [e.variance for e in exact], abs=0.6
    )
    distances = (
        squares - 2 * (moves[:, :1] * mean_x + moves[:, 1:] * mean_y) + np.square(moves).sum(axis=1)[:, None]
    )
    assert distances.mean(axis=1) == pytest.approx([e.squared_distance for e in exact], rel=0.03)


@pytest.mark.parametrize(
    ("name", "quantity", "sign"),
    [
        ("infotaxis", "information", 1),
        ("entrotaxis", "entropy", 1),
        ("infotaxis-variance", "variance", -1),
        ("entrotaxis-belief", "entropy_of_weights", 1),
        ("dcee", "squared_distance", -1),
    ],
)
def test_a_planner_goes_where_its_integral_is_best(name: str, quantity: str, sign: int) -> None:
    chosen = best = average = 0.0
    for seed in range(20):
        particles, moves = particles_of(40, seed, 8.0, 22.0), FOUR.moves((11.0, 13.0))
        exact = [sign * getattr(Exact(particles, place), quantity) for place in moves]
        chosen += exact[
            chosen_by(name, belief_at((11.0, 13.0)), particles, FOUR, np.random.default_rng(seed))
        ]
        best += max(exact)
        average += sum(exact) / 4
    # With 25 hypothetical readings the best of four moves is not always found, but the loss is far below that
    # of a random move.
    assert best - chosen < 0.5 * (best - average)


def test_entrotaxis_goes_where_counts_are_the_least_certain() -> None:
    # The exact entropy of the mixture of Poisson distributions, summed. The planner's 100 readings find the
    # best move or nearly so.
    sensor, reach, chosen, best, average = Hits(), Reach(measurements=100), 0.0, 0.0, 0.0
    for seed in range(20):
        particles, moves = particles_of(40, seed, 8.0, 22.0), FOUR.moves((11.0, 13.0))
        weights = particles[:, 2] / particles[:, 2].sum()
        entropies = []
        for place in moves:
            means = np.array([mean_and_std(place, x, y)[0] for x, y, _ in particles])
            mixture = np.exp(sensor.log_likelihood(np.arange(2000.0)[:, None], means)) @ weights
            entropies.append(-float(mixture @ np.log(np.maximum(mixture, 1e-300))))
        chosen += entropies[
            chosen_by(
                "entrotaxis", belief_at((11.0, 13.0), sensor), particles, reach, np.random.default_rng(seed)
            )
        ]
        best += max(entropies)
        average += sum(entropies) / 4
    assert best - chosen < 0.1 * (best - average)


def test_what_dcee_wants_does_not_depend_on_the_reading() -> None:
    """By the law of total expectation, E‖p' − s‖² after a reading equals that before it: dcee and greedy
    differ only by chance.
    """
    particles = particles_of(12, 4)
    x, y, weights = particles.astype(float).T
    for place in FOUR.moves(HERE):
        before = float(weights @ ((place[0] - x) ** 2 + (place[1] - y) ** 2)) / weights.sum()
        assert Exact(particles, place).squared_distance == pytest.approx(before, rel=1e-3)


SENSORS = [GAUSSIAN, Gaussian(0.1, 0.5), Threshold(), Threshold(2.0, 0.0), Hits(), Hits(0.5, 2.0)]


@pytest.mark.parametrize("sensor", SENSORS, ids=text)
def test_the_fused_imagination_equals_the_readable_one(sensor: Sensor) -> None:
    particles, moves = particles_of(300, 5), Reach(headings=8).moves(HERE)
    belief = belief_at(HERE, sensor)
    hypotheses = cloud(belief, particles)
    values = np.vstack([hypotheses.places, hypotheses.places[0] * hypotheses.places[1]])
    said = imagine(hypotheses, moves, 25, np.random.default_rng(5), values)
    # The same draws, by the sensor's own density.
    rng = np.random.default_rng(5)
    strata = (np.arange(25) + rng.random()) / 25
    drawn = np.searchsorted(np.cumsum(hypotheses.weights), strata, side="right")
    seed = int(rng.integers(2**63))
    for a, place in enumerate(moves):
        means = concentration(
            place, hypotheses.places.T, WIND, rate=RATE, diffusivity=DIFFUSIVITY, lifetime=LIFETIME
        )
        readings = sensor.measure(means[drawn], np.random.Generator(np.random.Philox(seed)))
        log_likelihoods = sensor.log_likelihood(readings[:, None], means)
        predictive = np.exp(log_likelihoods) @ hypotheses.weights
        after = hypotheses.weights * np.exp(log_likelihoods) / predictive[:, None]
        left_out = np.array([math.lgamma(z + 1) for z in readings]) if isinstance(sensor, Hits) else 0.0
        assert said.log_predictive[a] == pytest.approx(np.log(predictive) + left_out, abs=1e-9)
        assert said.log_likelihood[a] == pytest.approx(
            (after * log_likelihoods).sum(axis=1) + left_out, abs=1e-9
        )
        assert said.expectations[a] == pytest.approx(after @ values.T, rel=1e-9)


@pytest.mark.parametrize("sensor", SENSORS, ids=text)
def test_readings_along_a_path_are_weighed_together(sensor: Sensor) -> None:
    particles = particles_of(300, 6)
    belief = belief_at(HERE, sensor)
    hypotheses = cloud(belief, particles)
    paths = HERE + np.arange(1, 4)[:, None] * np.array([(1.0, 0.0), (0.0, 1.0)])[:, None]  # (2, 3, 2)
    values = np.linalg.norm(paths[..., None] - hypotheses.places, axis=2)[:, :, None]
    said = imagine_along(hypotheses, paths, 25, np.random.default_rng(5), values)
    rng = np.random.default_rng(5)
    strata = (np.arange(25) + rng.random()) / 25
    drawn = np.searchsorted(np.cumsum(hypotheses.weights), strata, side="right")
    seed = int(rng.integers(2**63))
    for a, path in enumerate(paths):
        rng, joint, left_out = np.random.Generator(np.random.Philox(seed)), np.zeros((25, 300)), np.zeros(25)
        for step, place in enumerate(path):
            means = concentration(
                place, hypotheses.places.T, WIND, rate=RATE, diffusivity=DIFFUSIVITY, lifetime=LIFETIME
            )
            readings = sensor.measure(means[drawn], rng)
            joint += sensor.log_likelihood(readings[:, None], means)
            if isinstance(sensor, Hits):
                left_out += [math.lgamma(z + 1) for z in readings]
            predictive = np.exp(joint) @ hypotheses.weights
            after = hypotheses.weights * np.exp(joint) / predictive[:, None]
            assert said.log_predictive[a, step] == pytest.approx(np.log(predictive) + left_out, abs=1e-9)
            assert said.log_likelihood[a, step] == pytest.approx(
                (after * joint).sum(axis=1) + left_out, abs=1e-9
            )
            assert said.expectations[a, step, :, 0] == pytest.approx(after @ values[a, step, 0], rel=1e-9)


@pytest.mark.parametrize("sensor", SENSORS, ids=text)
def test_readings_that_are_taken_before_are_weighed_with_those_at_a_place(sensor: Sensor) -> None:
    particles = particles_of(300, 6)
    belief = belief_at(HERE, sensor)
    hypotheses = cloud(belief, particles)
    before, places = HERE + np.array([(1.0, 1.0), (2.0, 1.0)]), HERE + np.array([(1.0, 0.0), (0.0, 1.0)])
    said = imagine(hypotheses, places, 25, np.random.default_rng(5), before=before)
    rng = np.random.default_rng(5)
    strata = (np.arange(25) + rng.random()) / 25
    drawn = np.searchsorted(np.cumsum(hypotheses.weights), strata, side="right")
    bits = np.random.Philox(int(rng.integers(2**63)))

    def log_likelihoods(*at: Array) -> tuple[Array, Array]:
        """(25, 300) of readings at all of these places, and the terms that are left out for hits."""
        plume = {"rate": RATE, "diffusivity": DIFFUSIVITY, "lifetime": LIFETIME}
        means = np.array([concentration(place, hypotheses.places.T, WIND, **plume) for place in at])
        readings = sensor.measure(means[:, drawn], np.random.Generator(bits))
        factorials = [
            [math.lgamma(z + 1) if isinstance(sensor, Hits) else 0.0 for z in row] for row in readings
        ]
        each = [sensor.log_likelihood(row[:, None], mean) for row, mean in zip(readings, means, strict=True)]
        return np.sum(each, axis=0), np.sum(factorials, axis=0)

    earlier, earlier_left_out = log_likelihoods(*before)
    state = bits.state
    for a, place in enumerate([None, *places], -1):  # -1: only those before
        bits.state = state
        here, left_out = (0.0, 0.0) if place is None else log_likelihoods(place)
        joint, left_out = earlier + here, earlier_left_out + left_out
        predictive = np.exp(joint) @ hypotheses.weights
        expected = (hypotheses.weights * np.exp(joint) / predictive[:, None] * joint).sum(axis=1)
        if place is None:
            assert said.gains_before == pytest.approx(expected - np.log(predictive), abs=1e-9)
            continue
        assert said.log_predictive[a] == pytest.approx(np.log(predictive) + left_out, abs=1e-9)
        assert said.log_likelihood[a] == pytest.approx(expected + left_out, abs=1e-9)


@pytest.mark.parametrize(
    "unknowns",
    [("x", "y"), ("y", "q"), ("x", "y", "z", "q", "u", "phi", "d", "tau"), ("x", "y", "phi")],
    ids=len,
)
def test_concentrations_are_those_of_the_plume(unknowns: tuple[str, ...]) -> None:
    rng = np.random.default_rng(6)
    ranges = {
        "x": (5, 25),
        "y": (5, 25),
        "z": (0, 5),
        "q": (50, 900),
        "u": (0.5, 4),
        "phi": (-7, 7),
        "d": (1, 8),
        "tau": (5, 20),
    }
    drawn = {name: rng.uniform(*ranges[name], 50).astype(np.float32) for name in unknowns}
    particles = np.column_stack([*drawn.values(), np.full(50, 0.02, np.float32)])
    belief = belief_at(HERE)
    belief = Belief(
        **{name: getattr(belief, name) for name in belief.__struct_fields__}
        | {"unknowns": unknowns, "z": 4.0}
    )
    value = {name: column.astype(float) for name, column in drawn.items()}
    x, y, z = np.broadcast_arrays(
        value.get("x", belief.mean[0]), value.get("y", belief.mean[1]), value.get("z", 4.0)
    )
    speed, direction = value.get("u", math.hypot(*WIND)), value.get("phi", math.atan2(WIND[1], WIND[0]))
    expected = concentration(
        np.array([14.0, 14.0, 5.0]),
        np.stack([x, y, z], axis=-1),
        np.stack(np.broadcast_arrays(speed * np.cos(direction), speed * np.sin(direction)), axis=-1),
        rate=value.get("q", RATE),
        diffusivity=value.get("d", DIFFUSIVITY),
        lifetime=value.get("tau", LIFETIME),
    )
    said = concentrations(cloud(belief, particles), np.array([[14.0, 14.0]]))
    assert said[0] == pytest.approx(expected, rel=1e-12)


def with_columns(belief: Belief, unknowns: tuple[str, ...]) -> Belief:
    return msgspec.structs.replace(
        belief, unknowns=unknowns, means=(0.0,) * len(unknowns), stds=(1.0,) * len(unknowns)
    )


def normal_and_gamma_noise(count: int, seed: int) -> tuple[Belief, np.ndarray]:
    """A belief with the unknowns x, y, noise and cv, and its particles."""
    rng, particles = np.random.default_rng(seed), particles_of(count, seed)
    noise, cv = rng.lognormal(0, 0.5, count), np.abs(rng.normal(0, 0.8, count))
    columns = np.column_stack([particles[:, :2], noise, cv, particles[:, 2]]).astype(np.float32)
    return with_columns(belief_at(HERE), ("x", "y", "noise", "cv")), columns


def imagined_with_readings(
    belief: Belief, particles: np.ndarray, places: np.ndarray, number: int
) -> tuple[Imagined, np.ndarray]:
    """What is imagined, and the readings (A, K) behind it."""
    readings, fused = [], kernels.imagine
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernels, "imagine", lambda *given: (readings.append(given[4]), fused(*given))[1])
        said = imagine(cloud(belief, particles), places, number, np.random.default_rng(2))
    return said, readings[0][:, 0]


def test_readings_are_imagined_with_each_particles_own_noise_and_intermittency() -> None:
    # All particles at one place: the readings' variance is the mean of noise² σ² + cv² m², their skewness
    # that of the gamma.
    belief, particles = normal_and_gamma_noise(40, 8)
    particles[:, :2] = 15.0, 13.5
    place = np.array([[14.0, 13.0]])
    _, readings = imagined_with_readings(belief, particles, place, 200_000)
    z = readings[0]
    m, std = mean_and_std(place[0], 15.0, 13.5)
    _, _, noise, cv, weights = particles.astype(float).T
    weights = weights / weights.sum()
    # Errors of 200,000 draws: of the mean 0.3%, of the variance 2%, of the third moment, whose tail is heavy,
    # 10%.
    assert z.mean() == pytest.approx(m, rel=0.02)
    assert z.var() == pytest.approx(weights @ (noise**2 * std**2 + cv**2 * m**2), rel=0.08)
    assert np.mean((z - m) ** 3) == pytest.approx(weights @ (2 * cv**4) * m**3, rel=0.3)


def test_an_imagined_reading_is_weighed_by_each_particles_own_variance() -> None:
    belief, particles = normal_and_gamma_noise(50, 9)
    moves = Reach(headings=8).moves(HERE)
    said, readings = imagined_with_readings(belief, particles, moves, 25)
    x, y, noise, cv, weights = particles.astype(float).T
    weights = weights / weights.sum()
    for a, place in enumerate(moves):
        m, std = np.array([mean_and_std(place, *at) for at in zip(x, y, strict=True)]).T
        variance = noise**2 * std**2 + cv**2 * m**2
        for k, z in enumerate(readings[a]):
            log_likelihood = -0.5 * (z - m) ** 2 / variance - 0.5 * np.log(2 * math.pi * variance)
            after = weights * np.exp(log_likelihood)
            after /= after.sum()
            some = after > 0
            assert said.gains[a, k] == pytest.approx(
                float(after[some] @ np.log(after[some] / weights[some])), abs=1e-9
            )


def test_a_known_intermittency_of_the_sensor_counts_as_an_unknown_one_of_the_same_value() -> None:
    particles, moves = particles_of(60, 10), FOUR.moves(HERE)
    known = belief_at(HERE, Gaussian(0.3, 0.2, 0.75))
    columns = np.column_stack([particles[:, :2], np.full(60, 0.75, np.float32), particles[:, 2]])
    unknown = with_columns(belief_at(HERE), ("x", "y", "cv"))
    one, two = (
        imagine(cloud(b, p), moves, 25, np.random.default_rng(3)).gains
        for b, p in ((known, particles), (unknown, columns))
    )
    assert one == pytest.approx(two, rel=1e-9)  # the plume is summed in another order
    calm = belief_at(HERE)
    assert np.all(
        imagine(cloud(calm, particles), moves, 25, np.random.default_rng(3)).gains.mean(axis=1)
        > one.mean(axis=1)
    )


def test_a_threshold_sensor_twice_as_noisy_is_imagined_as_one_with_twice_the_noise() -> None:
    particles, moves = particles_of(60, 11), FOUR.moves(HERE)
    columns = np.column_stack([particles[:, :2], np.full(60, 2.0, np.float32), particles[:, 2]])
    doubled = belief_at(HERE, Threshold(1.0, 0.2, 0.6, 0.4))
    unknown = with_columns(belief_at(HERE, Threshold(1.0, 0.2)), ("x", "y", "noise"))
    one, two = (
        imagine(cloud(b, p), moves, 25, np.random.default_rng(4)).gains
        for b, p in ((doubled, particles), (unknown, columns))
    )
    assert one == pytest.approx(two, rel=1e-9)
    entropies = Threshold(1.0, 0.2, 0.6, 0.4).entropy([0.0, 1.0, 5.0])
    assert Threshold(1.0, 0.2).entropy([0.0, 1.0, 5.0], 2.0) == pytest.approx(entropies)


def test_homing_leaves_the_middle_once_it_is_ruled_out() -> None:
    # The source is somewhere on a ring of 12 m around the middle, 4% more likely in the east. The middle has
    # the least expected distance.
    angles = np.linspace(0, 2 * math.pi, 240, endpoint=False)
    weights = 1 + 0.04 * np.cos(angles)
    particles = np.column_stack(
        [15 + 12 * np.cos(angles), 15 + 12 * np.sin(angles), weights / weights.sum()]
    ).astype(np.float32)
    belief = msgspec.structs.replace(belief_at((15.0, 15.0)), wind=(0.0, 0.0), rate=20.0, spread=12.0)
    for _ in range(9):
        chosen = chosen_by("homing", belief, particles, reach("homing"), np.random.default_rng(1))
        belief = msgspec.structs.replace(
            belief, position=tuple(reach("homing").moves(belief.position)[chosen].tolist())
        )
    assert math.dist(belief.position, (15.0, 15.0)) > 8.0


def test_a_certain_belief_has_nothing_to_learn() -> None:
    particles = np.array([[20.0, 20.0, 1.0]], np.float32)
    belief = belief_at(HERE)
    said = imagine(cloud(belief, particles), FOUR.moves(HERE), 25, np.random.default_rng(1))
    assert said.gains.mean(axis=1) == pytest.approx(np.zeros(4), abs=1e-12)


@pytest.mark.parametrize(
    "name", ["thompson", "greedy", "space-aware-infotaxis", "dcee", "lookahead", "homing"]
)
def test_who_is_certain_heads_for_the_source(name: str) -> None:
    for source, best in (((20.0, 14.0), 0), ((13.0, 25.0), 1), ((2.0, 12.0), 2), ((14.5, 1.0), 3)):
        particles = np.array([[*source, 1.0]], np.float32)
        assert (
            chosen_by(name, belief_at(HERE, mean=source), particles, FOUR, np.random.default_rng(1)) == best
        )


def test_the_spread_of_entropy_is_that_of_a_normal_belief() -> None:
    # 20,000 particles in some 130 cells: the entropy is accurate to 0.01 nats. Cells add 1/12 of their area
    # to a variance, 0.5%.
    places = np.random.default_rng(3).normal((15.0, 12.0), 2.0, (20_000, 2)).T
    assert entropy_spread(Cloud(places, np.full(20_000, 1 / 20_000)), math.sqrt(8)) == pytest.approx(
        math.sqrt(8), rel=0.02
    )


def test_the_spread_of_entropy_shrinks_where_places_are_ruled_out_and_the_spread_does_not() -> None:
    # For a uniform distribution over an area A it is sqrt(A / (π e)); over its left and right thirds,
    # sqrt(2/3) of that.
    places = np.random.default_rng(4).uniform(0, 24, (2, 40_000))
    outer = places[:, np.abs(places[0] - 12) > 4]
    spreads = [math.sqrt(of.var(axis=1).sum()) for of in (places, outer)]
    assert spreads[1] > spreads[0]
    said = [
        entropy_spread(Cloud(of, np.full(of.shape[1], 1 / of.shape[1])), spreads[0]) for of in (places, outer)
    ]
    # Cells at the edges are not full: 10% is allowed.
    assert said == pytest.approx(
        [24 / math.sqrt(math.pi * math.e), 24 * math.sqrt(2 / 3 / (math.pi * math.e))], rel=0.1
    )


@pytest.mark.parametrize("name", ["lookahead", "homing"])
def test_who_is_almost_certain_of_one_of_two_places_looks_at_the_nearer_one(name: str) -> None:
    # The source is 2 m to the east or 12 m to the west, equally likely: going east costs little and tells
    # which.
    particles = np.array([[16.0, 13.0, 0.5], [2.0, 13.0, 0.5]], np.float32)
    belief = belief_at(HERE, mean=(9.0, 13.0))
    assert chosen_by(name, belief, particles, FOUR, np.random.default_rng(1)) == 0


@pytest.mark.parametrize(
    ("name", "own"), [("infotaxis", (4, 25)), ("homing", (8, 100)), ("lookahead", (8, 50))]
)
def test_a_planner_has_its_own_reach_where_none_is_given(name: str, own: tuple[int, int]) -> None:
    assert (reach(name).headings, reach(name).measurements) == own
    assert reach(name, {"headings": 4, "step": 0.5}) == Reach(4, 0.5, own[1], fits=name != "infotaxis")


def test_a_thinned_cloud_keeps_every_so_many_th_particle() -> None:
    hypotheses = cloud(belief_at(HERE), particles_of(1000, 7))
    thin = hypotheses.thinned(400)
    assert np.array_equal(thin.values, hypotheses.values[:, ::3])
    assert thin.weights == pytest.approx(hypotheses.weights[::3] / hypotheses.weights[::3].sum())
    assert np.array_equal(hypotheses.thinned(1000).values, hypotheses.values)


def test_thompson_takes_a_side_as_often_as_it_is_believed() -> None:
    particles = np.array([[24.0, 13.0, 0.75], [4.0, 13.0, 0.25]], np.float32)
    rng = np.random.default_rng(2)
    east = sum(chosen_by("thompson", belief_at(HERE), particles, FOUR, rng) == 0 for _ in range(4000))
    assert abs(east - 3000) < 4 * math.sqrt(4000 * 0.75 * 0.25)  # 4 standard deviations


def test_moves_are_steps_of_a_metre() -> None:
    assert FOUR.moves(HERE).tolist() == [[15.0, 13.0], [14.0, 14.0], [13.0, 13.0], [14.0, 12.0]]
    eight = Reach(headings=8).moves(HERE)
    assert np.linalg.norm(eight - HERE, axis=1) == pytest.approx(np.ones(8), abs=1e-6)
    assert np.degrees(np.arctan2(*(eight - HERE).T[::-1])) % 360 == pytest.approx(
        np.arange(8) * 45.0, abs=1e-4
    )
    assert Reach(step=2.5).moves(HERE)[0].tolist() == [16.5, 13.0]


@pytest.mark.parametrize(
    ("position", "count"),
    [
        ((0.0, 0.0), 2),
        ((0.5, 0.5), 2),
        ((30.0, 15.0), 3),
        ((29.5, 29.5), 2),
        ((1.0, 1.0), 4),
        ((29.0, 29.0), 4),
    ],
)
def test_no_move_leaves_the_area(position: tuple[float, float], count: int) -> None:
    moves = FOUR.moves(position)
    assert len(moves) == count
    assert moves.min() >= 0.0
    assert moves.max() <= 30.0


def test_moves_are_exact_float32_values() -> None:
    moves = Reach(headings=8).moves((float(np.float32(3.7280619)), float(np.float32(0.21317468))))
    assert np.array_equal(moves, moves.astype(np.float32).astype(np.float64))


def test_random_takes_each_move_equally_often() -> None:
    particles, rng = particles_of(5, 1), np.random.default_rng(1)
    counts = np.bincount([chosen_by("random", belief_at(HERE), particles, FOUR, rng) for _ in range(4000)])
    assert np.all(np.abs(counts - 1000) < 4 * math.sqrt(4000 * 0.25 * 0.75))  # 4 standard deviations


@pytest.mark.parametrize("headings", [4, 8])
@pytest.mark.parametrize("name", PLANNERS)
def test_a_planner_is_a_function_of_belief_and_key(name: str, headings: int) -> None:
    reach, particles = Reach(headings=headings, measurements=10), particles_of(200, 1)
    choices = {
        chosen_by(name, belief_at((29.5, 13.0)), particles, reach, np.random.default_rng(5)) for _ in range(5)
    }
    assert len(choices) == 1
    assert choices <= set(range(len(reach.moves((29.5, 13.0)))))


@pytest.mark.parametrize("name", PLANNERS)
def test_decisions_do_not_depend_on_the_unit_of_length(name: str) -> None:
    """An area, a step, a belief and a wind that are eight times as long, of a plume of the same shape: exp(−r/λ + ψ)/r
    is the same with u and λ eight times, d 64 times and q 512 times as great.
    """
    for seed in range(8):
        particles, small = particles_of(300, seed), belief_at(HERE)
        large = msgspec.structs.replace(
            small,
            position=tuple(8 * at for at in small.position),
            mean=tuple(8 * at for at in small.mean),
            wind=tuple(8 * speed for speed in small.wind),
            covariance=tuple(64 * of for of in small.covariance),
            rate=512 * small.rate,
            diffusivity=64 * small.diffusivity,
            spread=8 * small.spread,
        )
        scaled = (particles * np.array([8, 8, 1])).astype(np.float32)
        near = reach(name, {"step": 2.0})
        far = reach(name, {"step": 16.0}, square(8 * near.area.side_m))
        chosen = [
            chosen_by(name, belief, cloud, it.fitted(belief), np.random.default_rng(seed))
            for belief, cloud, it in ((small, particles, near), (large, scaled, far))
        ]
        assert chosen[0] == chosen[1]
