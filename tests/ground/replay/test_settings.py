"""Protects who replays a stranger's record: it sets what the services assume, and no word of it reaches a
command line otherwise.
"""

import re

import pytest

from ground.replay.settings import flew_a_bundle, words
from link.record.reader import read
from tests.golden.__main__ import GOLDEN, path


def as_pairs(flags: list[str]) -> list[tuple[str, str]]:
    return sorted(zip(flags[::2], flags[1::2], strict=True))


@pytest.mark.parametrize("name", GOLDEN)
def test_every_golden_record_gives_the_flags_that_it_was_flown_with(name: str) -> None:
    parts = read(path(name)).about["parts"]
    assert set(parts) == {"estimator", "agent"}
    assert all(
        as_pairs(words(service, recorded)) == as_pairs(recorded) for service, recorded in parts.items()
    )


def test_settings_of_every_kind_are_kept() -> None:
    estimator = [
        "--stop",
        "within:1,0.99",
        "--stop-on",
        "location,q=50",
        "--prior",
        "q=gamma:2,150",
        "--prior",
        "tau=uniform:5,15",
        "--assume",
        "field",
    ]
    agent = [
        "--headings",
        "8",
        "--step",
        "0.5",
        "--measurements",
        "3",
        "--waypoints",
        "0:3,4.5;5,6e-1",
        "--waypoints",
        "9:1,1",
    ]
    assert as_pairs(words("estimator", estimator)) == as_pairs(estimator)
    assert as_pairs(words("agent", agent)) == as_pairs(agent)


def test_an_older_estimator_took_all_but_the_position_to_be_known() -> None:
    assert words("estimator", ["--particles", "100"]) == ["--particles", "100", "--assume", "paper"]


@pytest.mark.parametrize(
    ("service", "recorded", "named"),
    [
        ("agent", ["evaluate", "--missions", "/tmp/x.csv", "--force"], "'evaluate'"),
        ("agent", ["--policy", "homing", "evaluate", "--force"], "'evaluate'"),
        ("agent", ["--connect", "tcp/stranger:7447"], "'--connect tcp/stranger:7447'"),
        ("agent", ["-e", "tcp/stranger:7447"], "'-e'"),
        ("agent", ["--conn", "tcp/stranger:7447"], "'--conn tcp/stranger:7447'"),
        ("agent", ["--connect=tcp/stranger:7447", "--seed"], "'--connect=tcp/stranger:7447 --seed'"),
        ("agent", ["--policy", "beside/evil.zip"], "'--policy beside/evil.zip'"),
        ("agent", ["--policy", "evil.zip"], "'--policy evil.zip'"),
        ("agent", ["--policy", "/evil"], "'--policy /evil'"),
        ("agent", ["--policy", "--connect"], "'--policy --connect'"),
        ("agent", ["--seed", "1", "--seed", "2"], "'--seed'"),
        ("agent", ["--seed", "--connect"], "'--seed --connect'"),
        ("agent", ["--waypoints", "0:1,2", "--waypoints", "--connect"], "'--waypoints --connect'"),
        ("agent", ["--headings", "8\n"], "'--headings 8\\n'"),
        ("estimator", ["--namespace", "uav/2"], "'--namespace uav/2'"),
        ("estimator", ["--secure", "certs"], "'--secure certs'"),
        ("estimator", ["--log-level", "debug"], "'--log-level debug'"),
        ("estimator", ["--sensor", "/dev/ttyUSB0"], "'--sensor /dev/ttyUSB0'"),
        ("estimator", ["--stop", "spread:0.5\x1b[2J"], "'--stop spread:0.5\\x1b[2J'"),
        ("estimator", ["--prior", "q=gamma:2,150", "--prior", "--connect"], "'--prior --connect'"),
    ],
)
def test_what_is_no_setting_is_refused_by_name(service: str, recorded: list[str], named: str) -> None:
    with pytest.raises(ValueError, match=rf"^{re.escape(named)}\Z"):
        words(service, recorded)


def test_a_flag_without_a_value_is_refused() -> None:
    with pytest.raises(ValueError, match="'--force'"):
        words("agent", ["--seed", "1", "--force"])


def test_the_file_of_a_policy_is_the_one_that_the_user_names() -> None:
    recorded = ["--policy", "theirs.zip", "--seed", "3"]
    assert flew_a_bundle(recorded)
    assert words("agent", recorded, "mine.zip") == ["--seed", "3", "--policy", "mine.zip"]
    assert not flew_a_bundle(["--policy", "homing"])
