"""Protects the README's figures: they are those of the rows in results/."""

import re
from pathlib import Path

import pytest

from benchmarks import readme


@pytest.mark.slow
def test_the_readme_tells_the_figures_of_results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = readme.PAGE.read_text()
    page = tmp_path / "README.md"
    monkeypatch.setattr(readme, "PAGE", page)
    monkeypatch.setattr("sys.argv", ["readme", "--check"])
    page.write_text(text)
    assert readme.main() == 0
    page.write_text(re.sub(r"false stops [\d.]+%", "false stops 99%", text, count=1))
    assert readme.main() == 1
    monkeypatch.setattr("sys.argv", ["readme"])
    assert readme.main() == 0
    assert page.read_text() == text
