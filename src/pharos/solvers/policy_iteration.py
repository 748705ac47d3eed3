"""Policy iteration: values of the greedy policy by linear algebra, if sweeps would take too long.

Its result is only a better x to go on sweeping from: the bound of `fixed_point` comes from the next sweep alone.
Three ways, depending on the operator: a deterministic policy without chance has a functional graph, one pass over it
gives its values. Small systems are solved directly, large ones inexactly, by a Krylov method whose operator is a sweep
of the policy, so that nothing is stored but some vectors. Source: Howard (1960) and Puterman (1994), section 6.4.
Inexact: Gargiani et al. (2024), "Inexact policy iteration methods for large-scale Markov decision processes".

Sparse linear systems (1 - gamma P) x = r of a policy, within limits of time and memory: two families of MDPs are slow
by sweeps near gamma = 1, and each is quick by one of two methods. If states lead to near ones (rings, grids,
corridors, games of many screens), elimination in the order of Cuthill and McKee fills little in. How much is counted
beforehand. If any state soon leads anywhere, BiCGSTAB converges within some tens of steps. MDPs with neither property
are not solved here. Source: Cuthill and McKee (1969); Liu (1990), elimination trees; van der Vorst (1992), BiCGSTAB.
"""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from pharos.kernels import bellman, linear_algebra
from pharos.mdp import (
    BellmanEquation,
    PolicyTable,
    Rewards,
    Selection,
    TabularMDP,
    available_choices,
    executed_actions,
    nodes_of_outcomes,
)
from pharos.solvers.convergence import SETTLED, operations, shrinking, sweeps_left
from pharos.system.memory import available_memory

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix


# Unknowns of the largest dense system, and of the largest that is eliminated whatever it fills in.
DENSE, MOST_ELIMINATED = 400, 3000
# Steps of BiCGSTAB; by how much each call shrinks the residual; calls, each for the residual of the one before.
MOST_BICGSTAB_STEPS, SHRINKAGE, CALLS = 500, 1e-8, 4
# Entries of one factor, and multiplications: 250 MB and some seconds at most.
MOST_ATTEMPT_FILLED, MOST_ATTEMPT_MULTIPLICATIONS = 10_000_000, 5e9


