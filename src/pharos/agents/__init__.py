"""Agents: tabular Q-learning, and algorithms of Stable-Baselines3. `pharos.experiments.train` trains them on a task."""

from pharos.agents.hyperparameters import hyperparameters
from pharos.agents.kinds import AGENTS, TABULAR_OBSERVATION, AgentKind, agent_kind, agent_source, is_known
from pharos.agents.q_learning import QLearning

__all__ = [
    "AGENTS",
    "TABULAR_OBSERVATION",
    "AgentKind",
    "QLearning",
    "agent_kind",
    "agent_source",
    "hyperparameters",
    "is_known",
]
