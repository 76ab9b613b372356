"""An agent that says that it is ready has loaded, and compiled, all that its decisions take."""

import subprocess
import sys

import pytest

FIRST_DECISION = """
import sys
from agent.policies import choose, policy, reach
from estimator.belief import belief
from estimator.filter import Config, assimilate, prior
from link.bus.mavlink import Reading

config, name = Config(particles=200), sys.argv[1]
reading = Reading(0, (3.0, 4.0), 5.0, (1.0, 2.0), 0.5)
said, particles = belief(assimilate(prior(config), reading, config), reading, config)
policy(name)
within = reach(name)
before = set(sys.modules)
choose(name, said, particles, 1, within)
print(*(set(sys.modules) - before))
"""


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", ["ppo", "ddpg", "homing", "random"])
def test_a_decision_loads_nothing(name: str) -> None:
    command = [sys.executable, "-c", FIRST_DECISION, name]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout.split() == []
