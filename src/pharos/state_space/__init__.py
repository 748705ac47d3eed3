"""Enumerating states onto disk, and reading them back."""

from pharos.state_space.build import BuildProgress, build
from pharos.state_space.manifest import read_manifest
from pharos.state_space.store import StateSpace, load

__all__ = ["BuildProgress", "StateSpace", "build", "load", "read_manifest"]
