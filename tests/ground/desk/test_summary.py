"""Protects the command `log`: its counts and findings in a log made here message by message, and its
export.
"""

import csv
import io
import json
import os
import random
import tracemalloc
from pathlib import Path

import msgspec
import pytest

from link import cli
from link.bus.mavlink import Codec, Reading, gas_message, pack_reading
from link.bus.messages import Belief, Health, RoundReading, Stop
from link.record.record import Entry
from link.record.writer import Writer

SECOND = 1_000_000_000
BEGAN = 1_700_000_000 * SECOND
SOURCE = (14.0, 12.5)


def reading(step: int) -> bytes:
    return pack_reading(
        Codec(1, 1), Reading(1000 * (step + 1), (3.0 + step, 4.0), 5.0, (2.0, -1.0), 0.5 * step)
    )


def belief(step: int, ceased: bool = False, **more: str) -> bytes:
    said = Belief(
        1000 * (step + 1),
        step,
        (3.0 + step, 4.0),
        5.0,
        0.5 * step,
        (2.0, -1.0),
        "gaussian:0.3,0.2",
        300.0,
        4.5,
        10.0,
        0.0,
        ("x", "y"),
        (14.0, 12.0),
        (0.3, 0.2),
        (14.0, 12.0),
        (0.09, 0.0, 0.04),
        0.36,
        500.0,
        0.5,
        ceased,
        **more,
    )
    return msgspec.json.encode(said)


def health(service: str, uptime_s: float, compute_s: float = 0.0) -> bytes:
    return msgspec.json.encode(Health(service, "ready", 0, compute_s, uptime_s, {"late": 2}))


ABOUT = {
    "seed": 7,
    "policy": "homing",
    "budget": 5,
    "began": "2026-11-21T10:00:00+00:00",
    "mission": {"about": "a test"},
    "scenario": {
        "source": SOURCE,
        "q": 300.0,
        "u": 2.0,
        "phi": 0.5,
        "d": 4.5,
        "tau": 10.0,
        "start": (3.0, 4.0),
    },
}
MESSAGES = [
    # seconds, simulation, key, payload
    (0.0, 0.0, "health/estimator", health("estimator", 1.0)),
    (0.1, 1.0, "reading", reading(0)),
    (0.2, 1.0, "belief", belief(0)),
    (1.1, 2.0, "reading", reading(1)),
    (1.3, 2.0, "reading", reading(1)),  # again
    (1.4, 2.0, "health/estimator", health("estimator", 0.2, 0.25)),  # started again
    (1.5, 2.0, "belief", belief(1)),
    (2.0, 2.0, "mavlink/out", Codec(1, 1).pack(gas_message(2000, 0.5))),
    (6.1, 3.0, "reading", reading(2)),  # after 4.1 s of silence; never answered
    (7.1, 4.0, "reading", reading(3)),
    (7.15, 4.0, "agdc/stop", msgspec.json.encode(Stop(4000, 3, (14.0, 12.0), (0.09, 0.0, 0.04), 0.36, 0.5))),
    (7.2, 4.0, "belief", belief(3, ceased=True)),
    (7.3, 4.0, "belief", b"no JSON"),
]


def record(
    path: Path, messages: list[tuple[float, float, str, bytes]], about: dict[str, object] = ABOUT
) -> Path:
    writer = Writer(path, about)
    for at_s, simulation_s, key, payload in messages:
        at_ns = BEGAN + round(at_s * SECOND)
        writer.write(Entry(key, at_ns, simulation_s, payload), at_ns)
    writer.close()
    return path


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return record(tmp_path / "run.mcap", MESSAGES)


def log_of(path: Path, *flags: str) -> int:
    return cli.start("log", cli.Command("ground.desk.summary", ""), [str(path), *flags])


def said(capsys: pytest.CaptureFixture[str], path: Path, status: int = 0, **flags: str | bool) -> str:
    words = [word for name, value in flags.items() for word in (f"--{name}", value) if word is not True]
    assert log_of(path, *map(str, words)) == status
    out, err = capsys.readouterr()
    return err if status else out


