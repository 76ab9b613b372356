"""Protects whole searches on a real autopilot with each planner, with frames lost: estimator and agent
notice nothing.
"""

import math

import pytest

from agent.planners.registry import PLANNERS
from agent.policies import choose, reach
from aircraft.search.search import LANDED
from estimator.belief import belief
from estimator.filter import Config, assimilate, prior
from link.bus.mavlink import Reading
from plume.elementary import float32
from plume.randomness import derived_seed
from plume.scenario import draw
from plume.worlds.world import World
from tests.aircraft.remote.cockpit import Cockpit

SEED, BUDGET, PARTICLES = 1_000_011, 4, 100
KINDS = ("ardupilot", "px4")


class Mind:
    """Estimator and agent of one mission, in this process. The gas is that of the place that the vehicle
    reports.
    """

    def __init__(self, policy: str) -> None:
        told = draw(SEED)
        self.world = World(told, SEED)
        self.policy, self.within = policy, reach(policy, {})
        self.config = Config(PARTICLES, 0.5, derived_seed(SEED, "estimator"), told.q, told.d, told.tau)
        self.posterior = prior(self.config)
        self.asked: list[tuple[float, float]] = []

    def answer(self, cockpit: Cockpit) -> tuple[float, float]:
        """The waypoint after the newest reading."""
        north, east, down = cockpit.readings[-1][1]
        step = len(cockpit.readings) - 1
        reading = Reading(
            step, (float32(east), float32(north)), -down, self.world.wind, self.world.gas((east, north), step)
        )
        self.posterior = assimilate(self.posterior, reading, self.config)
        summary, cloud = belief(self.posterior, reading, self.config)
        self.asked.append(choose(self.policy, summary, cloud, derived_seed(SEED, "agent"), self.within))
        return self.asked[-1]


@pytest.mark.one_in(3)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("policy", [*PLANNERS, "ppo"])
def test_a_search_flies_each_waypoint_of_its_planner_with_5_percent_of_the_frames_lost(
    policy: str, kind: str
) -> None:
    mind, cockpit = Mind(policy), Cockpit(kind, "drop:5", seed=len(policy))
    cockpit.answers = mind.answer
    cockpit.reads(BUDGET + 1)
    cockpit.finds()
    cockpit.until(lambda: cockpit.search.state == LANDED)
    places = [(place[1], place[0]) for _, place in cockpit.readings[1:]]
    assert all(
        math.dist(place, asked) < 0.3 + 0.5 for place, asked in zip(places, mind.asked, strict=False)
    ), "0.35 m inside an edge"
    assert not cockpit.vehicle.failure
