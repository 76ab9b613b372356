"""Protects what a log of others is for: the source of a plume that somebody else has flown over is found
within the region that the belief claims, whichever preset the log is written in.
"""

from argparse import Namespace
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from estimator.belief import belief
from estimator.filter import Config, assimilate, prior
from estimator.priors import parse as parse_prior
from ground.replay.source import find
from link.bus.mavlink import unpack_reading
from plume.geodesy import to_global, to_local
from plume.problem import square
from plume.sensors.names import parse as parse_sensor
from tests.ground.logs.flights import Plume, gasflux, globe, skyhub
from tests.ground.replay.test_source import FLAGS

CHI2_95 = 5.991
"""The 95% quantile of a chi-squared variable with two degrees of freedom."""


@pytest.mark.parametrize("write", [gasflux, skyhub])
def test_the_source_of_a_flown_lawnmower_lies_within_its_95_percent_region(
    write: Callable[[Path, Plume], Path], tmp_path: Path
) -> None:
    plume = Plume()
    log = write(tmp_path / "flight.csv", plume)
    source, _ = find(Namespace(log=log, **FLAGS | {"given": {"every": 2.0, "diffusivity": 3.0}}))
    words = dict(zip(source.parts["estimator"][::2], source.parts["estimator"][1::2], strict=True))
    config = Config(
        particles=600,
        diffusivity=float(words["--diffusivity"]),
        area=square(float(words["--area"])),
        sensor=parse_sensor(words["--sensor"]),
        assume=words["--assume"],
        priors=dict([parse_prior(words["--prior"])]),
    )
    posterior = prior(config)
    for entry in source.entries:
        if entry.key == "reading":
            reading = unpack_reading(entry.payload)
            posterior = assimilate(posterior, reading, config)
    said, _ = belief(posterior, reading, config)
    corner = next(note for note in source.notes if note.startswith("area: ")).rpartition(" at ")[2]
    north, east = to_local(*map(float, corner.split(", ")), *globe(*plume.source))
    xx, xy, yy = said.covariance
    error = np.array([said.mean[0] - east, said.mean[1] - north])
    assert error @ np.linalg.solve([[xx, xy], [xy, yy]], error) < CHI2_95
    assert np.hypot(*error) < 3.0
    assert said.spread < 3.0
    assert said.rate == pytest.approx(plume.rate, rel=1.0)
    assert to_global(51.5, 9.25, 24.0, 33.0) == pytest.approx(globe(*plume.source), abs=1e-7)
