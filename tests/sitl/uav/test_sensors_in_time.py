"""Protects parity of sensors in time: what the simulated vehicle measures is what a rollout does, to the bit."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from agent.trials.rollout import rollout
from aircraft.state import Arrived
from plume.flight import ACCEL_MPS2, SPEED_MPS
from plume.scenario import draw
from plume.sensors.names import parse
from plume.worlds.world import World
from sitl.uav.simulated import SimulatedSensor

SEED = 7
VEHICLE: Any = SimpleNamespace(config=SimpleNamespace(speed_mps=SPEED_MPS, accel_mps2=ACCEL_MPS2))


@pytest.mark.parametrize(
    ("sensor", "world"),
    [
        ("pid:warmup=7.5", "as-modelled"),
        ("tgs2620", "readings-lost"),
        ("tdlas:dwell=1", "cv-1"),
        ("gaussian:0.3,0.2,dwell=2", "puffs"),
        ("pid:cv=0.5", "spikes-3+wind-noisy"),
    ],
)
def test_the_vehicle_measures_what_a_rollout_does(sensor: str, world: str) -> None:
    _, trace = rollout(SEED, "homing", 100, budget=12, world=world, sensor=parse(sensor))
    there = World(draw(SEED), SEED, parse(sensor), world)
    simulated = SimulatedSensor(there, VEHICLE, there.start)
    for number, point in enumerate(trace):
        (east, north), gas = point.position, float("nan")
        arrived = Arrived(0.0, (north, east, -5.0))
        while np.isnan(gas):  # it has no value yet, and is read again
            gas = simulated.measure(arrived, 0, number).gas
        assert gas == point.reading
