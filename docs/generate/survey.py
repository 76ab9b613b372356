"""The generator of docs/examples/lawnmower.csv: a flight over a simulated leak, as the package gasflux has it.

`python -m docs.generate.survey` writes it. The truth is SOURCE, of which the table says nothing.
"""

import math
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from ground.tlog.units import GasUnit
from plume.geodesy import to_global
from plume.scenario import Scenario
from plume.sensors.sensor import Gaussian
from plume.worlds.world import World

TABLE = Path(__file__).parents[1] / "examples" / "lawnmower.csv"
SOURCE = (36.0, 27.0)  # m east and north of the corner
CORNER = (47.397742, 8.545594)
RATE = 0.5  # g/s: 1.8 kg/h
BEGAN = datetime(2026, 6, 1, 9, 0, 0, tzinfo=UTC)
SIDE_M, LANE_M, SPEED_MPS = 52, 4, 4
BACKGROUND_PPM, NOISE_PPM = 2.0, 0.3
TEMPERATURE_C, PRESSURE_HPA = 22.5, 965.0


def rows() -> list[str]:
    """Return the lines of the table, one a second."""
    ppm = GasUnit("ppm").factor(TEMPERATURE_C, PRESSURE_HPA)
    release = Scenario(
        source=SOURCE, q=RATE, u=2.5, phi=math.radians(205.0), d=4.5, tau=10.0, start=(2.0, 2.0)
    )
    world = World(release, seed=1, sensor=Gaussian(0.3, NOISE_PPM * ppm))
    gusts = np.random.default_rng(1).normal(size=(1000, 2))  # of the anemometer
    lines = ["timestamp,latitude,longitude,height_ato,windspeed,winddir,temperature,pressure,ch4"]
    step = 0
    for lane, north in enumerate(range(2, SIDE_M + 1, LANE_M)):
        for along in range(2, SIDE_M + 1, SPEED_MPS):
            place = float(along if lane % 2 == 0 else SIDE_M + 2 - along), float(north)
            gas, wind = world.measure(place, step)
            east_mps, north_mps = np.array(wind) + 0.2 * gusts[step]
            lat, lon = to_global(*CORNER, place[1], place[0])
            speed, from_deg = math.hypot(east_mps, north_mps), math.degrees(math.atan2(east_mps, north_mps))
            when = f"{BEGAN + timedelta(seconds=step):%Y-%m-%dT%H:%M:%SZ}"
            lines.append(
                f"{when},{lat:.7f},{lon:.7f},3.0,{speed:.2f},{from_deg % 360:.0f},{TEMPERATURE_C},"
                f"{PRESSURE_HPA},{BACKGROUND_PPM + gas / ppm:.3f}"
            )
            step += 1
    return lines


if __name__ == "__main__":
    TABLE.write_text("\n".join(rows()) + "\n")
    print(*to_global(*CORNER, SOURCE[1], SOURCE[0]))
