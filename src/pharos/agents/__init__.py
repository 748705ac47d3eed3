"""Agents: tabular Q-learning, and algorithms of Stable-Baselines3. `pharos.experiments.train` trains them on a task."""

from pharos.agents.hyperparameters import hyperparameters
from pharos.agents.q_learning import QLearning

__all__ = ["QLearning", "hyperparameters"]
