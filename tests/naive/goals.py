"""Total rewards by trying every policy, in rational numbers: the slow twin of pharos.solvers.goals."""

import itertools
from fractions import Fraction

import numpy as np

from naive import mdp as naive_mdp


def written_out(mdp):
    """{node: [(reward, size, {node or None: probability})]} of the nodes that are not over, exactly as floats have it.

    Nodes are states; under sticky actions pairs (state, action executed before). `size` is the mean absolute reward.
    """
    nodes = {}
    for s in np.flatnonzero(~np.asarray(mdp.terminal)).tolist():
        for b in range(mdp.width) if mdp.is_sticky else [None]:
            nodes[s, b] = [_choice(mdp, s, b, a) for a in range(mdp.num_actions)]
    return nodes


def _choice(mdp, s, b, a):
    weights = naive_mdp.executed(mdp, mdp.num_actions if b is None else b)[a]
    total = sum(map(Fraction, weights.tolist()))
    reward, size, after = Fraction(0), Fraction(0), {}
    for x, weight in enumerate(weights.tolist()):
        paid = Fraction(float(mdp.rewards[s, x]))
        weight = Fraction(weight) / total
        reward, size = reward + weight * paid, size + weight * abs(paid)
        if not weight:
            continue
        outcomes = [(t, Fraction(p)) for t, p in naive_mdp.outcomes(mdp, s, x) if p > 1e-15]
        mass = sum(p for _, p in outcomes)
        for t, p in outcomes:
            node = None if t < 0 or mdp.terminal[t] else (t, b if b is None else x)
            after[node] = after.get(node, Fraction(0)) + weight * p / mass
    return reward, size, after


def solve(system, right):
    """Gaussian elimination."""
    rows = [[*row, value] for row, value in zip(system, right, strict=True)]
    size = len(rows)
    for i in range(size):
        pivot = next(j for j in range(i, size) if rows[j][i])
        rows[i], rows[pivot] = rows[pivot], rows[i]
        rows[i] = [entry / rows[i][i] for entry in rows[i]]
        for j in range(size):
            if j != i and rows[j][i]:
                rows[j] = [x - rows[j][i] * y for x, y in zip(rows[j], rows[i], strict=True)]
    return [row[-1] for row in rows]


def classes_of(chain):
    """Recurrent classes of a chain {node: (reward, size, after)}: nodes that lead to each other and nowhere else."""
    reach = {n: {n} for n in chain}
    for _ in chain:
        for n, (_, _, after) in chain.items():
            reach[n] = reach[n].union(*(reach[m] if m is not None else {None} for m in after))
    return {frozenset(r) for n, r in reach.items() if None not in r and all(n in reach[m] for m in r)}


def mean_reward(chain, nodes):
    """The mean reward of a recurrent class, by its stationary distribution."""
    order = sorted(nodes)
    system = [[chain[m][2].get(n, Fraction(0)) - (m == n) for m in order] for n in order]
    system[-1] = [Fraction(1)] * len(order)
    weights = solve(system, [Fraction(0)] * (len(order) - 1) + [Fraction(1)])
    return sum(w * chain[n][0] for w, n in zip(weights, order, strict=True))


def values_of(chain):
    """{node: value} of a chain, without those that are paid for ever."""
    classes = classes_of(chain)
    paying = set().union(*(c for c in classes if any(chain[n][1] for n in c)))
    free = set().union(*classes) - paying
    lost = set(paying)
    for _ in chain:
        lost |= {n for n, (_, _, after) in chain.items() if any(m in lost for m in after)}
    order = sorted(n for n in chain if n not in lost and n not in free)
    system = [[(m == n) - chain[n][2].get(m, Fraction(0)) for m in order] for n in order]
    return dict.fromkeys(free, Fraction(0)) | dict(zip(order, solve(system, [chain[n][0] for n in order]), strict=True))


def policies(nodes):
    for choice in itertools.product(*(range(len(choices)) for choices in nodes.values())):
        yield {n: choices[a] for (n, choices), a in zip(nodes.items(), choice, strict=True)}


def best_values(mdp, sign=1):
    """{node: value} of the best (or worst) policy; None where a value is infinite or does not exist.

    A class with a positive mean reward is repeated as often as one likes before it is left, if it can be: in any case
    there is no finite value.
    """
    nodes = written_out(mdp)
    nodes = {n: [(sign * r, size, after) for r, size, after in choices] for n, choices in nodes.items()}
    best = {}
    for chain in policies(nodes):
        if any(mean_reward(chain, c) > 0 for c in classes_of(chain)):
            return None
        for n, value in values_of(chain).items():
            best[n] = max(best.get(n, value), value)
    return {n: sign * value for n, value in best.items()} if len(best) == len(nodes) else None


def probabilities_of(chain, target):
    """{node: probability of ever entering a node of `target`} of a chain."""
    entering = {
        n: (
            sum(p for m, p in after.items() if m in target),
            Fraction(0),
            {m: p for m, p in after.items() if m not in target},
        )
        for n, (_, _, after) in chain.items()
        if n not in target
    }
    # what entered is over
    closed = {
        n: (r, s, {**after, None: after.get(None, Fraction(0)) + r} if r else after)
        for n, (r, s, after) in entering.items()
    }
    return values_of(closed)


def reaching(mdp, target):
    """{node: (largest, least probability, least, largest cost)} of states that are no target; costs are rewards."""
    nodes = {n: choices for n, choices in written_out(mdp).items() if n[0] not in target}
    # terminal targets are None in `written_out`: tell them apart
    ends = {(t, None) for t in target}
    result = {}
    for chain in policies(nodes):
        p = probabilities_of(chain, ends)
        surely = {n for n in chain if p[n] == 1}
        cost = values_of(
            {
                n: (r, r, {None if m in ends else m: q for m, q in after.items()})
                for n, (r, _, after) in chain.items()
                if n in surely
            }
        )
        for n in chain:
            high, low, least, largest = result.get(n, (0, 1, float("inf"), 0))
            value = cost.get(n, float("inf")) if n in surely else float("inf")
            result[n] = max(high, p[n]), min(low, p[n]), min(least, value), max(largest, value)
    return result
