"""Protects the router's words on whom it refuses: however many reasons there are, each refusal is counted."""

import os

from link.access.refusals import Refusals


def test_reasons_beyond_those_that_are_told_apart_are_counted_together() -> None:
    reader, writer = os.pipe2(os.O_NONBLOCK)
    refusals = Refusals(reader)
    for number in range(250):
        os.write(writer, f"WARN zenoh_link_tls::unicast: strange reason {number}. Hint: none\n".encode())
    lines = [line for _, line in refusals.news(0.0)]
    os.write(writer, b"WARN zenoh_link_tls::unicast: strange reason 999. Hint: none\n")
    later = [line for _, line in refusals.news(20.0)]
    os.close(writer)
    os.close(reader)
    assert len(lines) == 101
    assert lines[-1] == "refused connections (150): for other reasons"
    assert later == ["refused connections (1): for other reasons"]
