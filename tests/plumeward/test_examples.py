"""Protects the examples of the API: each public name has one in its docstring, and it prints what it shows."""

import doctest
import shutil
from pathlib import Path

import pytest

import plumeward

ROOT = Path(__file__).parents[2]
NAMES = [name for name in plumeward.__all__ if name != "__version__"]


def example(name: str) -> doctest.DocTest:
    """The example in the docstring of a public name, which may use `plumeward` and nothing else."""
    text = getattr(plumeward, name).__doc__ or ""
    return doctest.DocTestParser().get_doctest(text, {"plumeward": plumeward}, name, None, None)


@pytest.mark.parametrize("name", NAMES)
def test_every_public_name_has_an_example_that_uses_it(name: str) -> None:
    docs = getattr(plumeward, name).__doc__ or ""
    assert docs.count("    Examples:\n        >>> ") == 1, "such a section becomes code on the site"
    assert example(name).examples
    made_by = {
        "Outcome": "rollout",
        "TracePoint": "rollout",
        "Posterior": "prior",
        "Belief": "belief",
        "Recording": "read_record",
        "SourceSearch": "plumeward/SourceSearch-v0",
    }
    assert made_by.get(name, f"plumeward.{name}(") in docs


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_an_example_prints_what_it_shows(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "runs").mkdir()
    shutil.copy(ROOT / "tests" / "golden" / "homing-gaussian.mcap", tmp_path / "runs" / "NAME.mcap")
    monkeypatch.chdir(tmp_path)
    failed, tried = doctest.DocTestRunner(optionflags=doctest.REPORT_NDIFF).run(example(name))
    assert tried
    assert not failed, capsys.readouterr().out
