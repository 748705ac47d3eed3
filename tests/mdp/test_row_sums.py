"""Rows of probabilities that do not sum to 1: divided and counted in the bounds of values, ends, or refused."""

from dataclasses import replace
from fractions import Fraction

import gymnasium
import numpy as np
import pytest
from hypothesis import assume
from hypothesis import strategies as st
from scipy import sparse
from test_action_sets import of_chance, worlds

import pharos
from naive import exact as naive_exact
from pharos import exporters, hardness, importers
from pharos.errors import FileFormatError, ParameterError
from pharos.mdp import TabularMDP, random_actions, sticky_actions
from refusals import refusal
from strategies import examples

# The example of pymdptoolbox's documentation, two states and two actions, one matrix an action
FOREST = [np.array([[0.3, 0.7], [0.6, 0.4]]), np.array([[0.0, 1.0], [0.9, 0.1]])]
PAID = np.array([[1.0, 4.0], [0.0, 2.0]])
# Four states, four actions, one matrix an action: an action that is not available has a row of zeros
MASKED = np.zeros((4, 4, 4))
MASKED[0, [0, 1, 2, 3], [1, 2, 3, 0]] = 1.0
MASKED[1, [0, 1, 3], [0, 3, 3]] = 1.0
MASKED[2, [0, 1, 2], [2, 0, 1]] = 1.0
MASKED[3, 0] = [0.5, 0.5, 0.0, 0.0]


def chain(p):
    """Three states, an action that leads to each of them with probability p and pays 1; 1 and 2 lead back."""
    table = {s: {0: [(1.0, 0, 1.0, False)]} for s in (1, 2)}
    return {0: {0: [(p, s, 1.0, False) for s in range(3)]}, **table}


def solved(*arguments, **named):
    return pharos.value_iteration(TabularMDP.from_matrices(*arguments, gamma=0.9, **named)).v


@pytest.mark.long
@pytest.mark.parametrize("p", [0.3333333, 0.33333334, 0.33333366])
def test_rounded_thirds_are_thirds(p):
    """The end that seven digits leave makes 9,994 of a value of 10,000, and 16,666,667 of a diameter of 5."""
    mdp = importers.gymnasium(chain(p), gamma=0.9999)
    assert not mdp.has_ends and hardness.diameter(mdp).upper == pytest.approx(5.0)
    solution = pharos.value_iteration(mdp)
    assert solution.v == pytest.approx([1e4] * 3, rel=1e-9)
    lacks = abs(3 * p - 1)
    assert lacks * 1e4 / 1e-4 * 0.99 < solution.error_bound < lacks * 1e4 / 1e-4 * 1.01 + 1


def test_a_row_beyond_a_millionth_is_refused_whatever_way_it_came_in():
    for p in (0.3333, 0.33334):
        rows = [[[p] * 3]] + [[[1.0, 0.0, 0.0]]] * 2
        for message in (
            refusal(ParameterError, TabularMDP.from_matrices, rows, np.ones((3, 1))),
            refusal(ParameterError, importers.matrices, rows, np.ones((3, 1))),
            refusal(ParameterError, TabularMDP.from_outcomes, [[[0, 1, 2]]] * 3, rows, np.ones((3, 1))),
            refusal(FileFormatError, importers.gymnasium, chain(p)),
        ):
            assert f"{3 * p:.9g}"[:6] in message and ("state 0, action 0" in message or "P[0][0]" in message)


def test_numbers_of_32_bits_are_divided_by_their_sums():
    rows = np.float32([[0.1, 0.2, 0.7], [0.15, 0.25, 0.6], [1, 0, 0]])
    assert rows.astype(float).sum(axis=1)[0] < 1 < rows.astype(float).sum(axis=1)[1]
    mdp = importers.matrices(rows[:, None], np.arange(3.0), gamma=0.9)
    assert not mdp.has_ends and np.abs(mdp.transitions.sum(axis=1) - 1).max() <= 2.0**-50
    assert 1e-8 < mdp.residual.probabilities < 1e-7 and mdp.residual.rewards == 0.0
    exact = np.linalg.solve(np.eye(3) - 0.9 * np.array([[0.1, 0.2, 0.7], [0.15, 0.25, 0.6], [1, 0, 0]]), np.arange(3.0))
    solution = pharos.value_iteration(mdp)
    assert np.abs(solution.v - exact).max() <= solution.error_bound < 1e-4


