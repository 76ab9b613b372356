"""Protects the observation `polar-2`: each number against plain NumPy, and that it knows no units, no compass
and no prior of its own.
"""

import cmath
import math
from itertools import pairwise

import msgspec
import numpy as np
import pytest

from agent.facts import site_in
from agent.observation import SCHEMAS
from agent.planning.apart import Shared
from agent.trials.rollout import mission
from link.bus.messages import Belief, Particles
from plume.elementary import Array
from plume.problem import Area, Problem
from tests.agent.trials.test_scale import enlarged

POLAR = SCHEMAS["polar-2"]
HEADINGS = 16
CELLS, GAINS, NEARER, EDGES, NUMBERS = (
    slice(start, stop) for start, stop in pairwise((0, 128, 160, 176, 192, 210))
)
RINGS = (1.5, 3.0, 5.0, 8.0, 11.5, 15.5, 20.0)
WIDE = Area((-40.0, 10.0), (60.0, 50.0))
STEP_M = 1.5
FIELD = ("x", "y", "q", "tau", "wind-direction", "wind-speed", "noise", "cv")


def seen(belief: Belief, particles: Particles, area: Area = WIDE, step_m: float = STEP_M) -> Array:
    return POLAR.look(belief, particles, site_in(area, step_m))[0]


def searched(seed: int, unknowns: tuple[str, ...] = ("x", "y")) -> tuple[Belief, Particles]:
    """A belief in WIDE of 128 particles, so that the few that are drawn are all."""
    rng = np.random.default_rng(seed)
    narrow = 10.0 if seed % 2 else 0.5
    x, y = rng.normal((5.0, 30.0), narrow, (128, 2)).T
    drawn = {
        "x": x,
        "y": y,
        "q": rng.uniform(100, 500, 128),
        "tau": rng.uniform(5, 20, 128),
        "wind-direction": rng.normal(0, 20, 128),
        "wind-speed": rng.uniform(0.5, 2.0, 128),
        "noise": rng.uniform(0.5, 2.0, 128),
        "cv": rng.uniform(0, 1, 128),
    }
    particles = np.column_stack([*(drawn[name] for name in unknowns), np.full(128, 1 / 128)])
    xx, xy, yy = np.cov(x, y, ddof=0)[[0, 0, 1], [0, 1, 1]].tolist()
    position = tuple(np.float32(rng.uniform(WIDE.low, WIDE.high)).tolist())
    means, stds = particles[:, :-1].mean(axis=0).tolist(), particles[:, :-1].std(axis=0).tolist()
    said = dict(zip(unknowns, means, strict=True))
    belief = Belief(
        time_boot_ms=0,
        step=3,
        position=position,  # type: ignore[arg-type]
        altitude_m=5.0,
        gas=0.3,
        wind=tuple(rng.uniform(-3, 3, 2).tolist()),  # type: ignore[arg-type]
        rate=said.get("q", 270.0),
        diffusivity=4.2,
        lifetime=said.get("tau", 10.0),
        z=5.0,
        sensor="gaussian",
        unknowns=unknowns,
        means=tuple(means),
        stds=tuple(stds),
        mean=(means[0], means[1]),
        covariance=(xx, xy, yy),
        spread=math.sqrt(xx + yy),
        effective_sample_size=10.0,
        p_value=0.5,
        ceased=False,
    )
    return belief, particles.astype(np.float32)


