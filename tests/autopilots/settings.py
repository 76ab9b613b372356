"""What an autopilot double is started with."""

from dataclasses import dataclass

from tests.autopilots.body import Vector


@dataclass(frozen=True)
class Settings:
    """What a double is started with."""

    seed: int = 0
    instance: int = 0
    ready_s: float | None = None
    """When the EKF has a position, s after boot; None: 41 for ArduCopter, 12 for PX4."""
    home: Vector = (1.2, -0.7, -0.4)
    """Where the vehicle stands, north, east, down (m) from the EKF's origin."""
    wind: tuple[float, float] = (0.0, 0.0)
    """What it says of the wind: the direction that it comes from (deg), its speed (m/s). ArduCopter may
    say 0.
    """
    radio: bool = False
    """Whether a pilot with a radio is there."""
    parameters: tuple[tuple[str, float], ...] = ()
    faults: tuple[str, ...] = ()
