"""Statistics of the benchmark in plain Python: slow twins of its scores and comparisons."""

import itertools
import math

from scipy import optimize, stats


def run_score(curve):
    return 1.0 - min(1.0, max(0.0, math.fsum(curve) / len(curve)))


def mean(values):
    values = list(values)
    return math.fsum(values) / len(values)


def variance(values):
    middle = mean(values)
    return math.fsum((value - middle) ** 2 for value in values) / (len(values) - 1)


def error_of_mean(tasks):
    """Standard error of the mean over tasks, and Satterthwaite's degrees of freedom."""
    parts = [(variance(task) / len(task) / len(tasks) ** 2, len(task) - 1) for task in tasks]
    total = math.fsum(part for part, _ in parts)
    return math.sqrt(total), total**2 / math.fsum(part**2 / degrees for part, degrees in parts)


def increasing(means):
    """Pool adjacent violators: blocks of neighbours whose means fall are replaced by their common mean."""
    blocks = []
    for value in means:
        blocks.append([value])
        while len(blocks) > 1 and mean(blocks[-2]) >= mean(blocks[-1]):
            last = blocks.pop()
            blocks[-1] += last
    return [mean(block) for block in blocks for _ in block]


def crossing(levels, means, at=0.5):
    """First level where the increasing means, linear between levels, reach `at`; how it is censored."""
    means = increasing(means)
    if means[0] > at:
        return levels[0], "below"
    if means[-1] < at:
        return levels[-1], "above"
    for index, value in enumerate(means):
        if value >= at:
            if index == 0 or value == at:
                return levels[index], ""
            share = (at - means[index - 1]) / (value - means[index - 1])
            return levels[index - 1] + share * (levels[index] - levels[index - 1]), ""


def crossing_of_limit(levels, tasks, sign, at=0.5):
    """Last level where the upper limit (sign 1) of the mean is `at`, or first one where the lower (sign -1) is.

    Infinite where no level excludes what lies beyond; the end of the ladder where all levels do.
    """

    def limit(position):
        left = min(int(position), len(levels) - 2)
        share = position - left
        shares = ((1.0 - share, tasks[left]), (share, tasks[left + 1]))
        parts = [(weight**2 * variance(task) / len(task), len(task) - 1) for weight, task in shares]
        total = math.fsum(part for part, _ in parts)
        degrees = total**2 / math.fsum(part**2 / own for part, own in parts)
        middle = math.fsum(weight * mean(task) for weight, task in shares)
        return middle + sign * stats.t.ppf(0.975, degrees) * math.sqrt(total) - at

    grid = [index / 64 for index in range(64 * (len(levels) - 1) + 1)]
    grid = grid[::-1] if sign > 0 else grid
    if sign * limit(grid[0]) < 0:
        return levels[-1] if sign > 0 else levels[0]
    for before, after in itertools.pairwise(grid):
        if sign * limit(after) < 0:
            position = optimize.brentq(limit, before, after)
            left = min(int(position), len(levels) - 2)
            return levels[left] + (position - left) * (levels[left + 1] - levels[left])
    return -sign * math.inf


def holm(p_values):
    """Reject one after the other: each adjusted value is the largest so far of (number left) p."""
    adjusted, largest = {}, 0.0
    for rank, (p, index) in enumerate(sorted((p, index) for index, p in enumerate(p_values))):
        largest = max(largest, (len(p_values) - rank) * p)
        adjusted[index] = min(1.0, largest)
    return [adjusted[index] for index in range(len(p_values))]


def improvement(x, y):
    """Share of pairs in which x is larger, ties half."""
    return mean(1.0 if one > other else 0.5 if one == other else 0.0 for one in x for other in y)
