"""Agents: tabular Q-learning, and algorithms of Stable-Baselines3, one by one or batched. `pharos.training.train`
trains them on a task.
"""

from pharos.agents import batched
from pharos.agents.deep import (
    AGENTS,
    BATCHED,
    TABULAR_OBSERVATION,
    AgentKind,
    agent_kind,
    agent_source,
    algorithm,
    check_hyperparameters,
    extractor,
    is_known,
    joined_states,
    make_model,
    state_of,
)
from pharos.agents.hyperparameters import hyperparameters
from pharos.agents.q_learning import DEFAULTS as Q_LEARNING_DEFAULTS
from pharos.agents.q_learning import QLearning

__all__ = [
    "QLearning",
    "hyperparameters",
]
