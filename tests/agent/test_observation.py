"""Protects the observations of learned policies: each number against an independent computation, and
rotation and mirror symmetry.
"""

import cmath
import math

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.observation import OUTSIDE, SCHEMAS
from agent.scale_free import BOUND
from agent.trials.rollout import mission
from link.bus.messages import Belief, pack_particles, unpack_particles
from plume.scenario import AREA_M

SENSOR_NOISE, ENVIRONMENT_NOISE = 0.3, 0.2
EDGES_M = (1.5, 3.0, 5.0, 8.0, 11.5, 15.5, 20.0)
SECTORS, HEADINGS = 16, 16
CELLS, GAINS, NUMBERS = slice(0, 128), slice(128, 160), slice(160, 184)
PLACE = slice(179, 183)
"""Numbers of the frame's direction and the place in the area."""
MIDDLE = 17.5
"""x and y of the centre of the square in which sources are drawn, m."""


def belief_at(position: tuple[float, float] = (14.0, 13.0), **said: object) -> Belief:
    usual: dict[str, object] = dict(
        time_boot_ms=0,
        step=0,
        position=position,
        altitude_m=5.0,
        gas=0.0,
        wind=(1.5, -1.0),
        rate=270.0,
        diffusivity=4.2,
        lifetime=10.0,
        z=5.0,
        sensor="gaussian",
        unknowns=("x", "y"),
        means=(15.0, 15.0),
        stds=(1.0, 1.0),
        mean=(15.0, 15.0),
        covariance=(1.0, 0.0, 1.0),
        spread=1.4,
        effective_sample_size=10.0,
        p_value=0.5,
        ceased=False,
    )
    return Belief(**(usual | said))  # type: ignore[arg-type]


