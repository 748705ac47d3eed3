"""Chains whose loops are left ever so rarely: elimination against rational numbers, values against both."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import strategies as st
from scipy import sparse
from scipy.sparse import csgraph
from test_proof_steps import mutant

import pharos
from naive import goals as naive
from pharos.kernels import elimination
from pharos.mdp import BEST, TabularMDP
from pharos.solvers import chains, goals, rational
from pharos.solvers.chains import Chain
from strategies import examples


@st.composite
def rare_exits(draw, smallest=60):
    """(M, M + 1) probabilities without what stays, of which many are tiny; each node has a way to the end."""
    size = draw(st.integers(1, 7))
    exponents = st.integers(0, smallest)
    dense = np.zeros((size, size + 1))
    for n in range(size):
        for m in [draw(st.integers(0, n - 1)) if n else size, *draw(st.lists(st.integers(0, size), max_size=3))]:
            dense[n, m] += draw(st.sampled_from([1.0, 1 / 3, 0.7])) * 10.0 ** -draw(exponents)
    np.fill_diagonal(dense, 0.0)
    return dense


def exact_solution(dense, right):
    exact = [[Fraction(p) for p in row] for row in dense.tolist()]
    system = [[sum(row) * (n == m) - row[m] for m in range(len(exact))] for n, row in enumerate(exact)]
    return naive.solve(system, list(map(Fraction, right)))


def largest_relative_error(x, expected):
    return max(
        abs((Fraction(float(each.real)) + Fraction(float(each.imag))) / true - 1)
        for each, true in zip(x, expected, strict=True)
    )


@pytest.mark.long
@examples(200, rare_exits(), st.sampled_from([(float, 2.0**-46), (complex, 2.0**-96)]))
def test_each_entry_is_as_accurate_as_its_numbers(dense, precision):
    dtype, limit = precision
    right = np.linspace(1.0, 2.0, len(dense))
    x = Chain(sparse.csr_matrix(dense), dtype).solve(right)
    assert x[-1] == 0
    assert largest_relative_error(x[:-1], exact_solution(dense, right.tolist())) <= limit


def ring(leaving):
    """Three nodes in a ring, one of which is left for the end with a probability."""
    dense = np.zeros((3, 4))
    dense[0, 1], dense[1, 2], dense[2, 0], dense[2, 3] = 1.0, 1.0, 1.0 - leaving, leaving
    return dense


@pytest.mark.parametrize("leaving", [1e-12, 1e-40, 1e-280])
def test_what_leaves_is_carried_beside_the_rows(leaving, monkeypatch):
    dense, right = ring(leaving), np.ones(3)
    expected = exact_solution(dense, right.tolist())
    for dtype in (float, complex):
        x = Chain(sparse.csr_matrix(dense), dtype).solve(right)
        assert largest_relative_error(x[:-1], expected) <= 2.0**-46
    # instead: what is missing to 1
    edits = (
        "pivot[n] = out",
        "pivot[n] = 1.0 - stays",
        "work[n] = 0.0  # what stays",
        "stays = work[n]\n        work[n] = 0.0",
    )
    monkeypatch.setattr(chains, "elimination", mutant(monkeypatch, elimination, "mutant_of_elimination", *edits))
    x = Chain(sparse.csr_matrix(dense), float)._solved(right)
    assert not largest_relative_error(np.nan_to_num(x[:-1], posinf=0.0), expected) <= 1e-6


def test_scipy_numbers_components_from_those_that_lead_nowhere_on():
    rng = np.random.default_rng(0)
    for density in (0.5, 1.0, 2.0):
        graph = sparse.random(500, 500, density / 500, "csr", random_state=rng)
        component = csgraph.connected_components(graph, connection="strong")[1]
        row = np.repeat(np.arange(500), np.diff(graph.indptr))
        assert (component[graph.indices] <= component[row]).all()


@pytest.mark.parametrize("size", [30, 60])
def test_grids_and_expanders(size):
    # nobody leaves but from the last node: its visits are as many as the first one's steps
    line = sparse.diags([np.ones(size - 1), np.ones(size - 1)], [1, -1])
    grid = sparse.kronsum(line, line).tocsr()
    rng = np.random.default_rng(size)
    perm = sparse.csr_matrix((np.ones(size * size), (np.arange(size * size), rng.permutation(size * size))))
    for matrix in (grid, perm + perm.T):
        matrix.setdiag(0.0)
        matrix.eliminate_zeros()
        out = np.zeros((size * size, 1))
        component = csgraph.connected_components(matrix)[1]
        out[np.unique(component, return_index=True)[1]] = 1e-20
        x = Chain(sparse.hstack([matrix, out]).tocsr(), complex).solve(np.ones(size * size))
        # the stationary distribution of a symmetric chain is uniform: the mean time is the size, divided by what leaves
        sizes = np.bincount(component)[component]
        assert np.abs(x.real[:-1] / (sizes / 1e-20) - 1).max() <= 1e-12


def nested(*exits):
    """Loops of two states, each left for the next one with a probability; whoever leaves the last one is paid 0.75, and
    whoever gives up before, 0.5 in the first one and nothing in the others."""
    end, outcomes, weights = 2 * len(exits), [], []
    for first, p in zip(range(0, end, 2), exits, strict=True):
        outcomes += [[[first + 1, end], [end, end]], [[first, first + 2], [first, end]]]
        weights += [[[1.0, 0.0], [1.0, 0.0]], [[1 - p, p], [1.0, 0.0]]]
    rewards = np.zeros((end + 1, 2))
    rewards[0, 1], rewards[end - 1, 0] = 0.5, 0.75 * exits[-1]
    outcomes, weights = [*outcomes, [[end, end]] * 2], [*weights, [[1.0, 0.0]] * 2]
    return TabularMDP.from_outcomes(outcomes, weights, rewards, gamma=1.0, terminal=np.arange(end + 1) == end)


def check(v, error):
    assert (np.abs(v - 0.75) <= error + 2.0**-52).all()


@pytest.mark.parametrize("exits", [[1e-12], [1e-12, 1e-9], [1e-7, 1e-8, 0.5], [1e-20], [1e-15, 1e-12], [1e-22, 0.1]])
def test_nearly_closed_loops_need_no_rational_numbers(exits, monkeypatch):
    def none(*arguments):
        raise AssertionError("rational numbers")

    monkeypatch.setattr(rational, "rational_values", none)
    solved = goals.total_reward(nested(*exits), BEST, 1e-6)
    check(solved.v[:-1], solved.error[:-1])
    assert solved.error.max() <= 1e-6


@pytest.mark.parametrize("exits", [[1e-100], [1e-150, 1e-150], [1e-300], [1e-200, 1e-200, 1e-200]])
def test_closer_ones_are_solved_in_rational_numbers(exits):
    solution = pharos.value_iteration(nested(*exits))
    check(solution.v[:-1], solution.error_bound)
    assert solution.error_bound <= 1e-6


@examples(100, st.lists(st.integers(1, 26), min_size=1, max_size=3), st.sampled_from([float, complex]))
def test_no_bound_of_floats_alone_is_false(powers, dtype):
    problem = goals.GoalProblem.of(nested(*(10.0**-each for each in powers)), BEST)
    choices = problem._without_idle(problem.choices)
    try:
        v, error, _, _ = goals._iterated(choices, problem.proper(choices)[1], problem._infinite, None, 1e-6, dtype)
    except goals.Undecided:
        return
    check(v, error)
