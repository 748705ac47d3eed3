"""The nodes of a YAML file: where they stand, and that no specification would have them so."""

import re
from typing import Any

import yaml

from pharos.errors import ParameterError

# So that every mistake is told at once, and aliases do not stand for millions of entries.
MOST_NODES = 1_000_000
Loc = tuple[int | str, ...]


class Loader(yaml.SafeLoader):
    """Safe YAML in which 1e-4 is a number, not a text."""


Loader.yaml_implicit_resolvers = {k: list(v) for k, v in yaml.SafeLoader.yaml_implicit_resolvers.items()}
Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"), list("-+0123456789.")
)


def where(name: str, root: Any, loc: Loc) -> str:
    """`file:line`, the line of the innermost node on the path that exists; the path itself where there is no file."""
    if root is None:
        return ".".join(map(str, (name, *loc)))
    node, line = root, root.start_mark.line
    for part in loc:
        if isinstance(node, yaml.MappingNode):
            pair = next(((key, value) for key, value in node.value if key.value == str(part)), None)
            if pair is None:
                break
            line, node = pair[0].start_mark.line, pair[1]
        elif isinstance(node, yaml.SequenceNode) and isinstance(part, int) and part < len(node.value):
            node = node.value[part]
            line = node.start_mark.line
        else:
            break
    return f"{name}:{line + 1}"


def check_nodes(root: Any, name: str) -> None:
    """Refuse what no specification needs: keys that are no words or repeated, nodes within themselves, millions by
    aliases.

    A node that aliases share is looked at once; its size counts wherever it stands.
    """
    sizes: dict[int, int] = {}

    def size(node: Any) -> int:
        """How many nodes stand below this one, aliases written out."""
        if id(node) in sizes:
            if not sizes[id(node)]:
                raise ParameterError(f"{name}:{node.start_mark.line + 1}: an alias stands within what it names")
            return sizes[id(node)]
        sizes[id(node)] = 0  # until all below it are counted
        children: list[Any] = []
        if isinstance(node, yaml.MappingNode):
            _check_keys(node, name)
            children = [value for _, value in node.value]
        elif isinstance(node, yaml.SequenceNode):
            children = node.value
        total = 1 + sum(map(size, children))
        if total > MOST_NODES:
            line = node.start_mark.line + 1
            raise ParameterError(f"{name}:{line}: stands for more than {MOST_NODES:,} entries, aliases written out")
        sizes[id(node)] = total
        return total

    size(root)


def _check_keys(node: Any, name: str) -> None:
    lines: dict[str, int] = {}
    for key, _ in node.value:
        line = key.start_mark.line + 1
        if not isinstance(key, yaml.ScalarNode):
            raise ParameterError(f"{name}:{line}: a key is a list or a mapping; expected a word")
        if key.value in lines:
            raise ParameterError(f"{name}:{line}: the key {key.value!r} stands there twice (line {lines[key.value]})")
        lines[key.value] = line
