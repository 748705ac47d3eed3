"""Total rewards in rational numbers, where floats cannot tell a value from an infinite one.

The numbers are those of the floats, rows divided by their exact sums. Policy iteration keeps an action unless another
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
MOST_ENTRIES = 300_000

Row = tuple[Fraction, dict[int, Fraction]]


def rational_values(
    choices: "Choices", policy: np.ndarray, infinite: "Callable[[Choices, np.ndarray], DivergenceError]"
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """((M,) values, (M,) error of each, (M,) rows of a policy, improvements), from a proper policy (M,).

    Raises:
        DivergenceError: from `infinite`. PrecisionError: the nodes are too many.
    """
    count, entries_left = choices.num_nodes, MOST_ENTRIES
    matrix = choices.matrix
    rows: list[Row] = []
    if matrix.nnz > MOST_ENTRIES:
        raise _too_many(count)
    for i in range(matrix.shape[0]):
        places = range(matrix.indptr[i], matrix.indptr[i + 1])
        row = {int(matrix.indices[k]): Fraction(float(matrix.data[k])) for k in places}
        total = sum(row.values())
        rows.append((Fraction(float(choices.rewards[i])) / total, {m: p / total for m, p in row.items()}))
    policy, improvements = policy.copy(), 0
    while True:
        v, entries = eliminated([rows[i] for i in policy], count, entries_left)
        entries_left -= entries
        if entries_left < 0:
            raise _too_many(count)
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


def _too_many(count: int) -> PrecisionError:
    return PrecisionError(
        f"64-bit floats cannot tell the total reward of {count} nodes within the tolerance, or whether it is finite, "
        "and they are too many for rational numbers; raise the tolerance, lower gamma, or give a horizon"
    )


def eliminated(rows: list[Row], count: int, most: int) -> tuple[list[Fraction] | None, int]:
    """(x = r + P x by elimination without subtraction of probabilities; entries that it filled in).

    x is None where some nodes never end, and where it would fill in more entries than `most`.
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
