"""A hook of mkdocs: makes pages from notebooks, CONTRIBUTING.md and CHANGELOG.md."""

import base64
import json
import re
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
TOP_LEVEL = ("CONTRIBUTING.md", "CHANGELOG.md")
"""Pages that lie beside README.md, where people look for them."""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages."""
    for name in TOP_LEVEL:
        files.append(
            File.generated(config, name.lower(), content=from_docs((ROOT / name).read_text(encoding="utf-8")))
        )
    for notebook in [file for file in files if file.src_uri.endswith(".ipynb")]:
        page = PurePosixPath(notebook.src_uri)
        for name, content in pages(page, json.loads(notebook.content_string)):
            files.append(File.generated(config, str(page.parent / name), content=content))
    return files


def on_page_markdown(markdown: str, page: Page, **_: object) -> str:
    """Point links to those files at their pages. A notebook's own page keeps the link to the file, for
    download.
    """
    markdown = re.sub(
        rf"\]\(\.\./((?:\.\./)*)({'|'.join(TOP_LEVEL)})\b",
        lambda found: f"]({found[1]}{found[2].lower()}",
        markdown,
    )
    return re.sub(r"\]\(([\w./-]*?)([\w-]+)\.ipynb\)(?!\{ \.md-button)", r"](\1\2.md)", markdown)


def on_post_page(output: str, config: MkDocsConfig, **_: object) -> str:
    """Give the first page a title that says what this is: its own is the site's name."""
    name = config.site_name
    return output.replace(
        f"<title>{name} - {name}</title>", f"<title>{name}: {config.site_description}</title>"
    )


def from_docs(text: str) -> str:
    """Rewrite the links of a page beside README.md for docs/. A link to a file outside the site becomes
    plain text.
    """
    text = re.sub(r"\]\(docs/([^)]+)\)", r"](\1)", text)
    text = re.sub(r"\[([^\]]+)\]\(((?:\w+/)+[\w.]+|[\w.]+\.(?!md)\w+|README\.md)\)", r"\1", text)
    return re.sub(rf"\]\(({'|'.join(TOP_LEVEL)})\)", lambda found: f"]({found[1].lower()})", text)


def pages(page: PurePosixPath, notebook: dict[str, Any]) -> Iterator[tuple[str, str | bytes]]:
    """Yield (name, content) of each picture in a notebook, then of its page in Markdown."""
    text: list[str] = []
    for number, cell in enumerate(notebook["cells"]):
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            text.append(source)
            continue
        text.append(f"```python\n{source}\n```")
        for output in cell["outputs"]:
            data = output.get("data", {})
            if "image/png" in data:
                picture = f"{page.stem}-{number}.png"
                yield picture, base64.b64decode("".join(data["image/png"]))
                text.append(f"![{cell['metadata'].get('alt', '')}]({picture})")
            elif said := "".join(output.get("text", data.get("text/plain", ""))).rstrip():
                text.append(f"```text\n{said}\n```")
    text.insert(1, f"[Download the notebook]({page.name}){{ .md-button download }}")
    yield f"{page.stem}.md", "\n\n".join(text) + "\n"
