"""Protects the word that allows commands: it is made strong, read from a file, and guessed slowly."""

from base64 import urlsafe_b64encode
from pathlib import Path

import pytest

from ground.view.access import AccessRules, Doorkeeper, word_in, word_of

RULES = AccessRules("0.0.0.0", 8447, "the secret")


def coded(word: str) -> str:
    return f"word.{urlsafe_b64encode(word.encode()).decode().rstrip('=')}"


def test_a_file_that_is_not_there_is_made_for_its_owner_with_a_word_that_nobody_guesses(
    tmp_path: Path,
) -> None:
    words = set()
    for name in ("one", "other"):
        word, line = word_in(tmp_path / name)
        assert len(word) >= 20
        assert (tmp_path / name).stat().st_mode & 0o777 == 0o600
        assert str(tmp_path / name) in line
        assert word not in line
        assert word_in(tmp_path / name) == (word, "")  # the next time it is read
        words.add(word)
    assert len(words) == 2


@pytest.mark.parametrize(
    ("mode", "warned"), [(0o600, False), (0o400, False), (0o640, True), (0o604, True), (0o620, True)]
)
def test_a_file_that_others_may_use_is_warned_of(tmp_path: Path, mode: int, warned: bool) -> None:
    file = tmp_path / "word"
    file.write_text("  two words é \n")
    file.chmod(mode)
    word, line = word_in(file)
    assert word == "two words é"
    assert ("chmod 600" in line) == warned


@pytest.mark.parametrize(
    "content", ["", "\n", "seven77", "two lines\nof words", "x" * 1025, "a bell\a and more"]
)
def test_a_file_without_a_good_word_is_refused_and_left_as_it_is(tmp_path: Path, content: str) -> None:
    file = tmp_path / "word"
    file.write_text(content)
    with pytest.raises(ValueError, match=r"wanted a file with a word of at least 8 characters in one line$"):
        word_in(file)
    assert file.read_text() == content


def test_the_word_is_found_among_the_subprotocols() -> None:
    assert word_of(["plumeward", coded("two words, é/+?")]) == "two words, é/+?"
    for none in ([], ["plumeward"], ["word."], ["word.\xff"], ["word.A"], ["word._w"]):
        assert word_of(none) == ""


def test_who_gave_a_wrong_word_is_heard_again_a_second_later_and_nobody_else_waits() -> None:
    door = Doorkeeper(RULES)
    assert (
        door.why_no_commands("wrong one", "10.0.0.1", 100.0)
        == "read-only: that is not the word of --token-file"
    )
    for now_s in (100.0, 100.9):  # neither a wrong nor the right word is looked at
        for word in ("wrong two", "the secret"):
            assert "wait a second" in door.why_no_commands(word, "10.0.0.1", now_s)
    assert door.why_no_commands("the secret", "10.0.0.2", 100.5) == ""
    assert "enter the word" in door.why_no_commands("", "10.0.0.1", 100.5)  # who only looks does not guess
    assert door.why_no_commands("the secret", "10.0.0.1", 101.0) == ""


def test_guessers_without_end_take_no_memory_without_end() -> None:
    door = Doorkeeper(RULES)
    for number in range(3000):
        door.why_no_commands("wrong one", f"fe80::{number:x}", 100.0)
    assert "wait a second" in door.why_no_commands("wrong one", f"fe80::{2999:x}", 100.0)
    assert "not the word" in door.why_no_commands("wrong one", "fe80::0", 100.0)  # long forgotten
