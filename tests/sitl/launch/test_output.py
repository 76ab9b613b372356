"""Protects the display of a part's output: whole lines, however they arrive, and at most one line in
memory.
"""

from hypothesis import given
from hypothesis import strategies as st

from sitl.launch.child import LONGEST_LINE as LONGEST
from sitl.launch.child import Lines


@given(
    st.lists(st.text(st.characters(codec="utf-8", exclude_categories=("C", "Z")), min_size=1, max_size=50)),
    st.integers(1, 7),
)
def test_lines_are_the_same_however_they_are_cut_on_their_way(lines: list[str], piece: int) -> None:
    data = "".join(f"{line}\n" for line in lines).encode()
    taken = Lines()
    assert [line for at in range(0, len(data), piece) for line in taken.take(data[at : at + piece])] == lines
    assert taken.take(b"") == []


def test_the_end_ends_a_line() -> None:
    taken = Lines()
    assert taken.take(b"one\n\n  \ntw") == ["one"]
    assert taken.take(b"o") == []
    assert taken.take(b"") == ["two"]


def test_what_is_no_text_is_shown_all_the_same() -> None:
    assert Lines().take(b"caf\xe9\n") == ["caf\ufffd"]


def test_of_an_endless_line_only_the_begin_is_kept() -> None:
    taken = Lines()
    for _ in range(1000):
        assert taken.take(b"x" * 10_000) == []
        assert len(taken.begun) <= LONGEST + 1
    assert taken.take(b"y\nnext\n") == ["x" * LONGEST + " …", "next"]
    assert taken.take(b"x" * LONGEST + b"\n") == ["x" * LONGEST]
