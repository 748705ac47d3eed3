"""Values component by component: where states cannot come back, those behind them are solved first.

A strongly connected component needs the values of those that it leads to, and no others. Sweeps over all states
go on over those that are long settled, and a component settles only after those behind it; one after another, from the
last to the first, each is swept until it is settled, and states without a cycle once.

What it gives is a better place to go on sweeping from, as that of policy_iteration.py: the bound of `fixed_point` comes
from the next sweep over all states, and nothing has to be proven of components.
Source: Dai, Mausam, Weld and Goldsmith (2011), "Topological value iteration algorithms".
"""

import math

import numpy as np

from pharos.mdp import BellmanEquation, PolicyTable, Selection, TabularMDP
from pharos.solvers.convergence import SETTLED, operations, shrinking, sweeps_left
from pharos.system.memory import available_memory

# Sweeps before the attempt, and how many must be left: finding components takes as long as some tens of them.
FIRST_ATTEMPT, LEFT = 32, 100
# Operations that must be left: fewer take less time than compiling.
WORTH = 5e8
# States under sticky actions that are swept in one call, at least.
LEAST = 512
# Sweeps over all states that an attempt may cost, at most: near gamma = 1 those that are left are without number.
MOST = 4096
# Bytes of a state that an attempt takes, at most.
BYTES = 48
# The share of the change that the tolerance allows which a component may have left.
SHARE = 0.25


class ComponentSolver:
    """Decides once whether components pay, by counting operations, and improves values."""

    def __init__(self, mdp: TabularMDP, select: Selection):
        self.mdp, self.select = mdp, select
        self.equation = BellmanEquation(mdp.reward_table, mdp.gamma, mdp.chance, select)
        self._change, self._left = math.inf, 0.0
        self._is_tried = False

    def is_worth_it(self, sweeps: int, change: float, tolerance: float) -> bool:
        """Whether the sweeps that are left cost more than an attempt."""
        if self._is_tried or sweeps & (sweeps - 1) or not 0 < change < math.inf:
            return False
        before, self._change = self._change, change
        gamma = self.mdp.gamma
        if sweeps < FIRST_ATTEMPT or gamma == 0.0 or not self._is_known:
            return False
        self._left = sweeps_left(change, shrinking(change, before, sweeps, gamma), tolerance, gamma)
        return self._left > LEFT and operations(self.mdp, self._left) > WORTH and self._fits

    def improve(self, x: np.ndarray, tolerance: float) -> bool:
        """Settle the components of x (S + 1, W) one after another; whether that was tried.

        An attempt may cost half of the sweeps that seem to be left, and `MOST`; then each component that is left is
        swept once.
        """
        mdp, self._is_tried = self.mdp, True
        components = mdp.dynamics.components(~np.asarray(mdp.terminal), LEAST if mdp.is_sticky else 1)
        if components is None or components.largest > mdp.num_states // 2:
            return False
        target = SHARE * tolerance * (1 - mdp.gamma)
        with np.errstate(over="ignore", invalid="ignore"):
            most = min(0.5 * self._left, MOST) * mdp.num_states
            mdp.dynamics.settle_components(self.equation, x, components, target, SETTLED, most)
        return True

    @property
    def _is_known(self) -> bool:
        """Whether parts can be swept, and a policy may have several ways from a state: one way is solved at once."""
        if isinstance(self.select, PolicyTable):
            return self.select.actions is not None and not self.mdp.is_deterministic
        return not self.mdp.is_deterministic

    @property
    def _fits(self) -> bool:
        """Whether memory has room for what an attempt takes, and for the transitions, which are read out of order."""
        each = BYTES + 4 * self.mdp.num_actions
        return each * self.mdp.num_states <= available_memory()
