"""Explains field by field why a struct refuses a value, from the errors of the struct's JSON schema."""

import math
import sys
from collections.abc import Collection, Iterator
from itertools import islice
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec
from msgspec import inspect

if TYPE_CHECKING:
    import jsonschema
    from jsonschema.protocols import Validator

Fields = list[str | int]
"""The path to a field through objects (names) and lists (indices)."""


class Mistake(NamedTuple):
    """A field and its error."""

    fields: Fields
    text: str
    missing: bool = False
    """True if one of its fields is missing; that field may be present under a wrong name."""


def find(value: Any, kind: type, infinite: Collection[str] = ()) -> list[Mistake]:
    """Return the mistakes in a value for a struct of this kind; empty if there are none, or none that its
    JSON schema can express.

    Numbers must be finite, except in the fields that `infinite` names.
    """
    schema = msgspec.json.schema(kind)
    words = _Words(schema["$defs"])
    errors = [
        error
        for error in _validator(schema, words).iter_errors(value)
        if not _may_be_infinite(error, infinite)
    ]
    found = [mistake for error in errors for mistake in _mistakes(error, words)]
    return found or [*islice(_own_checks(value, inspect.type_info(kind), []), 1)]


def dotted(fields: Fields) -> str:
    """Write the path to a field: events[2].gas."""
    return "".join(f"[{field}]" if isinstance(field, int) else f".{shown(field)}" for field in fields).lstrip(
        "."
    )


def shown(name: str) -> str:
    """Return a name in a form that fits into one short line."""
    return short(name if name.isprintable() else repr(name), 60)


def short(text: str, length: int) -> str:
    """Return the text, cut to `length` characters with an ellipsis."""
    return text if len(text) <= length else text[: length - 3] + "..."


def finite(number: float) -> bool:
    """True if a finite float can hold the number."""
    return abs(number) <= sys.float_info.max


# ---- the JSON schema, as strict as msgspec ----


def _validator(schema: dict[str, Any], words: "_Words") -> "Validator":
    import jsonschema  # takes 0.05 s, and only a mistake needs it

    def is_number(_: Any, value: Any) -> bool:
        return isinstance(value, int | float) and not isinstance(value, bool) and finite(value)

    def is_whole(_: Any, value: Any) -> bool:
        return isinstance(value, int) and not isinstance(value, bool)  # 5.0 is not a whole number

    def one_of(_: Any, allowed: list[Any], value: Any, __: Any) -> Iterator[jsonschema.ValidationError]:
        if not any(value == one and type(value) is type(one) for one in allowed):  # 8.0 is not 8
            yield jsonschema.ValidationError("not one of them")

    def any_of(
        validator: "Validator", several: list[Any], value: Any, schema: dict[str, Any]
    ) -> Iterator[jsonschema.ValidationError]:
        meant = words.meant(schema, value)
        if meant is not None:  # report the errors of the intended alternative only
            yield from validator.descend(value, several[meant], schema_path=meant)
        elif not any(validator.evolve(schema=one).is_valid(value) for one in several):
            yield jsonschema.ValidationError("none of them")

    base = jsonschema.Draft202012Validator
    types = base.TYPE_CHECKER.redefine_many({"number": is_number, "integer": is_whole})
    strict: Validator = jsonschema.validators.extend(
        base, {"enum": one_of, "anyOf": any_of}, type_checker=types
    )(schema)
    return strict


# ---- from its errors to ours ----


def _may_be_infinite(error: "jsonschema.ValidationError", infinite: Collection[str]) -> bool:
    return (
        error.validator == "type"
        and error.instance == math.inf
        and dotted([*error.absolute_path]) in infinite
    )


def _mistakes(error: "jsonschema.ValidationError", words: "_Words") -> Iterator[Mistake]:
    fields, schema, value = [*error.absolute_path], error.schema, error.instance
    found = short(repr(value), 60)
    match error.validator:
        case "anyOf" if "discriminator" in schema and isinstance(value, dict):
            tag, kinds = schema["discriminator"]["propertyName"], words.wanted(words.kinds(schema))
            if tag in value:
                yield Mistake([*fields, tag], f"{short(repr(value[tag]), 60)} is not allowed; wanted {kinds}")
            else:
                yield Mistake(fields, f"{tag} is missing; wanted {kinds}", missing=True)
        case "additionalProperties":
            for name in value:
                if name not in schema["properties"]:
                    yield Mistake(
                        [*fields, name], f"unknown field; allowed: {', '.join(schema['properties'])}"
                    )
        case "required":
            for name in schema["required"]:
                if name not in value:
                    yield Mistake(
                        fields,
                        f"{name} is missing; wanted {words.wanted(schema['properties'][name])}",
                        missing=True,
                    )
        case _:
            yield Mistake(fields, f"{found} is not allowed; wanted {words.wanted(schema)}")


