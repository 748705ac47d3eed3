"""Environments: the contract of a class (`Environment`, `Layer`), the built-in classes, and the catalogue of their names."""

from pharos.environments.base import Components, Environment, Layer, State, start_distribution
from pharos.environments.breakout import Breakout
from pharos.environments.catalog import classes, imported, list_environments, make, named_instances, register
from pharos.environments.freeway import Freeway
from pharos.environments.frozen_lake import FrozenLake
from pharos.environments.simple_grid import SimpleGrid

__all__ = [
    "Breakout",
    "Components",
    "Environment",
    "Freeway",
    "FrozenLake",
    "Layer",
    "SimpleGrid",
    "State",
    "classes",
    "imported",
    "list_environments",
    "make",
    "named_instances",
    "register",
    "start_distribution",
]
