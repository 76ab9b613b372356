"""Protects long texts: the chunks of one are joined, and a cut-off one spoils no other."""

from link.bus.mavlink import Texts

LONG = "a" * 50


def test_a_text_without_an_id_is_whole() -> None:
    assert Texts().joined(LONG, 0, 0) == LONG


def test_chunks_are_joined_until_one_is_not_full() -> None:
    texts = Texts()
    assert [texts.joined(chunk, 7, n) for n, chunk in enumerate([LONG, LONG, "end"])] == [
        None,
        None,
        LONG + LONG + "end",
    ]


def test_a_text_that_is_cut_off_is_dropped_when_the_next_begins() -> None:
    texts = Texts()
    assert texts.joined(LONG, 7, 0) is None
    assert texts.joined("b" * 50, 8, 0) is None
    assert texts.joined("end", 8, 1) == "b" * 50 + "end"
    assert texts.joined("end", 7, 1) == "end"
    assert texts.joined(LONG, 7, 0) is None
    assert texts.joined("new", 7, 0) == "new", "an id begins anew"


def test_a_text_without_end_is_given_out_and_what_cannot_be_printed_is_marked() -> None:
    texts = Texts()
    said = [texts.joined("\x1b" + 49 * "x", 7, n) for n in range(256)]
    assert said[:-1] == [None] * 255
    assert said[-1] == ("?" + 49 * "x") * 256
