"""Colosseum's episodic diameter: its published value, and value iteration on the time-augmented chain."""

import math

import numpy as np
import pytest
from hypothesis import strategies as st

from pharos import TabularMDP
from pharos.errors import ParameterError
from pharos.hardness.diameter import colosseum_diameter
from strategies import examples


def deep_sea(size):
    """(row, column): every step goes a row down, one column to the left or right; the last row stays."""
    index = {}
    for row in range(size):
        for column in range(row + 1):
            index[row, column] = len(index)
    table = [
        [
            index[min(r + 1, size - 1), max(c - 1, 0) if r < size - 1 else c],
            index[min(r + 1, size - 1), c + (r < size - 1)],
        ]
        for r, c in index
    ]
    return TabularMDP.from_arrays(table, np.zeros((len(table), 2)))


def test_deep_sea_has_the_published_diameter():
    assert colosseum_diameter(deep_sea(5), horizon=5) == pytest.approx(5.0)


def by_iteration(P, start, horizon):
    size = len(P)
    largest = 0.0
    for e in range(size):
        times = np.zeros((horizon, size))
        for _ in range(20_000):
            old = times.copy()
            times[-1] = 1 + times[0, start]
            for h in range(horizon - 2, -1, -1):
                times[h] = 1 + (P @ np.where(np.arange(size) == e, 0.0, times[h + 1])).min(axis=1)
            times[:-1, e] = 0  # at the last step the target is no exception
            if np.abs(old - times).max() < 1e-11 or times.max() > 1e5:
                break
        if times.max() > 1e5:
            return math.inf
        largest = max(largest, np.where(times > 0, times, np.inf).min(axis=0).max())
    return largest


@examples(30, st.integers(0, 2**32 - 1), st.integers(1, 5), st.integers(1, 2), st.integers(2, 5))
def test_it_is_that_of_the_time_augmented_chain(seed, size, num_actions, horizon):
    rng = np.random.default_rng(seed)
    P = 0.7 * rng.dirichlet(np.ones(size), (size, num_actions)) + 0.3 / size  # so that iteration converges
    mdp = TabularMDP.from_matrices(P, np.zeros((size, num_actions)), axes="SAS")
    start = int(mdp.start_states[0])
    assert colosseum_diameter(mdp, horizon=horizon) == pytest.approx(by_iteration(P, start, horizon), rel=1e-6)


def test_a_state_out_of_reach_of_an_episode_makes_it_infinite():
    mdp = TabularMDP.from_arrays([[1], [2], [0]], np.zeros((3, 1)))
    assert colosseum_diameter(mdp, horizon=2) == math.inf


def test_a_missing_horizon_is_named():
    with pytest.raises(ParameterError, match="horizon is 0"):
        colosseum_diameter(deep_sea(2), horizon=0)
