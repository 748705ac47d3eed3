"""Enumerating states onto disk, and reading them back."""

from pharos.state_space.build import build, cached_folder
from pharos.state_space.manifest import read_manifest
from pharos.state_space.memory import available_memory
from pharos.state_space.memory_map import large_zeros, read_ahead
from pharos.state_space.progress import BuildProgress
from pharos.state_space.store import StateSpace, load

__all__ = [
    "BuildProgress",
    "StateSpace",
    "available_memory",
    "build",
    "cached_folder",
    "large_zeros",
    "load",
    "read_ahead",
    "read_manifest",
]
