"""Lawnmower flights over a plume, written as others write them: with formulas of their own, so that a reader
that shares a mistake with the simulator is found out.
"""

import math
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NamedTuple

import numpy as np

BEGAN = datetime(2026, 6, 1, 9, 0, 0, tzinfo=UTC)
CORNER = (51.5, 9.25)
"""Latitude and longitude of (0, 0)."""
M_PER_DEG = 111_194.92664455873
"""Of latitude, on a sphere of 6,371 km."""
METHANE_GM3 = 0.000678499
"""1 ppm at 15 °C and 1013.25 hPa: 101325 Pa · 16.043 g/mol / (8.314463 · 288.15 K) · 1e-6."""


class Plume(NamedTuple):
    """A source on the ground."""

    source: tuple[float, float] = (33.0, 24.0)
    rate: float = 0.6
    diffusivity: float = 3.0
    lifetime: float = 15.0
    speed: float = 2.5
    from_deg: float = 250.0

    def gas(self, east: float, north: float, up: float = 0.0) -> float:
        """Return g/m³ by Vergassola's formula."""
        x, y = east - self.source[0], north - self.source[1]
        r = max(math.sqrt(x * x + y * y + up * up), 0.1)
        upwind = x * math.sin(math.radians(self.from_deg)) + y * math.cos(math.radians(self.from_deg))
        d, u = self.diffusivity, self.speed
        decay = math.sqrt(d * self.lifetime / (1 + u * u * self.lifetime / (4 * d)))
        return self.rate / (4 * math.pi * d * r) * math.exp(-r / decay - u * upwind / (2 * d))

    def below(self, east: float, north: float, height: float) -> float:
        """Return g/m² from the ground up to a height."""
        levels = (np.arange(100) + 0.5) * height / 100
        return float(np.mean([self.gas(east, north, up) for up in levels])) * height


def globe(east: float, north: float) -> tuple[float, float]:
    """Return latitude and longitude of a place, near enough on 50 m."""
    per_lon = M_PER_DEG * math.cos(math.radians(CORNER[0]))
    return CORNER[0] + north / M_PER_DEG, CORNER[1] + east / per_lon


def lawnmower(hz: float, speed: float = 4.0) -> Iterator[tuple[float, float, float]]:
    """Yield time, s, east and north, m."""
    at_s = 0.0
    for lane, north in enumerate(range(2, 51, 4)):
        for n in range(round(46 / speed * hz)):
            east = 2 + n * speed / hz
            yield at_s, (east if lane % 2 == 0 else 50 - east), float(north)
            at_s += 1 / hz


def gasflux(path: Path, plume: Plume, seed: int = 1) -> Path:
    """Write a flight as the package gasflux reads it: 2 ppm of methane in clean air, noise of 0.4 ppm."""
    draws = np.random.default_rng(seed)
    lines = ["timestamp,latitude,longitude,height_ato,windspeed,winddir,temperature,pressure,ch4,co2"]
    per_ppm = 1e-6 * 98_000 * 16.043 / (8.314463 * 278.15)
    for at_s, east, north in lawnmower(4.0):
        gas = plume.gas(east, north)
        ppm = 2.0 + gas * (1 + 0.2 * draws.normal()) / per_ppm + 0.4 * draws.normal()
        lat, lon = globe(east, north)
        wind = plume.speed + 0.3 * draws.normal(), (plume.from_deg + 5 * draws.normal()) % 360
        when = f"{BEGAN + timedelta(seconds=at_s):%Y-%m-%d %H:%M:%S.%f}"
        lines.append(f"{when},{lat!r},{lon!r},4.0,{wind[0]:.4f},{wind[1]:.2f},5.0,980.0,{ppm:.5f},415.0")
    path.write_text("\n".join(lines) + "\n")
    return path


def skyhub(path: Path, plume: Plume, seed: int = 1) -> Path:
    """Write a flight as SkyHub does with a laser 5 m above the ground: 60 ppm·m of clean air, whole numbers,
    each value in three rows of one place; some are empty, and some have a status that says not to take them.
    """
    draws = np.random.default_rng(seed)
    header = "Elapsed,Date,Time,Pitch,Roll,Yaw,Latitude,Longitude,Altitude,Velocity,ALT:Altitude,ALT:ID"
    lines = [f"{header},GAS:Methane,GAS:Status,AIR:Speed,AIR:Direction"]
    for number, (at_s, east, north) in enumerate(lawnmower(4.0)):
        gas = plume.below(east, north, 5.0) * (1 + 0.2 * draws.normal())
        value, status = round(60 + gas / METHANE_GM3 + 3.0 * draws.normal()), number % 2
        if number % 29 == 7:
            value, status = 65_535, 2
        said = "" if number % 31 == 5 else str(value)
        lat, lon = globe(east, north)
        for repeat in range(3):
            when = BEGAN + timedelta(seconds=at_s + 0.01 * repeat)
            date, clock = f"{when:%Y/%m/%d}", f"{when:%H:%M:%S.%f}"[:-3]
            lines.append(
                f"{round(1000 * when.timestamp())},{date},{clock},0.2,4.9,132.9,{lat:.8f},{lon:.8f},5.00,4.00,"
                f"5.000000,v1:altimeter:AINSTEINUSD1:0,{said},{status},{plume.speed:.2f},{plume.from_deg:.2f}"
            )
    path.write_text("\r\n".join(lines) + "\r\n")
    return path
