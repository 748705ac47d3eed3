"""Tabular MDPs: dynamics, rewards, the chance that can be added, and what is chosen."""

from pharos.mdp.chance import Chance, random_actions, sticky_actions
from pharos.mdp.dynamics import BellmanEquation, Dynamics, Outcomes, Play
from pharos.mdp.matrices import Matrices
from pharos.mdp.rewards import Rewards
from pharos.mdp.rewards_of_space import rewards_of_space
from pharos.mdp.selection import BEST, WORST, Extreme, PolicyTable, Selection
from pharos.mdp.table import Table
from pharos.mdp.tabular import TabularMDP

__all__ = [
    "BEST",
    "WORST",
    "BellmanEquation",
    "Chance",
    "Dynamics",
    "Extreme",
    "Matrices",
    "Outcomes",
    "Play",
    "PolicyTable",
    "Rewards",
    "Selection",
    "Table",
    "TabularMDP",
    "random_actions",
    "rewards_of_space",
    "sticky_actions",
]
