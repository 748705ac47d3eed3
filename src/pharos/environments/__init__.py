"""Environments: the contract of a class (`Environment`, `Layer`), the built-in classes, the catalogue of names."""

from pharos.environments.base import Components, Environment, State, start_distribution
from pharos.environments.breakout import Breakout
from pharos.environments.catalog import (
    class_of,
    classes,
    imported,
    list_environments,
    make,
    named_instances,
    on_registration,
    register,
    source_of,
)
from pharos.environments.freeway import Freeway
from pharos.environments.frozen_lake import FrozenLake
from pharos.environments.look import Color, Ground, Layer, Look, Margin, Scenery, Shape, Sprite
from pharos.environments.mini_grid import MiniGrid
from pharos.environments.parameters import (
    CELL,
    VALUED_CELLS,
    Kind,
    Parameter,
    as_tuples,
    declared_parameters,
    integers,
    one_of,
    parameter,
)
from pharos.environments.pocket_cube import PocketCube
from pharos.environments.simple_grid import SimpleGrid
from pharos.environments.sliding_tiles import SlidingTiles

__all__ = [
    "CELL",
    "VALUED_CELLS",
    "Breakout",
    "Color",
    "Components",
    "Environment",
    "Freeway",
    "FrozenLake",
    "Ground",
    "Kind",
    "Layer",
    "Look",
    "Margin",
    "MiniGrid",
    "Parameter",
    "PocketCube",
    "Scenery",
    "Shape",
    "SimpleGrid",
    "SlidingTiles",
    "Sprite",
    "State",
    "as_tuples",
    "class_of",
    "classes",
    "declared_parameters",
    "imported",
    "integers",
    "list_environments",
    "make",
    "named_instances",
    "on_registration",
    "one_of",
    "parameter",
    "register",
    "source_of",
    "start_distribution",
]
