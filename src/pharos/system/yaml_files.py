"""YAML that somebody else may have written: data alone, and refused in one line if no file of pharos needs it."""

import re
from pathlib import Path
from typing import Any

from pharos.errors import MissingExtra, ParameterError, PharosError
from pharos.system.storage import check_regular

try:
    import yaml
except ImportError as error:
    raise MissingExtra("reading YAML", "pyyaml", "study") from error

# Limit that keeps aliases from standing for millions of entries
MOST_YAML_NODES = 1_000_000


class Loader(yaml.SafeLoader):
    """Safe YAML in which 1e-4 is a number, not a text."""


Loader.yaml_implicit_resolvers = {k: list(v) for k, v in yaml.SafeLoader.yaml_implicit_resolvers.items()}
Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"), list("-+0123456789.")
)


def read_yaml(path: Path, error: type[PharosError] = ParameterError) -> object:
    """The data in a file. Raises `error`, one line that names file and line, if it is no YAML that pharos reads."""
    return nodes_and_data(read_text(path, error), str(path), error)[1]


def read_text(path: Path, error: type[PharosError] = ParameterError) -> str:
    """The text of a file. A pipe or a device is refused before it is opened."""
    try:
        check_regular(path)
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as problem:
        raise error(f"{path}: byte {problem.start} is not UTF-8; expected a text file in YAML") from problem
    except OSError as problem:
        raise error(f"{path}: cannot be read ({problem.strerror}); expected a YAML file") from problem


def nodes_and_data(text: str, name: str, error: type[PharosError] = ParameterError) -> tuple["yaml.Node | None", Any]:
    """(root node, data) of a text in YAML, both None for an empty one. Raises `error`, which begins with `name`."""
    try:
        root = yaml.compose(text, Loader)
        if root is not None:
            _check_nodes(root, name)
        return root, yaml.load(text, Loader)
    except yaml.YAMLError as problem:
        mark = getattr(problem, "problem_mark", None)
        position = f"{name}:{mark.line + 1}" if mark is not None else name
        raise error(f"{position}: {getattr(problem, 'problem', None) or 'this is no YAML'}") from problem
    except RecursionError:
        raise error(f"{name}: is nested too deeply; expected a mapping with names") from None
    except ParameterError as problem:
        raise error(str(problem)) from None
    except (ValueError, OverflowError) as problem:  # numbers and dates that Python cannot hold
        raise error(f"{name}: {' '.join(str(problem).split())}") from problem


def _check_nodes(root: "yaml.Node", name: str) -> None:
    """Refuse what no file needs: keys that are no words or repeated, nodes within themselves, millions by aliases.

    A node that aliases share is looked at once. Its size counts at each alias.
    """
    sizes: dict[int, int] = {}

    def size(node: "yaml.Node") -> int:
        """Number of nodes of the tree from this one on, aliases written out."""
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
        if total > MOST_YAML_NODES:
            line = node.start_mark.line + 1
            raise ParameterError(
                f"{name}:{line}: stands for more than {MOST_YAML_NODES:,} entries, aliases written out"
            )
        sizes[id(node)] = total
        return total

    size(root)


def _check_keys(node: "yaml.Node", name: str) -> None:
    lines: dict[str, int] = {}
    for key, _ in node.value:
        line = key.start_mark.line + 1
        if not isinstance(key, yaml.ScalarNode):
            raise ParameterError(f"{name}:{line}: a key is a list or a mapping; expected a word")
        if key.value in lines:
            raise ParameterError(f"{name}:{line}: the key {key.value!r} stands there twice (line {lines[key.value]})")
        lines[key.value] = line
