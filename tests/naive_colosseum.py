"""Colosseum's episodic diameter by its own iteration, in the precision and with the stops that its printed digits show.

It stops when no entry changes by 0.001, or by 0.01 once a target adds less than a step to those before it.
"""

import numpy as np

STOPS = (1e-3, 1e-2)
ULPS = 8  # roundings of single precision that the order of its sums leaves open


def episodic_diameter(P, rho, horizon, targets, stop, kind):
    """Colosseum's number by its iteration: backwards through the time-indexed states that can be reached, until no
    entry changes by `stop`, for each of the targets; the largest.
    """
    P, rho = P.astype(kind), rho.astype(kind)
    size, at = P.shape[1], np.arange(len(targets))
    reached = np.zeros((horizon, size, 1), bool)
    reached[0, :, 0] = rho > 0
    for h in range(1, horizon):
        reached[h, :, 0] = P.T @ np.repeat(reached[h - 1, :, 0], len(P.indptr[:-1]) // size).astype(kind) > 0
    times, found = np.zeros((horizon, size, len(targets)), kind), np.full(len(targets), np.nan)
    while np.isnan(found).any():
        before = times.copy()
        times[-1] = rho @ (1 + times[0])
        for h in range(horizon - 2, -1, -1):
            following = 1 + times[h + 1]
            following[targets, at] = 1
            times[h] = np.where(reached[h], (P @ following).reshape(size, -1, len(targets)).min(axis=1), 0)
            times[h, targets, at] = 0
        ends = (abs(times - before).max(axis=(0, 1)) < stop) & np.isnan(found)
        found[ends] = np.where(times > 0, times, np.inf).min(axis=0).max(axis=0)[ends]
    return found.max()


def within_ulps(found, printed):
    return abs(np.float32(found) - np.float32(printed)) <= ULPS * np.spacing(np.float32(printed))
