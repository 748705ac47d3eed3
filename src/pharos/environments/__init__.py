"""The environments that `pharos.make` knows: name -> class, and the named instances of the paper.

This is the only list of environments. A user's own class joins it with `register`.
"""

from collections.abc import Mapping
from typing import Any

from pharos.environment import Environment
from pharos.environments._breakout import Breakout
from pharos.environments._simple_grid import SimpleGrid

__all__ = ["Breakout", "SimpleGrid", "classes", "named_instances", "register"]

_CLASSES: dict[str, type[Environment]] = {cls.name: cls for cls in (SimpleGrid, Breakout)}


def classes() -> dict[str, type[Environment]]:
    """Name -> class of every environment, the registered ones last."""
    return dict(_CLASSES)


def named_instances() -> dict[str, tuple[str, Mapping[str, Any]]]:
    """Name -> (name of the class, parameters) of the paper's instances, in the order of its tables."""
    instances: dict[str, tuple[str, Mapping[str, Any]]] = {}
    for size in (4, 6, 8):
        square = {"height": size, "width": size}
        decoy = {**square, "rewards": (((size // 2, size // 2), 0.1),)}
        instances[f"simple_grid/{size}x{size}-decoy"] = ("simple_grid", decoy)
        instances[f"simple_grid/{size}x{size}-plain"] = ("simple_grid", square)
    for extra in (0, 1):
        for height, columns in ((12, 10), (12, 8), (16, 8), (20, 8), (24, 8)):
            parameters = {"height": height, "columns": columns, "extra_paddle_width": extra}
            instances[f"breakout/{height}x{columns}x{1 + 2 * extra}"] = ("breakout", parameters)
    for height, columns, width in ((14, 8, 1), (14, 10, 3), (20, 10, 1), (20, 10, 3), (24, 10, 3)):
        parameters = {"height": height, "columns": columns, "extra_paddle_width": (width - 1) // 2}
        instances[f"breakout/{height}x{columns}x{width}"] = ("breakout", parameters)
    return instances


def register(cls: type[Environment]) -> type[Environment]:
    """Make the user's class reachable as `pharos.make(cls.name)`; usable as a decorator. Returns `cls`."""
    _CLASSES[cls.name] = cls
    return cls
