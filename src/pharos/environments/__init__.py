"""Environments: the contract of a class (`Environment`, `Layer`), the built-in classes, the catalogue of names.

`import pharos` needs the names of the built-in classes alone; a file is loaded when something in it is first used.
"""

from typing import TYPE_CHECKING

from pharos.environments.built_in import BUILT_IN, BuiltIn, on_registration
from pharos.system import lazy

if TYPE_CHECKING:
    from pharos.environments.base import (
        CELL,
        CELLS,
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
        classes,
        imported,
        instance_name,
        list_environments,
        make,
        named_instances,
        register,
        source_of,
    )
    from pharos.environments.mini_grid.mini_grid import MiniGrid
    from pharos.environments.mini_grid.mini_grid_empty import MiniGridEmpty
    from pharos.environments.mini_grid.mini_grid_rooms import MiniGridRooms
    from pharos.environments.worlds.blackjack import Blackjack
    from pharos.environments.worlds.breakout import Breakout
    from pharos.environments.worlds.catch import Catch
    from pharos.environments.worlds.cliff_walking import CliffWalking
    from pharos.environments.worlds.corner_grid import CornerGrid
    from pharos.environments.worlds.deep_sea import DeepSea
    from pharos.environments.worlds.discounting_chain import DiscountingChain
    from pharos.environments.worlds.endless_sea import EndlessSea
    from pharos.environments.worlds.freeway import Freeway
    from pharos.environments.worlds.frozen_lake import FrozenLake
    from pharos.environments.worlds.game_2048 import Game2048
    from pharos.environments.worlds.memory_chain import MemoryChain
    from pharos.environments.worlds.pocket_cube import PocketCube
    from pharos.environments.worlds.river_swim import RiverSwim
    from pharos.environments.worlds.simple_grid import SimpleGrid
    from pharos.environments.worlds.sliding_tiles import SlidingTiles
    from pharos.environments.worlds.sokoban import Sokoban
    from pharos.environments.worlds.taxi import Taxi
    from pharos.environments.worlds.umbrella_chain import UmbrellaChain

__all__ = [
    "Blackjack",
    "Breakout",
    "Catch",
    "CliffWalking",
    "CornerGrid",
    "DeepSea",
    "DiscountingChain",
    "EndlessSea",
    "Environment",
    "Freeway",
    "FrozenLake",
    "Game2048",
    "Layer",
    "Look",
    "MemoryChain",
    "MiniGrid",
    "MiniGridEmpty",
    "MiniGridRooms",
    "PocketCube",
    "RiverSwim",
    "Scenery",
    "SimpleGrid",
    "SlidingTiles",
    "Sokoban",
    "State",
    "Taxi",
    "UmbrellaChain",
    "classes",
    "list_environments",
    "make",
    "parameter",
    "register",
]
_shared = """
    BUILT_IN BuiltIn CELL CELLS Color Components Ground Kind Margin Parameter Shape Sprite VALUED_CELLS as_tuples
    class_called class_of declared_parameters imported instance_name integers named_instances on_registration one_of
    source_of start_distribution
"""

__getattr__ = lazy.attributes(__name__)