def solution_of_system(system: "csr_matrix", right: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The x of system x = right, from a guess. NaN if the system is singular to the last bit, or takes too long."""
    try:
        if len(right) <= DENSE:
            return np.linalg.solve(system.toarray(), right)
        if len(right) <= MOST_ELIMINATED:
            return _eliminated(system, right)
        return _large(system, right, x)
    except (np.linalg.LinAlgError, RuntimeError):
        return np.full(len(right), np.nan)


def _eliminated(system: "csr_matrix", right: np.ndarray) -> np.ndarray:
    from scipy.sparse import linalg

    return linalg.splu(system.tocsc()).solve(right)


def _large(system: "csr_matrix", right: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The x of system x = right, by elimination if it fills little in, else by BiCGSTAB from a guess."""
    from scipy.sparse import csgraph, linalg

    order = csgraph.reverse_cuthill_mckee(system)
    ordered = system[order][:, order]
    if not fills_little(ordered):
        return iterated(system, right, x)
    # in each row the diagonal outweighs the rest, so pivots are on the diagonal, and the pattern is the one that was
    # counted
    options = {"SymmetricMode": True}
    factors = linalg.splu(ordered.tocsc(), permc_spec="NATURAL", diag_pivot_thresh=0.0, options=options)
    solved = np.empty(len(right))
    solved[order] = factors.solve(right[order])
    solved[order] += factors.solve((right - system @ solved)[order])
    return solved


def iterated(system: "csr_matrix", right: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The x of system x = right, by BiCGSTAB, repeated on the residual as far as rounding allows. NaN if divergent."""
    residual = right - system @ x
    for call in range(CALLS):
        step, left, _ = bicgstab(lambda y: system @ y, residual, SHRINKAGE, MOST_BICGSTAB_STEPS)
        if call == 0 and not left <= SHRINKAGE:
            return np.full(len(right), np.nan)
        after = right - system @ (x + step)
        if not np.abs(after).max() < np.abs(residual).max():
            break
        x, residual = x + step, after
    return x


def bicgstab(
    times: Callable[[np.ndarray], np.ndarray], right: np.ndarray, shrinkage: float, steps: int
) -> tuple[np.ndarray, float, int]:
    """(x, norm of its residual divided by the norm of `right`, applications of the operator) of `times(x) = right`,
    from 0.

    Args:
        times: the image of a vector (n,), a new array, or one that the next call may overwrite.
        shrinkage: at most this ratio of norms is enough.
        steps: of two applications each, at most.
    SciPy's adds up by BLAS, whose sums depend on the number of threads, and which waits for them on a busy machine.
    """
    from pharos.kernels import linear_algebra

    size = len(right)
    constant = float(times(np.ones(size)).mean())
    x, towards, onwards = np.zeros(size), np.empty(size), np.empty(size)
    residual, direction, moved = right.copy(), right.copy(), np.empty(size)
    total = float(right.sum())
    rho = norm = whole = linear_algebra.products(right, right)[1]
    enough, step = shrinkage * shrinkage * norm, 0
    best = norm
    with np.errstate(all="ignore"):  # a breakdown is NaN, and does not converge
        while norm > enough and step < steps:
            step += 1
            # Search direction, preconditioned: if episodes do not end, constant vectors shrink to 1 - gamma, which
            # slows all methods.
            linear_algebra.shift(direction, np.float64(total) / size / constant, towards)
            moved[:] = times(towards)
            alpha = np.float64(rho) / linear_algebra.products(right, moved)[0]
            total = linear_algebra.add_scaled(residual, -alpha, moved)
            # Stabilisation: the step along the residual that makes the new residual smallest.
            linear_algebra.shift(residual, np.float64(total) / size / constant, onwards)
            stabilised = times(onwards)
            across, own = linear_algebra.products(residual, stabilised)
            omega = np.float64(across) / own
            linear_algebra.add_scaled(x, alpha, towards)
            linear_algebra.add_scaled(x, omega, onwards)
            linear_algebra.add_scaled(residual, -omega, stabilised)
            # Next direction.
            before = rho
            rho, norm = linear_algebra.products(right, residual)
            total = linear_algebra.next_direction(
                direction, (rho / np.float64(before)) * (alpha / omega), omega, moved, residual
            )
            if not norm < 1e8 * best:
                break
            best = min(best, norm)
    ratio = math.sqrt(norm / whole) if whole > 0 and norm >= 0 else math.nan if norm != 0 else 0.0
    return x, ratio, 2 * step + 1


def fills_little(matrix: "csr_matrix") -> bool:
    """Whether elimination in the order of the rows, with pivots on the diagonal, keeps within the limits above."""
    from pharos.kernels import linear_algebra

    both = (abs(matrix) + abs(matrix).T).tocsr()
    entries = linear_algebra.entries_of_factor(both.indptr, both.indices, MOST_ATTEMPT_FILLED).astype(float)
    return bool(entries.sum() <= MOST_ATTEMPT_FILLED and entries @ entries <= MOST_ATTEMPT_MULTIPLICATIONS)


# Policy iteration -----------------------------------------------------------------------------------------------------


# Sweeps before the first attempt, and before the attempt in the inexact way, which gains less: most games are solved by
# then. Later attempts come after twice as many sweeps each, four times if they failed.
FIRST_ATTEMPT, FIRST_INEXACT = 64, 256
# Nodes times actions of the largest linear system that is solved directly, and nodes of the largest that is tried so
# at once. (Nodes are states, or pairs with a previous action.)
MOST_CHOICES, DIRECTLY = 2_000_000, 3000
# States whose greedy actions are worked out in one go.
GREEDY_BLOCK = 1 << 16
# Improvements of one attempt.
MOST_ATTEMPT_IMPROVEMENTS = 60
# Inexact: improvements of one attempt, sweeps after each, by how much each shrinks the residual of its policy, and in
# how many steps at most.
MOST_INEXACT, SWEEPS_AFTER, FORCING, MOST_OPERATOR_STEPS = 500, 20, 0.1, 100
# Bytes of a node that an attempt takes, at most, and bytes that there always are.
NODE_BYTES, LEAST_BYTES = 80, 1 << 28
# Operations of policy iteration by sparse systems, for each node.
SPARSE = 50_000.0


class PolicyIteration:
    """Policy iteration between sweeps: decides when an attempt pays, by counting operations, and improves values.

    Attributes:
        tick: called between the parts of an attempt, as often as after a few sweeps. It may raise.
    """

    def __init__(self, mdp: TabularMDP, select: Selection, tick: Callable[[], object] = bool):
        self.mdp, self.select, self.tick = mdp, select, tick
        self.equation = BellmanEquation(mdp.reward_table, mdp.gamma, mdp.chance, select)
        self.nodes = mdp.num_states * mdp.width
        self._change, self._sweeps, self._rate = math.inf, 0, 1.0
        self._failures = 0
        self.is_exact = False
        self._next = FIRST_ATTEMPT if self.is_chain or self.is_direct else FIRST_INEXACT
        self._left = 0.0

    def is_worth_it(self, sweeps: int, change: float, tolerance: float) -> bool:
        """Whether the sweeps that are left cost more than an attempt."""
        if sweeps & (sweeps - 1) or self.mdp.gamma == 0.0 or not self._fits:
            return False
        change = max(change, 1e-300)
        before, self._change, self._sweeps = self._change, change, sweeps
        if sweeps < self._next:
            return False
        gamma = self.mdp.gamma
        self._rate = shrinking(change, before, sweeps, gamma)
        self._left = left = sweeps_left(change, self._rate, tolerance, gamma)
        of_sweeps = operations(self.mdp, left)
        if self.is_chain:
            return of_sweeps > 1000.0 * self.nodes and not self.is_exact
        if self.is_direct:
            return of_sweeps > self.nodes * min(SPARSE, float(self.nodes) ** 2)
        return left > 2.0 * sweeps

    @property
    def _fits(self) -> bool:
        """Whether memory has room for what an attempt takes, some ten vectors of values."""
        return NODE_BYTES * self.nodes <= max(LEAST_BYTES, available_memory())

    @property
    def is_direct(self) -> bool:
        """Whether linear systems are solved directly: if they are small, or the inexact way has failed twice."""
        most = MOST_CHOICES if self._failures > 1 else DIRECTLY
        return self.nodes <= most and self.nodes * self.mdp.num_actions <= MOST_CHOICES

    @property
    def is_chain(self) -> bool:
        """Whether a deterministic policy has one way from each state."""
        policy = self.select
        return self.mdp.is_deterministic and not (isinstance(policy, PolicyTable) and policy.actions is None)

    def improve(self, x: np.ndarray, tolerance: float) -> None:
        """Replace x (S + 1, W) by values of a policy that is greedy in its own values, or nearly so."""
        with np.errstate(all="ignore"):  # an attempt that is not finite has failed, and is undone
            if self.is_chain or self.is_direct:
                return self._improve_exactly(x)
            before = x.copy()
            if not self._improve_inexactly(x, 0.5 * tolerance * (1 - self.mdp.gamma)):
                self.fail()
                x[:] = before

    def fail(self) -> None:
        """Note that an attempt was in vain."""
        self._failures, self._next = self._failures + 1, 4 * self._sweeps

    def _improve_exactly(self, x: np.ndarray) -> None:
        policy = self._greedy(x)
        for _ in range(MOST_ATTEMPT_IMPROVEMENTS):
            self.tick()
            before = x.copy()
            self._evaluate(x, policy)
            if not np.isfinite(x).all():
                self.fail()
                x[:] = before
                return
            change, largest = self.mdp.dynamics.sweep(self.equation, x), np.abs(x).max()
            before_this, policy = policy, self._greedy(x)
            # the policy may still change between actions that are equal up to rounding
            is_settled = change <= SETTLED * largest
            if is_settled or policy is before_this or np.array_equal(policy.table, before_this.table):
                self.is_exact = True
                break
        if self.is_chain and policy.actions is not None:
            self._refine(x, policy)

    def _evaluate(self, x: np.ndarray, policy: PolicyTable) -> None:
        """Replace x (S + 1, W) by the values of a policy."""
        if self.is_chain and policy.actions is not None:
            x[:-1, 0] = chain_values(self.mdp.gamma, *chain(self.mdp, policy.actions))[0]
        else:
            x[:-1] = linear_values(self.mdp, policy, x[:-1])

    def _refine(self, x: np.ndarray, policy: PolicyTable) -> None:
        """Solve once more for the residual that rounding has left, which adds up along a cycle of n steps and counts
        1 / (1 - gamma) times."""
        assert policy.actions is not None
        successor, reward = chain(self.mdp, policy.actions)
        left = reward + self.mdp.gamma * x[successor, 0] - x[:-1, 0]
        step = chain_values(self.mdp.gamma, successor, left)[0]
        if np.isfinite(step).all():
            x[:-1, 0] += step

    def _improve_inexactly(self, x: np.ndarray, target: float) -> bool:
        """Improve x until a sweep changes it by at most the target, or by rounding alone. Return whether that beats
        sweeps.

        An attempt may cost a third of the sweeps that seem to be left, and more as long as it is ahead of them.
        """
        # an application of the operator is a sweep and a dozen passes over vectors
        weight = 1.0 + 3.0 * self.mdp.width / self.mdp.num_actions
        most, cost, least, in_vain = max(self._sweeps, self._left / 3), 0.0, self._change, 0
        for _ in range(MOST_INEXACT):
            cost += weight * self._evaluate_roughly(x, self._greedy(x)) + SWEEPS_AFTER
            for _ in range(SWEEPS_AFTER):
                change = self.mdp.dynamics.sweep(self.equation, x)
            if not math.isfinite(change):
                return False
            if change <= max(target, SETTLED * float(np.abs(x).max())):
                return True
            in_vain = 0 if change < least else in_vain + 1
            least = min(least, change)
            is_ahead = least < self._change * self._rate**cost
            if cost > most and (not is_ahead or in_vain > 3):
                return is_ahead and in_vain == 0
        return change < self._change

    def _evaluate_roughly(self, x: np.ndarray, policy: PolicyTable) -> float:
        """Move x (S + 1, W) towards the values of a policy. Return the cost, in sweeps.

        One sweep in place is x -> G x + g with the fixed point that is sought. (1 - G) d = G x + g - x is solved for
        the step d, to a tenth. G y is a sweep from y without rewards.
        """
        mdp = self.mdp
        equation = self.equation._replace(select=policy)
        silent = equation._replace(rewards=without_rewards(mdp.reward_table))
        swept = x.copy()
        mdp.dynamics.sweep(equation, swept)
        right = (swept - x)[:-1].reshape(self.nodes)
        image = swept[:-1].reshape(self.nodes)  # a view; the row of the end stays 0

        def times(y: np.ndarray) -> np.ndarray:
            self.tick()
            image[:] = y
            mdp.dynamics.sweep(silent, swept)
            linear_algebra.subtract_from(y, image)
            return image

        step, _, applications = bicgstab(times, right, FORCING, MOST_OPERATOR_STEPS)
        x[:-1] += step.reshape(x[:-1].shape)
        return applications + 2.0

    def _greedy(self, x: np.ndarray) -> PolicyTable:
        """The policy of the best (or worst) actions by x, or a fixed policy."""
        if isinstance(self.select, PolicyTable):
            return self.select
        mdp, actions = self.mdp, np.empty(self.mdp.num_states, np.int64)
        for start in range(0, mdp.num_states, GREEDY_BLOCK):
            states = slice(start, min(start + GREEDY_BLOCK, mdp.num_states))
            q = mdp.reward_table.rows(states) + mdp.gamma * mdp.acting(mdp.dynamics.expected(x, states), states)
            sets = None if mdp.available is None else mdp.available[states]
            actions[states] = available_choices(self.select.policy(q).table, sets)
        return PolicyTable(mdp.num_actions, actions=actions)


def without_rewards(rewards: Rewards) -> Rewards:
    """Rewards of 0, stored like `rewards`."""
    zeros = np.zeros_like(rewards.table), np.zeros_like(rewards.palette)
    return Rewards(*zeros, is_of_many=rewards.is_of_many)


def chain(mdp: TabularMDP, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """((S,) next state, -1 for the end, (S,) reward) of a deterministic policy on a deterministic MDP."""
    table, rewards = mdp.dynamics.deterministic_table(), mdp.reward_table
    assert table is not None
    rows = np.arange(mdp.num_states)
    entries = rewards.table[rows, actions]
    return table[rows, actions].astype(np.int64), rewards.palette[entries] if len(rewards.palette) else entries


def chain_values(gamma: float, successor: np.ndarray, reward: np.ndarray) -> tuple[np.ndarray, int]:
    """((S,) values on a functional graph, in O(S), and if gamma is 1 a state on a cycle of infinite value, else -1)."""
    v = np.empty(len(successor))
    return v, int(bellman.solve_chain(successor, reward, gamma, v, np.empty(len(successor), np.int64)))


def linear_values(mdp: TabularMDP, policy: PolicyTable, guess: np.ndarray) -> np.ndarray:
    """(S, W): the values of a policy, as the solution of (1 - gamma P) x = r, NaN if it is not found."""
    from scipy import sparse

    states, actions, width = mdp.num_states, mdp.num_actions, mdp.width
    nodes = states * width
    pi = np.broadcast_to(policy.later, (states, width, actions)).reshape(nodes, actions)
    weights = executed_actions(mdp, pi, np.repeat(np.arange(states), width), np.tile(np.arange(width), states))
    moves = nodes_of_outcomes(mdp.dynamics.matrix()[:, :states], actions, width)
    system = sparse.identity(nodes, format="csr") - mdp.gamma * (weights @ moves)
    rewards = weights @ mdp.rewards.ravel()
    return solution_of_system(system, rewards, guess.reshape(nodes)).reshape(states, width)
