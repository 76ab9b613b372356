"""The documents of the findings: what is written, and where."""

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path

from ground.findings.background import Background
from ground.findings.exchange import figures_csv, figures_json, geojson, kml, readings_csv
from ground.findings.figures import Findings
from ground.findings.page import page
from link.files import whole

# By the file's name: what makes it.
DOCUMENTS: Mapping[str, Callable[[Findings], str]] = {
    "findings.html": page,
    "findings.geojson": geojson,
    "findings.kml": kml,
    "findings.json": figures_json,
    "figures.csv": figures_csv,
    "readings.csv": readings_csv,
}


def write(it: Findings, folder: Path, background: Background | None = None) -> None:
    """Write all documents into a folder, or none. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    texts = {
        name: page(it, background) if make is page else make(it) for name, make in DOCUMENTS.items()
    }  # all of them before the first is written
    with ExitStack() as stack:
        for name, text in texts.items():
            partial = stack.enter_context(whole(folder / name))
            partial.write_text(text, encoding="utf-8", newline="\n")
