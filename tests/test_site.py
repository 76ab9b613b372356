"""Protects the documentation site, and the files for who cites or joins in: all is built, and what they
name is there.
"""

import json
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

import plumeward
from plume import __version__
from tests.view.browser import launched

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
NOTEBOOKS = sorted(DOCS.rglob("*.ipynb"))
PAGES = {str(page.relative_to(DOCS).with_suffix("")) for page in (*DOCS.rglob("*.md"), *NOTEBOOKS)} | {
    "contributing",
    "changelog",
}
"""The pages that there should be; the last two are made from files beside README.md."""
MODULES = {
    "api/index": [f"plumeward.{name}" for name in plumeward.__all__ if name != "__version__"],
    "api/physics": (
        "plume.dispersion.concentration",
        "plume.sensors.sensor.Gaussian.log_likelihood",
        "plume.scenario.Scenario.tau",
    ),
    "api/estimator": (
        "estimator.filter.assimilate",
        "estimator.filter.Config.threshold_m",
        "estimator.belief.belief",
    ),
    "api/planners": ("agent.planners.homing.plan", "agent.planners.registry.PLANNERS"),
    "api/environments": ("agent.learn.env.SourceSearch.step",),
    "api/messages": ("link.bus.messages.Belief.spread",),
    "api/records": ("link.record.reader.read",),
}
"""What the API reference describes, among other things."""


def nav_pages(part: Any) -> list[str]:
    """The pages of a nav, without their suffix, in order."""
    if isinstance(part, str):
        return [part.removesuffix(".md")]
    return [
        page for inner in (part.values() if isinstance(part, dict) else part) for page in nav_pages(inner)
    ]


def config() -> dict[str, Any]:
    return YAML(typ="safe").load(ROOT / "mkdocs.yml")


