"""The JSON messages on the bus, as typed structs, and the particle array that travels with a belief."""

from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

Pair = tuple[float, float]
Count = Annotated[int, Meta(ge=0)]
Covariance = Annotated[tuple[float, float, float], Meta(description="(xx, xy, yy) of the source's position, m²")]
TimeBootMs = Annotated[int, Meta(ge=0, description="time_boot_ms of the reading that this follows from")]
Step = Annotated[int, Meta(ge=0, description="number of the reading, 0 at the start: the moves made before it")]
Particles = NDArray[np.float32]
"""(N, D + 1): a column for each unknown of the belief, x and y by default, and the particle's weight; the weights sum to one."""


class Belief(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the estimator believes after one reading, with all that a planner needs to know of the model behind it."""

    time_boot_ms: TimeBootMs
    step: Step
    position: Annotated[Pair, Meta(description="where the reading was taken: (x, y) m, x east, y north, from home")]
    altitude_m: Annotated[float, Meta(description="height above home at which it was taken")]
    gas: Annotated[float, Meta(description="the reading, in the sensor's unit: g/m³, or a count of hits")]
    wind: Annotated[
        Pair, Meta(description="(u cos φ, u sin φ) m/s, to where the wind comes from: as measured, or its mean where it is unknown")
    ]
    sensor: Annotated[str, Meta(description="the sensor that is assumed, as --sensor takes it")]
    rate: Annotated[float, Meta(gt=0, description="release rate q that is assumed, or its mean where it is unknown, g/s")]
    diffusivity: Annotated[float, Meta(gt=0, description="diffusivity d that is assumed, or its mean, m²/s")]
    lifetime: Annotated[float, Meta(gt=0, description="lifetime τ of the gas that is assumed, or its mean, s")]
    z: Annotated[float, Meta(description="height of the source above home that is assumed, or its mean, m")]
    unknowns: Annotated[tuple[str, ...], Meta(description="names of the particle array's columns, of x y z q u phi d tau")]
    means: Annotated[tuple[float, ...], Meta(description="mean of each unknown")]
    stds: Annotated[tuple[float, ...], Meta(description="standard deviation of each unknown")]
    mean: Annotated[Pair, Meta(description="the estimate of the source's position, m")]
    covariance: Covariance
    spread: Annotated[float, Meta(ge=0, description="square root of the covariance's trace, m")]
    effective_sample_size: Annotated[float, Meta(gt=0, description="1/Σw² of the particles")]
    p_value: Annotated[
        float, Meta(ge=0, le=1, description="how well the recent readings fit the model: about 0 where they cannot be its own")
    ]
    ceased: Annotated[
        bool, Meta(description="what is asked of a stop is known well enough, and the readings fit the model: the search is over")
    ]


class Stop(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """AGDC's stop: a claim about where the source is."""

    time_boot_ms: TimeBootMs
    step: Step
    estimate: Annotated[Pair, Meta(description="where the source is claimed to be, m")]
    covariance: Covariance
    spread: Annotated[float, Meta(ge=0, description="square root of the covariance's trace, m")]
    threshold: Annotated[float, Meta(gt=0, description="ζ, which the spread fell below, m")]


class Health(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How a service is doing. The liveliness token on the same key says that its process lives, not that a vehicle does."""

    service: str
    state: Annotated[str, Meta(description="what it is doing; of the uav: standby, taking off, searching, returning, landed")]
    step: Annotated[int, Meta(ge=-1, description="the last step that it finished; -1 before the first")]
    compute_s: Annotated[float, Meta(ge=0, description="compute time spent on steps so far, without the bus; the uav's includes it")]
    uptime_s: Annotated[float, Meta(ge=0, description="seconds since it joined the bus")]
    refused: Annotated[dict[str, Count], Meta(description="messages dropped so far, by kind of reason")]
    warnings: Annotated[tuple[str, ...], Meta(description="what is wrong now, in words; empty where nothing is")] = ()
    refused_lately: Annotated[Count, Meta(description="messages dropped within the last 60 s, but for those that were only `repeated`")] = 0
    last_error: Annotated[str, Meta(description="the last thing that went wrong, as the log says it; empty where nothing has")] = ""
    rate_hz: Annotated[float, Meta(ge=0, description="steps a second over the last 10 s; of the recorder: messages")] = 0.0
    latency_s: Annotated[
        float, Meta(ge=0, description="from what it was given last to its answer, the uav's from its reading to the waypoint, s")
    ] = 0.0
    about: Annotated[str, Meta(description="what it runs with: the agent's policy, the estimator's particles")] = ""


def pack_particles(particles: Particles) -> bytes:
    """Float32, little-endian, row after row."""
    return particles.astype("<f4", copy=False).tobytes()


def unpack_particles(payload: bytes, unknowns: int) -> Particles:
    """Undo `pack_particles` for so many unknowns; raises ValueError on what is no such array."""
    row = 4 * (unknowns + 1)
    if not payload or len(payload) % row:
        raise ValueError(f"{len(payload)} bytes are no particle array; wanted a positive multiple of {row}")
    particles = np.frombuffer(payload, "<f4").reshape(-1, unknowns + 1)
    if not np.isfinite(particles).all():
        raise ValueError("the particle array holds NaN or infinite values")
    weights = particles[:, -1]
    if (weights < 0).any() or not weights.any():
        raise ValueError("the particle array holds negative weights, or none above 0")
    return particles.astype(np.float32, copy=False)
