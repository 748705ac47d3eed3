"""Tabular MDPs, and the chance that can be added to them."""

from pharos.mdp.chance import Chance, random_actions, sticky_actions
from pharos.mdp.rewards import Rewards
from pharos.mdp.tabular import TabularMDP

__all__ = ["Chance", "Rewards", "TabularMDP", "random_actions", "sticky_actions"]
