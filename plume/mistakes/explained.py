"""Explains msgspec's errors: the field, its value and what is allowed.

msgspec's error names the field, the struct's JSON schema what it may be.
"""

import difflib
import re
from collections.abc import Iterable, Sequence
from typing import Any

import msgspec

Fields = Sequence[str | int]  # the path to a field through objects (names) and lists (indices)
Schema = Any  # a JSON schema, with its references replaced by what they stand for
AT = re.compile(r"(.*) - at (?:`key` in )?`\$([^`]*)`", re.DOTALL)  # the end of an error of msgspec
LONGEST = 60  # characters of a name or value that are shown
BOUNDS = {"minimum": "from", "exclusiveMinimum": "above", "maximum": "up to", "exclusiveMaximum": "below"}
TYPES = {
    "string": "text",
    "boolean": "true or false",
    "number": "a number",
    "integer": "a whole number",
    "array": "a list",
}


def explained(error: Exception, value: Any, kind: type) -> tuple[Fields, str]:
    """Return the field at which the conversion of a value to a kind of struct ended, and its mistake."""
    at = AT.fullmatch(str(error))
    said, path = at.groups() if at else (str(error), "")
    schema, fields = (
        _schema(kind),
        [name or int(item) for name, item in re.findall(r"\.(\w+)|\[(\d+)\]", path)],
    )
    for field in fields:
        schema, value = _within(schema, value, field), value[field]
    if error.__cause__:  # a struct's own check, which may name one of its fields
        name, _, rest = said.partition(": ")
        return (
            ([*fields, name], rest) if isinstance(value, dict) and name in value and rest else (fields, said)
        )
    if said.startswith("Object missing"):
        name = said.split("`")[1]
        return fields, f"{name} is missing; wanted {_wanted(_within(schema, value, name))}"
    if said.startswith("Object contains unknown"):
        known = _chosen(schema, value)["properties"]
        name = next(name for name in value if name not in known)
        return [*fields, name], f"unknown field{nearest(name, known, 'allowed')}: {', '.join(known)}"
    near = nearest(value, _choices(schema), "wanted")
    return fields, f"{short(repr(value), LONGEST)} is not allowed{near} {_wanted(schema)}"


def dotted(fields: Fields) -> str:
    """Write the path to a field: events[2].gas."""
    return "".join(f"[{field}]" if isinstance(field, int) else f".{shown(field)}" for field in fields).lstrip(
        "."
    )


def nearest(name: Any, known: Iterable[Any], then: str) -> str:
    """Return what leads to the list of known names: "; wanted", after the one that is near, if any."""
    is_name = isinstance(name, str) and len(name) <= LONGEST
    near = difflib.get_close_matches(name, map(str, known), 1, cutoff=0.51) if is_name else []
    return f"; did you mean {near[0]!r}? {then.capitalize()}" if near else f"; {then}"


def shown(name: str) -> str:
    """Return a name in a form that fits into one short line."""
    return short(name if name.isprintable() else repr(name), LONGEST)


def short(text: str, length: int) -> str:
    """Return the text, cut to `length` characters with an ellipsis."""
    return text if len(text) <= length else text[: length - 3] + "..."


def _schema(kind: type) -> Schema:
    """Return the JSON schema of a struct."""
    whole = msgspec.json.schema(kind)

    def expanded(schema: Schema) -> Schema:
        if isinstance(schema, list):
            return [expanded(one) for one in schema]
        if not isinstance(schema, dict):
            return schema
        if "$ref" in schema:  # beside it is what the field says of itself
            struct = expanded(whole["$defs"][schema["$ref"].rpartition("/")[2]])
            return {**struct, "description": "", **schema}
        return {name: expanded(one) for name, one in schema.items()}

    return expanded({"$ref": whole["$ref"]})


def _several(schema: Schema) -> list[Schema]:
    """Return the alternatives of a schema, without null."""
    return [one for one in schema.get("anyOf", [schema]) if one.get("type") != "null"]


def _chosen(schema: Schema, value: Any) -> Schema:
    """Return the alternative that is meant for an object, by its tag if there are several, or for a list."""
    wanted = "object" if isinstance(value, dict) else "array"
    tag = schema.get("discriminator", {}).get("propertyName")
    for one in _several(schema):
        if one.get("type") == wanted and (not tag or value[tag] in one["properties"][tag]["enum"]):
            return one
    raise LookupError(f"no schema for {wanted}")


def _within(schema: Schema, value: Any, field: str | int) -> Schema:
    """Return the schema of a field of an object, or of an item of a list."""
    if field == schema.get("discriminator", {}).get("propertyName", ""):
        return {"enum": [*schema["discriminator"]["mapping"]]}
    schema = _chosen(schema, value)
    if isinstance(field, int):
        return schema["items"] or schema["prefixItems"][field]
    return schema["properties"][field]


def _choices(schema: Schema) -> list[Any]:
    """Return the values to choose from, if there are such."""
    return [choice for one in _several(schema) for choice in one.get("enum", ())]


def _wanted(schema: Schema) -> str:
    """Say what a field may be: its choices, its fields, its description, or its type and limits."""
    first = _several(schema)[0]
    if "discriminator" in schema:
        tag, kinds = schema["discriminator"].values()
        return f"fields with {tag}: one of {', '.join(kinds)}"
    if choices := _choices(schema):
        return f"one of {', '.join(map(str, choices))}"
    if "properties" in first and len(_several(schema)) == 1:
        about = schema.get("description")
        return f"{f'{about}, ' if about else ''}fields: {', '.join(first['properties'])}"
    bounds = [f"{word} {first[name]:.12g}" for name, word in BOUNDS.items() if name in first]
    return str(
        schema.get("description") or first.get("description") or " ".join([TYPES[first["type"]], *bounds])
    )