def particles_of(places: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """(N, 3) float32, as they come over the wire."""
    weights = np.ones(len(places)) if weights is None else weights
    return np.column_stack([places, weights / weights.sum()]).astype(np.float32)


def scattered(seed: int, count: int = 400, low: float = 0.0, high: float = AREA_M) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return particles_of(rng.uniform(low, high, (count, 2)), rng.uniform(0.0, 1.0, count))


def polar(belief: Belief, particles: np.ndarray) -> np.ndarray:
    return SCHEMAS["polar"].see(belief, particles)[0]


class Plain:
    """The parts of `polar` in plain NumPy. Places are complex numbers: a product rotates them, a conjugate
    mirrors them.
    """

    def __init__(self, belief: Belief, particles: np.ndarray) -> None:
        x, y, said = particles.astype(float).T
        drawn = (x >= 10) & (x <= 25) & (y >= 10) & (y <= 25)
        self.belief = belief
        self.inside = said[drawn].sum() / said.sum()
        self.weights = np.where(drawn, said, said / 20)
        self.weights /= self.weights.sum()
        self.here, self.places = complex(*belief.position), x + 1j * y
        self.mean = self.weights @ self.places
        self.turn = (self.mean - self.here) / abs(self.mean - self.here)
        self.mirrored = (complex(*belief.wind) / self.turn).imag < 0

    def seen(self, arrow: np.ndarray) -> np.ndarray:
        """A direction of the world, expressed in the frame."""
        turned = arrow / self.turn
        return turned.conjugate() if self.mirrored else turned

    def cells(self) -> np.ndarray:
        places = self.seen(self.places - self.here)
        ring = np.searchsorted(EDGES_M, np.abs(places))
        sector = np.round(np.angle(places) / (2 * np.pi / SECTORS)).astype(int) % SECTORS
        return 2 * np.sqrt(np.bincount(ring * SECTORS + sector, self.weights, CELLS.stop))

    def gains(self) -> np.ndarray:
        """½ log(1 + Var g(m)) of all the particles."""
        b, result = self.belief, []
        wind = complex(*b.wind)
        decay = math.sqrt(
            b.diffusivity * b.lifetime / (1 + abs(wind) ** 2 * b.lifetime / (4 * b.diffusivity))
        )
        for ahead in (2.0, 5.0):
            for heading in range(HEADINGS):
                arrow = cmath.rect(ahead, 2 * math.pi * heading / HEADINGS)
                there = self.here + self.turn * (arrow.conjugate() if self.mirrored else arrow)
                there = complex(min(max(there.real, 0.0), AREA_M), min(max(there.imag, 0.0), AREA_M))
                off = there - self.places
                r = np.maximum(np.abs(off), 0.1)
                downwind = -(off * wind.conjugate()).real
                m = (
                    b.rate
                    / (4 * np.pi * b.diffusivity * r)
                    * np.exp(-r / decay + downwind / (2 * b.diffusivity))
                )
                steady = np.arcsinh(SENSOR_NOISE * m / ENVIRONMENT_NOISE) / SENSOR_NOISE
                variance = self.weights @ (steady - self.weights @ steady) ** 2
                result.append(0.5 * math.log1p(variance))
        return np.array(result)

    def numbers(self) -> list[float]:
        b = self.belief
        off = self.seen(self.places - self.mean)
        square = self.weights @ np.abs(off) ** 2
        spread, said = math.sqrt(square), math.sqrt(b.covariance[0] + b.covariance[2])
        wind, middle = self.seen(complex(*b.wind)), self.seen(complex(MIDDLE, MIDDLE) - self.here)
        u, d = abs(wind), b.diffusivity
        length = math.sqrt(d * b.lifetime / (1 + u * u * b.lifetime / (4 * d)))
        swapped = slice(None, None, -1 if self.mirrored else 1)
        away = abs(self.mean - self.here)
        return [
            away / 15,
            math.log(away + 0.1) / 3,
            math.log(said + 0.05) / 3,
            said / 8,
            math.log(spread + 0.05) / 3,
            spread / 8,
            2 * (self.weights @ off.real**2) / square - 1,
            2 * (self.weights @ (off.real * off.imag)) / square,
            wind.real / 4,
            wind.imag / 4,
            wind.real / u,
            wind.imag / u,
            u / (2 * d),
            math.log(d) / 2,
            length / 10,
            math.log(length),
            math.log(b.rate / (4 * math.pi * d)) / 3,
            middle.real / 15,
            middle.imag / 15,
            *(self.turn.real, self.turn.imag)[swapped],
            *(self.here.real / AREA_M, self.here.imag / AREA_M)[swapped],
            math.log(self.inside + 0.001) / 3,
        ]


def test_the_papers_observation_is_position_reading_and_estimate() -> None:
    said = belief_at((6.0, 15.0), gas=math.e - 1, mean=(12.0, 21.0))
    seen, frame = SCHEMAS["paper"].see(said, scattered(0))
    assert seen == pytest.approx([0.2, 0.5, 1.0, 0.4, 0.7])
    assert frame.tolist() == [1.0, 0.0, 1.0]  # the world's own
    seen, _ = SCHEMAS["paper"].see(msgspec.structs.replace(said, gas=1 - math.e), scattered(0))
    assert seen[2] == pytest.approx(-1.0)


def test_an_observation_has_the_size_that_its_schema_says() -> None:
    assert {name: (schema.version, schema.size) for name, schema in SCHEMAS.items()} == {
        "paper": (1, 5),
        "polar": (1, 184),
        "polar-2": (2, 210),
    }
    for schema in SCHEMAS.values():
        seen, frame = schema.see(belief_at(), scattered(0))
        assert (seen.shape, seen.dtype, frame.shape) == ((schema.size,), np.float32, (3,))


# (sector, metres, ring, mass) in the frame. The masses left and right of its x axis balance, so that the
# estimate lies on the axis.
BALANCING_M = 2 * math.sin(math.pi / 4) / math.cos(math.pi / 8)
LAID_OUT = [
    (2, 4.0, 2, 0.3),
    (14, 6.0, 3, 0.2),
    (0, 1.0, 0, 0.1),
    (6, 2.0, 1, 0.2),
    (13, BALANCING_M, 1, 0.2),
]


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("towards", [0.0, 0.3, 2.0, -2.6])
def test_particles_fall_into_the_cells_of_a_frame_that_looks_at_the_estimate(
    towards: float, mirrored: bool
) -> None:
    side = -1 if mirrored else 1
    here, turn = complex(MIDDLE, MIDDLE), cmath.rect(1, towards)
    spots = [
        here + turn * cmath.rect(metres, side * 2 * math.pi * sector / SECTORS)
        for sector, metres, _, _ in LAID_OUT
    ]
    wind = 2 * turn * cmath.rect(1, side * 1.0)
    cloud = particles_of(
        np.array([[spot.real, spot.imag] for spot in spots]), np.array([mass for *_, mass in LAID_OUT])
    )
    seen, frame = SCHEMAS["polar"].see(belief_at((MIDDLE, MIDDLE), wind=(wind.real, wind.imag)), cloud)
    assert frame == pytest.approx([turn.real, turn.imag, side], abs=1e-6)
    expected = np.zeros(CELLS.stop)
    for sector, _, ring, mass in LAID_OUT:
        expected[ring * SECTORS + sector] = 2 * math.sqrt(mass)
    assert seen[CELLS] == pytest.approx(expected, abs=1e-5)
    assert seen[NUMBERS][9] > 0  # the wind comes from the left


@pytest.mark.parametrize(("ring", "edge"), list(enumerate(EDGES_M)))
def test_a_ring_ends_at_its_edge(ring: int, edge: float) -> None:
    for metres, expected in ((edge - 1e-3, ring), (edge + 1e-3, ring + 1)):
        seen = polar(belief_at((24.0 - metres, 15.0)), particles_of(np.array([[24.0, 15.0]])))
        assert np.flatnonzero(seen[CELLS]).tolist() == [expected * SECTORS]
        assert seen[CELLS][expected * SECTORS] == pytest.approx(2.0)


def test_what_lies_where_no_sources_are_drawn_counts_a_twentieth() -> None:
    assert OUTSIDE == 1 / 20
    cloud = particles_of(np.array([[25.0, 15.0], [25.1, 27.0]]))  # the first is just inside
    seen, frame = SCHEMAS["polar"].see(belief_at((15.0, 15.0), wind=(0.0, 1.0)), cloud)
    mean = complex(25 + 0.1 / 21, 15 + 12 / 21)
    assert complex(frame[0], frame[1]) == pytest.approx((mean - 15 - 15j) / abs(mean - 15 - 15j), abs=1e-6)
    assert sorted(seen[CELLS])[-2:] == pytest.approx([2 * math.sqrt(1 / 21), 2 * math.sqrt(20 / 21)])
    assert seen[-1] == pytest.approx(
        math.log(0.501) / 3
    )  # the mass inside the square, by the estimator's own weights


def test_without_any_particle_where_sources_are_drawn_the_others_are_all_there_is() -> None:
    seen = polar(belief_at((5.0, 5.0)), particles_of(np.array([[8.0, 5.0], [5.0, 8.0]])))
    assert np.square(seen[CELLS]).sum() / 4 == pytest.approx(1.0)
    assert seen[-1] == pytest.approx(math.log(0.001) / 3)


@pytest.mark.parametrize("seed", range(6))
def test_cells_and_numbers_are_those_of_plain_numpy(seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    said = belief_at(
        tuple(rng.uniform(0, AREA_M, 2).tolist()),
        wind=tuple(rng.uniform(-3, 3, 2).tolist()),
        rate=rng.uniform(100, 500),
        diffusivity=rng.uniform(1, 8),
        lifetime=rng.uniform(5, 20),
        covariance=(rng.uniform(0, 9), 0.1, rng.uniform(0, 9)),
    )
    cloud = scattered(seed, low=5.0)
    seen, plain = polar(said, cloud), Plain(said, cloud)
    assert seen[CELLS] == pytest.approx(plain.cells(), abs=1e-5)
    assert seen[NUMBERS] == pytest.approx(plain.numbers(), abs=1e-5)


@pytest.mark.parametrize(
    "position", [(14.0, 13.0), (0.5, 2.0), (29.0, 12.0)], ids=["amid", "in a corner", "at a side"]
)
@pytest.mark.parametrize("seed", range(3))
def test_what_readings_would_tell_is_what_plain_numpy_says(seed: int, position: tuple[float, float]) -> None:
    # Of 128 systematic draws, a particle with weight k/128 gets exactly k, so the sum is exact.
    rng = np.random.default_rng(seed)
    shares = rng.multinomial(128, rng.dirichlet(np.ones(60)))
    cloud = particles_of(rng.uniform(10.5, 24.5, (60, 2)), shares)
    # The wind blows from the sources, so that there is gas, slightly from the left or the right.
    to_middle = complex(MIDDLE, MIDDLE) - complex(*position)
    wind = to_middle / abs(to_middle) * cmath.rect(2, 0.4 if seed else -0.4)
    said = belief_at(position, wind=(wind.real, wind.imag))
    expected = Plain(said, cloud).gains()
    assert expected.max() > 0.01
    assert polar(said, cloud)[GAINS] == pytest.approx(expected, rel=1e-4, abs=1e-5)


def test_a_few_particles_tell_what_all_would() -> None:
    # A variance from 128 particles is off by a tenth, or more if few of them matter; half its logarithm by
    # half of that: 0.05 nats.
    clouds = [scattered(seed, 5000, 10.5, 24.5) for seed in range(5)]
    off = [polar(belief_at(), cloud)[GAINS] - Plain(belief_at(), cloud).gains() for cloud in clouds]
    assert np.abs(off).mean() < 0.1


def test_where_the_source_is_known_no_reading_tells_anything() -> None:
    seen = polar(belief_at(), particles_of(np.tile([20.0, 20.0], (50, 1))))
    assert seen[GAINS] == pytest.approx(np.zeros(32), abs=1e-6)


def turned(said: Belief, cloud: np.ndarray, turn: complex, mirrored: bool) -> tuple[Belief, np.ndarray]:
    """The same search, mirrored at the east-west line through MIDDLE if `mirrored`, then rotated about
    (MIDDLE, MIDDLE).
    """
    centre = complex(MIDDLE, MIDDLE)

    def arrow(x: float, y: float) -> complex:
        return turn * (complex(x, y).conjugate() if mirrored else complex(x, y))

    def spot(x: float, y: float) -> tuple[float, float]:
        place = centre + arrow(x - MIDDLE, y - MIDDLE)
        return place.real, place.imag

    wind = arrow(*said.wind)
    xx, xy, yy = said.covariance
    axes = np.array([arrow(1, 0), arrow(0, 1)])
    matrix = np.stack([axes.real, axes.imag])
    (xx, xy), (_, yy) = (matrix @ np.array([[xx, xy], [xy, yy]]) @ matrix.T).tolist()
    moved = np.column_stack([[spot(x, y) for x, y, _ in cloud], cloud[:, 2]]).astype(np.float32)
    where = msgspec.structs.replace(
        said,
        position=spot(*said.position),
        wind=(wind.real, wind.imag),
        mean=spot(*said.mean),
        covariance=(xx, xy, yy),
    )
    return where, moved


@given(st.integers(0, 5), st.floats(-math.pi, math.pi), st.booleans())
def test_a_turn_or_a_mirror_changes_nothing_but_where_the_frame_points(
    seed: int, angle: float, mirrored: bool
) -> None:
    # Within 4 m of the middle no gain is computed beyond the area's sides; within 7.5 m all particles are in
    # the sources' square.
    cloud = scattered(seed, 60, MIDDLE - 5, MIDDLE + 5)
    said = belief_at((15.5, 16.0), covariance=(2.0, 0.5, 1.0))
    seen, other = polar(said, cloud), polar(*turned(said, cloud, cmath.rect(1, angle), mirrored))
    same = np.ones(len(seen), bool)
    same[PLACE] = False
    assert other[same] == pytest.approx(seen[same], abs=1e-3)


@given(st.integers(0, 20), st.floats(0, AREA_M), st.floats(0, AREA_M), st.floats(-4, 4), st.floats(-4, 4))
def test_mirrored_at_the_areas_diagonal_a_search_looks_the_same(
    seed: int, x: float, y: float, wind_x: float, wind_y: float
) -> None:
    cloud = scattered(seed, 60)
    said = belief_at((x, y), wind=(wind_x, wind_y), mean=(12.0, 19.0), covariance=(2.0, 0.5, 1.0))
    mirror = msgspec.structs.replace(
        said, position=(y, x), wind=(wind_y, wind_x), mean=(19.0, 12.0), covariance=(1.0, 0.5, 2.0)
    )
    seen, frame = SCHEMAS["polar"].see(said, cloud)
    other, mirrored_frame = SCHEMAS["polar"].see(mirror, cloud[:, [1, 0, 2]])
    if (
        abs((complex(wind_x, wind_y) / complex(frame[0], frame[1])).imag) > 1e-9
    ):  # otherwise mirrored and plain are equally valid
        assert mirrored_frame == pytest.approx([frame[1], frame[0], -frame[2]], abs=1e-9)
        assert other == pytest.approx(seen, abs=1e-5)


ANYWHERE = st.tuples(*2 * [st.floats(-1e6, 1e6)])
POSITIVE = st.floats(1e-6, 1e6)


@pytest.mark.parametrize("name", SCHEMAS)
@given(
    position=ANYWHERE,
    wind=ANYWHERE,
    mean=ANYWHERE,
    gas=st.floats(-1e38, 1e38),
    rate=POSITIVE,
    diffusivity=POSITIVE,
    lifetime=POSITIVE,
    square=st.floats(0, 1e6),
    seed=st.integers(0, 3),
    size=st.sampled_from([0.0, 1e-6, 1.0, 1e4]),
)
def test_no_number_is_out_of_bounds_in_any_world(
    name: str,
    position: tuple[float, float],
    wind: tuple[float, float],
    mean: tuple[float, float],
    gas: float,
    rate: float,
    diffusivity: float,
    lifetime: float,
    square: float,
    seed: int,
    size: float,
) -> None:
    said = belief_at(
        position,
        wind=wind,
        mean=mean,
        gas=gas,
        rate=rate,
        diffusivity=diffusivity,
        lifetime=lifetime,
        covariance=(square, 0.0, square),
    )
    seen, frame = SCHEMAS[name].see(said, scattered(seed, 30, 15.0 - size, 15.0 + size))
    assert np.isfinite(frame).all()
    assert np.isfinite(seen).all()
    assert np.abs(seen).max() <= BOUND


def test_in_still_air_at_the_estimate_an_observation_is_still_finite() -> None:
    seen, frame = SCHEMAS["polar"].see(
        belief_at((15.0, 15.0), wind=(0.0, 0.0)), particles_of(np.tile([15.0, 15.0], (20, 1)))
    )
    assert frame.tolist() == [1.0, 0.0, 1.0]
    assert np.isfinite(seen).all()


@pytest.mark.parametrize("name", SCHEMAS)
def test_a_belief_that_crossed_the_wire_looks_the_same(name: str) -> None:
    for said, cloud, *_ in mission(3, "greedy", 300, 0.5, 30).steps:
        came = msgspec.json.decode(msgspec.json.encode(said), type=Belief)
        attached = unpack_particles(pack_particles(cloud), len(said.unknowns))
        here, there = SCHEMAS[name].see(said, cloud), SCHEMAS[name].see(came, attached)
        assert [part.tobytes() for part in here] == [part.tobytes() for part in there]


@pytest.mark.parametrize("name", SCHEMAS)
def test_x_and_y_are_found_among_other_unknowns_by_name(name: str) -> None:
    cloud, said = scattered(1), belief_at()
    plain = SCHEMAS[name].see(said, cloud)[0]
    other = np.random.default_rng(2).uniform(100, 500, (2, len(cloud))).astype(np.float32)
    more = np.column_stack([cloud[:, 0], cloud[:, 1], *other, cloud[:, 2]])
    named = msgspec.structs.replace(
        said,
        unknowns=("x", "y", "gain", "puff-rate"),
        means=(15.0, 15.0, 1.0, 10.0),
        stds=(1.0, 1.0, 0.1, 1.0),
    )
    assert SCHEMAS[name].see(named, more)[0].tobytes() == plain.tobytes()


def test_a_coordinate_that_is_known_is_the_same_for_all_particles() -> None:
    cloud = scattered(1)
    cloud[:, 0] = 12.0
    said = belief_at(mean=(12.0, 15.0))
    known = msgspec.structs.replace(said, unknowns=("y",), means=(15.0,), stds=(1.0,))
    assert polar(known, cloud[:, 1:]).tobytes() == polar(said, cloud).tobytes()


def test_a_belief_is_not_changed_by_a_look() -> None:
    cloud = scattered(1)
    before = cloud.tobytes()
    polar(belief_at(), cloud)
    assert cloud.tobytes() == before