def test_rows_that_sum_to_1_up_to_rounding_keep_every_bit():
    rows = np.random.default_rng(0).dirichlet(np.ones(7), (5, 2))[..., :5]
    rows[..., 0] += 1 - rows.sum(axis=2)
    mdp = TabularMDP.from_matrices(rows, np.ones((5, 2)))
    assert (mdp.transitions.toarray() == rows.reshape(10, 5)).all() and mdp.residual == (0.0, 0.0)


@pytest.mark.parametrize(
    ("P", "reason"),
    [
        (np.stack([[[0.5, 0.1]], [[0.0, 1.0]]]), "if the rest ends the episode, say ends=True"),
        (np.stack([[[0.0, 0.0]], [[0.0, 1.0]]]), "the state has no outcomes; if it is terminal, say ends=True"),
        (np.stack([[[0.499, 0.5]], [[0.0, 1.0]]]), "were they rounded, or computed in float32?"),
        ([matrix.T for matrix in FOREST], "its columns do; transpose the matrix of each action"),
    ],
)
def test_a_refused_row_is_named_with_the_likely_reason(P, reason):
    message = refusal(ParameterError, importers.matrices, P, np.zeros(2))
    assert reason in message


def test_what_a_row_lacks_is_an_end_if_it_is_said_so():
    rows = np.stack([[[0.5, 0.1]], [[0.0, 0.0]]])
    mdp = importers.matrices(rows, [1.0, 0.0], gamma=0.5, ends=True)
    assert mdp.has_ends and mdp.terminal.tolist() == [False, True]
    assert pharos.value_iteration(mdp).v[0] == pytest.approx(4 / 3)
    exactly = importers.matrices(rows, [1.0, 0.0], gamma=0.5, ends=[[0.4], [1.0]])
    assert (exactly.transitions != mdp.transitions).nnz == 0
    rare = importers.matrices(np.full((1, 1, 1), 1 - 2.0**-40), [1.0], gamma=0.5, ends=[[2.0**-40]])
    assert rare.has_ends and rare.residual == (0.0, 0.0)
    assert "sums to 1.1" in refusal(ParameterError, importers.matrices, rows, [1, 0], ends=[[0.5], [1.0]])
    assert "ends has shape (2,)" in refusal(ParameterError, importers.matrices, rows, [1, 0], ends=[0.4, 1.0])
    assert "sums to 1.1" in refusal(ParameterError, importers.matrices, rows + 0.25, [1, 0], ends=True)


def test_a_list_has_one_matrix_an_action_dense_or_sparse():
    right = [30.0552486, 28.9502762]  # by hand: (I - 0.9 P) V = R of the best policy
    for P in (
        FOREST,
        [sparse.csr_matrix(each) for each in FOREST],
        tuple(FOREST),
        [FOREST[0], sparse.coo_array(FOREST[1])],
    ):
        assert solved(P, PAID) == pytest.approx(right)
    assert solved(np.stack(FOREST), PAID, axes="ASS") == pytest.approx(right)
    assert solved(np.stack(FOREST, axis=1), PAID, axes="SAS") == pytest.approx(right)
    assert solved([*np.stack(FOREST, axis=1)], PAID, axes="SAS") == pytest.approx(right)


def test_axes_are_asked_for_where_both_orders_fit():
    for P in (np.stack(FOREST), np.stack(FOREST).tolist()):
        assert "say axes='SAS' or axes='ASS'" in refusal(ParameterError, importers.matrices, P, PAID)
    assert "say axes='ASS'" in refusal(ParameterError, importers.matrices, np.full((4, 3, 3), 1 / 3), np.zeros((3, 4)))
    assert importers.matrices(np.full((4, 3, 3), 1 / 3), np.zeros((3, 4)), axes="ASS").num_actions == 4
    assert "axes is 'AXS'" in refusal(ParameterError, importers.matrices, FOREST, PAID, axes="AXS")
    assert "or axes='SAS'" in refusal(ParameterError, importers.matrices, [np.full((3, 2), 0.5)] * 2, PAID)
    R = np.ones((2, 2, 2))
    assert "R has shape (2, 2, 2)" in refusal(ParameterError, importers.matrices, FOREST, R)


