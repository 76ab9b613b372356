"""Protects the reading of mission scripts from huge, recursive or locked files, pipes and devices, and
other editors' text formats.
"""

import os
from pathlib import Path

import pytest

from link.cli import BadInput
from sitl.script.script import Script, load

TEXT = "about: |\n  two\n  lines\nseed: 7\nevents:\n- {step: 30, do: wind, phi: 2}\n"


def bomb(width: int, depth: int, leaf: str) -> str:
    """A list of lists of lists: width**depth leaves in depth + 1 short lines."""
    lines = [f"a0: &a0 [{', '.join([leaf] * width)}]"]
    lines += [f"a{level}: &a{level} [{', '.join([f'*a{level - 1}'] * width)}]" for level in range(1, depth)]
    return "\n".join(lines) + "\n"


TOO_MUCH = {
    "a billion laughs": bomb(9, 9, "lol"),
    "a billion laughs that are found to be no number": bomb(9, 9, "lol") + "seed: *a8",
    "merges of merges": "a0: &a0 {x: 1}\n"
    + "".join(f"a{n}: &a{n}\n  <<: [{', '.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 10)),
    "a list that holds itself": "events: &x [*x]",
    "an object that holds itself": "scenario: &x {q: *x}",
    "an object that is merged into itself": "scenario: &x {<<: *x}",
    "more values than any mission has": "a: [" + "1," * 100_001 + "]",
}


@pytest.mark.parametrize(
    "text",
    [
        pytest.param(
            text, id=name, marks=pytest.mark.full if len(text) > 100_000 else ()
        )  # reading it takes seconds
        for name, text in TOO_MUCH.items()
    ],
)
def test_a_few_lines_that_stand_for_endless_values_are_refused_at_once(tmp_path: Path, text: str) -> None:
    path = tmp_path / "mission.yaml"
    path.write_text(text)
    with pytest.raises(BadInput) as error:
        load(path)
    assert str(error.value) == f"{path}: more than 100,000 values (with aliases expanded) are not allowed"


def test_an_alias_stands_for_its_value(tmp_path: Path) -> None:
    path = tmp_path / "mission.yaml"
    path.write_text(
        "scenario: {source: &here [12, 13], start: *here}\nvehicle: &slow {speed_mps: 2}\nagent: {budget: "
        "5}\n"
    )
    release = load(path).release()
    assert release.source == release.start == (12.0, 13.0)


def test_a_huge_file_is_refused_unread(tmp_path: Path) -> None:
    path = tmp_path / "mission.yaml"
    with path.open("wb") as file:
        file.truncate(100_000_000_000)  # larger than the memory; a sparse file takes no disk space
    with pytest.raises(BadInput) as error:
        load(path)
    assert str(error.value) == f"{path}: 100,000,000,000 bytes are not allowed; wanted 250,000 at most"


def test_a_file_of_the_greatest_size_is_read(tmp_path: Path) -> None:
    path = tmp_path / "mission.yaml"
    path.write_text("seed: 3 #".ljust(250_000, "x"))
    assert load(path).seed == 3
    path.write_text("seed: 3 #".ljust(250_001, "x"))
    with pytest.raises(BadInput, match=r": 250,001 bytes are not allowed; wanted 250,000 at most$"):
        load(path)


@pytest.mark.one_in(4)
@pytest.mark.slow
@pytest.mark.parametrize("opening", ["[", "{", "- ", "? "])
def test_a_nest_without_a_bottom_is_refused(tmp_path: Path, opening: str) -> None:
    path = tmp_path / "mission.yaml"
    path.write_text("seed: 1\nevents:\n  " + opening * 50_000)
    with pytest.raises(BadInput) as error:
        load(path)
    assert str(error.value) == f"{path}: not valid YAML: maximum recursion depth exceeded"


def test_a_pipe_and_a_device_are_not_waited_for(tmp_path: Path) -> None:
    pipe = tmp_path / "mission.yaml"
    os.mkfifo(pipe)
    for path in (pipe, Path("/dev/zero")):
        with pytest.raises(BadInput) as error:
            load(path)
        assert str(error.value) == f"{path}: a pipe or a device is not allowed; wanted a file"


def test_a_file_that_cannot_be_read_is_one_line_that_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop = tmp_path / "loop.yaml"
    loop.symlink_to(loop)
    broken = Path("/proc/self/mem")  # a regular file whose first byte cannot be read
    for path, reason in ((loop, "Too many levels of symbolic links"), (broken, "Input/output error")):
        with pytest.raises(BadInput, match=f"^{path}: {reason}$"):
            load(path)
    locked = tmp_path / "mission.yaml"
    locked.touch(mode=0)
    if os.access(locked, os.R_OK):  # root can read every file
        monkeypatch.setattr(
            os, "open", lambda *_: (_ for _ in ()).throw(PermissionError(13, os.strerror(13)))
        )
    with pytest.raises(BadInput, match=f"^{locked}: Permission denied$"):
        load(locked)


def test_a_name_that_comes_twice_is_told_with_both_lines_and_without_its_values(tmp_path: Path) -> None:
    path = tmp_path / "mission.yaml"
    path.write_text(bomb(9, 9, "lol") + "seed: *a8\nseed: *a8")
    with pytest.raises(
        BadInput, match=f'^{path}:11: found duplicate key "seed"; the first one is in line 10$'
    ):
        load(path)
    path.write_text('scenario:\n  q: 1\n  u: 1\n  "q": "two\\nlines"\n')
    with pytest.raises(BadInput) as error:
        load(path)
    assert str(error.value) == f'{path}:4: found duplicate key "q"; the first one is in line 2'


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"], ids=["LF", "CRLF", "CR"])
@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"], ids=["no mark", "byte order mark"])
def test_an_editors_way_to_write_text_makes_no_difference(tmp_path: Path, mark: bytes, end: str) -> None:
    path = tmp_path / "mission.yaml"
    path.write_bytes(mark + TEXT.replace("\n", end).encode())
    script = load(path)
    path.write_text(TEXT)
    assert script == load(path)
    path.write_bytes(mark + TEXT.replace("seed: 7", "seed: seven").replace("\n", end).encode())
    with pytest.raises(BadInput, match=r"mission.yaml:4: seed: 'seven' is not allowed"):
        load(path)


@pytest.mark.parametrize(
    "content", [b"", b"\n\n", b"# nothing\n", b"\xef\xbb\xbf"], ids=["empty", "blank", "a comment", "a mark"]
)
def test_an_empty_script_is_the_usual_mission(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "mission.yaml"
    path.write_bytes(content)
    assert load(path) == Script()


@pytest.mark.slow
@pytest.mark.parametrize(
    "text", ["k" * 200_000 + ": 1", "about: !" + "t" * 200_000 + " x", "seed: " + "y" * 200_000]
)
def test_a_line_that_is_told_stays_short(tmp_path: Path, text: str) -> None:
    path = tmp_path / "mission.yaml"
    path.write_text(text)
    with pytest.raises(BadInput) as error:
        load(path)
    assert len(str(error.value)) < len(str(path)) + 1100