def _own_checks(value: Any, kind: inspect.Type, fields: Fields) -> Iterator[Mistake]:
    """The errors of the structs' own checks in a value that passes the schema, the innermost struct first."""
    match kind:
        case inspect.Metadata():
            yield from _own_checks(value, kind.type, fields)
        case inspect.UnionType():
            for one in kind.types:
                if (
                    not isinstance(one, inspect.StructType)
                    or one.tag_field is None
                    or value.get(one.tag_field) == one.tag
                ):
                    yield from _own_checks(value, one, fields)
        case inspect.ListType() if isinstance(value, list):
            for number, item in enumerate(value):
                yield from _own_checks(item, kind.item_type, [*fields, number])
        case inspect.StructType() if isinstance(value, dict):
            for field in kind.fields:
                if field.encode_name in value:
                    yield from _own_checks(value[field.encode_name], field.type, [*fields, field.encode_name])
            try:
                msgspec.convert(value, kind.cls)
            except msgspec.ValidationError as error:
                if error.__cause__:
                    yield Mistake(fields, str(error.__cause__))


class _Words:
    """Describes in words what a schema allows."""

    def __init__(self, components: dict[str, Any]) -> None:
        self._components = components

    def wanted(self, schema: dict[str, Any]) -> str:
        """Describe what a field may be: its own description, or a list of its fields, items or choices."""
        schema = self._resolved(schema)
        listed = (
            schema.get("type") in ("object", "array")
            or "enum" in schema
            or any("enum" in one for one in schema.get("anyOf", []))
        )
        return self._words(schema) if listed else schema.get("description") or self._words(schema)

    def meant(self, schema: dict[str, Any], value: Any) -> int | None:
        """Return the index of the alternative that is meant: by the tag of an object, else by whether the
        value is a list or an object.
        """
        if "discriminator" in schema:
            tag = value.get(schema["discriminator"]["propertyName"]) if isinstance(value, dict) else None
            reference = schema["discriminator"]["mapping"].get(tag) if isinstance(tag, str) else None
            return schema["anyOf"].index({"$ref": reference}) if reference else None
        if not isinstance(value, list | dict):
            return None
        kind = "array" if isinstance(value, list) else "object"
        return next(
            (number for number, one in enumerate(schema["anyOf"]) if self._resolved(one).get("type") == kind),
            None,
        )

    def kinds(self, schema: dict[str, Any]) -> dict[str, Any]:
        """Return the schema of the tag that tells several kinds of object apart."""
        return {"enum": list(schema["discriminator"]["mapping"])}

    def _resolved(self, schema: dict[str, Any]) -> dict[str, Any]:
        while "$ref" in schema:
            schema = self._components[schema["$ref"].rpartition("/")[2]]
        return schema

    def _words(self, schema: dict[str, Any]) -> str:
        schema = self._resolved(schema)
        if "discriminator" in schema:
            return f"fields with {schema['discriminator']['propertyName']}: {self._words(self.kinds(schema))}"
        if "anyOf" in schema:
            return " or ".join(
                dict.fromkeys(self.wanted(one) for one in schema["anyOf"] if one.get("type") != "null")
            )
        if "enum" in schema:
            return "one of " + ", ".join(map(str, schema["enum"]))
        kind = schema.get("type", "something else")
        if kind in ("number", "integer"):
            bounds = [
                f"{word} {schema[name]:.12g}"
                for name, word in (
                    ("minimum", "from"),
                    ("exclusiveMinimum", "above"),
                    ("maximum", "up to"),
                    ("exclusiveMaximum", "below"),
                )
                if name in schema
            ]
            return " ".join(["a number" if kind == "number" else "a whole number", *bounds])
        if kind == "array":
            if "prefixItems" in schema:
                each = schema["prefixItems"]
                return f"a list of {'two: ' if len(each) == 2 else ''}{self._words(each[0])}"
            least = f"at least {schema['minItems']}: " if "minItems" in schema else ""
            return f"a list of {least}{self._words(schema.get('items') or {})}"
        if kind == "object":
            return (
                "fields: " + ", ".join(schema["properties"])
                if schema.get("properties")
                else "names with values"
            )
        return {"string": "text", "boolean": "true or false"}.get(kind, str(kind))