class Plain:
    """The parts of `polar-2` in plain NumPy; places and directions are complex numbers."""

    def __init__(self, belief: Belief, particles: Particles) -> None:
        self.belief = belief
        rows = dict(zip(belief.unknowns, particles.T.astype(float), strict=False))
        self.places = rows["x"] + 1j * rows["y"]
        self.here, self.mean = complex(*belief.position), complex(*belief.mean)
        self.side = math.sqrt(100 * 40)
        self.unit = min(max(4 * belief.spread, self.side / 300), self.side / 30)
        self.turn = (self.mean - self.here) / abs(self.mean - self.here)
        self.wind = complex(*belief.wind)
        self.mirrored = (self.wind / self.turn).imag < 0
        q, tau = rows.get("q", belief.rate), rows.get("tau", belief.lifetime)
        turned = np.exp(1j * np.radians(rows.get("wind-direction", np.zeros(128))))
        self.winds = self.wind * turned * rows.get("wind-speed", 1.0)
        self.strength = q / (4 * np.pi * belief.diffusivity)
        self.decay = np.sqrt(
            1 / (belief.diffusivity * tau) + np.abs(self.winds / (2 * belief.diffusivity)) ** 2
        )
        noise, cv = rows.get("noise", np.ones(128)).mean(), rows.get("cv", np.zeros(128)).mean()
        self.slope, self.floor = math.hypot(0.3 * noise, cv), 0.2 * noise

    def seen(self, arrow: Array) -> Array:
        turned = arrow / self.turn
        return turned.conjugate() if self.mirrored else turned

    def heading(self, k: int) -> complex:
        arrow = cmath.rect(1, 2 * math.pi * k / HEADINGS)
        return self.turn * (arrow.conjugate() if self.mirrored else arrow)

    def ahead(self, units: float, k: int) -> complex:
        there = self.here + units * self.unit * self.heading(k)
        return complex(min(max(there.real, -40.0), 60.0), min(max(there.imag, 10.0), 50.0))

    def cells(self) -> Array:
        places = self.seen(self.places - self.here) / self.unit
        ring = np.searchsorted(RINGS, np.abs(places))
        sector = np.round(np.angle(places) / (2 * np.pi / 16)).astype(int) % 16
        return 2 * np.sqrt(np.bincount(ring * 16 + sector, np.full(128, 1 / 128), 128))

    def gains(self) -> Array:
        result = []
        for units in (2.0, 5.0):
            for k in range(HEADINGS):
                off = self.ahead(units, k) - self.places
                r = np.maximum(np.abs(off), self.unit / 10)
                upwind = (off * self.winds.conjugate()).real / (2 * self.belief.diffusivity)
                means = self.strength / r * np.exp(-r * self.decay - upwind)
                steady = np.arcsinh(self.slope * means / self.floor) / self.slope
                result.append(0.5 * math.log1p(steady.var()))
        return np.array(result)

    def nearer(self) -> Array:
        now = np.abs(self.here - self.places).mean()
        then = [np.abs(self.ahead(2.0, k) - self.places).mean() for k in range(HEADINGS)]
        return (now - np.array(then)) / self.unit

    def edges(self) -> Array:
        """By walking: a ray leaves the area between two of many short steps."""
        ways = np.arange(0, 130, 0.002)
        result = []
        for k in range(HEADINGS):
            x, y = (part(self.here + ways * self.heading(k)) for part in (np.real, np.imag))
            inside = (x >= -40) & (x <= 60) & (y >= 10) & (y <= 50)
            way = ways[inside.argmin()] / self.unit
            result.append(way / (way + 5))
        return np.array(result)

    def numbers(self) -> list[float]:
        b, unit = self.belief, self.unit
        away, expected = abs(self.mean - self.here), np.abs(self.here - self.places).mean()
        off = self.seen(self.places - self.mean)
        square = b.spread**2
        towards = self.seen(self.wind / abs(self.wind))
        u, d = abs(self.wind), b.diffusivity
        length = 1 / math.sqrt(1 / (d * b.lifetime) + u * u / (4 * d * d))
        x, y = self.places.real, self.places.imag
        outside = ((x < -40) | (x > 60) | (y < 10) | (y > 50)).mean()
        return [
            away / unit / 15,
            math.log(away / unit + 0.1) / 3,
            math.log(expected / unit + 0.1) / 3,
            math.log(b.spread / unit + 0.05) / 3,
            b.spread / unit / 8,
            2 * (off.real**2).mean() / square - 1,
            2 * (off.real * off.imag).mean() / square,
            towards.real,
            towards.imag,
            u * unit / (2 * d),
            length / unit / 10,
            math.log(length / unit),
            math.log(b.rate / (4 * math.pi * d * unit)) / 3,
            math.log(min(STEP_M, max(unit, b.spread / 4)) / unit),
            math.log(self.side / unit) - 3.4,
            100 / self.side - 1,
            2 * math.sqrt(outside),
            math.log(self.slope / 0.3),
        ]


@pytest.mark.parametrize("unknowns", [("x", "y"), FIELD], ids=["paper", "field"])
@pytest.mark.parametrize("seed", range(6))
def test_each_number_is_what_plain_numpy_says(seed: int, unknowns: tuple[str, ...]) -> None:
    belief, particles = searched(seed, unknowns)
    result, plain = seen(belief, particles), Plain(belief, particles)
    assert result.shape == (210,)
    assert result[CELLS] == pytest.approx(plain.cells(), abs=1e-5)
    assert result[GAINS] == pytest.approx(plain.gains(), rel=1e-3, abs=1e-5)
    assert result[NEARER] == pytest.approx(plain.nearer(), abs=1e-4)
    assert result[EDGES] == pytest.approx(plain.edges(), abs=1e-3)
    assert result[NUMBERS] == pytest.approx(np.clip(plain.numbers(), -10, 10), rel=1e-4, abs=1e-4)


