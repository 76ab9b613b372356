"""Protects what a link calls garbage: a console's text is none, and a wrong baud rate is told once, with a
hint.
"""

import random

import pytest

from aircraft.bridge.links import Channel, Traffic
from link.bus.log import Log
from link.bus.mavlink import Codec, gas_message
from link.bus.tally import Tally

FRAME = Codec(1, 1).pack(gas_message(2000, 0.5))
SHELL = b"\r\nNuttShell (NSH) NuttX-11.0.0\r\nnsh> \x1b[K" * 20
BANNER = b"\n\nInit ArduCopter V4.6.3 (3fc7011a)\n\nFree RAM: 131072\n" * 20
WRONG_BAUD = random.Random(0).randbytes(3000)


def link(url: str = "serial:/dev/ttyAMA0:57600") -> Channel:
    return Channel(Traffic(url, Log("bridge", "test", Tally(), "warning")), lambda _: None, "a test")


@pytest.mark.parametrize("opening", [SHELL, BANNER, b"\xfd\x80\x99 " + SHELL, FRAME[7:] + BANNER])
def test_a_serial_line_may_begin_with_a_console_and_in_the_middle_of_a_frame(
    opening: bytes, capsys: pytest.CaptureFixture[str]
) -> None:
    line = link()
    frames = [
        frame for at in range(0, len(opening), 7) for frame in line.take(opening[at : at + 7])
    ] + line.take(FRAME)
    assert [frame.data for frame in frames] == [FRAME]
    assert not line.traffic.dropped
    assert capsys.readouterr().err == ""


def test_a_wrong_baud_rate_is_told_once_with_a_hint(capsys: pytest.CaptureFixture[str]) -> None:
    line = link()
    for at in range(0, len(WRONG_BAUD), 50):
        line.take(WRONG_BAUD[at : at + 50])
    (told,) = capsys.readouterr().err.splitlines()
    assert (
        "serial:/dev/ttyAMA0:57600: drops bytes of garbage; no frame has come: is this its baud rate?" in told
    )
    assert line.traffic.dropped["bytes of garbage"] > 1000


def test_what_comes_between_frames_is_garbage_whatever_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    line = link()
    line.take(FRAME + b"nsh> " + FRAME)
    assert line.traffic.dropped == {"bytes of garbage": 5}
    assert "baud" not in capsys.readouterr().err


def test_on_the_network_text_is_garbage_too() -> None:
    peer = link("tcpin:0.0.0.0:5760")
    peer.take(b"GET / HTTP/1.1\r\n\r\n" + FRAME)
    assert peer.traffic.dropped == {"bytes of garbage": 18}
