"""Typed YAML files: read into a struct, with errors that name file, line, field, what was found and what is allowed."""

import re
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from ruamel.yaml import YAML
from ruamel.yaml.constructor import DuplicateKeyError
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

T = TypeVar("T")

Fields = list[str | int]
"""The way to a field through objects and lists."""


class FileError(ValueError):
    """A file that cannot be used; the text is one line."""


class Document:
    """One YAML file with the places of its fields."""

    def __init__(self, path: Path) -> None:
        """Read it; raises FileError where it cannot be read or is no YAML."""
        self.path = path
        yaml = YAML(typ="safe", pure=True)  # YAML 1.2: `on` is a word, 1e3 a number
        try:
            self._root: Node | None = yaml.compose(path.read_text(encoding="utf-8"))
            self.value: Any = yaml.constructor.construct_document(self._root) if self._root else {}
        except OSError as error:
            raise FileError(f"{path}: {error.strerror}") from None
        except UnicodeDecodeError:
            raise FileError(f"{path}: this is no UTF-8 text") from None
        except DuplicateKeyError as error:
            line = error.problem_mark.line + 1 if error.problem_mark else 1
            raise FileError(f"{path}:{line}: {str(error.problem).splitlines()[0]}") from None
        except MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            raise FileError(f"{path}:{mark.line + 1 if mark else 1}: this is no YAML: {error.problem or error.context}") from None
        except (YAMLError, RecursionError, ValueError) as error:
            raise FileError(f"{path}: this is no YAML: {str(error).splitlines()[0]}") from None

    def to(self, kind: type[T]) -> T:
        """Return it as a struct; raises FileError."""
        try:
            return msgspec.convert(self.value, kind)
        except msgspec.ValidationError as error:
            reason, _, where = str(error).rpartition(" - at `$")
            raise self._explained(reason or str(error), _fields(where.rstrip("`")) if reason else [], kind) from None
        except RecursionError:
            raise FileError(f"{self.path}: nested too deeply") from None

    def error(self, fields: Fields, text: str) -> FileError:
        """Return the error that says this about a field."""
        return FileError(f"{self.path}:{self._line(fields)}: {_dotted(fields) + ': ' if fields else ''}{text}")

    def _explained(self, reason: str, fields: Fields, kind: type) -> FileError:
        schema = _Schema(kind)
        if match := re.match(r"Object contains unknown field `(.*)`", reason):
            allowed = schema.names(fields, self.value)
            return self.error([*fields, match[1]], f"there is no such field; allowed: {', '.join(allowed)}")
        if match := re.match(r"Object missing required field `(.*)`", reason):
            wanted = schema.wanted([*fields, match[1]], self.value)
            return self.error(fields, f"{match[1]} is missing; wanted {wanted}")
        if not reason.startswith(("Expected", "Invalid")):
            return self.error(fields, reason)  # of a struct's own check: it says all
        found = _found(self.value, fields)
        return self.error(fields, f"{found} is not allowed; wanted {schema.wanted(fields, self.value)}")

    def _line(self, fields: Fields) -> int:
        """Line of a field, or of the nearest thing around it that is there."""
        node, line = self._root, 1
        if node is not None:
            line = node.start_mark.line + 1
        for field in fields:
            if isinstance(node, MappingNode):
                pairs = {key.value: (key, value) for key, value in node.value if isinstance(key, ScalarNode)}
                if field not in pairs:
                    break
                key, node = pairs[str(field)]
                line = key.start_mark.line + 1
            elif isinstance(node, SequenceNode) and isinstance(field, int) and field < len(node.value):
                node = node.value[field]
                line = node.start_mark.line + 1
            else:
                break
        return line


def _fields(path: str) -> Fields:
    """`.events[2].gas` as ["events", 2, "gas"]; a `[...]`, which is any key of an object, ends it."""
    fields: Fields = []
    for name, index in re.findall(r"\.([^.\[]+)|\[(\d+|\.\.\.)\]", path):
        if index == "...":
            break
        fields.append(int(index) if index else name)
    return fields