def test_rewards_of_transitions_come_in_every_form_of_the_probabilities():
    R = [np.array([[5.0, 10.0], [-1.0, 2.0]]), np.array([[np.nan, 2.0], [3.0, 1.0]])]  # NaN: cannot happen
    means = [[0.3 * 5 + 0.7 * 10, 2.0], [0.6 * -1 + 0.4 * 2, 0.9 * 3 + 0.1]]
    for given in (R, [sparse.csr_matrix(each) for each in R]):
        for P in (FOREST, [sparse.csr_matrix(each) for each in FOREST]):
            assert TabularMDP.from_matrices(P, given).rewards == pytest.approx(np.array(means))
    stacked = np.stack(R)
    assert TabularMDP.from_matrices(np.stack(FOREST), stacked, axes="ASS").rewards == pytest.approx(np.array(means))
    rows = sparse.csr_matrix(np.stack(R, axis=1).reshape(4, 2))
    assert TabularMDP.from_matrices(FOREST, rows).rewards == pytest.approx(np.array(means))
    assert TabularMDP.from_matrices(FOREST, sparse.csr_matrix(PAID)).rewards.tolist() == PAID.tolist()
    assert "expected (4, 2), as P" in refusal(ParameterError, TabularMDP.from_matrices, FOREST, R[:1])
    R[0][0, 0] = np.inf
    assert "R of state 0, action 0" in refusal(ParameterError, TabularMDP.from_matrices, FOREST, R)


def test_actions_that_are_not_there_are_no_free_exits():
    costs, sets = -np.ones((4, 4)), MASKED.sum(axis=2).T > 0
    for ready, axes in ((MASKED, "ASS"), (MASKED.transpose(1, 0, 2), "SAS")):
        mdp = importers.matrices(ready, costs, axes=axes, gamma=0.5)
        np.testing.assert_array_equal(mdp.available, sets)
        np.testing.assert_allclose(pharos.value_iteration(mdp, 1e-9).v, -2.0)


# Bounds ---------------------------------------------------------------------------------------------------------------


@st.composite
def stated_rows(draw):
    """(probabilities (S, A, S) in fractions, the same rounded to a few digits, rewards, gamma)."""
    states, actions = draw(st.integers(1, 4)), draw(st.integers(1, 2))
    number = st.sampled_from([0, 1, 1, 2, 3, 7])
    weights = [[[draw(number) for _ in range(states)] for _ in range(actions)] for _ in range(states)]
    weights = [[row if any(row) else [1] * states for row in rows] for rows in weights]
    true = [[[Fraction(w, sum(row)) for w in row] for row in rows] for rows in weights]
    digits = draw(st.integers(7, 9))
    stated = np.array([[[round(float(p), digits) for p in row] for row in rows] for rows in true])
    if draw(st.booleans()):
        stated = stated.astype(np.float32).astype(np.float64)
    paid = st.sampled_from([0.0, 1.0, -0.7, 12.5])
    rewards = np.array([[[draw(paid) for _ in range(states)] for _ in range(actions)] for _ in range(states)])
    return stated, rewards, draw(st.sampled_from([0.5, 0.9, 0.999]))


def product(row, others):
    """The sum of products in fractions."""
    return sum((Fraction(p) * Fraction(x) for p, x in zip(row, others, strict=True)), Fraction(0))


