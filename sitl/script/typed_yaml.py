"""Typed YAML files: read into a struct, with errors that name file, line, field, what was found and what is allowed."""

import os
import stat
from collections.abc import Collection
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from sitl.script.mistakes import Fields, dotted, find, finite, short, shown

T = TypeVar("T")

MOST_BYTES = 250_000
"""Reading this much takes a few seconds, and no mission needs as much."""
MOST_VALUES = 100_000
"""With each alias counted as what it stands for: nine short lines can stand for a thousand million values."""
MOST_DIGITS = 1000
"""Of a whole number: Python refuses to write down one of more than 4300."""
TEXT, WHOLE, MERGE = (f"tag:yaml.org,2002:{name}" for name in ("str", "int", "merge"))


class FileError(ValueError):
    """A file that cannot be used; the text is one line."""


class Document:
    """One YAML file with the places of its fields."""

    def __init__(self, path: Path) -> None:
        """Read it; raises FileError where it cannot be read or is no YAML."""
        self.path = path
        self._names: dict[Node, dict[str, tuple[Node, Node]]] = {}
        yaml = YAML(typ="safe", pure=True)  # YAML 1.2: `on` is a word, 1e3 a number
        text = _read(path)
        try:
            self._root: Node | None = yaml.compose(text)
            self._check_nodes()
            self.value: Any = yaml.constructor.construct_document(self._root) if self._root else {}
        except FileError:
            raise
        except MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            raise self._at(mark.line + 1 if mark else 1, f"this is no YAML: {error.problem or error.context}") from None
        except (YAMLError, RecursionError, ValueError) as error:
            raise FileError(f"{path}: this is no YAML: {str(error).splitlines()[0]}") from None
        except LookupError:  # of `!!bool perhaps`
            raise FileError(f"{path}: this is no YAML: a value is not what its tag says") from None

    def to(self, kind: type[T], infinite: Collection[str] = ()) -> T:
        """Return it as a struct; raises FileError. Numbers have to be finite, but in the fields named."""
        made, reason = None, ""
        try:
            made = msgspec.convert(self.value, kind)
            if self._finite():
                return made
        except msgspec.ValidationError as error:
            reason = str(error)
        mistakes = find(self.value, kind, infinite)
        if mistakes:  # the first one in the file; but a field that is missing may be there under a wrong name
            first = min(mistakes, key=lambda mistake: (mistake.missing, self._line(mistake.fields)))
            raise self.error(first.fields, first.text)
        if made is None:
            raise self.error([], reason)
        return made

    def error(self, fields: Fields, text: str) -> FileError:
        """Return the error that says this about a field."""
        return self._at(self._line(fields), f"{dotted(fields) + ': ' if fields else ''}{text}")

    def _at(self, line: int, text: str) -> FileError:
        return FileError(f"{self.path}:{line}: {short(text, 1000)}")

    def _check_nodes(self) -> None:
        """Refuse what is too much, and names that are no text or come twice."""
        nodes = [self._root] if self._root else []
        count = 0
        while nodes:
            node = nodes.pop()
            count += 1
            if count > MOST_VALUES:
                raise FileError(f"{self.path}: more than {MOST_VALUES:,} values, aliases counted in full, are not allowed")
            if isinstance(node, MappingNode):
                self._check_names(node)
                nodes += [part for pair in node.value for part in pair]
            elif isinstance(node, SequenceNode):
                nodes += node.value
            elif node.tag == WHOLE and len(node.value) > MOST_DIGITS:
                text = f"a number of {len(node.value):,} digits is not allowed; wanted {MOST_DIGITS:,} at most"
                raise self._at(node.start_mark.line + 1, text)

    def _check_names(self, node: MappingNode) -> None:
        if node in self._names:
            return
        names = self._names[node] = {}
        for name, value in node.value:
            line = name.start_mark.line + 1
            if name.tag not in (TEXT, MERGE):
                found = shown(name.value) if isinstance(name, ScalarNode) else "a list or an object"
                raise self._at(line, f"{found} is not allowed as a name; wanted text")
            if name.value in names:
                first = names[name.value][0].start_mark.line + 1
                raise self._at(line, f'found duplicate key "{shown(name.value)}"; the first one is in line {first}')
            names[name.value] = name, value

    def _finite(self) -> bool:
        values = [self.value]
        while values:
            value = values.pop()
            if isinstance(value, dict):
                values += value.values()
            elif isinstance(value, list):
                values += value
            elif isinstance(value, int | float) and not finite(value):
                return False
        return True

    def _line(self, fields: Fields) -> int:
        """Line of a field, or of the nearest thing around it that is there."""
        node, line = self._root, 1
        if node is not None:
            line = node.start_mark.line + 1
        for field in fields:
            if isinstance(node, MappingNode) and field in (names := self._names[node]):
                key, node = names[str(field)]
                line = key.start_mark.line + 1
            elif isinstance(node, SequenceNode) and isinstance(field, int) and field < len(node.value):
                node = node.value[field]
                line = node.start_mark.line + 1
            else:
                break
        return line


def _read(path: Path) -> str:
    """Return the text of a file; raises FileError, and waits for no pipe."""
    try:
        with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
            about = os.fstat(file.fileno())
            if not stat.S_ISREG(about.st_mode):
                raise FileError(f"{path}: a pipe or a device is not allowed; wanted a file")
            content = file.read(MOST_BYTES + 1)
    except OSError as error:
        raise FileError(f"{path}: {error.strerror}") from None
    if len(content) > MOST_BYTES:
        raise FileError(f"{path}: {max(about.st_size, len(content)):,} bytes are not allowed; wanted {MOST_BYTES:,} at most")
    try:
        return content.decode()
    except UnicodeDecodeError:
        raise FileError(f"{path}: this is no UTF-8 text") from None