def _dotted(fields: Fields) -> str:
    return "".join(f"[{field}]" if isinstance(field, int) else f".{field}" for field in fields).lstrip(".")


def _value(value: Any, fields: Fields) -> Any:
    for field in fields:
        try:
            value = value[field]
        except (KeyError, IndexError, TypeError):
            return None
    return value


def _found(value: Any, fields: Fields) -> str:
    text = repr(_value(value, fields))
    return text if len(text) <= 60 else text[:57] + "..."


class _Schema:
    """What is allowed where, in words, from a struct's JSON schema."""

    def __init__(self, kind: type) -> None:
        schemas, self._components = msgspec.json.schema_components([kind])
        self._root = schemas[0]

    def names(self, fields: Fields, value: Any) -> list[str]:
        """Return the fields that an object may have."""
        return list(self._at(fields, value).get("properties", {}))

    def wanted(self, fields: Fields, value: Any) -> str:
        """Say in words what a field may be."""
        schema = self._at(fields, value)
        in_words = schema.get("type") in ("object", "array") or "enum" in schema or any("enum" in one for one in schema.get("anyOf", []))
        return self._words(schema) if in_words else schema.get("description") or self._words(schema)

    def _resolved(self, schema: dict[str, Any]) -> dict[str, Any]:
        while "$ref" in schema:
            schema = self._components[schema["$ref"].rpartition("/")[2]]
        return schema

    def _at(self, fields: Fields, value: Any) -> dict[str, Any]:
        schema = self._chosen(self._resolved(self._root), value)
        for field in fields:
            value = _value(value, [field])
            if isinstance(field, int):
                items = schema.get("items") or {}
                schema = schema["prefixItems"][field] if "prefixItems" in schema else items
            elif field in schema.get("properties", {}):
                schema = schema["properties"][field]
            elif "discriminator" in schema:  # of an object whose kind is not known
                schema = {"enum": list(schema["discriminator"]["mapping"])}
            else:
                schema = schema.get("additionalProperties") or {}
            schema = self._chosen(self._resolved(schema), value)
        return schema

    def _chosen(self, schema: dict[str, Any], value: Any) -> dict[str, Any]:
        """Of several kinds of object the one that its tag names; of a value or a list of them, the one that is there."""
        if "discriminator" in schema and isinstance(value, dict):
            tag = schema["discriminator"]["propertyName"]
            reference = schema["discriminator"]["mapping"].get(value.get(tag))
            return self._resolved({"$ref": reference}) if reference else schema
        if "anyOf" in schema and isinstance(value, list):
            return next((one for one in schema["anyOf"] if one.get("type") == "array"), schema)
        return schema

    def _words(self, schema: dict[str, Any]) -> str:
        schema = self._resolved(schema)
        if "anyOf" in schema:
            return " or ".join(dict.fromkeys(self._words(one) for one in schema["anyOf"] if one.get("type") != "null"))
        if "enum" in schema:
            return "one of " + ", ".join(map(str, schema["enum"]))
        kind = schema.get("type", "something else")
        if kind in ("number", "integer"):
            bounds = [
                f"{word} {schema[name]:.12g}"
                for name, word in (("minimum", "from"), ("exclusiveMinimum", "above"), ("maximum", "up to"), ("exclusiveMaximum", "below"))
                if name in schema
            ]
            return " ".join(["a number" if kind == "number" else "a whole number", *bounds])
        if kind == "array":
            each = schema.get("prefixItems") or [schema.get("items") or {}]
            return f"a list of {'two: ' if len(each) == 2 else ''}{self._words(each[0])}"
        if kind == "object":
            return "fields: " + ", ".join(schema["properties"]) if schema.get("properties") else "names with values"
        return {"string": "text", "boolean": "true or false"}.get(kind, str(kind))
