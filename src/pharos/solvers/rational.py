"""Total and average rewards in rational numbers, if floats are too short to tell or to hold a value.

The numbers are the floats, rows divided by their exact sums. Policy iteration keeps an action unless another
one is better, and begins with a policy that ends almost surely. So a policy that does not, later on, stays in a
component in which no residual is negative and one is positive: the value is infinite. There is no other way to fail.
"""

import heapq
from collections.abc import Callable
from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np

from pharos.errors import DivergenceError, PrecisionError

if TYPE_CHECKING:
    from pharos.solvers.goals import Choices

# Entries that all eliminations of one solve may fill in, about a second: the numbers grow, too.
MOST_RATIONAL_ENTRIES = 300_000

Row = tuple[Fraction, dict[int, Fraction]]


def rational_values(
    choices: "Choices", policy: np.ndarray, infinite: "Callable[[Choices, np.ndarray], DivergenceError]"
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """((M,) values, (M,) error of each, (M,) rows of a policy, improvements), from a proper policy (M,).

    Raises:
        DivergenceError: from `infinite`. PrecisionError: the nodes are too many.
    """
    count, entries_left = choices.num_nodes, MOST_RATIONAL_ENTRIES
    written = fractions_of(choices)
    if written is None:
        raise _too_many_nodes(count)
    rows = [_divided(*row) for row in written]
    policy, improvements = policy.copy(), 0
    while True:
        v, entries = eliminated([rows[i] for i in policy], count, entries_left)
        entries_left -= entries
        if entries_left < 0:
            raise _too_many_nodes(count)
        if v is None:
            raise infinite(choices, policy[_stuck(choices, policy)])
        v.append(Fraction(0))
        improvements += 1
        is_better = False
        for n in range(count):
            best = v[n]
            for i in range(choices.rows[n], choices.rows[n + 1]):
                q = rows[i][0] + sum((p * v[m] for m, p in rows[i][1].items()), Fraction(0))
                if q > best:
                    best, policy[n], is_better = q, i, True
        if not is_better:
            values = np.array([float(each) for each in v[:-1]])
            return values, 2.0**-52 * np.abs(values) + 2.0**-1074, policy, improvements


def fractions_of(choices: "Choices") -> list[Row] | None:
    """The rows as rational numbers, equal to the floats. None if they are too many."""
    matrix = choices.matrix
    if matrix.nnz > MOST_RATIONAL_ENTRIES:
        return None
    rows = []
    for i in range(matrix.shape[0]):
        entries = range(matrix.indptr[i], matrix.indptr[i + 1])
        row = {int(matrix.indices[k]): Fraction(float(matrix.data[k])) for k in entries}
        rows.append((Fraction(float(choices.rewards[i])), row))
    return rows


def _divided(reward: Fraction, after: dict[int, Fraction]) -> Row:
    """A row divided by its sum: what stays, which a row leaves out, is repeated until it leaves."""
    total = sum(after.values())
    return reward / total, {m: p / total for m, p in after.items()}


def exact_sums(after: list[dict[int, Fraction]], b: list[Fraction]) -> list[Fraction] | None:
    """x = b + P x of n nodes, of rows without what stays, each left almost surely. None if it fills in too much."""
    rows = [_divided(*each) for each in zip(b, after, strict=True)]
    return eliminated(rows, len(b), MOST_RATIONAL_ENTRIES)[0]


def best_mean(
    choices: "Choices", rows: list[Row], policy: np.ndarray, class_of: np.ndarray
) -> tuple[Fraction, np.ndarray] | None:
    """(The mean reward of a policy (M,), a better policy or the same one). None if it fills in too much.

    Args:
        class_of: (M,) 0 in the only recurrent class of the policy, else -1.
    """
    count, home = choices.num_nodes, int(np.argmax(class_of == 0))
    nodes = [n for n in range(count) if n != home]
    number = {n: i for i, n in enumerate(nodes)} | {home: count - 1}
    afters = [{number[m]: p for m, p in rows[policy[n]][1].items()} for n in nodes]
    sums = [exact_sums(afters, b) for b in ([rows[policy[n]][0] for n in nodes], [Fraction(1)] * len(nodes))]
    if sums[0] is None or sums[1] is None:
        return None
    totals, times = ([*each, Fraction(0)] for each in sums if each is not None)
    reward, after = rows[policy[home]]
    earned, steps = (sum((p * each[number[m]] for m, p in after.items()), Fraction(0)) for each in (totals, times))
    gain = (reward + earned) / (1 + steps)
    h = [totals[number[n]] - gain * times[number[n]] for n in range(count)]
    better = policy.copy()
    for n in range(count):
        most = gain
        for i in range(choices.rows[n], choices.rows[n + 1]):
            change = rows[i][0] + sum((p * (h[m] - h[n]) for m, p in rows[i][1].items()), Fraction(0))
            if change > most:
                most, better[n] = change, i
    return gain, better


def _too_many_nodes(count: int) -> PrecisionError:
    return PrecisionError(
        f"64-bit floats cannot tell the total reward of {count} nodes within the tolerance, or whether it is finite, "
        "and they are too many for rational numbers; raise the tolerance, lower gamma, or give a horizon"
    )


def eliminated(rows: list[Row], count: int, most: int) -> tuple[list[Fraction] | None, int]:
    """(x = r + P x by elimination without subtraction of probabilities, entries that it filled in).

    x is None if some nodes never end, or if it would fill in more entries than `most`.
    Source: Grassmann, Taksar and Heyman (1985).
    """
    rewards = [row[0] for row in rows]
    into = [dict(row[1]) for row in rows]
    from_node: list[set[int]] = [set() for _ in range(count + 1)]
    for n, row in enumerate(into):
        for m in row:
            from_node[m].add(n)
    # the node next that fills in the least; a node whose row or column has changed since waits for another turn
    waiting = [(len(from_node[n]) * len(into[n]), n) for n in range(count)]
    heapq.heapify(waiting)
    is_done, order, entries = [False] * count, list[int](), 0
    while waiting:
        cost, n = heapq.heappop(waiting)
        now = len(from_node[n]) * len(into[n])
        if is_done[n] or cost < now:
            if not is_done[n]:
                heapq.heappush(waiting, (now, n))
            continue
        is_done[n] = True
        order.append(n)
        into[n].pop(n, None)
        leaving = sum(into[n].values(), Fraction(0))
        if leaving == 0:
            return None, entries
        into[n] = {m: p / leaving for m, p in into[n].items()}
        rewards[n] /= leaving
        for i in from_node[n]:
            if is_done[i]:
                continue
            weight = into[i].pop(n)
            rewards[i] += weight * rewards[n]
            for m, p in into[n].items():
                into[i][m] = into[i].get(m, Fraction(0)) + weight * p
                from_node[m].add(i)
            entries += len(into[n])
            heapq.heappush(waiting, (len(from_node[i]) * len(into[i]), i))
        for m in into[n]:
            from_node[m].discard(n)
        if entries > most:
            return None, entries
    x = [Fraction(0)] * count
    for n in reversed(order):
        x[n] = rewards[n] + sum((p * x[m] for m, p in into[n].items() if m < count), Fraction(0))
    return x, entries


def _stuck(choices: "Choices", policy: np.ndarray) -> np.ndarray:
    """The nodes of one recurrent class of a policy."""
    from pharos.solvers.goals import recurrent_classes

    return np.flatnonzero(recurrent_classes(choices.matrix[policy], np.ones(choices.num_nodes, np.bool_))[0] == 0)
