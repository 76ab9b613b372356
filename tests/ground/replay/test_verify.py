"""Protects the comparison of a replay: which messages are answers, every difference in a bit, and what the
log cannot show.
"""

import json
import math
import struct

import pytest
from pymavlink.dialects.v20 import common as mavlink

from ground.replay import verify
from ground.replay.verify import Rules
from link.record.record import Entry
from tests.golden.__main__ import compare

BELIEF = {
    "time_boot_ms": 12350,
    "step": 7,
    "position": [3.0, 4.0],
    "gas": 0.5,
    "unknowns": ["x", "y"],
    "mean": [14.913, 15.5],
    "spread": 2.25,
    "p_value": 0.5,
    "ceased": False,
}
STOP = {"time_boot_ms": 12350, "step": 7, "estimate": [14.9, 14.7], "spread": 0.4, "threshold": 0.5}
CLOUD = struct.pack("<6f", 1.0, 2.0, 0.25, 3.0, 4.0, 0.75)


def belief(cloud: bytes = CLOUD, **changes: object) -> Entry:
    said = {name: value for name, value in {**BELIEF, **changes}.items() if value is not ...}
    return Entry("belief", 0, said["time_boot_ms"] / 1000, json.dumps(said).encode(), cloud)


def stop(**changes: object) -> Entry:
    return Entry("agdc/stop", 0, 12.35, json.dumps({**STOP, **changes}).encode())


def waypoint(time_boot_ms: int = 12350, north: float = 4.0, sequence: int = 0, yaw: float = 0.0) -> Entry:
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
    sender.seq = sequence
    message = mavlink.MAVLink_set_position_target_local_ned_message(
        time_boot_ms, 1, 1, 1, 0xDF8, north, 3.0, -5.0, *[0.0] * 6, yaw, 0.0
    )
    return Entry("waypoint", 0, time_boot_ms / 1000, bytes(message.pack(sender)))


def text(then: list[Entry], now: list[Entry], *ignored: str, tolerance: float = 0.0) -> str | None:
    rules = Rules(verify.ignored(ignored), tolerance)
    found = compare(verify.said(then), verify.said(now), rules)
    return found and found.text()


def test_what_says_the_same_does_not_differ() -> None:
    assert text([belief(), stop(), waypoint()], [belief(), stop(), waypoint()]) is None


def test_the_first_field_that_differs_is_named_with_both_values() -> None:
    assert (
        text([belief()], [belief(mean=[14.921, 15.6])])
        == "belief at 12.35 s (step 7): mean[0] was 14.913, is 14.921"
    )
    assert (
        text([belief()], [belief(mean=[14.913, 15.6], ceased=True)])
        == "belief at 12.35 s (step 7): mean[1] was 15.5, is 15.6"
    )
    assert text([belief()], [belief(ceased=True)]) == "belief at 12.35 s (step 7): ceased was false, is true"
    assert (
        text([belief()], [belief(unknowns=["x", "z"])])
        == "belief at 12.35 s (step 7): unknowns[1] was y, is z"
    )
    assert text([stop()], [stop(threshold=0.6)]) == "stop at 12.35 s (step 7): threshold was 0.5, is 0.6"
    assert text([waypoint()], [waypoint(north=4.1)]) == "waypoint at 12.35 s: x was 4.0, is 4.1"
    assert (
        text([belief(), waypoint()], [belief(), waypoint(north=4.1)])
        == "waypoint at 12.35 s (step 7): x was 4.0, is 4.1"
    )


def test_an_older_record_says_nothing_of_the_assumption_and_the_stop() -> None:
    now = [belief(assume="paper", stop="spread:0.5", evidence=9.0), stop(stop="spread:0.5")]
    assert text([belief(), stop()], now) is None
    assert text([belief(assume="field")], now[:1]) == "belief at 12.35 s (step 7): assume was field, is paper"
    assert (
        text([belief(stop="spread:0.6")], now[:1])
        == "belief at 12.35 s (step 7): stop was spread:0.6, is spread:0.5"
    )


def test_one_bit_is_a_difference() -> None:
    next_double, next_float = (
        math.nextafter(2.25, 3),
        struct.unpack("<f", struct.pack("<I", struct.unpack("<I", struct.pack("<f", 4.0))[0] + 1)),
    )
    assert (
        text([belief()], [belief(spread=next_double)])
        == "belief at 12.35 s (step 7): spread was 2.25, is 2.2500000000000004"
    )
    assert (
        text([waypoint()], [waypoint(north=next_float[0])]) == "waypoint at 12.35 s: x was 4.0, is 4.0000005"
    )
    flipped = bytearray(CLOUD)
    flipped[12] ^= 1  # the second particle's x
    assert (
        text([belief()], [belief(bytes(flipped))])
        == "belief at 12.35 s (step 7): particles[1][0] was 3.0, is 3.0000002"
    )
    assert (
        text([belief(spread=0.0)], [belief(spread=-0.0)])
        == "belief at 12.35 s (step 7): spread was 0.0, is -0.0"
    )


