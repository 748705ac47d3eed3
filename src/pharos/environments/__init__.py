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
    from pharos.environments.mini_grid.mini_grid import MiniGrid as MiniGrid
    from pharos.environments.mini_grid.mini_grid_empty import MiniGridEmpty as MiniGridEmpty
    from pharos.environments.mini_grid.mini_grid_rooms import MiniGridRooms as MiniGridRooms
    from pharos.environments.worlds.blackjack import Blackjack as Blackjack
    from pharos.environments.worlds.breakout import Breakout as Breakout
    from pharos.environments.worlds.catch import Catch as Catch
    from pharos.environments.worlds.cliff_walking import CliffWalking as CliffWalking
    from pharos.environments.worlds.corner_grid import CornerGrid as CornerGrid
    from pharos.environments.worlds.deep_sea import DeepSea as DeepSea
    from pharos.environments.worlds.discounting_chain import DiscountingChain as DiscountingChain
    from pharos.environments.worlds.endless_sea import EndlessSea as EndlessSea
    from pharos.environments.worlds.freeway import Freeway as Freeway
    from pharos.environments.worlds.frozen_lake import FrozenLake as FrozenLake
    from pharos.environments.worlds.game_2048 import Game2048 as Game2048
    from pharos.environments.worlds.memory_chain import MemoryChain as MemoryChain
    from pharos.environments.worlds.pocket_cube import PocketCube as PocketCube
    from pharos.environments.worlds.river_swim import RiverSwim as RiverSwim
    from pharos.environments.worlds.simple_grid import SimpleGrid as SimpleGrid
    from pharos.environments.worlds.sliding_tiles import SlidingTiles as SlidingTiles
    from pharos.environments.worlds.sokoban import Sokoban as Sokoban
    from pharos.environments.worlds.taxi import Taxi as Taxi
    from pharos.environments.worlds.umbrella_chain import UmbrellaChain as UmbrellaChain

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

__getattr__ = lazy.attributes(__name__)
