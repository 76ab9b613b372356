"""`python -m tests.system.bits [NAME...]` prints a line `NAME DIGEST` for each thing that must have the
same bits on every machine.

NAME is a check, or the beginning of several: `golden`, `flight/ppo`. It needs no router and no packages
but a flight's. After the digest comes `DIFFERS` and why where an answer is not as a golden record has it,
or a rebuilt belief not as it was flown.
"""

import argparse
import hashlib
import struct
import sys
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import msgspec
import numpy as np

from agent.policies import OURS, SHIPPED, choose, reach
from agent.trials.figures import figures
from agent.trials.rollout import Mission, Step, mission
from agent.trials.sweep import Sweep, fly
from estimator import priors
from estimator.batch import Batch
from estimator.belief import belief, stop
from estimator.criterion import parse as criterion
from estimator.filter import Config, Posterior, assimilate, prior
from estimator.options import add_sensor_argument, criteria, knowledge
from ground.replay import verify
from link import cli
from link.bus.keys import BELIEF, READING, STOP, WAYPOINT
from link.bus.mavlink import ONBOARD_COMPUTER, Codec, Reading, unpack_reading, waypoint_message
from link.bus.messages import pack_particles
from link.record.reader import read
from plume.problems.options import add_problem_argument, problem_of
from plume.randomness import Keyed, keyed
from plume.scenario import AS_MODELLED, draw
from plume.sensors.instruments import INSTRUMENTS
from plume.sensors.names import parse
from plume.worlds.errors import WRONG
from plume.worlds.world import World, readings_of
from tests.golden.__main__ import GOLDEN, SENSORS, compare, path


def fed(digest: Any, value: Any) -> None:
    """Feed every bit of a value to a digest, with its type and its size."""
    match value:
        case float():
            digest.update(b"f" + struct.pack("<d", value))
        case np.generic() | np.ndarray():
            digest.update(f"{value.dtype.str} {value.shape}".encode() + np.ascontiguousarray(value).tobytes())
        case msgspec.Struct():
            said = msgspec.structs.asdict(value).items()
            fed(digest, {name: each for name, each in said if each is not msgspec.UNSET})
        case Posterior():
            fed(digest, vars(value))
        case dict():
            fed(digest, [pair for pair in value.items()])
        case list() | tuple():
            digest.update(f"{len(value)} of".encode())
            for each in value:
                fed(digest, each)
        case int() | str() | bytes() | None:
            digest.update(f"{type(value).__name__} {value!r}".encode())
        case _:
            raise TypeError(f"no bits of a {type(value).__name__} are known")


def digest_of(values: Any) -> str:
    digest = hashlib.blake2b(digest_size=8)
    for value in values:
        fed(digest, value)
    return digest.hexdigest()


# ---- golden records ----


def told(words: list[str]) -> Config:
    """What the estimator of a record was told, by its command line."""
    parser = cli.Parser()
    cli.add_filter_arguments(parser)
    add_sensor_argument(parser)
    add_problem_argument(parser)
    parser.add_argument("--seed", type=int)
    for flag in ("--rate", "--diffusivity", "--lifetime", "--sysid"):
        parser.add_argument(flag, type=float)
    args = parser.parse_args(words)
    problem = problem_of(args)
    (stops,) = criteria(args, problem)
    knows = knowledge(args, problem)
    return Config(
        args.particles,
        stops.threshold_m,
        args.seed,
        args.rate,
        args.diffusivity,
        args.lifetime,
        within=stops.within,
        **knows,
    )


def golden(name: str) -> str:
    """Answer the readings of a golden record as the services do; returns their digest, and the first value
    that is not as recorded.
    """
    log = read(path(name))
    config = told(log.about["parts"]["estimator"])
    words = log.about["parts"]["agent"]
    agent = dict(zip(words[::2], words[1::2], strict=True))
    policy, budget, seed = agent["--policy"], int(agent["--budget"]), int(agent["--seed"])
    readings = {}
    for entry in log.entries:
        if entry.key == READING.name:
            reading = unpack_reading(entry.payload, 1)
            readings.setdefault(reading.time_boot_ms, reading)
    answers = []
    stopped = False
    posterior, codec = prior(config), Codec(1, ONBOARD_COMPUTER)
    for reading in readings.values():
        posterior = assimilate(posterior, reading, config)
        said, particles = belief(posterior, reading, config)
        if said.ceased and not stopped:
            stopped = True
            answers += verify.answers(STOP.name, msgspec.json.encode(stop(said, config)))
        answers += verify.answers(BELIEF.name, msgspec.json.encode(said), pack_particles(particles))
        if not said.ceased and said.step < budget:
            place = choose(policy, said, particles, seed, reach(policy))
            message = waypoint_message(1, said.time_boot_ms, place, said.altitude_m)
            answers += verify.answers(WAYPOINT.name, codec.pack(message))
    then, now = verify.said(log.entries), {(answer.time_ms, answer.kind): answer for answer in answers}
    found = compare(then, now)
    differs = f" DIFFERS {found.text()}" if found else "" if then else " DIFFERS nothing is recorded"
    return digest_of(now.values()) + differs


