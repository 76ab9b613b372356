"""Protects the key file: which key it means, and that a bad one gets one line that says what is wrong."""

import os
from pathlib import Path

import pytest

from link.signing.key import read_key

ABC = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
"""SHA-256 of "abc", from FIPS 180-2, appendix B.1."""


@pytest.mark.parametrize("text", ["abc", "abc\n", "  abc\r\n", "\ufeffabc\n"])
def test_a_passphrase_means_its_sha_256_whatever_ends_its_line(text: str, tmp_path: Path) -> None:
    (tmp_path / "key").write_bytes(text.encode())
    assert read_key(tmp_path / "key")[:2] == (bytes.fromhex(ABC), "a passphrase")


@pytest.mark.parametrize("text", [ABC, ABC.upper() + "\n"])
def test_64_digits_are_the_key_itself(text: str, tmp_path: Path) -> None:
    (tmp_path / "key").write_text(text)
    assert read_key(tmp_path / "key")[:2] == (bytes.fromhex(ABC), "64 hexadecimal digits")


def test_other_numbers_of_digits_and_words_in_a_row_are_passphrases(tmp_path: Path) -> None:
    for text in (ABC[:-1], ABC + "0", "correct horse battery staple", "grün"):
        (tmp_path / "key").write_text(text)
        assert read_key(tmp_path / "key").made_from == "a passphrase"


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        (b"", "is empty"),
        (b" \n\n", "is empty"),
        (b"one\ntwo\n", "has more than one line"),
        (b"\x00" * 32, "has more than one line"),
        (bytes(range(128, 160)), "is not text"),
        (b"x" * 1025, "is too long"),
        (b"\n" * 1025 + b"x", "is empty"),
    ],
)
def test_a_bad_file_gets_one_line_that_names_it_and_what_is_allowed(
    content: bytes, fault: str, tmp_path: Path
) -> None:
    (tmp_path / "bad.key").write_bytes(content)
    with pytest.raises(
        ValueError, match="64 hexadecimal digits, or with a passphrase in one line"
    ) as refusal:
        read_key(tmp_path / "bad.key")
    assert fault in str(refusal.value)
    assert "bad.key" in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_what_is_no_file_is_refused_and_never_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for name, fault in (
        ("pipe", "is not a file"),
        ("", "is not a file"),
        ("none", "No such file or directory"),
    ):
        with pytest.raises(ValueError, match=fault):
            read_key(tmp_path / name)


@pytest.mark.parametrize(
    ("mode", "open_to_all"), [(0o600, False), (0o640, False), (0o644, True), (0o602, True)]
)
def test_a_key_that_all_may_read_or_change_is_noticed(mode: int, open_to_all: bool, tmp_path: Path) -> None:
    (tmp_path / "key").write_text("abc")
    (tmp_path / "key").chmod(mode)
    assert read_key(tmp_path / "key").open_to_all == open_to_all
