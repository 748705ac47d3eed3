"""pharos: principled reinforcement-learning benchmarking.

In the order of the data flow: an Environment (`make`) is enumerated into a StateSpace (`build`, `load`), which is a
TabularMDP with its rewards (`StateSpace.mdp`), to which chance can be added (`sticky_actions`, `random_actions`,
`lazy_actions`), which is solved (`value_iteration`, `evaluate_policy`, `reach`, `average_reward`) and measured
(`hardness`).

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

import warnings as _warnings
from typing import TYPE_CHECKING

from pharos.interaction import registration as _registration  # noqa: F401  (Gymnasium's registry)
from pharos.system import lazy as _lazy

if TYPE_CHECKING:
    from pharos import (
        agents,
        benchmark,
        bisimulation,
        drawing,
        environments,
        errors,
        explorer,
        exporters,
        hardness,
        importers,
        interaction,
        mdp,
        observations,
        plots,
        policies,
        prediction,
        solvers,
        state_space,
        study,
        training,
    )
    from pharos import (
        experiments as experiments,
    )
    from pharos import (
        leaderboard as leaderboard,
    )
    from pharos import (
        sb3_env as sb3_env,
    )
    from pharos import (
        validation as validation,
    )
    from pharos.benchmark import LoopRun as Run
    from pharos.benchmark import check_agent
    from pharos.environments import Environment, Layer, list_environments, make, register
    from pharos.errors import PharosError
    from pharos.explorer import explore
    from pharos.interaction import GymEnv, make_vec, to_gymnax
    from pharos.mdp import TabularMDP, lazy_actions, random_actions, sticky_actions
    from pharos.observations import observe
    from pharos.policies import evaluate_policy
    from pharos.prediction import predict
    from pharos.solvers import Solution, average_reward, reach, value_iteration
    from pharos.state_space import StateSpace, load
    from pharos.state_space.build import build
    from pharos.state_space.conformance import check_environment
    from pharos.training import train, train_many

if _lazy.conflict() is not None:
    _warnings.warn(str(_lazy.conflict()), stacklevel=2)

__version__ = "0.1.0"

__all__ = [
    "Environment",
    "GymEnv",
    "Layer",
    "PharosError",
    "Run",
    "Solution",
    "StateSpace",
    "TabularMDP",
    "__version__",
    "agents",
    "average_reward",
    "benchmark",
    "bisimulation",
    "build",
    "check_agent",
    "check_environment",
    "drawing",
    "environments",
    "errors",
    "evaluate_policy",
    "explore",
    "explorer",
    "exporters",
    "hardness",
    "importers",
    "interaction",
    "lazy_actions",
    "list_environments",
    "load",
    "make",
    "make_vec",
    "mdp",
    "observations",
    "observe",
    "plots",
    "policies",
    "predict",
    "prediction",
    "random_actions",
    "reach",
    "register",
    "solvers",
    "state_space",
    "sticky_actions",
    "study",
    "to_gymnax",
    "train",
    "train_many",
    "training",
    "value_iteration",
]

__getattr__ = _lazy.attributes(__name__)


def __dir__() -> list[str]:
    return sorted(__all__)
