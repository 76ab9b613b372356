"""A griffe extension: shows this project's docstrings well, and describes fields by comments and types."""

import re
from itertools import takewhile

import griffe

NEW_LINE = re.compile(r"\n(?=[a-z_]+(?:, [a-z_]+)*: |Returns |Raises )")
"""The start of a line about another argument, the result or an error."""
IMPORTS = re.compile(r"\s*Imports: .+?\.(?=\n|$)")
"""The imports that a package's docstring states; the architecture page lists them for all packages."""


def comment_on(attr: griffe.Attribute) -> str:
    """Return the comment behind an attribute, else the one above it; empty if there is none."""
    lines, first, last = attr.lines_collection[attr.filepath], attr.lineno, attr.endlineno
    _, behind, comment = lines[last - 1].partition("  # ")
    if behind:
        return "" if comment.startswith(("noqa", "type:")) else comment
    above = list(takewhile(lambda line: line.strip().startswith("# "), reversed(lines[: first - 1])))
    return " ".join(line.strip().removeprefix("# ") for line in reversed(above))


class Fields(griffe.Extension):
    """Reads `field: Annotated[type, Meta(description="...")]`, also if the field names such a type.

    Attributes without a docstring are described by their comments.
    """

    def on_instance(self, *, obj: griffe.Object, **_: object) -> None:
        """Keep each argument on a line of its own, and leave out the imports of a package."""
        if obj.docstring:
            obj.docstring.value = NEW_LINE.sub("  \n", IMPORTS.sub("", obj.docstring.value))

    def on_attribute_instance(self, *, attr: griffe.Attribute, **_: object) -> None:
        """Use the comment or the description as the docstring, and only the type as the annotation."""
        if not attr.docstring and attr.lineno and (comment := comment_on(attr)):
            attr.docstring = griffe.Docstring(comment, parent=attr)
        annotation = attr.annotation
        if isinstance(annotation, griffe.ExprName) and isinstance(
            named := attr.module.members.get(annotation.name), griffe.Attribute
        ):
            annotation = named.value
        if not (isinstance(annotation, griffe.ExprSubscript) and annotation.canonical_name == "Annotated"):
            return
        assert isinstance(annotation.slice, griffe.ExprTuple)
        kind, *more = annotation.slice.elements
        for call in more:
            for argument in getattr(call, "arguments", ()):
                if isinstance(argument, griffe.ExprKeyword) and argument.name == "description":
                    attr.docstring = griffe.Docstring(str(argument.value)[1:-1], parent=attr)
        attr.annotation = kind
