"""Protects every planner's choice: it is the best by scores that plain NumPy computes from the formulas,
place by place.

Only the draws are shared with the planners: which particles readings are imagined from, and the noise of
each.
"""

import math
from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest

from agent.planners.registry import PLANNERS, reach
from agent.planning.moves import Reach
from link.bus.messages import Belief
from plume.sensors.names import GAUSSIAN, Sensor, text
from plume.sensors.sensor import Gaussian, Hits, Threshold
from tests.agent.planners.test_planners import chosen_by

Array = np.ndarray
DIFFUSIVITY, LIFETIME, ALTITUDE, HEIGHT = 4.2, 10.0, 5.0, 4.25


class World:
    """A belief, its particles, the possible moves and the planner's choice."""

    def __init__(self, seed: int, sensor: Sensor, name: str, count: int = 60, headings: int = 4) -> None:
        rng = np.random.default_rng(seed)
        around, width = rng.uniform(8, 22, 2), math.exp(rng.uniform(-1.5, 1.8))
        x, y = np.clip(rng.normal(around, width, (count, 2)), 0.5, 29.5).astype(np.float32).T
        rate = rng.uniform(100, 500, count).astype(np.float32)
        weights = rng.dirichlet(np.ones(count)).astype(np.float32)
        here = np.clip(around + rng.normal(0, 1 + width, 2), 0, 30).astype(np.float32)
        if seed % 4 == 0:  # close to each edge in turn
            here[seed // 4 % 2] = (0.75, 29.5)[seed // 8 % 2]
        speed, direction = rng.uniform(1, 4), rng.uniform(0, 2 * math.pi)
        self.wind = (
            float(np.float32(speed * math.cos(direction))),
            float(np.float32(speed * math.sin(direction))),
        )
        self.particles = np.column_stack([x, y, rate, weights])
        self.x, self.y, self.rate, self.weights = self.particles.T.astype(float)
        self.weights = self.weights / self.weights.sum()
        self.dead_ends = 0
        self.sensor, self.here = sensor, (float(np.float32(here[0])), float(np.float32(here[1])))
        self.mean = (float(self.weights @ self.x), float(self.weights @ self.y))
        self.spread = math.sqrt(self.weights @ ((self.x - self.mean[0]) ** 2 + (self.y - self.mean[1]) ** 2))
        self.reach = Reach(headings=headings, measurements=10)
        self.rng = np.random.default_rng(seed + 1000)
        self.chosen = chosen_by(
            name, self.belief(), self.particles, self.reach, np.random.default_rng(seed + 1000)
        )
        self.moves = np.array(
            [self.move(heading) for heading in range(headings) if self.is_inside(self.move(heading))]
        )

    def belief(self) -> Belief:
        return Belief(
            time_boot_ms=0,
            step=0,
            position=self.here,
            altitude_m=ALTITUDE,
            gas=0.0,
            wind=self.wind,
            rate=300.0,
            diffusivity=DIFFUSIVITY,
            lifetime=LIFETIME,
            z=HEIGHT,
            sensor=text(self.sensor),
            unknowns=("x", "y", "q"),
            means=(*self.mean, 300.0),
            stds=(1.0, 1.0, 1.0),
            mean=self.mean,
            covariance=(1.0, 0.0, 1.0),
            spread=self.spread,
            effective_sample_size=10.0,
            p_value=0.5,
            ceased=False,
        )

    def move(self, heading: int) -> list[float]:
        """The waypoint one metre away in a direction, float32 values; rounding makes east exactly east."""
        angle = 2 * math.pi * heading / self.reach.headings
        return [
            float(np.float32(p + round(of(angle), 12)))
            for p, of in zip(self.here, (math.cos, math.sin), strict=True)
        ]

    def is_inside(self, place: list[float]) -> bool:
        return all(0 <= value <= 30 for value in place)

    def thin(self, most: int) -> None:
        """Keep at most `most` evenly spaced particles."""
        every = -(-len(self.x) // most)
        self.x, self.y, self.rate, self.weights = (
            values[::every] for values in (self.x, self.y, self.rate, self.weights)
        )
        self.weights = self.weights / self.weights.sum()

    def means_at(self, place: Array) -> Array:
        """Concentration for each particle: the paper's section 2."""
        dx, dy, dz = place[0] - self.x, place[1] - self.y, ALTITUDE - HEIGHT
        r = np.maximum(np.sqrt(dx**2 + dy**2 + dz**2), 0.1)
        lam = math.sqrt(
            DIFFUSIVITY
            * LIFETIME
            / (1 + (self.wind[0] ** 2 + self.wind[1] ** 2) * LIFETIME / (4 * DIFFUSIVITY))
        )
        psi = -(dx * self.wind[0] + dy * self.wind[1]) / (2 * DIFFUSIVITY)
        return self.rate / (4 * math.pi * DIFFUSIVITY * r) * np.exp(-r / lam + psi)

    def density(self, z: float, means: Array) -> Array:
        """p(z | m) for each m; for hits up to a factor that depends on z alone."""
        match self.sensor:
            case Hits(efficiency, background):
                expected = efficiency * means + background
                return np.exp(z * np.log(expected) - expected - (z * math.log(max(z, 1)) - z))
            case Threshold(threshold, missed, slope, floor):
                std = np.sqrt((slope * means) ** 2 + floor**2)
                if z == 0:
                    below = [
                        0.5 * math.erfc((m - threshold) / s / math.sqrt(2))
                        for m, s in zip(means, std, strict=True)
                    ]
                    return missed + (1 - missed) * np.array(below)
                return (1 - missed) * np.exp(-0.5 * ((z - means) / std) ** 2) / (std * math.sqrt(2 * math.pi))
            case Gaussian(slope, floor):
                std = np.sqrt((slope * means) ** 2 + floor**2)
                return np.exp(-0.5 * ((z - means) / std) ** 2) / (std * math.sqrt(2 * math.pi))

    def after(self, paths: list[list[Array]]) -> list[list[Array]]:
        """Weights (K, N) at each place of each path, after the hypothetical readings on the path up to
        there: [path][place].
        """
        number = self.reach.measurements
        strata = (np.arange(number) + self.rng.random()) / number
        of = [int(np.argmax(np.cumsum(self.weights) > stratum)) for stratum in strata]
        key = int(self.rng.integers(2**63))
        result = []
        for path in paths:
            noise, weights = np.random.Generator(np.random.Philox(key)), np.tile(self.weights, (number, 1))
            result.append([])
            for place in path:
                means = self.means_at(place)
                for k, z in enumerate(self.sensor.measure(means[of], noise)):
                    raised = weights[k] * self.density(float(z), means)
                    weights[k] = raised / raised.sum()
                result[-1].append(weights.copy())
        return result

    def after_moves(self) -> list[Array]:
        """The same for one reading at the end of each move."""
        return [weights for (weights,) in self.after([[place] for place in self.moves])]

    def information(self, weights: Array) -> float:
        """Kullback–Leibler divergence from this belief to the one with these weights, nats."""
        some = weights > 0
        return float(weights[some] @ np.log(weights[some] / self.weights[some]))

    def distances(self, place: Array) -> Array:
        return np.hypot(place[0] - self.x, place[1] - self.y)

    def entropy_spread(self) -> float:
        """Spread σ of the round normal distribution, whose entropy ln(π e σ²) is that of the particles in
        cells.
        """
        cell = max(self.spread, 0.1) / 4
        shares: Counter[tuple[int, int]] = Counter()
        for x, y, weight in zip(self.x, self.y, self.weights, strict=True):
            shares[math.floor(x / cell), math.floor(y / cell)] += weight
        entropy = -sum(share * math.log(share / cell**2) for share in shares.values())
        return math.sqrt(math.exp(entropy) / (math.pi * math.e))

    def ahead(self, steps: float) -> list[Array]:
        """Places this many steps ahead along each move, clipped to the area."""
        return [np.clip(np.array(self.here) + steps * (place - self.here), 0, 30) for place in self.moves]


def infotaxis(w: World) -> list[float]:
    return [np.mean([w.information(weights) for weights in of_place]) for of_place in w.after_moves()]


def entropy_of_noise(w: World, mean: float) -> float:
    """−∫ p(z | m) log p(z | m) dz, by the definition."""
    if isinstance(w.sensor, Hits):
        expected = w.sensor.efficiency * mean + w.sensor.background
        counts = np.arange(int(expected + 12 * math.sqrt(expected) + 30))
        logs = counts * math.log(expected) - expected - np.array([math.lgamma(k + 1) for k in counts])
        return float(-np.exp(logs) @ logs)
    std = math.sqrt((w.sensor.sensor_noise * mean) ** 2 + w.sensor.environment_noise**2)
    if isinstance(w.sensor, Gaussian):
        return 0.5 * math.log(2 * math.pi * math.e * std**2)
    z = np.linspace(w.sensor.threshold, max(mean, w.sensor.threshold) + 10 * std, 20_001)
    heard = (1 - w.sensor.missed) * np.exp(-0.5 * ((z - mean) / std) ** 2) / (std * math.sqrt(2 * math.pi))
    silent = w.density(0.0, np.array([mean]))[0]
    return float(-silent * math.log(silent) - np.trapezoid(heard * np.log(np.maximum(heard, 1e-300)), z))


def entrotaxis(w: World) -> list[float]:
    noise = [
        sum(p * entropy_of_noise(w, m) for p, m in zip(w.weights, w.means_at(place), strict=True))
        for place in w.moves
    ]
    return [information + of_noise for information, of_noise in zip(infotaxis(w), noise, strict=True)]


def entrotaxis_belief(w: World) -> list[float]:
    return [
        np.mean([-sum(p * math.log(p) for p in weights if p > 0) for weights in of_place])
        for of_place in w.after_moves()
    ]


def infotaxis_variance(w: World) -> list[float]:
    def trace(weights: Array) -> float:
        return sum(float(weights @ (values - weights @ values) ** 2) for values in (w.x, w.y))

    return [-np.mean([trace(weights) for weights in of_place]) for of_place in w.after_moves()]


def dcee(w: World) -> list[float]:
    """‖p' − ŝ'‖² + tr Cov'."""

    def score(place: Array, weights: Array) -> float:
        middle = weights @ w.x, weights @ w.y
        return math.dist(place, middle) ** 2 + sum(
            float(weights @ (v - m) ** 2) for v, m in zip((w.x, w.y), middle, strict=True)
        )

    return [
        -np.mean([score(place, weights) for weights in of_place])
        for place, of_place in zip(w.moves, w.after_moves(), strict=True)
    ]


def space_aware_infotaxis(w: World) -> list[float]:
    """log₂(D + (2^H − 1)/2), in cells of a metre and bits."""
    shares: Counter[tuple[int, int]] = Counter()
    for x, y, weight in zip(w.x, w.y, w.weights, strict=True):
        shares[math.floor(x), math.floor(y)] += weight
    bits = -sum(share * math.log2(share) for share in shares.values())

    def score(place: Array, weights: Array) -> float:
        distance = weights @ (np.abs(place[0] - w.x) + np.abs(place[1] - w.y))
        left = max(bits - w.information(weights) / math.log(2), 0.0)
        return math.log2(distance + (2**left - 1) / 2)

    return [
        -np.mean([score(place, weights) for weights in of_place])
        for place, of_place in zip(w.moves, w.after_moves(), strict=True)
    ]


def greedy(w: World) -> list[float]:
    return [-math.dist(place, w.mean) for place in w.moves]


def thompson(w: World) -> list[float]:
    drawn = w.rng.choice(len(w.weights), p=w.weights)
    return [-math.dist(place, (w.x[drawn], w.y[drawn])) for place in w.moves]


def homing(w: World) -> list[float]:
    """E‖p − s‖ + 4 E[spread], two steps ahead; entropy falls by the information I, the spread by
    exp(−I/2).

    If that falls by less than 0.75 a metre everywhere, −S log E exp(−‖p − s‖/S) + 4 E[spread].
    """
    w.thin(500)
    places, now = w.ahead(2.0), w.entropy_spread()
    spreads = [
        now * np.mean([math.exp(-w.information(weights) / 2) for weights in of_place])
        for (of_place,) in w.after([[place] for place in places])
    ]
    costs = [
        w.weights @ w.distances(place) + 4.0 * spread for place, spread in zip(places, spreads, strict=True)
    ]
    here = w.weights @ w.distances(np.array(w.here)) + 4.0 * now
    if any(here - cost >= 0.75 * math.dist(place, w.here) for place, cost in zip(places, costs, strict=True)):
        return [-cost for cost in costs]
    w.dead_ends += 1
    return [
        now * math.log(w.weights @ np.exp(-w.distances(place) / now)) - 4.0 * spread
        for place, spread in zip(places, spreads, strict=True)
    ]


def lookahead(w: World) -> list[float]:
    """The same after readings two and four steps ahead, plus the distance flown; the better of the two
    places counts.
    """
    w.thin(500)
    paths = [list(path) for path in zip(w.ahead(2.0), w.ahead(4.0), strict=True)]
    scores = []
    for path, of_path in zip(paths, w.after(paths), strict=True):
        costs = [
            math.dist(place, w.here)
            + w.weights @ w.distances(place)
            + 4.0
            * w.entropy_spread()
            * np.mean([math.exp(-w.information(weights) / 2) for weights in of_place])
            for place, of_place in zip(path, of_path, strict=True)
        ]
        scores.append(-min(costs))
    return scores


ORACLES: dict[str, Callable[[World], list[float]]] = {
    "infotaxis": infotaxis,
    "entrotaxis": entrotaxis,
    "dcee": dcee,
    "infotaxis-variance": infotaxis_variance,
    "entrotaxis-belief": entrotaxis_belief,
    "thompson": thompson,
    "space-aware-infotaxis": space_aware_infotaxis,
    "greedy": greedy,
    "lookahead": lookahead,
    "homing": homing,
}


def test_every_planner_has_an_oracle_but_the_one_that_has_no_formula() -> None:
    assert set(PLANNERS) - set(ORACLES) == {"random"}


@pytest.mark.one_in(2)
@pytest.mark.parametrize("sensor", [GAUSSIAN, Threshold(1.0, 0.2), Hits(0.5, 0.3)], ids=text)
@pytest.mark.parametrize("name", ORACLES)
def test_a_planner_chooses_what_its_formula_finds_best(name: str, sensor: Sensor) -> None:
    chosen, margins, dead_ends = set(), [], 0
    for seed in range({"entrotaxis": 8, "lookahead": 80}.get(name, 40)):
        world = World(seed, sensor, name, headings=8 if seed % 2 else 4)
        scores = ORACLES[name](world)
        assert len(scores) == len(world.moves)
        assert scores[world.chosen] == pytest.approx(max(scores), rel=1e-9, abs=1e-9), seed
        chosen.add(world.chosen)
        margins.append(np.diff(np.sort(scores)[-2:])[0])
        dead_ends += world.dead_ends
    assert len(chosen) > 2
    assert np.median(margins) > 1e-4  # the best move is clearly better than the second
    assert name != "homing" or 5 <= dead_ends <= 35  # both of homing's formulas are tried


@pytest.mark.parametrize("name", ["homing", "lookahead"])
def test_of_many_particles_every_so_many_th_is_planned_with(name: str) -> None:
    for seed in range(8):
        world = World(seed, GAUSSIAN, name, count=1001, headings=8)
        scores = ORACLES[name](world)
        assert (
            len(world.x) == 334
        )  # every third of 1,001; every second would leave 501, above the limit of 500
        assert scores[world.chosen] == pytest.approx(max(scores), rel=1e-9)


@pytest.mark.parametrize("name", ORACLES)
def test_in_a_world_turned_by_a_quarter_the_choice_turns_too(name: str) -> None:
    """Places and wind are rotated about the area's centre four times. The spread is chosen so that cells
    map onto cells.
    """
    for seed in range(6):
        world = World(seed, GAUSSIAN, name)
        world.here, world.spread = (11.5 + seed, 13.25), 2.0
        if name == "greedy":
            world.mean = (14.0, 13.5 + seed)
        choices = []
        for _ in range(4):
            world.particles[:, 0], world.particles[:, 1] = (
                30 - world.particles[:, 1],
                world.particles[:, 0].copy(),
            )
            world.here, world.mean = (30 - world.here[1], world.here[0]), (30 - world.mean[1], world.mean[0])
            world.wind = (-world.wind[1], world.wind[0])
            choices.append(
                chosen_by(name, world.belief(), world.particles, reach(name), np.random.default_rng(seed))
            )
        assert np.all(np.diff(choices) % reach(name).headings == reach(name).headings // 4), (seed, choices)


@pytest.mark.parametrize(
    ("name", "towards"),
    [
        ("infotaxis", True),
        ("entrotaxis", True),
        ("infotaxis-variance", True),
        ("space-aware-infotaxis", True),
        ("entrotaxis-belief", False),
    ],
)
def test_of_two_places_the_near_one_is_looked_at_first(name: str, towards: bool) -> None:
    """In still air the source is 2 m to one side or 12 m to the other. A reading nearer to the near place
    is the most informative.

    entrotaxis-belief prefers beliefs that stay uncertain, so it moves away.
    """
    for heading, (x, y) in enumerate([(1, 0), (0, 1), (-1, 0), (0, -1)]):
        world = World(1, GAUSSIAN, name)
        world.here, world.wind = (15.0, 15.0), (0.0, 0.0)
        world.particles = np.array(
            [[15 + 2 * x, 15 + 2 * y, 300.0, 0.5], [15 - 12 * x, 15 - 12 * y, 300.0, 0.5]], np.float32
        )
        said = chosen_by(
            name, world.belief(), world.particles, Reach(measurements=100), np.random.default_rng(3)
        )
        assert said == (heading if towards else (heading + 2) % 4)
