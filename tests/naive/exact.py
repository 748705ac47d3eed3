"""Values of small MDPs in exact fractions: what a proven error bound is held against."""

from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np

from naive import mdp as naive_mdp
from pharos.mdp import OutcomeTable


def exact(array):
    """The same numbers as fractions."""
    array = np.asarray(array)
    return array.copy() if array.dtype == object else np.vectorize(Fraction, otypes=[object])(array.astype(float))


@dataclass(frozen=True)
class AsGiven:
    """An MDP with the rewards and the laziness that were asked for, in fractions, before any of them was rounded.

    Attributes:
        mdp: for all else. rewards: (S, A) fractions. laziness: of all in one.
        tables: the MDP without laziness; None: `mdp` is.
    """

    mdp: object
    rewards: np.ndarray
    laziness: Fraction = Fraction(0)
    tables: object = None

    def __getattr__(self, name):
        return getattr(self.mdp, name)

    def lazy(self, p, staying):
        """With probability p nothing happens, which pays `staying` (S, A)."""
        p = Fraction(p)
        rewards = (1 - p) * self.rewards + p * exact(staying)
        return replace(self, rewards=rewards, laziness=1 - (1 - self.laziness) * (1 - p))


def outcomes(mdp, s, x):
    """[(next state, probability)] of executing x in s; what is missing ends."""
    if isinstance(mdp, AsGiven):
        stays = mdp.laziness
        return [(t, (1 - stays) * p) for t, p in outcomes(mdp.tables or mdp.mdp, s, x)] + [(s, stays)] * bool(stays)
    if isinstance(mdp.dynamics, OutcomeTable):
        return [(t, Fraction(p)) for t, p in naive_mdp.listed(mdp.dynamics, s, x) if t >= 0]
    if mdp.transitions is None:
        t = int(mdp.next_states[s, x])
        return [] if t < 0 else [(t, Fraction(1))]
    row = mdp.transitions[s * mdp.num_actions + x]
    return [(int(t), Fraction(float(p))) for t, p in zip(row.indices, row.data, strict=True)]


def values_of(mdp, policy):
    """(S, W) fractions: values of a policy, (S, B, A) fractions, B = 1 or W previous actions."""
    width = mdp.num_actions if mdp.is_sticky else 1
    size, gamma = mdp.num_states * width, Fraction(mdp.gamma)
    rewards = exact(mdp.rewards)
    rows = []
    for s in range(mdp.num_states):
        for b in range(width):
            row = [Fraction(0)] * (size + 1)
            row[s * width + b] += 1
            executed = executed_actions(mdp, list(policy[s, b if policy.shape[1] > 1 else 0]), b)
            for x, p in enumerate(executed):
                row[size] += p * rewards[s, x]
                for t, probability in outcomes(mdp, s, x):
                    row[t * width + (x if width > 1 else 0)] -= gamma * p * probability
            rows.append(row)
    return np.array(solved(rows), object).reshape(mdp.num_states, width)


def executed_actions(mdp, chosen, b):
    """[A] fractions: which action is executed after b."""
    chance, num_actions = mdp.chance, mdp.num_actions
    result = [Fraction(chance.chosen) * p + Fraction(chance.uniform) / num_actions for p in chosen]
    result[b] += Fraction(chance.previous)
    return result


def solved(rows):
    """The solution of a linear system, rows (N, N + 1), by elimination."""
    size = len(rows)
    for i in range(size):
        pivot = next(j for j in range(i, size) if rows[j][i] != 0)
        rows[i], rows[pivot] = rows[pivot], rows[i]
        for j in range(i + 1, size):
            if rows[j][i] != 0:
                factor = rows[j][i] / rows[i][i]
                rows[j] = [y - factor * x for x, y in zip(rows[i], rows[j], strict=True)]
    result = [Fraction(0)] * size
    for i in range(size - 1, -1, -1):
        rest = sum((rows[i][j] * result[j] for j in range(i + 1, size)), Fraction(0))
        result[i] = (rows[i][size] - rest) / rows[i][i]
    return result


def action_values(mdp, v):
    """(S, A) fractions: r + gamma E v(next), v (S, W)."""
    q, gamma = exact(mdp.rewards), Fraction(mdp.gamma)
    for s in range(mdp.num_states):
        for x in range(mdp.num_actions):
            column = x if v.shape[1] > 1 else 0
            q[s, x] += gamma * sum((p * v[t, column] for t, p in outcomes(mdp, s, x)), Fraction(0))
    return q


def extreme_values(mdp, sign=1):
    """(S, W) fractions: optimal (or worst) values, by policy iteration."""
    actions = np.zeros(mdp.num_states, int)
    while True:
        policy = exact(np.eye(mdp.num_actions)[actions])[:, None]
        v = values_of(mdp, policy)
        q = sign * action_values(mdp, v)
        better = [int(max(range(mdp.num_actions), key=lambda a, row=row: row[a])) for row in q]
        improved = [s for s in range(mdp.num_states) if q[s, better[s]] > q[s, actions[s]]]
        if not improved:
            return v
        actions[improved] = np.array(better)[improved]


def largest_error(found, truth):
    """max |found - truth| as a fraction."""
    return max(abs(Fraction(float(f)) - t) for f, t in zip(np.ravel(found), truth.ravel(), strict=True))
