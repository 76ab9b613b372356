"""The JSON messages on the bus, as typed structs, and the particle array that travels with a belief."""

from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

Pair = tuple[float, float]
Count = Annotated[int, msgspec.Meta(ge=0)]
Particles = NDArray[np.float32]
"""(N, 3): x and y in metres, and the particle's weight; the weights sum to one."""


class Belief(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the estimator believes after one reading, with all that a planner needs to know of the model behind it."""

    time_boot_ms: Count
    """The reading that it answers."""
    step: Count
    """Readings assimilated before this one: the number of moves made."""
    position: Pair
    """Where the reading was taken: (x, y) m, x east, y north, from home."""
    altitude_m: float
    gas: float
    """The reading, g/m³."""
    wind: Pair
    """(u cos φ, u sin φ) m/s: points to where the wind comes from."""
    rate: float
    """q, g/s."""
    diffusivity: float
    """d, m²/s."""
    lifetime: float
    """τ, s."""
    mean: Pair
    """The estimate of the source, m."""
    covariance: tuple[float, float, float]
    """(xx, xy, yy), m²."""
    spread: float
    """sqrt(trace of the covariance), m."""
    effective_sample_size: float
    ceased: bool
    """The spread is below the threshold: the search is over, no waypoint is wanted."""


class Stop(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """AGDC's stop: a claim about where the source is."""

    time_boot_ms: Count
    step: Count
    estimate: Pair
    covariance: tuple[float, float, float]
    spread: float
    threshold: float
    """ζ, m."""


class Health(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How a service is doing, published after every step. Its liveliness token says that the process lives, not that a vehicle does."""

    service: str
    state: str
    step: int
    """The last step that it finished; -1 before the first."""
    compute_s: Annotated[float, msgspec.Meta(ge=0)]
    """Compute time spent on steps so far, without reading from and writing to the bus."""
    uptime_s: Annotated[float, msgspec.Meta(ge=0)]
    refused: dict[str, Count]
    """Messages dropped so far, by reason."""


def pack_particles(particles: Particles) -> bytes:
    """Float32, little-endian, row after row."""
    return particles.astype("<f4", copy=False).tobytes()


def unpack_particles(payload: bytes) -> Particles:
    """Undo `pack_particles`; raises ValueError on what is no such array."""
    if not payload or len(payload) % 12:
        raise ValueError(f"{len(payload)} bytes are no particle array; wanted a positive multiple of 12")
    particles = np.frombuffer(payload, "<f4").reshape(-1, 3)
    if not np.isfinite(particles).all():
        raise ValueError("the particle array holds NaN or infinite values")
    return particles.astype(np.float32, copy=False)
