"""Tabular MDPs: dynamics, rewards, added chance, selections of actions, and merged states.

A file is loaded when something in it is first used: to step an environment needs `Chance` and no table.
"""

from typing import TYPE_CHECKING

from pharos.system import lazy

if TYPE_CHECKING:
    from pharos.mdp.action_sets import (
        available_choices,
        check_choices,
        checked_sets,
        drawn_actions,
        filled,
        most_actions,
        stand_ins,
        uniform_choice,
        with_sets,
    )
    from pharos.mdp.actions import (
        BEST,
        WORST,
        Chance,
        ChanceSetting,
        Extreme,
        PolicyTable,
        Selection,
        lazy_actions,
        mass_of,
        random_actions,
        sticky_actions,
    )
    from pharos.mdp.arguments import STEPS_EXPECTED, Residual, check_horizon, normalized_rows, require_mdp, whole_number
    from pharos.mdp.bisimulation import Minimization, minimize
    from pharos.mdp.dynamics import (
        BellmanEquation,
        Dynamics,
        Outcomes,
        PolicyStep,
        count_of,
        runs_between,
        runs_of,
        shares_of,
    )
    from pharos.mdp.expanded import ExpandedMDP, executed_actions, mean_of_actions, nodes_of_outcomes, outcome_matrix
    from pharos.mdp.matrices import lacking
    from pharos.mdp.names import Names, SpaceColumns, names_from, names_of
    from pharos.mdp.reachability import (
        EndComponents,
        Part,
        end_components,
        lone_starts,
        mdp_within,
        nodes_after,
        nodes_within,
        pairs_within,
        states_within,
    )
    from pharos.mdp.rewards import (
        PaidOutcomes,
        Rewards,
        paid_outcomes,
        ranged_rewards,
        rewards_of_outcomes,
        rewards_of_space,
        rewards_of_staying,
        rounding_of_mean,
    )
    from pharos.mdp.table import Lazy, Matrices, OutcomeTable, Table
    from pharos.mdp.tabular import TabularMDP

__all__ = [
    "Chance",
    "TabularMDP",
    "lazy_actions",
    "minimize",
    "random_actions",
    "sticky_actions",
]

__getattr__ = lazy.attributes(__name__)
