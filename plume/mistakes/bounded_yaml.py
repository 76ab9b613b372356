"""Reads the value of a YAML text from anybody, within limits."""

from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.nodes import MappingNode, SequenceNode

# Of a text, with every alias and merge key expanded: ten short lines can expand to ten billion values.
MOST_VALUES = 20_000


def value_of(text: str | bytes) -> Any:
    """Return the value of a YAML text. Raises ValueError, YAMLError, LookupError or RecursionError."""
    yaml = YAML(typ="safe", pure=True)
    root = yaml.compose(text)
    nodes, count = [root] if root else [], 0
    while nodes:
        node, count = nodes.pop(), count + 1
        if count > MOST_VALUES:
            raise ValueError(f"more than {MOST_VALUES:,} values, with aliases expanded, are not allowed")
        if isinstance(node, SequenceNode):
            nodes += node.value
        elif isinstance(node, MappingNode):
            nodes += [part for pair in node.value for part in pair]
    return yaml.constructor.construct_document(root) if root else None