def test_particle_arrays_of_another_size_differ_in_their_size() -> None:
    three = CLOUD + struct.pack("<3f", 1, 1, 0)
    assert (
        text([belief()], [belief(three)])
        == "belief at 12.35 s (step 7): particles was 2 rows of 3, is 3 rows of 3"
    )
    assert (
        text([belief()], [belief(CLOUD[:-1])])
        == "belief at 12.35 s (step 7): particles was 2 rows of 3, is 23 bytes"
    )


def test_nan_equals_nan_and_nothing_else() -> None:
    assert text([waypoint(yaw=math.nan)], [waypoint(yaw=math.nan)]) is None
    assert text([waypoint(yaw=math.nan)], [waypoint()]) == "waypoint at 12.35 s: yaw was nan, is 0.0"
    assert text([waypoint(yaw=math.nan)], [waypoint()], tolerance=1000) is not None


def test_a_field_that_one_side_does_not_know_differs_until_it_is_ignored() -> None:
    then, now = [belief(p_value=...)], [belief()]
    assert text(then, now) == "belief at 12.35 s (step 7): p_value was none, is 0.5"
    assert text(now, then) == "belief at 12.35 s (step 7): p_value was 0.5, is none"
    assert text(then, now, "belief.p_value") is None


def test_a_message_that_only_one_side_has_differs() -> None:
    assert (
        text([belief()], [belief(), stop()])
        == "stop at 12.35 s (step 7): it was none, is estimate [14.9,14.7]"
    )
    assert (
        text([belief(), stop()], [belief()])
        == "stop at 12.35 s (step 7): it was estimate [14.9,14.7], is none"
    )
    assert (
        text([belief()], [belief(), waypoint()])
        == "waypoint at 12.35 s (step 7): it was none, is x 4.0, y 3.0"
    )
    assert text([], [belief()]) == "belief at 12.35 s (step 7): it was none, is mean [14.913,15.5]"


def test_the_first_difference_is_the_first_in_time_and_of_one_reading_the_stop_before_the_belief_before_the_waypoint() -> (
    None
):
    then = [belief(), stop(), waypoint(), belief(time_boot_ms=13000, step=8)]
    now = [
        belief(time_boot_ms=13000, step=8, spread=0.0),
        waypoint(north=0.0),
        belief(spread=0.0),
        stop(spread=0.0),
    ]
    differences = [text(then, now, *ignored) for ignored in ([], ["stop"], ["stop", "belief.spread"])]
    assert [found and found.split(":")[0] for found in differences] == [
        f"{kind} at 12.35 s (step 7)" for kind in ("stop", "belief", "waypoint")
    ]
    assert str(text(then, now, "stop", "waypoint", "belief.spread")) == "None"


@pytest.mark.parametrize("name", ["belief", "belief.mean"])
def test_what_is_ignored_may_differ(name: str) -> None:
    assert text([belief()], [belief(mean=[0.0, 0.0])], name) is None
    assert text([belief(), stop()], [belief(mean=[0.0, 0.0]), stop(spread=0.0)], name) is not None


def test_keys_and_the_particles_can_be_ignored_by_their_names_on_the_bus() -> None:
    assert (
        text([belief(), stop(), waypoint()], [belief(CLOUD[:12])], "particles", "agdc/stop", "waypoint")
        is None
    )
    assert verify.ignored(["waypoint.x", "agdc/stop.spread"]) == {"waypoint.x", "stop.spread"}


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (
            "gas",
            "'gas' is not allowed; wanted stop, belief, waypoint, agdc/stop, a field of theirs, or particles",
        ),
        ("belief.men", "'belief.men' is not allowed; belief has time_boot_ms, step, position, "),
        ("waypoint.lat", "'waypoint.lat' is not allowed; waypoint has time_boot_ms, target_system, "),
    ],
)
def test_what_cannot_be_ignored_is_named_with_what_can(name: str, words: str) -> None:
    with pytest.raises(ValueError, match="--ignore: ") as error:
        verify.ignored(["belief", name])
    assert words in str(error.value)


def test_a_field_that_only_the_log_knows_can_be_ignored() -> None:
    then = verify.said([belief(entropy=1.0)])
    assert verify.ignored(["belief.entropy"], then.values()) == {"belief.entropy"}


def test_numbers_may_differ_by_the_tolerance_and_nothing_else_may() -> None:
    then = [belief(), waypoint()]
    assert text(then, [belief(mean=[14.923, 15.5]), waypoint(north=4.01)], tolerance=0.011) is None
    assert text(then, [belief(mean=[14.925, 15.5]), waypoint()], tolerance=0.011) is not None
    assert (
        text(then, [belief(struct.pack("<6f", 1.0, 2.0, 0.25, 3.0, 4.01, 0.75)), waypoint()], tolerance=0.011)
        is None
    )
    assert text(then, [belief(ceased=True), waypoint()], tolerance=0.011) is not None


