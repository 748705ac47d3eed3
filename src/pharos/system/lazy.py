"""Packages that load a file when something in it is first used (PEP 562).

`import pharos` and a script's first lines need few of the names that a package publishes; the others cost nothing then.
"""

import importlib
import sys
from collections.abc import Callable, Mapping
from typing import Any


def attributes(package: str, files: Mapping[str, str]) -> Callable[[str], Any]:
    """The `__getattr__` of a package.

    Args:
        package: its `__name__`.
        files: name that the package publishes -> file of the package that has it.
    Returns:
        Function(name) -> what the file has under this name, which the package keeps; AttributeError for other names.
    """

    def attribute(name: str) -> Any:
        if name not in files:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(f"{package}.{files[name]}"), name)
        setattr(sys.modules[package], name, value)
        return value

    return attribute
