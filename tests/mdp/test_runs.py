"""Runs of rows: some rows of a range, as a few contiguous stretches."""

import itertools

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from pharos.mdp import count_of, runs_between, runs_of, shares_of

masks = hnp.arrays(np.bool_, st.integers(0, 30))


def rows(runs):
    return [row for start, stop in runs.tolist() for row in range(start, stop)]


@given(masks, st.integers(1, 8))
def test_runs_have_the_rows_and_what_lies_close_between_them(is_in, gap):
    runs = runs_of(is_in, gap)
    inside = np.flatnonzero(is_in)
    expected = set(inside.tolist())
    for one, other in itertools.pairwise(inside):
        if other - one - 1 < gap:
            expected |= set(range(one, other))
    assert rows(runs) == sorted(expected)
    assert count_of(runs) == len(expected)
    assert (runs[1:, 0] - runs[:-1, 1] >= gap).all()
    assert sorted(rows(runs) + rows(runs_between(runs, len(is_in)))) == list(range(len(is_in)))


@given(masks, st.integers(1, 6))
def test_shares_are_even_and_keep_the_order(is_in, shares):
    runs = runs_of(is_in)
    parts = shares_of(runs, shares)
    assert [row for part in parts for row in rows(part)] == rows(runs)
    counts = [count_of(part) for part in parts]
    assert 0 not in counts
    assert len(parts) == min(shares, count_of(runs)) and max(counts, default=0) - min(counts, default=0) <= 1
