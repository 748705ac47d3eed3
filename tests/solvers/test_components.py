"""Strongly connected components against SciPy's; values solved component by component against sweeps alone."""

import numpy as np
import pytest
from hypothesis import strategies as st
from scipy.sparse import csgraph, csr_matrix

from benchmark_modules import benchmark
from pharos.mdp import Table
from pharos.solvers import fixed_point, value_iteration, worst_value
from pharos.solvers.fixed_point import ComponentSolver
from strategies import examples, small_mdps

pytestmark = pytest.mark.long


def graph(dynamics, live):
    """(S, S) bool: where live states lead."""
    leads = np.zeros((dynamics.num_states, dynamics.num_states + 1), bool)
    for action in range(dynamics.num_actions):
        states = np.flatnonzero(live)
        found = dynamics.outcomes(states, np.full(len(states), action))
        leads[states[found.which], found.states] = True
    return leads[:, :-1]


@st.composite
def tables(draw):
    """(dynamics with ends, live): few ways, so that there are components of all sizes."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    num_states, num_actions = draw(st.integers(1, 30)), draw(st.integers(1, 3))
    table = rng.integers(-1, num_states, (num_states, num_actions))
    if draw(st.booleans()):
        table = np.minimum(table, np.arange(num_states)[:, None])
    return Table(table.astype(np.int32)), rng.random(num_states) < 0.9


@examples(200, tables(), st.integers(1, 8))
def test_components_are_those_of_scipy_in_topological_order(drawn, least):
    dynamics, live = drawn
    found, leads = dynamics.components(live, least), graph(dynamics, live)
    count, label = csgraph.connected_components(csr_matrix(leads), connection="strong")
    place = np.empty(dynamics.num_states, np.int64)
    place[found.order] = np.arange(dynamics.num_states)
    group = np.searchsorted(found.starts, place, side="right") - 1
    assert found.total == count and sorted(found.order) == list(range(dynamics.num_states))
    s, t = np.nonzero(leads & (label[:, None] != label))
    assert (place[s] < place[t]).all()
    sizes = [0]
    for one in range(count):
        states = np.flatnonzero(label == one)
        assert np.ptp(place[states]) == len(states) - 1
        assert (np.diff(place[states]) == 1).all()  # ascending, so that sweeps go as they do without components
        if len(states) > 1 or leads[states[0], states[0]]:
            sizes.append(len(states))
            assert len(set(group[states])) == 1 and found.has_cycle[group[states]].all()
    assert found.largest == max(sizes)


def always(patched):
    """Let components be solved after two sweeps, whatever they cost; a list of whether that was done."""
    improve, done = ComponentSolver.improve, []

    def improved(self, x, tolerance):
        self._left = 1e6
        done.append(improve(self, x, tolerance))
        return done[-1]

    patched.setattr(fixed_point, "LEAST_PART", 1)
    patched.setattr(ComponentSolver, "is_worth_it", lambda self, sweeps, *_: sweeps == 2 and self._is_known)
    patched.setattr(ComponentSolver, "improve", improved)
    return done


@examples(60, small_mdps(), st.sampled_from([0.5, 0.9, 0.99]), st.sampled_from([value_iteration, worst_value]))
def test_values_by_components_and_by_sweeps_alone_are_within_both_bounds(mdp, gamma, solve):
    mdp = mdp.with_gamma(gamma)
    alone = solve(mdp, 1e-6)
    with pytest.MonkeyPatch.context() as patched:
        always(patched)
        together = solve(mdp, 1e-6)
    assert together.error_bound <= 1e-6
    assert (np.abs(together.v - alone.v) <= together.error_bound + alone.error_bound).all()


def test_a_chain_in_no_order_takes_its_states_once_each():
    """A state n steps before the end is worth -0.01 (1 - f^n) / (1 - gamma), f = 0.5 gamma / (1 - 0.5 gamma)."""
    gamma, length = 0.999, 2000
    number = np.random.default_rng(0).permutation(length)
    mdp = benchmark("components").chain(number, gamma)
    with pytest.MonkeyPatch.context() as patched:
        done = always(patched)
        solution = value_iteration(mdp, 1e-9)
    assert done == [True] and solution.sweeps <= 4
    steps = length - 1 - np.arange(length)
    truth = -0.01 * (1 - (0.5 * gamma / (1 - 0.5 * gamma)) ** steps) / (1 - gamma)
    assert np.abs(solution.v[number] - truth).max() <= solution.error_bound
