"""Protects the end of a record: what was said before is in it, however early the recorder is told to end."""

import signal
from pathlib import Path

from link.bus.keys import BELIEF
from link.bus.session import Bus
from link.bus.tap import Tap
from link.record.reader import read
from link.record.writer import Writer
from sitl.desk.recorder import _record


def test_a_recorder_that_is_told_to_end_before_it_begins_writes_what_was_said(router: str, tmp_path: Path) -> None:
    with Tap("recorder", router) as tap, Bus("estimator", router) as estimator:
        tap.subscribe(BELIEF)
        tap.settle(30.0)
        estimator.publish(BELIEF, b"said")
        estimator.settle(30.0)
        _record(tap, Writer(tmp_path / "run.mcap", {}), [signal.SIGTERM])
    recording = read(tmp_path / "run.mcap")
    assert recording.complete
    assert [entry.payload for entry in recording.entries] == [b"said"]
