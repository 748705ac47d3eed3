"""Enumerating states onto disk, and reading them back."""

from pharos.state_space.build import build, cached_folder, is_of_state_space
from pharos.state_space.manifest import read_manifest
from pharos.state_space.progress import BuildProgress
from pharos.state_space.store import StateSpace, load

__all__ = [
    "BuildProgress",
    "StateSpace",
    "build",
    "load",
]