def exact_values(probabilities, means, gamma, choose):
    """[V(s)] in fractions: the best of all deterministic policies at once, by policy iteration; choose: max or min."""
    states, actions = len(means), len(means[0])
    policy = [0] * states
    while True:
        system = [
            [Fraction(i == j) - Fraction(gamma) * Fraction(probabilities[i][policy[i]][j]) for j in range(states)]
            + [means[i][policy[i]]]
            for i in range(states)
        ]
        v = naive_exact.solved(system)
        q = [
            [means[s][a] + Fraction(gamma) * product(probabilities[s][a], v) for a in range(actions)]
            for s in range(states)
        ]
        better = [choose(range(actions), key=row.__getitem__) for row in q]
        if all(q[s][better[s]] == q[s][policy[s]] for s in range(states)):
            return v
        policy = better


@pytest.mark.long
@examples(150, stated_rows(), st.sampled_from(["matrices", "outcomes", "table"]))
def test_the_model_as_it_was_stated_is_within_the_bound(drawn, kind):
    """Rows that lack something end the episode there, rows that exceed 1 are left out: they are no model."""
    stated, rewards, gamma = drawn
    states, actions, _ = stated.shape
    if kind == "matrices":
        mdp = TabularMDP.from_matrices(stated, rewards, gamma=gamma, axes="SAS")
    elif kind == "outcomes":
        successors = np.broadcast_to(np.arange(states), stated.shape)
        mdp = TabularMDP.from_outcomes(successors, stated, rewards, gamma=gamma)
    else:
        table = [
            [[(p, t, rewards[s, a, t], False) for t, p in enumerate(stated[s, a])] for a in range(actions)]
            for s in range(states)
        ]
        mdp = importers.gymnasium(table, gamma=gamma)
    means = [[product(stated[s, a].tolist(), rewards[s, a].tolist()) for a in range(actions)] for s in range(states)]
    solution, worst = pharos.value_iteration(mdp), pharos.solvers.worst_value(mdp)
    is_model = all(sum(map(Fraction, row)) <= 1 for rows in stated.tolist() for row in rows)
    if is_model:
        truth = exact_values(stated.tolist(), means, gamma, max)
        assert naive_exact.largest_error(solution.v, np.array(truth)) <= Fraction(solution.error_bound)
        truth = exact_values(stated.tolist(), means, gamma, min)
        assert naive_exact.largest_error(worst.v, np.array(truth)) <= Fraction(worst.error_bound)
        with_steps = pharos.value_iteration(mdp, horizon=7)
        v = [Fraction(0)] * states
        for _ in range(7):
            v = [
                max(means[s][a] + Fraction(gamma) * product(stated[s, a].tolist(), v) for a in range(actions))
                for s in range(states)
            ]
        assert naive_exact.largest_error(with_steps.v, np.array(v)) <= Fraction(with_steps.error_bound)
    exact = naive_exact.extreme_values(replace(mdp, residual=type(mdp.residual)()))
    assert naive_exact.largest_error(solution.v, exact) <= Fraction(solution.error_bound)


@pytest.mark.long
def test_the_bound_of_an_example_by_hand():
    """One state that stays with 1 - 1e-7 and pays 1, gamma 0.99: 100, and 1 / (1 - 0.99 (1 - 1e-7)) as stated."""
    stays = Fraction(1 - 1e-7)
    mdp = TabularMDP.from_matrices([[[float(stays)]]], [1.0], gamma=0.99)
    solution = pharos.value_iteration(mdp, 1e-9)
    apart = abs(Fraction(float(solution.v[0])) - 1 / (1 - Fraction(0.99) * stays))
    assert Fraction(98, 100) * Fraction(solution.error_bound) < apart <= Fraction(solution.error_bound)
    for policy in ([0], [[1.0]]):
        assert apart <= Fraction(pharos.evaluate_policy(mdp, np.array(policy)).error_bound) < 2 * apart
    for chance in (sticky_actions, random_actions, pharos.lazy_actions):
        assert pharos.value_iteration(chance(mdp, 0.3)).error_bound > 1e-4
    assert mdp.with_rewards([[2.0]]).residual == (mdp.residual.probabilities, 0.0)


