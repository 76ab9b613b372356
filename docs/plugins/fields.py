"""A griffe extension: docstrings as they are written here, and fields that are described in their types."""

import re

import griffe

NEW_LINE = re.compile(r"\n(?=[a-z_]+(?:, [a-z_]+)*: |Returns |Raises )")
"""Where a docstring begins to speak of another argument or of the result."""
IMPORTS = re.compile(r"\s*Imports: .+?\.(?=\n|$)")
"""What a package's docstring says of its place in the house; the architecture page has it for all."""


class Fields(griffe.Extension):
    """Reads `field: Annotated[type, Meta(description="...")]`, and names of such types."""

    def on_instance(self, *, obj: griffe.Object, **_: object) -> None:
        """Keep each argument on a line of its own, and leave out what a package imports."""
        if obj.docstring:
            obj.docstring.value = NEW_LINE.sub("  \n", IMPORTS.sub("", obj.docstring.value))

    def on_attribute_instance(self, *, attr: griffe.Attribute, **_: object) -> None:
        """Take the description for the docstring, and the type alone for the annotation."""
        annotation = attr.annotation
        if isinstance(annotation, griffe.ExprName) and isinstance(named := attr.module.members.get(annotation.name), griffe.Attribute):
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
