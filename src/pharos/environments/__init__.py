"""Environments: the contract of a class (`Environment`, `Layer`), the built-in classes, the catalogue of names.

`import pharos` needs the names of the built-in classes alone. A file is loaded when something in it is first used.
BUILT_IN lists the classes, such as `environments.Breakout`.
"""

import importlib
from typing import TYPE_CHECKING

from pharos.environments.built_in import BUILT_IN, BuiltIn, on_registration
from pharos.system import lazy

if TYPE_CHECKING:
    from pharos.environments.base import (
        CELL,
        CELLS,
        NO_ACTION,
        VALUED_CELLS,
        Color,
        Components,
        Environment,
        Ground,
        Kind,
        Layer,
        Look,
        Margin,
        Parameter,
        Scenery,
        Shape,
        Sprite,
        State,
        as_tuples,
        declared_parameters,
        integers,
        one_of,
        parameter,
        start_distribution,
    )
    from pharos.environments.catalog import (
        class_called,
        class_of,
        class_source,
        classes,
        import_class,
        instance_name,
        list_environments,
        make,
        named_instances,
        register,
    )

__all__ = [
    "Environment",
    "Layer",
    "Look",
    "Scenery",
    "State",
    "classes",
    "list_environments",
    "make",
    "parameter",
    "register",
]

_FILES = {entry.class_name: entry.file for entry in BUILT_IN}
_attribute = lazy.attributes(__name__)


def __getattr__(name: str) -> object:
    if name in _FILES:
        return getattr(importlib.import_module(f"{__name__}.{_FILES[name]}"), name)
    return _attribute(name)