class Loads(HTMLParser):
    """Collects what a browser fetches by itself, the links that a reader may follow, the anchors and the
    text.
    """

    def __init__(self, html: str) -> None:
        super().__init__()
        self.fetched: list[str] = []
        self.anchors: set[str] = set()
        self.text = ""
        self.feed(html)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        said = dict(attributes)
        if said.get("id"):
            self.anchors.add(said["id"] or "")
        names = ("src", "srcset", "poster", "data") if tag != "link" else ("href",)
        self.fetched += [said[name] or "" for name in names if name in said]

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, as `make site` builds it, on a machine whose only way out is a proxy that is not there."""
    folder = tmp_path_factory.mktemp("site")
    closed = dict.fromkeys(
        ("http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY"), "http://127.0.0.1:9"
    )
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=ROOT,
        env={**os.environ, **closed, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert built.returncode == 0, built.stdout + built.stderr
    return folder


def test_every_page_is_in_the_nav_once_and_every_entry_of_the_nav_is_a_page() -> None:
    assert sorted(nav_pages(config()["nav"])) == sorted(PAGES)


def test_make_site_builds_strictly() -> None:
    said = subprocess.run(
        ["make", "--dry-run", "site"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    assert "mkdocs build --strict" in said


@pytest.mark.full
def test_every_page_is_built(site: Path) -> None:
    assert {str(page.relative_to(site).with_suffix("")) for page in site.rglob("*.html")} == PAGES | {"404"}


@pytest.mark.full
def test_no_page_fetches_anything_from_elsewhere(site: Path) -> None:
    for page in site.rglob("*.html"):
        fetched = Loads(page.read_text()).fetched
        assert fetched, page
        assert [
            url for url in fetched if re.match(r"(?i)[a-z][a-z+.-]*:|//", url) and not url.startswith("data:")
        ] == [], page
    for style in site.rglob("*.css"):
        assert not re.search(r"(?:url\(|@import)\s*['\"]?(?:https?:)?//", style.read_text()), style


@pytest.mark.full
def test_nothing_on_a_page_makes_the_theme_load_a_library_or_a_repository(site: Path) -> None:
    """Its script fetches a diagram's library, or the facts of a repository, only for pages that hold
    these.
    """
    for page in site.rglob("*.html"):
        assert not re.search(
            r'class="[^"]*\bmermaid\b|data-md-component="source"|class="md-source', page.read_text()
        ), page


@pytest.mark.full
def test_each_page_has_a_title_of_its_own_that_says_the_site_once(site: Path) -> None:
    titles = [
        re.findall(r"<title>(.*?)</title>", page.read_text())[0]
        for page in site.rglob("*.html")
        if page.name != "404.html"
    ]
    assert [title for title in titles if title.count("Plumeward") != 1] == []
    assert len({*titles}) == len(titles)


@pytest.mark.full
def test_no_page_is_wider_than_a_phone_or_a_small_screen(site: Path) -> None:
    with launched() as chromium:
        for width in (360, 1280):
            window = chromium.new_page(viewport={"width": width, "height": 800})
            for page in site.rglob("*.html"):
                window.goto(page.as_uri())
                assert window.evaluate("document.documentElement.scrollWidth") <= width, page


def test_no_host_is_invented() -> None:
    assert not {"site_url", "repo_url", "edit_uri"} & set(config())


@pytest.mark.full
def test_all_that_a_page_shows_or_links_to_is_in_the_site(site: Path) -> None:
    for page in site.rglob("*.html"):
        if page.name == "404.html":  # a server's page: its links begin at the root
            continue
        for url in re.findall(r'(?:href|src)="([^"#?:]+)(?:[#?][^"]*)?"', page.read_text()):
            assert (page.parent / url).exists(), f"{page.relative_to(site)}: {url}"


@pytest.mark.full
@pytest.mark.parametrize("page", MODULES)
def test_the_reference_describes_what_its_page_is_about(site: Path, page: str) -> None:
    anchors = Loads((site / page).with_suffix(".html").read_text()).anchors
    assert set(MODULES[page]) <= anchors


@pytest.mark.full
def test_a_fields_description_is_in_the_reference(site: Path) -> None:
    text = Loads((site / "api/messages.html").read_text()).text
    assert "square root of the covariance's trace, m" in text
    assert "Annotated[" not in text


@pytest.mark.full
def test_the_search_finds_every_page(site: Path) -> None:
    found = {
        entry["location"].partition("#")[0]
        for entry in json.loads((site / "search/search_index.json").read_text())["docs"]
    }
    assert {page.removesuffix(".html") or "index" for page in found} >= PAGES


@pytest.mark.full
@pytest.mark.timeout(300)  # where kernels are not compiled yet
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_its_claims_hold_and_it_prints_what_it_shows(
    path: Path, site: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import nbformat
    from nbclient import NotebookClient

    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    notebook = nbformat.read(path, 4)
    nbformat.validate(notebook)
    assert sum("assert " in cell.source for cell in notebook.cells) >= 3
    shown = [said(cell) for cell in notebook.cells]
    page = Loads((site / path.relative_to(DOCS)).with_suffix(".html").read_text()).text
    assert all(text.strip() in page for text in shown)
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(ROOT)}}).execute()
    assert [said(cell) for cell in notebook.cells] == shown


def said(cell: Any) -> str:
    """What a cell printed to stdout."""
    return "".join(
        output.text
        for output in cell.get("outputs", [])
        if output.output_type == "stream" and output.name == "stdout"
    )


def test_the_citation_is_valid() -> None:
    command = [
        sys.executable,
        "-m",
        "check_jsonschema",
        "--builtin-schema",
        "vendor.citation-file-format",
        str(ROOT / "CITATION.cff"),
    ]
    checked = subprocess.run(command, capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stdout


def test_citation_and_changelog_are_of_this_version() -> None:
    citation = YAML(typ="safe").load(ROOT / "CITATION.cff")
    assert citation["version"] == __version__
    versions = re.findall(
        r"^## \[(.+?)\](?: - \d{4}-\d\d-\d\d)?$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE
    )
    assert versions[:2] == ["Unreleased", __version__]


def test_the_citation_names_the_paper_as_the_site_does() -> None:
    (paper,) = YAML(typ="safe").load(ROOT / "CITATION.cff")["references"]
    page = " ".join((DOCS / "index.md").read_text().replace("> ", "").split())
    assert paper["title"] in page
    assert (
        ", ".join(f"{author['given-names']} {author['family-names']}" for author in paper["authors"]) in page
    )
    assert paper["url"] in page
    assert f'Paper = "{paper["url"]}"' in (ROOT / "pyproject.toml").read_text()


def test_contributing_names_targets_and_files_that_are_there() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text()
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert set(re.findall(r"`make ([\w-]+)", text)) <= targets
    files = set(re.findall(r"`([\w./]+/[\w./]*)`", text)) | set(re.findall(r"\]\(([^)#:]+)\)", text))
    made = {
        "agent/planners/NAME.py",
        "site/",
        "site/index.html",
        ".venv/clients/",
    }  # by who reads, or by a target
    assert files - made <= {name for name in files if (ROOT / name).exists()}
    for constants, file in re.findall(r"`([A-Za-z_]+)` in\s+`([\w./]+\.py)`", text):
        assert re.search(rf"^(?:def |class )?{constants}\b", (ROOT / file).read_text(), re.MULTILINE), (
            f"{file}: {constants}"
        )
