"""The report as one self-contained HTML page, with pictures embedded, for light and dark mode."""

import base64
import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from agent.trials.report.tables import Table

CSS = """
:root { color-scheme: light dark; --ink: #1b1f24; --paper: #ffffff; --faint: #6b7280; --rule: #d9dde3; --band: #f5f6f8; --link: #0b5cad; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e6e8eb; --paper: #14171a; --faint: #9aa3ad; --rule: #333a42; --band: #1c2126; --link: #7db7f0; }
}
body { margin: 0 auto; padding: 2rem 1.25rem 5rem; max-width: 68rem; color: var(--ink); background: var(--paper);
  font: 1rem/1.6 system-ui, sans-serif; }
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0 0 .5rem; }
h2 { font-size: 1.3rem; margin: 3.5rem 0 1rem; }
p, figcaption, nav { max-width: 46rem; }
a { color: var(--link); }
figure { margin: 0; }
img { display: block; width: 100%; height: auto; padding: .75rem; box-sizing: border-box; background: #fff; border: 1px solid var(--rule);
  border-radius: 8px; }
figcaption, .note { color: var(--faint); font-size: .92rem; margin-top: .75rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .85rem; font-variant-numeric: tabular-nums; }
th, td { padding: .35rem .7rem; text-align: left; vertical-align: top; border-bottom: 1px solid var(--rule); }
th { white-space: nowrap; }
tbody tr:nth-child(even) { background: var(--band); }
code { font-size: .92em; background: var(--band); padding: .1em .3em; border-radius: 4px; }
"""


@dataclass(frozen=True)
class Picture:
    """A drawn figure with its caption."""

    name: str  # name of its files without the ending
    title: str
    caption: str
    svg: bytes


def page(summary: str, pictures: Sequence[Picture], tables: Sequence[Table]) -> str:
    """Return the whole page."""
    sections = [(picture.name, picture.title, _figure(picture)) for picture in pictures]
    sections += [(f"table-{i}", table.title, _table(table)) for i, table in enumerate(tables, 1)]
    contents = "\n".join(f'<li><a href="#{name}">{escape(title)}</a></li>' for name, title, _ in sections)
    body = "\n".join(
        f'<section id="{name}">\n<h2>{escape(title)}</h2>\n{content}\n</section>'
        for name, title, content in sections
    )
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Plumeward: results</title>
<style>{CSS}</style>
</head>
<body>
<h1>Plumeward: results</h1>
<p>{_prose(summary)}</p>
<nav aria-label="Contents"><ol>
{contents}
</ol></nav>
{body}
</body>
</html>
"""


def _figure(picture: Picture) -> str:
    source = "data:image/svg+xml;base64," + base64.b64encode(picture.svg).decode()
    return (
        f'<figure>\n<img src="{source}" '
        f'alt="{escape(picture.title)}">\n<figcaption>{_prose(picture.caption)}</figcaption>\n</figure>'
    )


def _table(table: Table) -> str:
    heads = "".join(f"<th>{escape(head)}</th>" for head in table.heads)
    rows = "\n".join(
        "<tr>" + "".join(f"<td>{escape(text)}</td>" for text in row) + "</tr>" for row in table.rows
    )
    notes = "\n".join(f'<p class="note">{_prose(note)}</p>' for note in table.notes)
    return (
        "<div "
        f'class="wide"><table>\n<thead><tr>{heads}</tr></thead>\n<tbody>\n{rows}\n</tbody>\n</table></div>\n{notes}'
    )


def _prose(text: str) -> str:
    """HTML of a text with Markdown's `code` and *emphasis*."""
    return re.sub(r"\*(.+?)\*", r"<em>\1</em>", re.sub(r"`(.+?)`", r"<code>\1</code>", escape(text)))
