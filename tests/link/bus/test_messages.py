"""Protects the JSON messages and the particle array."""

import math

import msgspec
import numpy as np
import pytest

from link.bus.messages import Belief, Stop, pack_particles, unpack_particles

STOP = Stop(
    time_boot_ms=5, step=3, estimate=(0.1, 1 / 3), covariance=(1.0, 0.0, 1.0), spread=0.4, threshold=0.5
)


def test_json_keeps_doubles_to_the_last_bit() -> None:
    assert msgspec.json.decode(msgspec.json.encode(STOP), type=Stop) == STOP


@pytest.mark.parametrize(
    "change", [{"step": -1}, {"spread": None}, {"estimate": [1.0]}, {"extra": 1}, {"threshold": -0.5}]
)
def test_a_message_that_breaks_the_schema_does_not_decode(change: dict[str, object]) -> None:
    fields = msgspec.to_builtins(STOP) | change
    with pytest.raises(msgspec.ValidationError):
        msgspec.json.decode(msgspec.json.encode(fields), type=Stop)


def test_particles_cross_the_wire_as_rows_of_little_endian_float32() -> None:
    particles = np.array([[1.0, 2.0, 0.25], [3.0, 4.0, 0.75]], np.float32)
    payload = pack_particles(particles)
    assert payload == bytes.fromhex("0000803f000000400000803e" + "00004040000080400000403f")
    assert np.array_equal(unpack_particles(payload, 2), particles)


def test_more_unknowns_are_more_columns() -> None:
    particles = np.arange(8, dtype=np.float32).reshape(2, 4)
    assert np.array_equal(unpack_particles(pack_particles(particles), 3), particles)
    with pytest.raises(ValueError, match="16"):
        unpack_particles(pack_particles(particles)[:-4], 3)


@pytest.mark.parametrize("payload", [b"", b"x" * 13, np.array([1, 2, math.nan], "<f4").tobytes()])
def test_what_is_no_particle_array_is_refused(payload: bytes) -> None:
    with pytest.raises(ValueError, match="particle array"):
        unpack_particles(payload, 2)


@pytest.mark.parametrize("weights", [(0.0, 0.0), (-0.5, 1.5)])
def test_weights_that_weigh_nothing_are_refused(weights: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="weights"):
        unpack_particles(
            pack_particles(np.array([[1.0, 2.0, weights[0]], [3.0, 4.0, weights[1]]], np.float32)), 2
        )


SAID = Belief(
    time_boot_ms=5,
    step=3,
    position=(1.0, 2.0),
    altitude_m=5.0,
    gas=0.5,
    wind=(1.0, 0.0),
    sensor="gaussian:0.3,0.2",
    rate=300.0,
    diffusivity=4.5,
    lifetime=10.0,
    z=5.0,
    unknowns=("x", "y"),
    means=(1.0, 2.0),
    stds=(0.1, 0.1),
    mean=(1.0, 2.0),
    covariance=(0.01, 0.0, 0.01),
    spread=0.14,
    effective_sample_size=900.0,
    p_value=0.5,
    ceased=False,
    intermittency={"downwind": (0.1, 0.2, 0.3)},
    advised_dwell=2.0,
)


def test_beliefs_of_older_records_say_nothing_of_how_the_gas_comes_and_goes() -> None:
    assert msgspec.json.decode(msgspec.json.encode(SAID), type=Belief) == SAID
    fields = msgspec.to_builtins(SAID)
    del fields["intermittency"], fields["advised_dwell"]
    older = msgspec.json.decode(msgspec.json.encode(fields), type=Belief)
    assert (older.intermittency, older.advised_dwell) == ({}, 0.0)


@pytest.mark.parametrize("wrong", [{"downwind": [0.1, 0.2]}, {"downwind": None}, [0.1, 0.2, 0.3]])
def test_quantiles_that_are_no_three_numbers_are_refused(wrong: object) -> None:
    fields = msgspec.to_builtins(SAID) | {"intermittency": wrong}
    with pytest.raises(msgspec.ValidationError, match="intermittency"):
        msgspec.json.decode(msgspec.json.encode(fields), type=Belief)