# ---- missions ----

LITTLE = {"particles": 300, "threshold_m": 0.5}
FAMILIES = ("homing", "infotaxis", "thompson", *SHIPPED)
"""A policy of each kind: a planner of one move, one of hypothetical readings, one that draws, and the
learned ones.
"""


def computed(step: Step) -> tuple[Any, ...]:
    """All that a step computed, but for the time it took."""
    return step.belief, step.particles, step.posterior


def flown(ready: Mission) -> str:
    return digest_of(map(computed, ready.steps))


def flight(policy: str, sensor: str, assume: str, world: str, budget: int) -> str:
    within = criterion("within:1,0.99").within
    return flown(
        mission(
            7,
            policy,
            budget=budget,
            world=world,
            sensor=parse(sensor),
            assume=assume,
            within=within,
            **LITTLE,
        )
    )


def unusual() -> str:
    """A mission whose every assumption is its own, in four headings."""
    known = {
        "phi": priors.Uniform(0.0, 6.28),
        "u": priors.Normal(2.5, 1.0),
        "q": priors.Gamma(2.0, 150.0),
        "z": priors.Fixed(4.0),
    }
    known["tau"] = priors.LogNormal(10.0, 0.3)
    moves = {"headings": 4, "step": 0.5, "measurements": 9}
    return flown(
        mission(5, "lookahead", budget=40, moves=moves, priors=known, stop_limits={"q": 90.0}, **LITTLE)
    )


def recovery(assume: str, sensor: str) -> str:
    """Rebuild each tenth belief from the readings alone, as a restarted estimator does, and compare it
    with the flown one.
    """
    ready = mission(1, "homing", budget=30, assume=assume, sensor=parse(sensor), ends=False, **LITTLE)
    steps = list(ready.steps)
    for last in steps[::10]:
        rebuilt = prior(ready.config)
        for step in steps[: last.belief.step + 1]:
            said = step.belief
            rebuilt = assimilate(
                rebuilt,
                Reading(said.time_boot_ms, said.position, said.altitude_m, said.wind, said.gas),
                ready.config,
            )
        again = belief(
            rebuilt,
            Reading(said.time_boot_ms, said.position, said.altitude_m, said.wind, said.gas),
            ready.config,
        )
        if digest_of([*again, rebuilt]) != digest_of(computed(last)):
            return f"{digest_of([rebuilt])} DIFFERS from what was flown at step {said.step}"
    return digest_of(map(computed, steps))


def side_by_side(assume: str) -> str:
    """Missions in one batch, on two threads."""
    seeds, steps = range(12), 40
    scenarios = [draw(seed) for seed in seeds]
    configs = [
        Config(100, 0.5, seed, s.q, s.d, s.tau, assume=assume)
        for seed, s in zip(seeds, scenarios, strict=True)
    ]
    worlds = [World(s, seed) for seed, s in zip(seeds, scenarios, strict=True)]
    ways = np.array(
        [np.linspace(world.start, s.source, steps) for world, s in zip(worlds, scenarios, strict=True)]
    )
    batch, noise, computed = Batch(configs, 2), Keyed(), []
    for k in range(steps):
        gas = readings_of(worlds, ways[:, k], [k] * len(seeds), np.zeros(len(seeds)), noise)[0].tolist()
        readings = [
            Reading(k, tuple(ways[i, k].tolist()), 5.0, worlds[i].wind, gas[i]) for i in range(len(seeds))
        ]
        batch.assimilate(
            np.array([config.row(reading) for config, reading in zip(configs, readings, strict=True)])
        )
        computed.append(
            (
                batch.means.copy(),
                batch.covariances.copy(),
                [(batch.may_claim(i), batch.has_ceased(i)) for i in range(len(seeds))],
            )
        )
    return digest_of([*computed, *(batch.posterior(i) for i in range(len(seeds)))])


