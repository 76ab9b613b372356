"""The JSON messages on the bus, as typed structs, and the particle array that travels with a belief."""

from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

Pair = tuple[float, float]
Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Covariance = Annotated[
    tuple[float, float, float], Meta(description="(xx, xy, yy) of the source's position, m²")
]
MOST = 2**32 - 1  # greatest number that MAVLink's time_boot_ms can say; no mission has more steps
TimeBootMs = Annotated[int, Meta(ge=0, le=MOST, description="time_boot_ms of the reading that this answers")]
Step = Annotated[
    int,
    Meta(
        ge=0,
        le=MOST,
        description="number of the reading, 0 at the start; equals the number of moves before it",
    ),
]
Outside = Annotated[
    float, Meta(ge=0, le=1, description="share of the belief that lies outside the search area")
]
Particles = NDArray[np.float32]
"""(N, D + 1): a column for each unknown of the belief, by default x and y, then the weights, of sum 1."""
System = Annotated[int, Meta(ge=1, le=255)]


class RoundReading(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One reading of a round, of a vehicle that searches together with others."""

    vehicle: Annotated[int, Meta(ge=1, le=64, description="number of the vehicle in the search, from 1")]
    system: Annotated[System, Meta(description="MAVLink system id of the vehicle")]
    time_boot_ms: Annotated[int, Meta(ge=0, le=MOST, description="time_boot_ms of its reading")]
    position: Annotated[Pair, Meta(description="where it was taken: (x, y) m")]
    altitude_m: Annotated[float, Meta(description="height above home at which it was taken, m")]
    gas: Annotated[float, Meta(description="the gas reading, in the sensor's unit")]


class Stand(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where a vehicle of a search by several comes back to."""

    vehicle: Annotated[int, Meta(ge=1, le=64, description="number of the vehicle in the search, from 1")]
    place: Annotated[Pair, Meta(description="where it has read first, (x, y) m")]


class LeftAt(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where a vehicle may be that takes no part in a search by several: it has left, or is about to join.

    The others keep clear of both places.
    """

    vehicle: Annotated[int, Meta(ge=1, le=64, description="number of the vehicle in the search, from 1")]
    first: Annotated[
        Pair, Meta(description="where it read first, (x, y) m: it may land there; or where it takes off")
    ]
    last: Annotated[
        Pair, Meta(description="where it read last, (x, y) m: it may hover near it; or where it takes off")
    ]


class Belief(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The posterior after one reading, and the model parameters that a planner needs.

    Examples:
        >>> config = plumeward.Config(rate=250.0, diffusivity=3.0)
        >>> reading = plumeward.Reading(0, (8.0, 9.0), 5.0, (1.5, -0.5), 1.3)
        >>> posterior = plumeward.assimilate(plumeward.prior(config), reading, config)
        >>> said, _ = plumeward.belief(posterior, reading, config)
        >>> said.step, said.position, said.unknowns
        (0, (8.0, 9.0), ('x', 'y'))
    """

    time_boot_ms: TimeBootMs
    step: Step
    position: Annotated[
        Pair, Meta(description="where the reading was taken: (x, y) m, x east, y north, from home")
    ]
    altitude_m: Annotated[float, Meta(description="height above home at which the reading was taken, m")]
    gas: Annotated[float, Meta(description="the gas reading, in the sensor's unit: g/m³, or a count of hits")]
    wind: Annotated[
        Pair,
        Meta(
            description="(u cos φ, u sin φ) m/s, points to where the wind comes from; as measured, or its "
            "mean if u or φ has a prior"
        ),
    ]
    sensor: Annotated[str, Meta(description="assumed sensor, in the form of --sensor")]
    rate: Annotated[float, Meta(gt=0, description="assumed release rate q, or its mean if unknown, g/s")]
    diffusivity: Annotated[
        float, Meta(gt=0, description="assumed diffusivity d, or its mean if unknown, m²/s")
    ]
    lifetime: Annotated[
        float, Meta(gt=0, description="assumed lifetime τ of the gas, or its mean if unknown, s")
    ]
    z: Annotated[
        float, Meta(description="assumed height of the source above home, or its mean if unknown, m")
    ]
    unknowns: Annotated[
        tuple[str, ...],
        Meta(
            description="names of the particle array's columns, of x y z q u phi d tau wind-direction "
            "wind-speed gain noise cv puff-rate puff-share"
        ),
    ]
    means: Annotated[tuple[float, ...], Meta(description="mean of each unknown")]
    stds: Annotated[tuple[float, ...], Meta(description="standard deviation of each unknown")]
    mean: Annotated[Pair, Meta(description="the estimate of the source's position, m")]
    covariance: Covariance
    spread: Annotated[float, Meta(ge=0, description="square root of the covariance's trace, m")]
    effective_sample_size: Annotated[float, Meta(gt=0, description="1/Σw² of the particles")]
    p_value: Annotated[
        float,
        Meta(
            ge=0,
            le=1,
            description="p-value of the recent readings under the model: near 0 if they do not fit it",
        ),
    ]
    ceased: Annotated[
        bool,
        Meta(
            description="true if the stop criterion is met and the readings fit the model: the search is over"
        ),
    ]
    # Older records lack this field and the next ones; their beliefs get these defaults.
    assume: Annotated[str, Meta(description="what is taken to be known, in the form of --assume")] = "paper"
    stop: Annotated[str, Meta(description="the stop criterion, in the form of --stop")] = "spread"
    evidence: Annotated[
        float,
        Meta(
            description="nats by which the readings are explained better than by a sensor that shows one "
            "value plus noise"
        ),
    ] = 0.0
    outside: Outside = 0.0
    wind_p_value: Annotated[
        float,
        Meta(
            ge=0,
            le=1,
            description="p-value of the measured winds under one wind: near 0 if it differs from place to "
            "place or from time to time, 1 if it hardly does",
        ),
    ] = 1.0
    intermittency: Annotated[
        dict[str, tuple[float, float, float]],
        Meta(
            description="how the gas comes and goes: 5, 50 and 95% quantiles of its coefficient of variation "
            "3 m downwind of the source (`downwind`), and of cv, puff-rate (1/s) and puff-share where they "
            "are unknown; empty if none is"
        ),
    ] = {}
    advised_dwell: Annotated[
        float,
        Meta(ge=0, description="how long to hover for a reading in such gas, s; 0: as long as now"),
    ] = 0.0
    # These are not said at all where there is nothing to say.
    system: Annotated[
        System | msgspec.UnsetType,
        Meta(description="MAVLink system id of the vehicle; absent if it is 1, and with several vehicles"),
    ] = msgspec.UNSET
    back: Annotated[
        Pair | msgspec.UnsetType,
        Meta(
            description="where a search that repeats itself would go next, (x, y) m: it has read at two "
            "places in turn for long; absent if it does not, and with several vehicles"
        ),
    ] = msgspec.UNSET
    backs: Annotated[
        dict[int, Pair] | msgspec.UnsetType,
        Meta(
            description="of a search by several vehicles: where each that repeats itself would go next, as "
            "`back`, by its number; absent if none does"
        ),
    ] = msgspec.UNSET
    readings: Annotated[
        tuple[RoundReading, ...] | msgspec.UnsetType,
        Meta(
            description="of a search by several vehicles: the readings of the round, one of each that takes "
            "part in it, in their order; absent with one vehicle"
        ),
    ] = msgspec.UNSET
    stands: Annotated[
        tuple[Stand, ...] | msgspec.UnsetType,
        Meta(
            description="of a search by several vehicles: where each of the round has read first, in their "
            "order: it comes back there; absent with one vehicle"
        ),
    ] = msgspec.UNSET
    doubted: Annotated[
        tuple[int, ...] | msgspec.UnsetType,
        Meta(
            description="of a search by several vehicles: the numbers of those whose readings do not fit the "
            "others', or whose sensor is stuck; absent if there are none"
        ),
    ] = msgspec.UNSET
    left_at: Annotated[
        tuple[LeftAt, ...] | msgspec.UnsetType,
        Meta(
            description="of a search by several vehicles: where those that have left have read, and where "
            "those take off that are about to join; absent if there are none"
        ),
    ] = msgspec.UNSET


class Contribution(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What one vehicle has measured, of several that have searched together."""

    vehicle: Annotated[int, Meta(ge=1, le=64, description="number of the vehicle in the search, from 1")]
    readings: Annotated[int, Meta(ge=1, le=MOST, description="how many of its readings the belief has taken")]
    largest: Annotated[float, Meta(description="the largest of them, in the sensor's unit")]


class Stop(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The stop (Autonomous Goal Detection and Cessation, AGDC): a claim about where the source is."""

    time_boot_ms: TimeBootMs
    step: Step
    estimate: Annotated[Pair, Meta(description="claimed position of the source, (x, y) m")]
    covariance: Covariance
    spread: Annotated[float, Meta(ge=0, description="square root of the covariance's trace, m")]
    threshold: Annotated[
        float,
        Meta(ge=0, description="ζ, the spread below which the search stops, m; 0 with another criterion"),
    ]
    stop: Annotated[str, Meta(description="the stop criterion, in the form of --stop")] = "spread"
    outside: Outside = 0.0
    measured: Annotated[
        tuple[Contribution, ...] | msgspec.UnsetType,
        Meta(
            description="of a search by several vehicles: what each that has read has measured, also those "
            "that have left; absent with one vehicle"
        ),
    ] = msgspec.UNSET


class Departure(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A vehicle has left the search by several: the others go on without it."""

    vehicle: Annotated[int, Meta(ge=1, le=64, description="number of the vehicle in the search, from 1")]
    step: Annotated[
        int,
        Meta(
            ge=0,
            le=MOST,
            description="the first round that it takes no part in; unless it has joined late, that is the "
            "number of its readings that count",
        ),
    ]
    reason: Annotated[str, Meta(description="why, in words")]
    forgotten: Annotated[
        bool,
        Meta(
            description="true if the readings that it took before no longer count either: from `step` on the "
            "belief is that of the others' readings alone"
        ),
    ] = False


class LeaveOut(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An order of an operator: a vehicle leaves the search by several, and its readings are forgotten."""

    vehicle: Annotated[int, Meta(ge=1, le=64, description="number of the vehicle in the search, from 1")]
    reason: Annotated[str, Meta(max_length=200, description="who orders it, or why, in words")]
    late: Annotated[
        bool,
        Meta(description="true if it has not come yet: the others begin without it, and it may join later"),
    ] = False


class Join(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A vehicle that comes late asks for its part in a search by several; said until it has it."""

    place: Annotated[Pair, Meta(description="where it stands and takes off, (x, y) m: wanted clear")]
    clear: Annotated[
        bool,
        Meta(description="true once the others are clear of it: it takes off as soon as it has its round"),
    ] = False


class Latecomer(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A vehicle comes late to a search by several. Of those about one the one that says most holds."""

    vehicle: Annotated[int, Meta(ge=1, le=64, description="number of the vehicle in the search, from 1")]
    place: Annotated[
        Pair | msgspec.UnsetType,
        Meta(description="where it takes off, (x, y) m; absent: it has not come, and is not waited for"),
    ] = msgspec.UNSET
    since: Annotated[
        int, Meta(ge=0, le=MOST, description="the first round after which the others keep clear of it")
    ] = 0
    step: Annotated[
        Annotated[int, Meta(ge=0, le=MOST)] | msgspec.UnsetType,
        Meta(description="the first round that it takes part in; absent: it has none yet"),
    ] = msgspec.UNSET

    @property
    def says(self) -> int:
        """How much it says: 0 that it has not come, 1 where it takes off, 2 when it takes part."""
        return (self.place is not msgspec.UNSET) + (self.step is not msgspec.UNSET)


class Health(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The status of a service.

    The liveliness token on the same key shows that its process runs, not that a vehicle is alive.
    """

    service: str
    state: Annotated[
        str,
        Meta(
            description="what it is doing; uav: standby, taking off, searching, paused, returning, holding, "
            "landed"
        ),
    ]
    step: Annotated[int, Meta(ge=-1, le=MOST, description="last step finished; -1 before the first")]
    compute_s: Annotated[
        float, Meta(ge=0, description="compute time of the steps so far, s; only the uav's includes the bus")
    ]
    uptime_s: Annotated[float, Meta(ge=0, description="time since it joined the bus, s")]
    refused: Annotated[dict[str, Count], Meta(description="messages dropped so far, by kind")]
    warnings: Annotated[
        tuple[str, ...], Meta(description="current problems, in words; empty if there are none")
    ] = ()
    refused_lately: Annotated[
        Count, Meta(description="messages dropped within the last 60 s, except `repeated` ones")
    ] = 0
    last_error: Annotated[
        str, Meta(description="text of the last warning or error in the log; empty if there was none")
    ] = ""
    rate_hz: Annotated[
        float, Meta(ge=0, description="steps per second over the last 10 s; recorder: messages per second")
    ] = 0.0
    latency_s: Annotated[
        float,
        Meta(
            ge=0,
            description="time from the last message to its answer, s; uav: from its reading to the waypoint",
        ),
    ] = 0.0
    about: Annotated[
        str, Meta(description="what it runs with: the agent's policy, the estimator's particles")
    ] = ""
    ceased: Annotated[bool, Meta(description="true once it knows of the stop: the search has ceased")] = False
    system: Annotated[
        int, Meta(ge=0, le=255, description="uav: the vehicle's MAVLink system id; 0: none is told")
    ] = 0


def began_anew(uptime_s: float, uptime_before_s: float, since_s: float) -> bool:
    """Whether a part has begun anew since its last message, by the uptimes of both and the time between them.

    One that has been up for longer than that time is another part of the same name.
    """
    return uptime_s < min(uptime_before_s, since_s)


def by_number(belief: Belief) -> dict[int, Belief]:
    """Return a belief as each vehicle of its round sees it, about its own reading, by their numbers."""
    return {
        each.vehicle: msgspec.structs.replace(
            belief,
            time_boot_ms=each.time_boot_ms,
            position=each.position,
            altitude_m=each.altitude_m,
            gas=each.gas,
            readings=msgspec.UNSET,
        )
        for each in belief.readings or ()
    } or {1: belief}


def departure_text(left: Departure) -> str:
    """Return a departure in words."""
    forgotten = "; its readings no longer count" if left.forgotten and left.step else ""
    return f"uav/{left.vehicle} has left the search at step {left.step}: {left.reason}{forgotten}"


def latecomer_text(late: Latecomer) -> str:
    """Return in words how far a latecomer has come."""
    if late.step is not msgspec.UNSET:
        return f"uav/{late.vehicle} joins the search at step {late.step}"
    asks = late.place is not msgspec.UNSET
    return f"uav/{late.vehicle} {'asks to join the search' if asks else 'comes late: the others begin'}"


def stop_text(stop: Stop) -> str:
    """Return a stop in words."""
    (x, y), spread = stop.estimate, stop.spread
    outside = f", {100 * stop.outside:.0f}% of the belief outside the area" if stop.outside >= 0.005 else ""
    return (
        f"the search has ceased at step {stop.step}: source at ({x:.2f}, {y:.2f}) m, spread {spread:.2f} m"
        f"{outside}"
    )


def pack_particles(particles: Particles) -> bytes:
    """Return the array as bytes: little-endian float32, row by row."""
    return particles.astype("<f4", copy=False).tobytes()


def unpack_particles(payload: bytes, unknowns: int) -> Particles:
    """Undo `pack_particles` for this number of unknowns; raises ValueError for what it did not make."""
    row = 4 * (unknowns + 1)
    if not payload or len(payload) % row:
        raise ValueError(f"the particle array has {len(payload)} bytes; wanted a positive multiple of {row}")
    particles = np.frombuffer(payload, "<f4").reshape(-1, unknowns + 1)
    if not np.isfinite(particles).all():
        raise ValueError("the particle array holds NaN or infinite values")
    weights = particles[:, -1]
    if (weights < 0).any() or not weights.any():
        raise ValueError("the particle array holds negative weights, or none above 0")
    return particles.astype(np.float32, copy=False)
