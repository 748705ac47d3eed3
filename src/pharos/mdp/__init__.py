"""Tabular MDPs, and the chance that can be added to them."""

from pharos.mdp._randomization import Chance, random_actions, sticky_actions
from pharos.mdp._rewards import Rewards
from pharos.mdp._tabular import TabularMDP

__all__ = ["Chance", "Rewards", "TabularMDP", "random_actions", "sticky_actions"]
