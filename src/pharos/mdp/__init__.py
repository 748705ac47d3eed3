"""Tabular MDPs: dynamics, rewards, the chance that can be added, what is chosen, and states merged."""

from pharos.mdp.arguments import takes_mdp
from pharos.mdp.bisimulation import Minimization, minimize
from pharos.mdp.chance import Chance, random_actions, sticky_actions
from pharos.mdp.dynamics import BellmanEquation, Dynamics, Outcomes, Play
from pharos.mdp.matrices import Matrices
from pharos.mdp.outcome_table import OutcomeTable
from pharos.mdp.rewards import Rewards
from pharos.mdp.rewards_of_space import rewards_of_space
from pharos.mdp.selection import BEST, WORST, Extreme, PolicyTable, Selection, chosen_mass
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
    "Minimization",
    "OutcomeTable",
    "Outcomes",
    "Play",
    "PolicyTable",
    "Rewards",
    "Selection",
    "Table",
    "TabularMDP",
    "chosen_mass",
    "minimize",
    "random_actions",
    "rewards_of_space",
    "sticky_actions",
    "takes_mdp",
]