def test_a_reading_after_the_wrap_of_the_vehicles_time_is_answered_by_the_belief_of_its_time(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wrap_s = 4_294_967.296
    messages = [
        (0.1, wrap_s + 1, "reading", reading(0)),
        (0.2, wrap_s + 1, "belief", belief(0)),
        (0.3, wrap_s + 2, "reading", reading(1)),
    ]
    fields = json.loads(said(capsys, record(tmp_path / "run.mcap", messages), json=True).splitlines()[-1])
    assert fields["gaps"] == ["1 reading without a belief, at 4294969.30 s of simulation"]


def test_an_autopilot_that_was_on_for_an_hour_before_does_not_make_the_flight_longer(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    later = [
        (at_s, simulation_s and simulation_s + 3600, key, payload)
        for at_s, simulation_s, key, payload in MESSAGES
    ]
    log = record(tmp_path / "run.mcap", later)
    assert json.loads(said(capsys, log, json=True).splitlines()[-1])["simulation_s"] == pytest.approx(3.0)
    assert "3.0 s of simulation" in said(capsys, log)


def test_the_summary_counts_keys_repeats_and_what_is_missing(
    log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fields = json.loads(said(capsys, log, json=True).splitlines()[-1])
    assert fields["complete"]
    assert fields["messages"] == len(MESSAGES)
    assert fields["duration_s"] == pytest.approx(7.3)
    counts = {key: told["messages"] for key, told in fields["keys"].items()}
    assert counts == {"health/estimator": 2, "reading": 5, "belief": 4, "agdc/stop": 1, "mavlink/out": 1}
    assert fields["keys"]["reading"]["repeats"] == 1
    assert fields["beliefs"] == 3
    assert fields["gaps"] == [
        "1 reading without a belief, at 3.00 s of simulation",
        "1 beliefs missing, of step 2",
        "1 pauses of the whole bus: 4.1 s at 2.0 s",
        "estimator was restarted 1 time",
        "1 belief could not be read: JSON is malformed: invalid character (byte 4)",
    ]


def test_of_several_vehicles_each_ones_repeats_gaps_and_restarts_are_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    answered = msgspec.json.decode(belief(0)) | {
        "readings": [RoundReading(number, number, 1000, (3.0, 4.0), 5.0, 0.5) for number in (1, 2)]
    }
    messages = [
        (0.0, 1.0, "uav/1/reading", reading(0)),
        (0.1, 1.0, "uav/2/reading", reading(0)),
        (0.2, 1.0, "uav/2/reading", reading(0)),  # again
        (0.3, 1.0, "belief", msgspec.json.encode(answered)),
        (0.4, 1.0, "uav/1/health/uav", health("uav", 9.0)),
        (0.5, 1.0, "uav/2/health/uav", health("uav", 5.0)),  # younger, but another vehicle
        (0.8, 2.0, "uav/2/reading", reading(1)),
        (1.4, 2.0, "uav/1/health/uav", health("uav", 0.2)),
    ]
    fields = json.loads(said(capsys, record(tmp_path / "run.mcap", messages), json=True).splitlines()[-1])
    assert [fields["keys"][f"uav/{number}/reading"]["repeats"] for number in (1, 2)] == [0, 1]
    assert fields["gaps"] == [
        "1 reading of uav/2 without a belief, at 2.00 s of simulation",
        "uav/1 was restarted 1 time",
    ]


def test_two_recorders_on_one_bus_are_no_restart(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The second came 30 s after the first. Each says every second how it is."""
    messages = [
        (at_s, 0.0, "health/recorder", health("recorder", at_s + since_s))
        for second in range(5)
        for at_s, since_s in ((second, 40.0), (second + 0.5, 10.0))
    ]
    fields = json.loads(said(capsys, record(tmp_path / "run.mcap", messages), json=True).splitlines()[-1])
    assert fields["gaps"] == []


def test_the_outcome_is_judged_by_the_source_that_the_log_tells(
    log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fields = json.loads(said(capsys, log, json=True).splitlines()[-1])
    assert (fields["ceased"], fields["located"], fields["estimate"], fields["error_m"]) == (
        True,
        True,
        [14.0, 12.0],
        0.5,
    )
    text = said(capsys, log)
    assert "a test, homing, seed 7" in text
    assert "source   (14.00, 12.50), error 0.50 m" in text


def test_the_outcome_says_what_was_assumed_and_in_which_world(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    messages = [(0.0, 1.0, "belief", belief(0, assume="field", stop="within:1,0.99"))]
    told = "assumed  field, stop within:1,0.99"
    for about, line in (
        (ABOUT, told),
        (ABOUT | {"mission": {"world": "as-modelled"}}, told),
        (ABOUT | {"mission": {"world": "wind-30"}}, f"{told}, world wind-30"),
        ({"mission": {"world": "wind-30"}}, f"{told}, world wind-30"),  # the truth is not known
        (ABOUT | {"mission": {"world": 5}}, told),
    ):
        assert said(capsys, record(tmp_path / "run.mcap", messages, about)).splitlines()[-1] == line
    fields = json.loads(
        said(
            capsys, record(tmp_path / "run.mcap", messages, {"mission": {"world": "wind-30"}}), json=True
        ).splitlines()[-1]
    )
    assert (fields["assume"], fields["stop"], fields["world"]) == ("field", "within:1,0.99", "wind-30")


def test_a_key_as_csv_has_a_column_for_each_number(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = list(csv.DictReader(io.StringIO(said(capsys, log, csv="belief"))))
    assert [row["step"] for row in rows] == ["0", "1", "3"]
    assert (rows[2]["mean[0]"], rows[2]["mean[1]"], rows[2]["covariance[2]"], rows[2]["ceased"]) == (
        "14.0",
        "12.0",
        "0.04",
        "True",
    )
    assert float(rows[0]["published_s"]) == pytest.approx(BEGAN / SECOND + 0.2)
    rows = list(csv.DictReader(io.StringIO(said(capsys, log, csv="reading"))))
    assert {
        name: rows[3][name] for name in ("time_boot_ms", "x", "y", "altitude_m", "wind_x", "wind_y", "gas")
    } == {
        "time_boot_ms": "3000",
        "x": "5.0",
        "y": "4.0",
        "altitude_m": "5.0",
        "wind_x": "2.0",
        "wind_y": "-1.0",
        "gas": "1.0",
    }
    rows = list(csv.DictReader(io.StringIO(said(capsys, log, csv="health/estimator"))))
    assert [row["refused.late"] for row in rows] == ["2", "2"]
    rows = list(csv.DictReader(io.StringIO(said(capsys, log, csv="mavlink/out/NAMED_VALUE_FLOAT"))))
    assert [(row["name"], row["value"], row["time_boot_ms"]) for row in rows] == [("gas", "0.5", "2000")]


def test_a_key_that_is_not_there_is_one_line_with_those_that_are(
    log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert said(capsys, log, status=2, csv="mavlink/out") == (
        "error: --csv: 'mavlink/out' is not allowed; "
        "wanted one of agdc/stop, belief, health/estimator, mavlink/out/NAMED_VALUE_FLOAT, reading\n"
    )


def test_a_log_that_was_cut_off_is_summed_up_and_says_so(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(log.read_bytes()[:-50])
    assert "CUT OFF" in said(capsys, cut)


def test_a_log_that_was_cut_off_before_its_first_belief_is_not_said_to_be_of_no_search(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(log.read_bytes()[:400])
    assert said(capsys, cut).endswith("\nno belief: the log is cut off before the first\n")


def test_an_autopilots_log_is_counted_by_message(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tlog = log.with_suffix(".tlog")
    fields = json.loads(said(capsys, tlog, json=True).splitlines()[-1])
    assert {kind: told["messages"] for kind, told in fields["keys"].items()} == {
        "LOCAL_POSITION_NED": 5,
        "WIND_COV": 5,
        "NAMED_VALUE_FLOAT": 6,
    }
    rows = list(csv.DictReader(io.StringIO(said(capsys, tlog, csv="LOCAL_POSITION_NED"))))
    assert [row["y"] for row in rows] == ["3.0", "4.0", "4.0", "5.0", "6.0"]
    assert said(capsys, tlog, status=2, csv="ATTITUDE").startswith(
        "error: --csv: 'ATTITUDE' is not allowed; wanted one of LOCAL_POSITION_NED"
    )


def test_health_that_is_no_json_is_counted_and_the_rest_is_summed_up(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    deep = b'{"uptime_s":1,"a":' + b"[" * 100_000 + b"]" * 100_000 + b"}"
    odd = [
        b"no JSON",
        b"\xff",
        b"[]",
        b'{"uptime_s": null}',
        b'{"uptime_s": 1%s}' % (b"0" * 400),
        deep,
    ]
    messages = [
        *MESSAGES,
        *((8.0, 5.0, f"health/{service}", payload) for service in ("estimator", "agent") for payload in odd),
    ]
    path = record(tmp_path / "odd.mcap", messages)
    fields = json.loads(said(capsys, path, json=True).splitlines()[-1])
    assert fields["keys"]["health/agent"]["messages"] == len(odd)
    assert fields["ceased"]
    (line,) = (line for line in fields["gaps"] if "health" in line)
    assert line.startswith(f"{2 * len(odd)} health messages could not be read: ")
    assert "estimator was restarted 1 time" in fields["gaps"]


def test_beliefs_of_another_version_are_counted_with_what_is_wrong_with_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    older = [belief(step).replace(b'"p_value":0.5,', b"") for step in (1, 2)]
    newer = belief(3).replace(b'"ceased"', b'"\\u001b[31mred\\n":1,"ceased"')
    payloads = [belief(0), *older, newer]
    path = record(
        tmp_path / "mixed.mcap",
        [(float(n), float(n + 1), "belief", payload) for n, payload in enumerate(payloads)],
    )
    fields = json.loads(said(capsys, path, json=True).splitlines()[-1])
    assert (fields["beliefs"], fields["keys"]["belief"]["messages"]) == (1, 4)
    assert fields["gaps"] == [
        "3 beliefs could not be read: Object missing required field `p_value`, Object contains unknown field "
        "`\\x1b[31mred\\n`"
    ]
    path = record(
        tmp_path / "older.mcap",
        [(float(n), float(n + 1), "belief", payload) for n, payload in enumerate(older)],
    )
    text = said(capsys, path)
    assert "2 beliefs could not be read: Object missing required field `p_value`" in text
    assert "no readable belief: the outcome of the search is unknown" in text


def test_a_belief_of_a_step_far_away_is_a_gap_like_any_other(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    payloads = [belief(1), belief(9), belief(2).replace(b'"step":2', b'"step":4000000000')]
    path = record(
        tmp_path / "far.mcap",
        [(float(n), float(n + 1), "belief", payload) for n, payload in enumerate(payloads)],
    )
    fields = json.loads(said(capsys, path, json=True).splitlines()[-1])
    assert fields["gaps"] == ["3999999998 beliefs missing, of step 0, 2, 3, 4, 5 and 3,999,999,993 more"]


def test_what_a_log_tells_about_itself_may_be_anything(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for odd in ("text", 5, None, [1], {"a": 1}):
        about = {
            **ABOUT,
            **dict.fromkeys(("mission", "versions", "git", "seed", "policy", "began"), odd),
            "stopped": odd,
        }
        about["mission"] = {"about": odd} if odd == 5 else odd
        assert "error 0.50 m" in said(capsys, record(tmp_path / "run.mcap", MESSAGES, about))
        assert "not ceased after 0 steps" in said(
            capsys, record(tmp_path / "run.mcap", [(0.0, 1.0, "belief", belief(0))], {"scenario": odd})
        )


def test_the_waypoints_of_a_record_from_before_they_had_a_key_are_listed_and_exported_under_it(
    capsys: pytest.CaptureFixture[str],
) -> None:
    golden = Path(__file__).parents[2] / "golden" / "greedy-gaussian.mcap"
    fields = json.loads(said(capsys, golden, json=True).splitlines()[-1])
    assert fields["keys"]["waypoint"]["messages"] >= fields["steps"] > 10
    assert "mavlink/in" not in fields["keys"]
    rows = said(capsys, golden, csv="waypoint/SET_POSITION_TARGET_LOCAL_NED").splitlines()
    assert len(rows) == 1 + fields["keys"]["waypoint"]["messages"]


def test_a_record_of_a_newer_format_is_one_line(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log.write_bytes(log.read_bytes().replace(b"format\x01\x00\x00\x002", b"format\x01\x00\x00\x003"))
    assert (
        said(capsys, log, status=2)
        == f"error: {log} has record format 3 of another plumeward version; readable formats: 0, 1, 2\n"
    )


def test_what_is_no_log_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "text").write_text("hello")
    (tmp_path / "empty.mcap").write_bytes(b"")
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "none", tmp_path / "text", tmp_path / "empty.mcap", tmp_path / "pipe", tmp_path):
        line = said(capsys, path, status=2)
        assert line.startswith(f"error: {path}")
        assert line.count("\n") == 1


def test_a_damaged_log_is_told_with_what_is_missing_and_has_a_status_of_its_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = record(tmp_path / "run.mcap", MESSAGES)
    whole = path.read_bytes()
    at = whole.index(b"zstd") + 40
    path.write_bytes(whole[:at] + bytes(16) + whole[at + 16 :])
    assert log_of(path, "--json") == 1
    out, err = capsys.readouterr()
    fields = json.loads(out)
    (place,) = fields["damage"]
    assert (fields["complete"], fields["messages"], place["after_s"], place["before"]) == (False, 0, 0.0, 0)
    assert "; DAMAGED\n" in err
    assert (
        f"it is damaged, and lacks {place['size']:,} bytes at byte {place['at']:,}, after 0.00 s of "
        "simulation\n" in err
    )


def test_text_of_a_stranger_draws_nothing_on_the_terminal_and_forges_no_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    hostile = "\x1b[2J\x1b]0;owned\x07\nlocated after 1 steps\u202e"
    about = {name: hostile for name in ("policy", "began", "git", "stopped")}
    about |= {"mission": {"about": hostile, "world": hostile}, "versions": {"plumeward": hostile}, "seed": 1}
    text = said(
        capsys, record(tmp_path / "run.mcap", [(0.0, 1.0, "belief", belief(0, assume=hostile))], about)
    )
    assert all(line.isprintable() for line in text.splitlines())
    assert not any(line.startswith("located") for line in text.splitlines())
    assert text.count("\\x1b[2J\\x1b]0;owned\\x07\\nlocated after 1 steps\\u202e") >= 5


@pytest.mark.parametrize("flags", [{}, {"csv": "belief"}], ids=["summary", "csv"])
def test_a_large_record_is_read_in_little_memory(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: dict[str, str]
) -> None:
    count, size = 400, 100_000  # 40 MB that no packing makes smaller
    path, noise = tmp_path / "large.mcap", random.Random(1)
    writer = Writer(path, ABOUT)
    for step in range(count):
        at_ns = BEGAN + step * SECOND
        writer.write(Entry("belief", at_ns, step + 1.0, belief(step), noise.randbytes(size)), at_ns)
    writer.close()
    tracemalloc.start()
    said(capsys, path, **flags)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < count * size / 2  # a few chunks of 4 MB, packed and unpacked
