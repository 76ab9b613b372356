"""Protects `plumeward certs`: what it prints, and what it refuses."""

from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from link.__main__ import main


def made(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, list[str], str]:
    status = main(arguments=["certs", *words])
    out, err = capsys.readouterr()
    return status, out.splitlines(), err


def test_it_says_what_it_made_and_what_it_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "certificates"
    status, lines, _ = made(capsys, str(folder), "--vehicles", "1,3")
    assert status == 0
    assert [line.split("  ")[0] for line in lines[:-1]] == ["made"] * 4
    assert [line.partition(f"{folder}")[2] for line in lines[:4]] == [
        ": ca",
        ": router, operator, observer, ros",
        "/uav/1: vehicle, estimator, agent, payload, bridge, ros2",
        "/uav/3: vehicle, estimator, agent, payload, bridge, ros2",
    ]
    assert lines[-1].endswith("never ca.key.")
    _, lines, _ = made(capsys, str(folder), "--vehicles", "1,2")
    assert [line.split("  ")[0] for line in lines[:-1]] == ["kept", "kept", "kept", "made"]
    assert lines[3].endswith("/uav/2: vehicle, estimator, agent, payload, bridge, ros2")


def test_vehicles_of_a_search_get_a_certificate_each_and_share_estimator_and_agent(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, lines, _ = made(capsys, str(tmp_path), "--search", "5", "--vehicles", "1,2")
    assert status == 0
    assert [line.partition(f"{tmp_path}")[2] for line in lines[2:-1]] == [
        "/search/5: estimator, agent",
        "/search/5/uav/1: vehicle, payload, bridge, ros2",
        "/search/5/uav/2: vehicle, payload, bridge, ros2",
    ]
    _, lines, _ = made(capsys, str(tmp_path), "--search", "5", "--vehicles", "3")
    assert [line.split("  ")[0] for line in lines[:-1]] == ["kept", "kept", "kept", "made"]
    status, lines, err = made(capsys, str(tmp_path), "--search", "5", "--vehicles", "1,9")
    assert (status, lines) == (2, [])
    assert err == ("error: --vehicles: 9 is not allowed with --search; wanted whole numbers from 1 to 8\n")


def test_bad_input_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words, said in (
        (["--vehicles", "65"], "--vehicles: '65' is not allowed; wanted a whole number from 1 to 64"),
        (["--router", "a,b c"], "--router: 'b c' is not allowed; wanted a host name or an IP address"),
        (["--search", "9"], "--search: '9' is not allowed; wanted a whole number from 1 to 8"),
        (["--days", "0"], "--days: '0' is not allowed; wanted a whole number from 1 to 3650"),
    ):
        with pytest.raises(SystemExit) as end:
            main(arguments=["certs", str(tmp_path), *words])
        assert end.value.code == 2
        assert capsys.readouterr().err.splitlines() == [f"python -m link certs: error: {said}"]


def test_a_router_s_certificate_that_is_kept_and_lacks_a_name_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made(capsys, str(tmp_path))
    status, lines, err = made(capsys, str(tmp_path), "--router", "localhost,drone.example,10.0.0.1")
    assert (status, [line.split("  ")[0] for line in lines[:-1]]) == (0, ["kept"] * 3)
    assert err == (
        f"warning: --router: {tmp_path}/router.pem is kept, and does not name drone.example, 10.0.0.1: delete it "
        "and its key, or give --force\n"
    )
    for file in ("router.pem", "router.key"):
        (tmp_path / file).unlink()
    assert made(capsys, str(tmp_path), "--router", "drone.example,10.0.0.1")[2] == ""
    assert made(capsys, str(tmp_path), "--router", "10.0.0.1")[2] == ""
    assert made(capsys, str(tmp_path), "--vehicles", "2")[2] == ""  # the default asks for nothing


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    status, out, err = made(capsys, str(tmp_path / "file"))
    assert (status, out) == (2, [])
    assert err.splitlines() == [f"error: DIR: cannot write {tmp_path / 'file'}: File exists"]


def test_a_folder_behind_a_link_or_open_to_everybody_is_made_with_a_warning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "there")
    (tmp_path / "there").mkdir()
    status, lines, err = made(capsys, str(tmp_path / "link" / "certs"))
    assert (status, len(lines)) == (0, 4)
    (line,) = err.splitlines()
    assert line.startswith(
        f"warning: DIR: {tmp_path / 'link' / 'certs'} leads through a link to "
        f"{tmp_path / 'there' / 'certs'}: "
    )
    assert made(capsys, str(tmp_path / "there" / "certs"))[2] == ""
    for mode, risky in ((0o1777, tmp_path / "there" / "certs"), (0o777, tmp_path / "there"), (0o1777, None)):
        place = risky or tmp_path / "there"
        place.chmod(mode)
        _, lines, err = made(capsys, str(tmp_path / "there" / "certs"))
        assert err.splitlines() == (
            [
                f"warning: DIR: {place} may be written by everybody: others can replace certificates and "
                "keys "
                f"(forbid it with: chmod o-w {place})"
            ]
            if risky
            else []
        )
        assert len(lines) == 4
        place.chmod(0o700)


def test_a_key_that_everybody_may_read_is_kept_with_a_warning(capsys: pytest.CaptureFixture[str]) -> None:
    with TemporaryDirectory() as folder:  # a test's own folder is closed to others
        place, key = Path(folder), Path(folder) / "uav" / "1" / "agent.key"
        if not all(path.stat().st_mode & 0o001 for path in place.parents):
            pytest.skip("folders for temporary files are closed to others here")
        assert made(capsys, folder)[2] == ""
        for path in (place, place / "uav", key.parent):
            path.chmod(0o755)
        assert made(capsys, folder)[2] == ""
        key.chmod(0o644)
        said = f"warning: DIR: {key} is open to everybody (forbid it with: chmod o-rw {key})\n"
        assert made(capsys, folder)[2] == said
        place.chmod(0o700)
        assert made(capsys, folder)[2] == ""
