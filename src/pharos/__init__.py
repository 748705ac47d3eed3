"""pharos: principled reinforcement-learning benchmarking.

In the order of the data flow: an Environment (`make`) is enumerated into a StateSpace (`build`, `load`), which is a
TabularMDP with its rewards (`StateSpace.mdp`), to which chance can be added (`sticky_actions`, `random_actions`), which is
solved (`value_iteration`, `evaluate_policy`) and measured (`hardness`).

Importing pharos loads nothing heavy: every name below is imported when it is first used.
"""

import importlib
from typing import Any

__version__ = "0.1.0"

_HOMES = {
    "Environment": "pharos.environment",
    "Layer": "pharos.environment",
    "make": "pharos.environment",
    "list_environments": "pharos.environment",
    "check_environment": "pharos.conformance",
    "build": "pharos.state_space",
    "load": "pharos.state_space",
    "StateSpace": "pharos.state_space",
    "TabularMDP": "pharos.mdp",
    "sticky_actions": "pharos.mdp",
    "random_actions": "pharos.mdp",
    "Solution": "pharos.solvers",
    "value_iteration": "pharos.solvers",
    "evaluate_policy": "pharos.solvers",
    "PharosError": "pharos.errors",
}
_PACKAGES = ("environments", "errors", "exporters", "hardness", "importers", "mdp", "solvers", "state_space")

__all__ = [*_HOMES, *_PACKAGES, "__version__"]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        value = getattr(importlib.import_module(_HOMES[name]), name)
        globals()[name] = value
        return value
    if name in _PACKAGES:
        return importlib.import_module(f"pharos.{name}")
    raise AttributeError(f"module 'pharos' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES, *_PACKAGES])
