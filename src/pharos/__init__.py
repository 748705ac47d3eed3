"""pharos: principled reinforcement-learning benchmarking.

In the order of the data flow: an Environment (`make`) is enumerated into a StateSpace (`build`, `load`), which is a
TabularMDP with its rewards (`StateSpace.mdp`), to which chance can be added (`sticky_actions`, `random_actions`,
`lazy_actions`), which is solved (`value_iteration`, `evaluate_policy`) and measured (`hardness`).

Interaction goes another way from the same Environment:
`gymnasium.make("pharos/Breakout-v0", observation="simple_image")`.

Importing pharos loads nothing heavy: every name below is imported when it is first used. Gymnasium alone is loaded at
once, so that its registry knows the environments.
"""

import os as _os
import sys as _sys


def _is_command() -> bool:
    """Whether this process began as `pharos` or `python -m pharos`, not as a program that uses the library."""
    words = getattr(_sys, "argv", None) or [""]
    if words[0] == "-m":  # as long as Python looks for the module
        return _sys.orig_argv[-len(words)] in ("pharos", "-mpharos")
    script = getattr(_sys.modules.get("__main__"), "__file__", None) or ""
    return _os.path.basename(words[0]) == _os.path.basename(script) == "pharos"


def _end_at_once(*_: object) -> None:
    try:
        _os.write(2, b"pharos: interrupted\n")
    finally:
        _os._exit(130)


if _is_command():
    import _signal  # which is there from the start: what would be loaded first could be interrupted

    if _signal.getsignal(_signal.SIGINT) is _signal.default_int_handler:
        _signal.signal(_signal.SIGINT, _end_at_once)
    from pharos.system import interrupts as _interrupts  # noqa: F401  (its `atexit` is to be the first)

import importlib
import warnings as _warnings
from typing import Any

from pharos.interaction import registration as _registration  # noqa: F401  (Gymnasium's registry)
from pharos.system.lazy import conflict as _conflict

if _conflict() is not None:
    _warnings.warn(str(_conflict()), stacklevel=2)

__version__ = "0.1.0"

_HOMES = {
    "Environment": "pharos.environments",
    "Layer": "pharos.environments",
    "make": "pharos.environments",
    "list_environments": "pharos.environments",
    "register": "pharos.environments",
    "check_environment": "pharos.state_space.conformance",
    "build": "pharos.state_space",
    "load": "pharos.state_space",
    "StateSpace": "pharos.state_space",
    "TabularMDP": "pharos.mdp",
    "sticky_actions": "pharos.mdp",
    "random_actions": "pharos.mdp",
    "lazy_actions": "pharos.mdp",
    "Solution": "pharos.solvers",
    "value_iteration": "pharos.solvers",
    "evaluate_policy": "pharos.policies",
    "observe": "pharos.observations",
    "GymEnv": "pharos.interaction",
    "make_vec": "pharos.interaction",
    "to_gymnax": "pharos.interaction",
    "train": "pharos.training",
    "train_many": "pharos.training",
    "predict": "pharos.prediction",
    "explore": "pharos.explorer",
    "PharosError": "pharos.errors",
}
# Modules that stand in another folder than their public name says.
_MODULES = {
    "bisimulation": "pharos.bisimulation",
    "experiments": "pharos.experiments",
    "leaderboard": "pharos.leaderboard",
    "sb3_env": "pharos.sb3_env",
    "validation": "pharos.validation",
}
_PACKAGES = (
    "errors",
    "environments",
    "drawing",
    "state_space",
    "mdp",
    "solvers",
    "hardness",
    "importers",
    "exporters",
    "observations",
    "interaction",
    "policies",
    "agents",
    "training",
    "prediction",
    "plots",
    "study",
    "benchmark",
    "explorer",
)

__all__ = [*_HOMES, *_PACKAGES, "bisimulation", "__version__"]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        value = getattr(importlib.import_module(_HOMES[name]), name)
        globals()[name] = value
        return value
    if name in _PACKAGES:
        return importlib.import_module(f"pharos.{name}")
    if name in _MODULES:
        return importlib.import_module(_MODULES[name])
    raise AttributeError(f"module 'pharos' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
