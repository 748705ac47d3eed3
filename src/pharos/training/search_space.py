"""What is searched of the hyperparameters of an agent."""

import inspect
from collections.abc import Mapping, Sequence
from typing import Any

from pharos.agents import Q_LEARNING_DEFAULTS as Q_LEARNING
from pharos.agents import agent_kind, algorithm
from pharos.errors import ParameterError

SPACES: dict[str, dict[str, tuple[Any, ...]]] = {
    "q_learning": {
        "learning_rate": ("log", 0.01, 1.0),
        "visits_exponent": ("one of", 0.0, 0.6, 0.8),
        "gamma": ("one of", 0.95, 0.99, 0.999),
        "initial_q": ("one of", 0.0, 0.5, 1.0, 2.0),
        "exploration_final_eps": ("linear", 0.0, 0.1),
        "exploration_fraction": ("linear", 0.01, 0.5),
    },
    "dqn": {
        "learning_rate": ("log", 5e-5, 2e-3),
        "batch_size": ("one of", 32, 64, 128),
        "gamma": ("one of", 0.95, 0.98, 0.99, 0.995),
        "n_steps": ("one of", 1, 3, 5),
        "train_freq": ("one of", 1, 4, 8),
        "learning_starts": ("one of", 200, 1000, 5000),
        "target_update_interval": ("one of", 100, 500, 1000, 2500),
        "exploration_fraction": ("linear", 0.05, 0.5),
        "exploration_final_eps": ("linear", 0.01, 0.1),
    },
    "ppo": {
        "learning_rate": ("log", 5e-5, 2e-3),
        "n_steps": ("one of", 16, 32, 64, 128, 256),
        "n_epochs": ("one of", 4, 8),
        "gamma": ("one of", 0.95, 0.98, 0.99, 0.995),
        "gae_lambda": ("linear", 0.8, 1.0),
        "ent_coef": ("log", 1e-4, 0.1),
        "clip_range": ("one of", 0.1, 0.2, 0.3),
    },
    "a2c": {
        "learning_rate": ("log", 5e-5, 5e-3),
        "n_steps": ("one of", 5, 16, 32),
        "gamma": ("one of", 0.95, 0.98, 0.99, 0.995),
        "gae_lambda": ("linear", 0.8, 1.0),
        "ent_coef": ("log", 1e-4, 0.1),
    },
}
"""What is searched for each agent: between two bounds on a logarithmic or a linear scale, or one of some values."""


def checked_space(agent: str, space: Mapping[str, Sequence[Any]] | None) -> dict[str, tuple[Any, ...]]:
    """`space`, or that of the agent in SPACES; ParameterError where there is none, or an entry is wrong."""
    searched = space if space is not None else SPACES.get(agent)
    if not searched:
        raise ParameterError(
            f"agent {agent!r} has no space to search; expected one of {', '.join(SPACES)}, or give `space`, such as "
            f"{{'learning_rate': ('log', 0.0001, 0.01)}}"
        )
    for name, choices in searched.items():
        kind, *values = choices
        ranged = kind in ("log", "linear") and len(values) == 2 and 0 <= values[0] < values[1]
        if not (ranged and (kind == "linear" or values[0] > 0)) and not (kind == "one of" and values):
            raise ParameterError(
                f"space: {name} is {tuple(choices)!r}; expected ('log', low, high), ('linear', low, high) "
                f"or ('one of', value, ...)"
            )
    return {name: tuple(choices) for name, choices in searched.items()}


def suggested_value(trial: Any, name: str, choices: tuple[Any, ...]) -> Any:
    """The value that Optuna's trial takes."""
    kind, *values = choices
    if kind == "one of":
        return trial.suggest_categorical(name, values)
    return trial.suggest_float(name, *values, log=kind == "log")


def default_value(agent: str, name: str) -> Any:
    """What the agent itself takes for a hyperparameter that the table leaves out; None: it says nothing."""
    if agent_kind(agent).is_tabular:
        return Q_LEARNING.get(name)
    parameter = inspect.signature(algorithm(agent)).parameters.get(name)
    return None if parameter is None or parameter.default is parameter.empty else parameter.default


def allows(choices: tuple[Any, ...], value: Any) -> bool:
    """Whether a value lies in the part of the space that `choices` describe."""
    kind, *values = choices
    if kind == "one of":
        return value in values
    return isinstance(value, int | float) and values[0] <= value <= values[1]