def test_what_is_said_again_counts_once_and_the_first_time_is_the_one_that_counts() -> None:
    said = verify.said([belief(), waypoint(sequence=4), belief(), waypoint(sequence=5), waypoint(north=9.0)])
    assert list(said) == [(12350, "belief"), (12350, "waypoint")]
    assert said[12350, "waypoint"].fields["x"] == 4.0


def test_the_sequence_numbers_of_a_link_are_not_compared() -> None:
    assert text([waypoint(sequence=4)], [waypoint(sequence=99)]) is None


def test_only_waypoints_and_what_decodes_are_answers() -> None:
    assert verify.answers("mavlink/in", waypoint().payload) == []
    heartbeat = bytes(
        mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 0, 3).pack(mavlink.MAVLink(None, 1, 191))
    )
    assert verify.answers("waypoint", heartbeat) == []
    assert [
        answer.time_ms
        for answer in verify.answers("waypoint", heartbeat + waypoint().payload + waypoint(99).payload)
    ] == [
        12350,
        99,
    ]
    for payload in (b"noise", b"", b"[]", b"7", b"{}", b'{"time_boot_ms": "soon"}', b"\xff"):
        assert (
            verify.answers("belief", payload)
            == verify.answers("agdc/stop", payload)
            == verify.answers("waypoint", payload)
            == []
        )
    assert (
        verify.answers("reading", belief().payload)
        == verify.answers("health/estimator", belief().payload)
        == []
    )


def test_silence_in_the_middle_of_a_log_means_that_nothing_was_said() -> None:
    then = verify.said([belief(time_boot_ms=1000), belief(time_boot_ms=2000), belief(time_boot_ms=3000)])
    assert all(verify.must_be_silent(then, 2000, kind, math.inf) for kind in ("stop", "waypoint"))
    assert verify.must_be_silent(then, 2500, "belief", math.inf)


def test_answers_keep_their_order_where_the_vehicles_time_wraps() -> None:
    def at(time_boot_ms: int, time_s: float, **changed: object) -> Entry:
        return belief(time_boot_ms=time_boot_ms, **changed)._replace(simulation_s=time_s)

    then = [at(2**32 - 1000, 4_294_966.3), at(200, 4_294_967.496), at(1400, 4_294_968.7)]
    now = [then[0], at(200, 4_294_967.496, ceased=True), then[2]]
    said = verify.said(then)
    assert [time for time, _ in said] == [2**32 - 1000, 2**32 + 200, 2**32 + 1400]
    assert verify.must_be_silent(said, 2**32 + 200, "waypoint", math.inf)
    assert text(then, now) == "belief at 4294967.50 s (step 7): ceased was false, is true"


def test_a_log_does_not_tell_what_was_said_before_it_began_and_after_it_ended() -> None:
    then = verify.said([belief(time_boot_ms=1000), belief(time_boot_ms=2000)])
    for kind in ("stop", "belief", "waypoint"):
        assert not verify.must_be_silent(then, 999, kind, math.inf)
        assert not verify.must_be_silent(then, 2001, kind, math.inf)
        assert not verify.must_be_silent({}, 1000, kind, math.inf)


def test_of_the_last_reading_it_tells_what_would_have_been_said_before_something_that_it_has() -> None:
    last = verify.said([belief(time_boot_ms=1000), belief()])
    assert verify.must_be_silent(last, 12350, "stop", math.inf)
    assert not verify.must_be_silent(last, 12350, "waypoint", math.inf)
    assert verify.must_be_silent(
        verify.said([belief(time_boot_ms=1000), waypoint()]), 12350, "belief", math.inf
    )
    assert not verify.must_be_silent(
        verify.said([belief(time_boot_ms=1000), stop()]), 12350, "belief", math.inf
    )


def test_no_waypoint_is_owed_to_a_belief_that_has_ceased_or_spent_the_budget() -> None:
    assert verify.must_be_silent(verify.said([belief(ceased=True)]), 12350, "waypoint", math.inf)
    assert verify.must_be_silent(verify.said([belief(step=60)]), 12350, "waypoint", 60)
    assert not verify.must_be_silent(verify.said([belief(step=59)]), 12350, "waypoint", 60)


def test_a_difference_as_json_has_the_key_and_both_values() -> None:
    found = compare(verify.said([belief()]), verify.said([belief(mean=[1.0, 15.5])]))
    assert found is not None
    assert found.as_json() == {
        "key": "belief",
        "time_s": 12.35,
        "step": 7,
        "field": "mean[0]",
        "was": 14.913,
        "is": 1.0,
    }
    found = compare(verify.said([waypoint()]), {})
    assert found is not None
    assert found.as_json() == {
        "key": "waypoint",
        "time_s": 12.35,
        "step": None,
        "field": "",
        "was": {"x": 4.0, "y": 3.0},
        "is": None,
    }
