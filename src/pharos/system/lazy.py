"""Lazy packages, which load a file when something in it is first used (PEP 562), and a conflict of installations.

`import pharos` and a script's first lines need few of the names that a package publishes. The others cost nothing then.

The distribution `pharos-rl` is this project. The distribution `pharos` is Graviti's SDK for pictures, whose files lie
in the same folder if both are installed. The one installed last has replaced the other's `__init__.py`.
"""

import ast
import functools
import importlib
import sys
from collections.abc import Callable
from pathlib import Path


def attributes(package: str) -> Callable[[str], object]:
    """The `__getattr__` of a package: the names that its `__init__.py` imports under `TYPE_CHECKING`, modules included.

    Args:
        package: its `__name__`.
    Returns:
        Function(name) -> what the module has under this name, which the package keeps. AttributeError for other names.
    """

    @functools.cache
    def origins() -> dict[str, tuple[str, str]]:
        module = sys.modules[package]
        tree = ast.parse(module.__loader__.get_source(package))  # type: ignore[union-attr]  # also inside of a zip
        blocks = [node for node in tree.body if isinstance(node, ast.If)]
        imports = [node for block in blocks for node in block.body if isinstance(node, ast.ImportFrom)]
        return {alias.asname or alias.name: (str(node.module), alias.name) for node in imports for alias in node.names}

    def attribute(name: str) -> object:
        if name.startswith("__") or name not in origins():
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, name_there = origins()[name]
        if module == package:
            return importlib.import_module(f"{package}.{name_there}")
        value = getattr(importlib.import_module(module), name_there)
        setattr(sys.modules[package], name, value)
        return value

    return attribute


# Installation ---------------------------------------------------------------------------------------------------------


FOREIGN_FILE = "__version__.py"
"""A file of Graviti's package; this one has none of that name."""


def conflict(folder: Path | None = None) -> str | None:
    """Message about the other project in the same folder, and how to mend it. None if it is not there.

    Args:
        folder: of the package. Default: of pharos.
    """
    folder = folder or Path(__file__).parents[1]
    if not (folder / FOREIGN_FILE).exists():
        return None
    return (
        f"the distribution 'pharos' (Graviti's SDK, another project) is installed in the folder of pharos-rl, "
        f"{folder}, and each overwrites files of the other; "
        f"to mend it: pip uninstall pharos pharos-rl; pip install pharos-rl"
    )