@pytest.mark.parametrize("spread_m", [0.05, 0.2, 0.5, 2.0, 10.0])
@pytest.mark.parametrize("step_m", [0.1, 1.0, 10.0])
def test_a_move_is_as_long_as_a_fleets_planner_makes_it(spread_m: float, step_m: float) -> None:
    belief, particles = searched(0)
    narrow = msgspec.structs.replace(belief, spread=spread_m, covariance=(spread_m**2, 0.0, 0.0))
    _, frame = POLAR.look(narrow, particles, site_in(WIDE, step_m))
    fitted = Shared(step=step_m, area=WIDE, fits=True).fitted(narrow)
    assert math.hypot(frame[0], frame[1]) == pytest.approx(fitted.step)


TURNS = [(turn, mirrored) for turn in (1, 1j, -1, -1j) for mirrored in (False, True)]


@pytest.mark.parametrize(("turn", "mirrored"), TURNS)
@pytest.mark.parametrize("seed", range(3))
def test_a_search_that_is_turned_or_mirrored_with_its_area_looks_the_same(
    seed: int, turn: complex, mirrored: bool
) -> None:
    """Nothing in it knows where north is."""
    belief, particles = searched(seed)

    def arrow(x: float, y: float) -> tuple[float, float]:
        there = turn * (complex(x, y).conjugate() if mirrored else complex(x, y))
        return there.real, there.imag

    corners = np.array([arrow(*WIDE.low), arrow(*WIDE.high)])
    area = Area(tuple(corners.min(axis=0).tolist()), tuple(corners.max(axis=0).tolist()))  # type: ignore[arg-type]
    axes = np.array([arrow(1, 0), arrow(0, 1)]).T
    xx, xy, yy = belief.covariance
    (xx, xy), (_, yy) = (axes @ np.array([[xx, xy], [xy, yy]]) @ axes.T).tolist()
    there = msgspec.structs.replace(
        belief,
        position=arrow(*belief.position),
        mean=arrow(*belief.mean),
        wind=arrow(*belief.wind),
        covariance=(xx, xy, yy),
    )
    moved = np.column_stack([[arrow(x, y) for x, y, _ in particles], particles[:, 2]]).astype(np.float32)
    assert seen(there, moved, area) == pytest.approx(seen(belief, particles), abs=1e-4)


@pytest.mark.parametrize("assume", ["paper", "field"])
def test_a_search_in_a_field_that_is_larger_in_all_its_lengths_looks_the_same(assume: str) -> None:
    """Powers of two round nothing, so it is the same to the last bit while the beliefs are."""

    def looks(scale: float) -> list[bytes]:
        problem = enlarged(scale)
        flown = mission(2, "greedy", 200, 0.5 * scale, 6, problem=problem, assume=assume).steps
        return [POLAR.see(step.belief, step.particles, problem)[0].tobytes() for step in flown]

    here = looks(1.0)
    assert len(set(here)) == 7
    if assume == "paper":
        assert looks(8.0) == here == looks(0.5)
    else:
        # The rate's prior is log-normal: a logarithm of a larger number rounds elsewhere.
        for one, other in zip(here, looks(8.0), strict=True):
            a, b = np.frombuffer(one, np.float32), np.frombuffer(other, np.float32)
            assert b[GAINS.start :] == pytest.approx(a[GAINS.start :], rel=1e-3, abs=1e-3)


def test_where_sources_are_drawn_or_expected_changes_nothing_but_through_the_belief() -> None:
    belief, particles = searched(1)
    square = Area((0.0, 20.0), (20.0, 40.0))
    looks = [
        POLAR.see(belief, particles, Problem(area=WIDE, step_m=STEP_M, prior=prior, source=source))[
            0
        ].tobytes()
        for prior in (None, square)
        for source in (None, square)
    ]
    assert set(looks) == {seen(belief, particles).tobytes()}


def test_on_the_estimate_in_still_air_it_is_still_finite() -> None:
    belief, particles = searched(0)
    still = msgspec.structs.replace(belief, position=belief.mean, wind=(0.0, 0.0), spread=0.0)
    still = msgspec.structs.replace(still, covariance=(0.0, 0.0, 0.0))
    particles[:, :2] = belief.mean
    assert np.isfinite(seen(still, particles)).all()