@pytest.mark.long
def test_folders_and_environments_keep_what_the_rows_leave_open(tmp_path):
    mdp = importers.gymnasium(chain(0.3333333), gamma=0.9)
    bound = pharos.value_iteration(mdp).error_bound
    assert bound > 1e-6 and mdp.residual.rewards == pytest.approx(1e-7, rel=1e-3)
    folder = importers.save(mdp, tmp_path / "chain", outcomes=importers.gymnasium_outcomes(chain(0.3333333)))
    again = importers.load(folder)
    assert again.residual == mdp.residual and pharos.value_iteration(again).error_bound == bound
    assert again.reward_table.rounding == mdp.reward_table.rounding > 0
    space = pharos.build(importers.environment(mdp), progress=False)
    built = space.mdp(gamma=0.9)
    assert built.residual == (mdp.residual.probabilities, mdp.residual.rewards + mdp.reward_table.rounding)
    assert pharos.value_iteration(built).error_bound == pytest.approx(bound, rel=1e-3)
    seen = pharos.evaluate_policy(built, lambda seen: np.zeros(len(seen), int), observation="index")
    assert seen.error_bound > 1e-6
    rare = TabularMDP.from_matrices(np.full((1, 1, 1), 1 - 2.0**-40), [1.0], ends=[[2.0**-40]])
    assert importers.environment(rare).successors[0].tolist() == [[0, 1]]  # an end, however rare
    plain = importers.environment(TabularMDP.from_matrices(mdp.transitions, mdp.rewards, gamma=0.9))
    assert plain.digest != importers.environment(mdp).digest and plain.residual == (0.0, 0.0)


# Tables of Gymnasium --------------------------------------------------------------------------------------------------


STAYS = [(1.0, 0, 0.0, False)]


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (
            {0: {0: STAYS}, 1: {}},
            "P[1] has no actions; expected one at least: a terminal state has [(1.0, 1, 0.0, True)]",
        ),
        (
            {0: {0: STAYS}, 1: {0: []}},
            "P[1] has no actions; expected one at least: a terminal state has [(1.0, 1, 0.0, True)]",
        ),
        ({0: {0: [(0.0, 0, 0.0, False)]}}, "P[0][0] has no outcomes"),
        ([[STAYS, STAYS], [STAYS]], "P[1] is a list of 1 actions, and there are 2; expected a list of all, or a dict"),
        ({0: {0: STAYS, 2: STAYS}}, "has no state with the action 1; expected actions 0 to 2"),
        ({0: {0: STAYS, 1: []}}, "has no state with the action 1; expected actions 0 to 1"),
        ({0: {0: STAYS, 10**9: STAYS}}, "has no state with the action 1; expected"),
        ({0: {"left": STAYS}}, "P[0] has the action left; expected numbers from 0 on"),
        ({0: {-1: STAYS, 0: STAYS}}, "P[0] has the action -1; expected numbers from 0 on"),
        ({0: {0: 3}}, "has no P[0][0] with outcomes; expected a list of them"),
        ({1: {0: STAYS}, 2: {0: STAYS}}, "has no P[0] with actions; expected states 0 to 1"),
        ({0: {1: STAYS}}, "has no state with the action 0; expected actions 0 to 1"),
        (
            {0: {0: [(1.0, 0, 0.0)]}},
            "P[0][0] has (1.0, 0, 0.0); expected (probability, next state, ",
        ),
        ("FrozenLake-v1", "FrozenLake-v1: has no table"),
    ],
)
def test_a_malformed_table_is_refused_by_the_row_that_is_wrong(table, message):
    said = refusal(FileFormatError, importers.gymnasium, table)
    assert message in said and len(said) < 200


