"""Protects the search area: the prior, admission and the filter's moves all respect the chosen side."""

import contextlib
import math
import sys

import numpy as np
import pytest

from estimator import __main__ as command
from estimator import service
from estimator.admission import refusal
from estimator.belief import belief
from estimator.filter import Config, assimilate, prior
from link.bus.mavlink import Reading
from plume.problem import AREA, square
from plume.scenario import Scenario
from plume.worlds.world import World

SIDE_M = 80.0


def chosen(monkeypatch: pytest.MonkeyPatch, *flags: str) -> Config:
    """The configuration that `python -m estimator` runs with."""
    configs: list[Config] = []
    monkeypatch.setattr(sys, "argv", ["estimator", *flags])
    monkeypatch.setattr(command, "Bus", lambda *_, **__: contextlib.nullcontext())
    monkeypatch.setattr(service, "run", lambda _bus, config, *_: configs.append(config))
    command.main()
    return configs[0]


def test_it_is_30_m_or_what_the_command_line_says(monkeypatch: pytest.MonkeyPatch) -> None:
    assert chosen(monkeypatch).area == AREA
    assert chosen(monkeypatch, "--area", "80").area == square(SIDE_M)


@pytest.mark.parametrize("side", ["0", "-5", "nan", "wide", "1e6"])
def test_a_side_that_cannot_be_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], side: str
) -> None:
    with pytest.raises(SystemExit, match="2"):
        chosen(monkeypatch, f"--area={side}")
    assert f"--area: {side!r} is not allowed; wanted a number above 0 up to 100000" in capsys.readouterr().err


def test_a_prior_of_the_location_must_leave_something_of_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert chosen(monkeypatch, "--area", "80", "--prior", "x=uniform:50,70").prior_rows[0].tolist()[1:] == [
        50.0,
        70.0,
        50.0,
        70.0,
    ]
    with pytest.raises(SystemExit, match="2"):
        chosen(monkeypatch, "--prior", "x=uniform:50,70")
    assert "--prior: the prior of x excludes every possible value" in capsys.readouterr().err


def test_the_prior_fills_it() -> None:
    counts, _, _ = np.histogram2d(
        *prior(Config(particles=4000, area=square(SIDE_M))).particles,
        bins=4,
        range=[[0, SIDE_M], [0, SIDE_M]],
    )
    assert counts.sum() == 4000
    assert (
        np.abs(counts - 250).max() < 16
    )  # 16 is one standard deviation of independent draws; the lattice is more even


@pytest.mark.parametrize(("x", "kind"), [(79.9, None), (80.1, "outside"), (-0.1, "outside")])
def test_readings_from_within_it_are_admitted(x: float, kind: str | None) -> None:
    refused = refusal(Reading(1000, (x, 40.0), 5.0, (1.0, 0.5), 0.5), None, Config(area=square(SIDE_M)))
    assert (refused and refused[0]) == kind


def test_a_source_far_off_in_it_is_found_and_no_particle_leaves_it() -> None:
    s = Scenario(source=(66.0, 78.5), q=300.0, u=2.0, phi=4.0, d=4.0, tau=10.0, start=(0.0, 0.0))
    world, config = World(s, 3), Config(rate=s.q, diffusivity=s.d, lifetime=s.tau, area=square(SIDE_M))
    posterior = prior(config)
    path = [(x, y) for y in (70.0, 74.0, 77.0, 79.0) for x in np.linspace(50.0, 80.0, 31).tolist()]
    for step, place in enumerate(path):
        posterior = assimilate(
            posterior, Reading(step, place, 5.0, world.wind, world.gas(place, step)), config
        )
        assert posterior.particles.min() >= 0.0
        assert posterior.particles.max() <= SIDE_M
    summary, _ = belief(posterior, Reading(step, place, 5.0, world.wind, 0.0), config)
    assert summary.spread < 0.5
    # The error of an honest posterior exceeds twice its spread in exp(−4) = 1.8% of all missions.
    assert math.dist(summary.mean, s.source) < 2.0 * summary.spread
