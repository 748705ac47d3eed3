"""Gaps by several processes: those of one process, whatever the number."""

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pharos
from pharos.errors import ParameterError, PrecisionError
from pharos.hardness import gaps, minimal_gap, sum_of_reciprocal_gaps
from pharos.mdp import TabularMDP, random_actions, sticky_actions
from rank_threads import Killed, fails_at, out_of_order, threads
from strategies import outcome_mdps, small_mdps, with_chance

MPIEXEC = shutil.which("mpiexec", path=Path(sys.executable).parent)
MODULE = sys.modules["pharos.hardness.gaps.gaps"]
EXACT = ("minimal", "count", "ties", "unresolved", "small", "tie_tolerance", "error", "conventions")
SUMS = ("sum_of_reciprocals", "lower", "upper", "regularized")
ROUNDING = 1e-12


def walk(num_states=60, gamma=0.9):
    """Walk right for a reward at the end, or jump back; two actions do the same, which is a tie."""
    states = np.arange(num_states)
    right = np.minimum(states + 1, num_states - 1)
    following = np.stack([right, states // 7, right], axis=1)
    rewards = np.zeros((num_states, 3))
    rewards[-2, [0, 2]], rewards[::5, 1] = 1.0, 0.01
    following[-1], rewards[-1] = num_states - 1, 0.0
    return TabularMDP.from_arrays(following, rewards, gamma=gamma)


def check_same(shared, alone):
    for name in EXACT:
        assert getattr(shared, name) == getattr(alone, name), name
    assert (shared.histogram == alone.histogram).all()
    assert (shared.edges == alone.edges).all()
    for name in SUMS:
        one, other = getattr(alone, name), getattr(shared, name)
        assert one == other or abs(one - other) <= ROUNDING * one, name


def by_threads(mdp, solution=None, disturb=lambda rank: None, **options):
    with threads(MODULE, disturb):
        return gaps(mdp, solution, **options)


def test_three_ranks_find_the_gaps_of_one():
    mdp = walk()
    solution = pharos.value_iteration(mdp, 1e-9)
    alone = gaps(mdp, solution)
    assert alone.count
    assert alone.ties > mdp.num_states
    check_same(by_threads(mdp, solution, processes=3), alone)


@pytest.mark.long
def test_episodes_may_begin_in_any_range():
    mdp = sticky_actions(walk().with_initial([3, 59]), 0.25)
    solution = pharos.value_iteration(mdp, 1e-9)
    check_same(by_threads(mdp, solution, processes=3), gaps(mdp, solution))


@pytest.mark.long
@settings(max_examples=150, deadline=None)
@given(
    mdp=st.one_of(small_mdps(), outcome_mdps(), with_chance(small_mdps()), st.just(walk(20))),
    size=st.integers(2, 5),
    tie_tolerance=st.sampled_from([None, 1e-3, 0.3]),
    seed=st.integers(0, 2**32),
)
def test_gaps_do_not_depend_on_ranks(mdp, size, tie_tolerance, seed):
    mdp = mdp.with_gamma(min(mdp.gamma, 0.9)).with_horizon(None)
    solution = pharos.value_iteration(mdp, 1e-6 * max(1.0, np.abs(mdp.rewards).max()))
    size = min(size, mdp.num_states)
    try:
        alone = gaps(mdp, solution, tie_tolerance=tie_tolerance)
    except PrecisionError:
        with pytest.raises(PrecisionError):
            by_threads(mdp, solution, processes=size, tie_tolerance=tie_tolerance)
        return
    check_same(by_threads(mdp, solution, out_of_order(seed), processes=size, tie_tolerance=tie_tolerance), alone)


@pytest.mark.long
@settings(max_examples=40, deadline=None)
@given(who=st.integers(0, 2), number=st.integers(0, 30))
def test_a_rank_that_fails_ends_all(who, number):
    mdp = walk(20)
    solution = pharos.value_iteration(mdp, 1e-9)
    try:
        check_same(by_threads(mdp, solution, fails_at(who, number), processes=3), gaps(mdp, solution))
    except (Killed, pharos.ranks.RankFailed) as error:
        assert f"at exchange {number}" in str(error)


@pytest.mark.long
def test_processes_find_the_gaps(tmp_path):
    space = pharos.build(pharos.make("breakout", height=7, columns=5, brick_rows=1), tmp_path, progress=False)
    for change in (lambda mdp: mdp, lambda mdp: sticky_actions(mdp, 0.25), lambda mdp: random_actions(mdp, 0.1)):
        mdp = change(space.mdp(0.9))
        solution = pharos.value_iteration(mdp, 1e-9)
        alone = gaps(mdp, solution)
        check_same(gaps(mdp, solution, processes=3), alone)
        assert minimal_gap(mdp, solution, processes=2) == alone.minimal
        shared = sum_of_reciprocal_gaps(mdp, solution, processes=2)
        assert abs(shared - alone.sum_of_reciprocals) <= ROUNDING * shared
        assert gaps(mdp, processes=3).is_resolved == gaps(mdp).is_resolved


PROGRAM = """
import sys
import pharos
from pharos.hardness import gaps, minimal_gap
from test_ranked_gaps import check_same, walk
from pharos.errors import ParameterError
from pharos.ranks import mpi_rank

mdp = walk()
is_first = mpi_rank().rank == 0
solution = pharos.value_iteration(mdp, 1e-9, processes="mpi")
found = gaps(mdp, solution, processes="mpi")
solved = gaps(mdp, processes="mpi")
smallest = minimal_gap(mdp, solution, processes="mpi")
if is_first:
    check_same(found, gaps(mdp, solution))
    assert solved.is_resolved and smallest == found.minimal
else:
    assert found is solved is smallest is None
try:
    gaps(mdp, pharos.solvers.worst_value(mdp) if is_first else None, processes="mpi")
except ParameterError as error:
    assert "expected the optimal one" in str(error)
    print("done")
"""


@pytest.mark.long
@pytest.mark.skipif(MPIEXEC is None, reason="needs the extra mpi")
def test_ranks_of_mpi_find_the_gaps():
    command = [MPIEXEC, "-n", "3", sys.executable, "-c", PROGRAM]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=Path(__file__).parent)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.count("done") == 3


def test_what_several_processes_do_not_add_up_is_said():
    mdp = walk()
    with pytest.raises(ParameterError, match="the horizon is 5; several processes take none: expected processes=1"):
        gaps(mdp.with_horizon(5), processes=2)
    with pytest.raises(ParameterError, match="61 processes for 60 states; expected at most one for each state"):
        gaps(mdp, processes=61)
    with pytest.raises(ParameterError, match="expected a whole number from 1 to 1024"):
        gaps(mdp, processes=0)
