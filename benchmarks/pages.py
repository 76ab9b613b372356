"""Tables of pages: in Markdown, each between its marks `<!-- NAME -->` and `<!-- end -->`."""

from collections.abc import Iterable, Sequence


def table(heads: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    return "".join(f"| {' | '.join(line)} |\n" for line in (heads, ["---"] * len(heads), *lines))


def placed(page: str, name: str, made: str) -> str:
    """Return a page with `made` between the marks of a name, in place of what was there.

    Raises ValueError if the page has no such marks.
    """
    before, begin, rest = page.partition(f"<!-- {name} -->\n")
    _, end, after = rest.partition("<!-- end -->")
    if not begin or not end:
        raise ValueError(f"the page has no lines <!-- {name} --> and <!-- end --> to put the table between")
    return f"{before}{begin}\n{made}\n{end}{after}"