def table() -> str:
    """The rows and figures of a small sweep, but for the times."""
    stops = (criterion("spread:1"), criterion("spread:0.5"), criterion("within:1,0.9"))
    sweep = Sweep(("homing", "greedy"), range(1_000_000, 1_000_006), (100,), stops, budget=60)
    rows = [
        row for policy, *rest in sweep.flights for mission in fly(sweep, [(policy, *rest)]) for row in mission
    ]
    rows = [msgspec.structs.replace(row, search_time_s=0.0, decision_ms=0.0, update_ms=0.0) for row in rows]
    told = [
        figures([row for row in rows if row.policy == policy and row.criterion == s.text])
        for policy in sweep.policies
        for s in stops
    ]
    return digest_of([*rows, *told])


# ---- the world and what is drawn ----


def scenarios() -> str:
    return digest_of((scenario := draw(seed), scenario.wind) for seed in range(200))


MOVING = "puffs:meander=10,gusts=0.1"  # a world in which gas and wind move
WALLED = "walls:file=courtyard"


def readings(world: str) -> str:
    """What each sensor reads in a world, by seed and along a path."""

    def taken() -> Iterator[Any]:
        for kind in ("gaussian", "gaussian:0.3,0.2,1.0", "threshold", "hits"):
            for seed in range(6):
                there = World(draw(seed), seed, parse(kind), world)
                yield there.errors._asdict(), there.truth, there.wind, there.start
                for step, place in enumerate(np.linspace(there.start, there.truth.source, 40).tolist()):
                    yield there.measure(tuple(place), step), there.loses(step)

    return digest_of(taken())


PRIORS: dict[str, priors.Prior] = {
    "uniform": priors.Uniform(1.0, 7.3),
    "normal": priors.Normal(2.5, 1.7),
    "gamma": priors.Gamma(2.3, 1.9),
    "gamma-below-1": priors.Gamma(0.7, 150.0),
    "lognormal": priors.LogNormal(300.0, 0.7),
}


def drawn(kind: str) -> str:
    """Particles of a prior, and its row."""
    config = Config(20_000, priors={"q": PRIORS[kind]})
    return digest_of(
        [
            config.prior_rows,
            *(
                priors.draw(config.prior_rows, config.unknown_indices, 20_000, keyed(s, "prior"))
                for s in range(5)
            ),
        ]
    )


def checks() -> dict[str, Callable[[], str]]:
    """All checks by name, in the order in which a difference should be looked for."""
    found: dict[str, Callable[[], str]] = {"scenarios": scenarios}
    found |= {f"prior/{kind}": partial(drawn, kind) for kind in PRIORS}
    found |= {
        f"readings/{world}": partial(readings, world) for world in (AS_MODELLED, *WRONG, MOVING, WALLED)
    }
    found |= {f"golden/{name}": partial(golden, name) for name in GOLDEN}
    found |= {
        f"flight/{policy}-paper": partial(flight, policy, "gaussian", "paper", "as-modelled", 60)
        for policy in OURS
    }
    found |= {
        f"flight/{policy}-field": partial(flight, policy, "gaussian", "field", "as-modelled", 25)
        for policy in OURS
    }
    for policy in FAMILIES:
        found |= {
            f"flight/{policy}-{kind}": partial(flight, policy, kind, "field", "all-at-once", 25)
            for kind in ("threshold", "hits")
        }
        found[f"flight/{policy}-gusts"] = partial(
            flight, policy, "gaussian:0.3,0.2,1.0", "paper", "cv-1-correlated", 25
        )
        found[f"flight/{policy}-moving"] = partial(flight, policy, "gaussian", "field", MOVING, 25)
    for kind in INSTRUMENTS:
        found[f"flight/homing-{kind}"] = partial(flight, "homing", kind, "field", "spikes-3", 25)
    found["flight/unusual"] = unusual
    found |= {
        f"recovery/{assume}-{kind}": partial(recovery, assume, kind)
        for assume in ("paper", "field")
        for kind in SENSORS
    }
    found |= {f"batch/{assume}": partial(side_by_side, assume) for assume in ("paper", "field")}
    found["figures"] = table
    return found


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tests.system.bits",
        description="Print a digest of everything that must have the same bits.",
    )
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help="only checks whose names begin so (default: all)"
    )
    wanted = tuple(parser.parse_args().names)
    for name, check in checks().items():
        if not wanted or name.startswith(wanted):
            print(name, check(), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