@pytest.mark.long
@examples(60, worlds(), st.sampled_from([0.0, 0.3]), st.booleans())
def test_what_is_exported_comes_back_with_its_sets(world, random, is_written_as_empty):
    mdp = of_chance(world, 0.0, random)
    assume(mdp.available.any(axis=0).all())  # else the table does not say how many actions there are
    table = exporters.gym_p(mdp)
    if is_written_as_empty:
        table = {s: {a: row.get(a, []) for a in range(mdp.num_actions)} for s, row in table.items()}
    again = importers.gymnasium(table, gamma=mdp.gamma, initial=mdp.initial)
    np.testing.assert_array_equal(again.available, mdp.available)
    for solve in (pharos.value_iteration, pharos.solvers.worst_value, pharos.solvers.uniform_value):
        one, other = solve(mdp), solve(again)
        assert np.abs(one.v - other.v).max() <= one.error_bound + other.error_bound
    twice = importers.gymnasium(exporters.gym_p(again), gamma=mdp.gamma, initial=mdp.initial)
    np.testing.assert_allclose(twice.rewards, again.rewards, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(twice.available, again.available)
    assert abs(twice.dynamics.matrix() - again.dynamics.matrix()).max() <= 1e-15


def test_rewards_and_outcomes_of_a_table_leave_out_what_is_not_available():
    table = {0: {0: [(0.5, 0, 1.0, False), (0.5, 1, 2.0, False)]}, 1: {0: STAYS, 1: [(1.0, 1, 3.0, True)]}}
    asked = []

    def rewards(state, action, next_state, reward):
        asked.append((state, action))
        return 2 * reward

    mdp = importers.gymnasium(table, rewards=rewards)
    assert set(asked) == {(0, 0), (1, 0), (1, 1)}
    assert mdp.available.tolist() == [[True, False], [True, True]]
    assert mdp.rewards.tolist() == [[3.0, 3.0], [0.0, 6.0]]
    outcomes = importers.gymnasium_outcomes(table)
    assert np.diff(outcomes.offsets).tolist() == [2, 2, 1, 1]  # that of an action which is not there is a copy


class Corridor(gymnasium.Env):
    """Two cells, in the first of which there is no way back; what is not available would lead astray."""

    observation_space, action_space = gymnasium.spaces.Discrete(2), gymnasium.spaces.Discrete(2)
    P = {0: {0: [(1.0, 1, 0.0, False)]}, 1: {0: [(1.0, 1, 1.0, True)], 1: [(1.0, 0, 0.0, False)]}}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.cell = 0
        return 0, {}

    def step(self, action):
        assert action in self.P[self.cell]
        ((_, self.cell, reward, ended),) = self.P[self.cell][action]
        return self.cell, reward, ended, False, {}


def test_an_environment_is_stepped_by_available_actions_alone():
    mdp = importers.gymnasium(Corridor(), gamma=0.9)
    assert mdp.available.tolist() == [[True, False], [True, True]]
    assert pharos.value_iteration(mdp).v.tolist() == pytest.approx([0.9, 1.0])


def test_a_message_never_quotes_a_whole_table():
    table = gymnasium.make("Taxi-v4").unwrapped.P
    table[3][2] = [(0.5, 0, 0.0, False)]
    assert refusal(FileFormatError, importers.gymnasium, table).startswith(
        "table: the probabilities of P[3][2] sum to 0.5"
    )
    assert len(str(ParameterError("x" * 10_000 + "; try y"))) <= 2000
    assert str(ParameterError("x" * 10_000 + "; try y")).endswith("; try y")


class FromOne(gymnasium.Env):
    """A ring of three states that shows them from 1 on."""

    P = {s: {a: [(1.0, (s + 1 + a) % 3, float(s), False)] for a in range(2)} for s in range(3)}
    observation_space, action_space = gymnasium.spaces.Discrete(3, start=1), gymnasium.spaces.Discrete(2)

    def __init__(self, bonus=0.0):
        self.bonus = bonus

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.s = 0
        return 1, {}

    def step(self, action):
        _, self.s, reward, ended = self.P[self.s][action][0]
        return self.s + 1, reward + self.bonus, ended, False, {}


def test_observations_may_be_numbered_from_1():
    assert importers.gymnasium(FromOne(), gamma=0.9).next_states.tolist() == [[1, 2], [2, 0], [0, 1]]


def test_a_reward_that_differs_is_called_that():
    message = refusal(FileFormatError, importers.gymnasium, FromOne(bonus=0.5))
    assert "its reward differs from that of the table, 0.0" in message and "chance" not in message
