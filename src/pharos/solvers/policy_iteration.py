"""Policy iteration: values of the greedy policy by linear algebra, where sweeps would take too long.

What it gives is only a better place to go on sweeping from: the bound of `fixed_point` comes from the next sweep alone.
Source: Howard (1960); Puterman (1994), section 6.4.
"""

import math

import numpy as np

from pharos.kernels import bellman
from pharos.mdp import BellmanEquation, PolicyTable, Selection, TabularMDP
from pharos.solvers.linear_systems import solution_of_system

# Sweeps before the first attempt, and before that of more than LARGE nodes: most games are solved by then. Later
# attempts come after twice as many sweeps each.
FIRST_ATTEMPT, FIRST_ATTEMPT_OF_LARGE, LARGE = 64, 512, 10_000
# Nodes (states, or pairs with a previous action) of the largest functional graph, which takes 48 bytes a state; nodes
# times actions of the largest linear system.
MOST_OF_CHAIN, MOST_ENTRIES = 5_000_000, 2_000_000
# States whose greedy actions are worked out in one go.
BLOCK = 1 << 16
# Improvements of one attempt, and the relative change by a sweep that is no more than rounding.
MOST_IMPROVEMENTS, SETTLED = 60, 2.0**-47
# Operations that calling a sweep costs, however few states there are; and those of policy iteration by sparse systems,
# for each node.
CALL, SPARSE = 5000, 50_000.0


class PolicyIteration:
    """Decides when it pays, by counting operations, and improves values."""

    def __init__(self, mdp: TabularMDP, select: Selection):
        self.mdp, self.select = mdp, select
        self.equation = BellmanEquation(mdp.reward_table, mdp.gamma, mdp.chance, select)
        self.nodes = mdp.num_states * mdp.width
        self._change = math.inf
        self._has_failed = False

    def is_worth_it(self, sweeps: int, change: float, tolerance: float) -> bool:
        """Whether the sweeps that are left cost more than solving some linear systems.

        How many are left, the last half of the sweeps tells: changes often shrink by much more than gamma in each.
        """
        if sweeps & (sweeps - 1) or self.mdp.gamma == 0.0:
            return False
        change = max(change, 1e-300)
        before, self._change = self._change, change
        if sweeps < (FIRST_ATTEMPT if self.nodes <= LARGE else FIRST_ATTEMPT_OF_LARGE):
            return False
        gamma = self.mdp.gamma
        rate = min(gamma, max(change / before, 1e-300) ** (2 / sweeps))
        left = math.log(change / (tolerance * (1 - gamma))) / -math.log(rate)
        of_sweeps = left * (CALL + 4.0 * self.nodes * self.mdp.num_actions)
        if self.is_chain:
            return self.nodes <= MOST_OF_CHAIN and of_sweeps > 1000.0 * self.nodes
        if self._has_failed or self.nodes * self.mdp.num_actions > MOST_ENTRIES:
            return False
        return of_sweeps > self.nodes * min(SPARSE, float(self.nodes) ** 2)

    @property
    def is_chain(self) -> bool:
        """Whether a deterministic policy has one way from each state."""
        policy = self.select
        return self.mdp.is_deterministic and not (isinstance(policy, PolicyTable) and policy.actions is None)

    def improve(self, x: np.ndarray) -> None:
        """Replace x (S + 1, W) by values of a policy that is greedy in its own values, or nearly so."""
        policy = self._greedy(x)
        for _ in range(MOST_IMPROVEMENTS):
            if self.is_chain and policy.actions is not None:
                values = chain_values(self.mdp.gamma, *chain(self.mdp, policy.actions))[0][:, None]
            else:
                values = linear_values(self.mdp, policy, x[:-1])
            if not np.isfinite(values).all():
                self._has_failed = True
                return
            x[:-1] = values
            if self.mdp.dynamics.sweep(self.equation, x) <= SETTLED * np.abs(x).max():
                return  # all that still changes is the policy, between actions that are equal up to rounding
            before, policy = policy, self._greedy(x)
            if policy is before or np.array_equal(policy.table, before.table):
                return

    def _greedy(self, x: np.ndarray) -> PolicyTable:
        """The policy of the best (or worst) actions by x; a given policy as it is."""
        if isinstance(self.select, PolicyTable):
            return self.select
        mdp, actions = self.mdp, np.empty(self.mdp.num_states, np.int64)
        for start in range(0, mdp.num_states, BLOCK):
            states = slice(start, min(start + BLOCK, mdp.num_states))
            q = mdp.reward_table.rows(states) + mdp.gamma * mdp.dynamics.expected(x, states)
            actions[states] = self.select.policy(q).table
        return PolicyTable(mdp.num_actions, actions=actions)


def chain(mdp: TabularMDP, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """((S,) next state, -1 for the end; (S,) reward) of a deterministic policy on a deterministic MDP."""
    table, rewards = mdp.dynamics.deterministic_table(), mdp.reward_table
    assert table is not None
    rows = np.arange(mdp.num_states)
    paid = rewards.table[rows, actions]
    return table[rows, actions].astype(np.int64), rewards.palette[paid] if len(rewards.palette) else paid


def chain_values(gamma: float, successor: np.ndarray, reward: np.ndarray) -> tuple[np.ndarray, int]:
    """((S,) values on a functional graph, in O(S); a state on a cycle of infinite value, where gamma is 1, or -1)."""
    v = np.empty(len(successor))
    return v, int(bellman.chain_values(successor, reward, gamma, v, np.empty(len(successor), np.int64)))


def linear_values(mdp: TabularMDP, policy: PolicyTable, guess: np.ndarray) -> np.ndarray:
    """(S, W): the values of a policy, as the solution of (1 - gamma P) x = r; NaN where it is not found."""
    from scipy import sparse

    states, actions, width = mdp.num_states, mdp.num_actions, mdp.width
    nodes = states * width
    # weights: (S W, S A), the probability that being in (s, b) executes a
    chosen = np.broadcast_to(policy.later, (states, width, actions)).reshape(nodes, actions)
    previous = np.tile(np.arange(width), states) if mdp.is_sticky else None
    executed = mdp.chance.weights(chosen, previous)
    columns = np.repeat(np.arange(states), width)[:, None] * actions + np.arange(actions)
    weights = sparse.csr_matrix(
        (executed.ravel(), columns.ravel(), np.arange(nodes + 1) * actions), shape=(nodes, states * actions)
    )
    weights.eliminate_zeros()
    outcomes = mdp.dynamics.matrix().tocoo()
    inside = outcomes.col < states
    row, column = outcomes.row[inside], outcomes.col[inside].astype(np.int64)
    following = column * width + (row % actions if width > 1 else 0)
    moves = sparse.csr_matrix((outcomes.data[inside], (row, following)), shape=(states * actions, nodes))
    system = sparse.identity(nodes, format="csr") - mdp.gamma * (weights @ moves)
    paid = weights @ mdp.rewards.ravel()
    return solution_of_system(system, paid, guess.reshape(nodes)).reshape(states, width)
