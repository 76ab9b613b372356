"""Reads a YAML file into a typed struct; errors name file, line, field, the value and what is allowed."""

import os
import stat
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from link.cli import BadInput
from plume.mistakes.explained import Fields, dotted, explained, short, shown

T = TypeVar("T")
MOST_BYTES = 250_000  # reading a file of this size takes a few seconds; no mission needs more
MOST_VALUES = 100_000  # with every alias expanded: nine short lines can expand to a billion values
MOST_DIGITS = 1000  # digits of a whole number: Python refuses to print more than 4300
TEXT, WHOLE, MERGE = (f"tag:yaml.org,2002:{name}" for name in ("str", "int", "merge"))


class Document:
    """A YAML file's value, and the line of each field."""

    def __init__(self, path: Path) -> None:
        """Read the file; raises BadInput if it cannot be read or is not valid YAML."""
        self.path = path
        yaml = YAML(typ="safe", pure=True)  # YAML 1.2: `on` is a word, 1e3 a number
        try:
            self._root: Node | None = yaml.compose(_read(path))
            self._check_nodes()
            self.value: Any = yaml.constructor.construct_document(self._root) if self._root else {}
        except BadInput:
            raise
        except MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            raise self._at(
                mark.line + 1 if mark else 1, f"not valid YAML: {error.problem or error.context}"
            ) from None
        except (YAMLError, RecursionError, ValueError) as error:
            raise BadInput(f"{path}: not valid YAML: {str(error).splitlines()[0]}") from None
        except LookupError:  # such as `!!bool perhaps`
            raise BadInput(f"{path}: not valid YAML: a value does not match its tag") from None

    def to(self, kind: type[T]) -> T:
        """Return the value as a struct of this kind; raises BadInput."""
        try:
            return msgspec.convert(self.value, kind)
        except msgspec.ValidationError as error:
            raise self.error(*explained(error, self.value, kind)) from None

    def given(self, name: str) -> Any:
        """Return the value of a field, such as agent.budget; None if it has none."""
        value = self.value
        for field in name.split("."):
            value = value.get(field) if isinstance(value, dict) else None
        return value

    def error(self, fields: Fields, text: str) -> BadInput:
        """Return an error with this text about a field, with its file and line."""
        return self._at(self._line(fields), f"{dotted(fields) + ': ' if fields else ''}{text}")

    def _at(self, line: int, text: str) -> BadInput:
        return BadInput(f"{self.path}:{line}: {short(text, 1000)}")

    def _check_nodes(self) -> None:
        """Refuse too many values, too long numbers, names that are not text, and duplicate names."""
        nodes = [self._root] if self._root else []
        count = 0
        while nodes:
            node = nodes.pop()
            count += 1
            if count > MOST_VALUES:
                raise BadInput(
                    f"{self.path}: more than {MOST_VALUES:,} values (with aliases expanded) are not allowed"
                )
            if isinstance(node, MappingNode):
                self._check_names(node)
                nodes += [part for pair in node.value for part in pair]
            elif isinstance(node, SequenceNode):
                nodes += node.value
            elif node.tag == WHOLE and len(node.value) > MOST_DIGITS:
                raise self._at(
                    _line_of(node),
                    f"a number of {len(node.value):,} digits is not allowed; wanted {MOST_DIGITS:,} at most",
                )

    def _check_names(self, node: MappingNode) -> None:
        lines: dict[str, int] = {}
        for name, _ in node.value:
            line = _line_of(name)
            if name.tag not in (TEXT, MERGE) or "`" in name.value:  # msgspec quotes names with backticks
                found = shown(name.value) if isinstance(name, ScalarNode) else "a list or an object"
                raise self._at(line, f"{found} is not allowed as a field name; wanted text")
            if name.value in lines:
                raise self._at(
                    line,
                    f'found duplicate key "{shown(name.value)}"; '
                    f"the first one is in line {lines[name.value]}",
                )
            lines[name.value] = line

    def _line(self, fields: Fields) -> int:
        """Return the line of a field, or where there is none, of the innermost object or list around it."""
        node, line = self._root, _line_of(self._root) if self._root else 1
        for field in fields:
            pairs: list[tuple[Node, Node]] = []
            if isinstance(node, MappingNode):
                pairs = [pair for pair in node.value if pair[0].value == field]
            elif isinstance(node, SequenceNode) and isinstance(field, int):
                pairs = [(item, item) for item in node.value[field : field + 1]]
            if not pairs:
                break
            name, node = pairs[0]
            line = _line_of(name)
        return line


def _line_of(node: Node) -> int:
    return int(node.start_mark.line) + 1


def _read(path: Path) -> str:
    """Return the text of a file; raises BadInput. Does not block on a pipe."""
    try:
        with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
            about = os.fstat(file.fileno())
            if not stat.S_ISREG(about.st_mode):
                raise BadInput(f"{path}: a pipe or a device is not allowed; wanted a file")
            content = file.read(MOST_BYTES + 1)
    except OSError as error:
        raise BadInput(f"{path}: {error.strerror}") from None
    if len(content) > MOST_BYTES:
        raise BadInput(
            f"{path}: {max(about.st_size, len(content)):,} bytes are not allowed; wanted {MOST_BYTES:,} at "
            "most"
        )
    try:
        return content.decode()
    except UnicodeDecodeError:
        raise BadInput(f"{path}: not valid UTF-8") from None
