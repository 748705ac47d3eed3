"""Enumerating states onto disk, and reading them back."""

from pharos.state_space._build import BuildProgress, build
from pharos.state_space._store import StateSpace, load

__all__ = ["BuildProgress", "StateSpace", "build", "load"]
