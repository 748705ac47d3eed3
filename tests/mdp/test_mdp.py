"""TabularMDP: what it accepts and refuses, rewards kept exactly, and chance nested step by step."""

import re

import numpy as np
import pytest
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import sparse

import pharos
from naive import mdp as naive_mdp
from pharos.errors import ParameterError
from pharos.mdp import (
    Rewards,
    TabularMDP,
    mdp_within,
    random_actions,
    states_within,
    sticky_actions,
)
from pharos.mdp.rewards import RewardsCollector
from pharos.solvers import uniform_value, value_iteration, worst_value
from refusals import refusal
from strategies import deterministic_mdps, examples, probabilities, small_mdps


@pytest.mark.parametrize(
    ("initial", "states", "probabilities"),
    [
        (2, [2], [1.0]),
        ([0, 0, 2], [0, 2], [2 / 3, 1 / 3]),
        ([1, 0, 0, 0], [0], [1.0]),
        ([0, 0, 1, 0], [2], [1.0]),
        ([0, 1, 2, 3], [0, 1, 2, 3], [0.25] * 4),
        ([0.0, 0.5, 0.5, 0.0], [1, 2], [0.5, 0.5]),
    ],
)
def test_one_of_all_states_that_is_1_is_a_probability(initial, states, probabilities):
    """An array (S,) of a 1 and else 0 had been taken for the states 1 and 0."""
    mdp = TabularMDP.from_arrays([[1], [2], [3], [3]], np.zeros((4, 1)), initial=initial)
    assert mdp.start_states.tolist() == states
    assert mdp.start_probabilities == pytest.approx(probabilities)


def test_of_two_states_0_and_1_are_the_states():
    mdp = TabularMDP.from_arrays([[1], [1]], [[1.0], [0.0]], initial=[0, 1])
    assert mdp.start_probabilities.tolist() == [0.5, 0.5]


@examples(100, hnp.arrays(np.float64, st.tuples(st.integers(1, 40), st.integers(1, 3)), elements=st.floats(-1e6, 1e6)))
def test_rewards_are_kept_to_the_last_bit(array):
    assert (Rewards.from_array(array).array == array).all()


def test_few_distinct_rewards_take_one_byte_and_many_take_eight():
    assert Rewards.from_array(np.arange(256.0)[:, None]).table.dtype == np.uint8
    many = Rewards.from_array(np.arange(257.0)[:, None])
    assert many.table.dtype == np.float64
    assert (many.array.ravel() == np.arange(257.0)).all()


def test_rewards_collected_in_blocks_turn_from_a_palette_into_numbers_without_loss():
    array = np.random.default_rng(0).normal(size=(300, 2))
    collector = RewardsCollector((300, 2))
    for start in range(0, 300, 50):
        collector.add(start, array[start : start + 50])
    assert (collector.finish().array == array).all()


def executed_distribution(stages, choice, previous, num_actions):
    """Which action is executed, by simulating the stages of chance from the outermost in, in exact arithmetic."""
    distribution = np.eye(num_actions)[choice]
    for kind, p in stages:
        if kind == "random":
            distribution = (1 - p) * distribution + p / num_actions
        elif previous is not None:
            distribution = (1 - p) * distribution + p * np.eye(num_actions)[previous]
    return distribution


@pytest.mark.long
@examples(100, st.lists(st.tuples(st.sampled_from(["random", "sticky"]), probabilities), max_size=4))
def test_any_nesting_of_chance_is_three_weights(stages):
    mdp = TabularMDP.from_arrays([[0, 0, 0]], [[0.0, 0.0, 0.0]])
    for kind, p in reversed(stages):  # the innermost is applied first
        mdp = random_actions(mdp, p) if kind == "random" else sticky_actions(mdp, p)
    chance = mdp.chance
    later = chance.chosen * np.eye(3)[0] + chance.previous * np.eye(3)[1] + chance.uniform / 3
    first = chance.first_chosen * np.eye(3)[0] + chance.first_uniform / 3
    assert later == pytest.approx(executed_distribution(stages, 0, 1, 3))
    assert first == pytest.approx(executed_distribution(stages, 0, None, 3))


@examples(100, deterministic_mdps())
def test_an_mdp_made_of_the_arrays_of_another_is_the_same(mdp):
    again = TabularMDP.from_arrays(
        mdp.next_states, mdp.rewards, gamma=mdp.gamma, initial=mdp.initial, terminal=mdp.terminal
    )
    assert (again.next_states == mdp.next_states).all()
    assert (again.rewards == mdp.rewards).all()
    assert (again.start_states == mdp.start_states).all()
    assert again.start_probabilities == pytest.approx(mdp.start_probabilities)


def test_matrices_may_be_dense_stacked_or_one_for_each_action():
    rng = np.random.default_rng(0)
    dense = rng.dirichlet(np.ones(4), (4, 2))
    rewards = rng.normal(size=(4, 2))
    made = [
        TabularMDP.from_matrices(dense, rewards),
        TabularMDP.from_matrices(sparse.csr_matrix(dense.reshape(8, 4)), rewards),
        TabularMDP.from_matrices([sparse.csr_matrix(dense[:, a]) for a in range(2)], rewards),
    ]
    for mdp in made:
        assert np.abs(mdp.transitions.toarray() - dense.reshape(8, 4)).max() == 0


def test_rewards_of_transitions_are_averaged_over_them():
    P = np.array([[[0.25, 0.75]], [[0.0, 1.0]]])
    R = np.array([[[4.0, 8.0]], [[0.0, 2.0]]])
    assert TabularMDP.from_matrices(P, R).rewards.tolist() == [[7.0], [2.0]]
    assert TabularMDP.from_matrices(P.tolist(), R.tolist()).rewards.tolist() == [[7.0], [2.0]]


def test_rewards_of_states_are_those_of_every_action():
    P = np.array([[[0.25, 0.75], [1.0, 0.0]], [[0.0, 1.0], [0.5, 0.5]]])
    assert TabularMDP.from_matrices(P, [3.0, 4.0], axes="SAS").rewards.tolist() == [[3.0, 3.0], [4.0, 4.0]]


@pytest.mark.parametrize("paid", [0, 1])
def test_a_row_of_minus_one_is_a_terminal_state_where_it_pays_nothing(paid):
    mdp = TabularMDP.from_arrays([[1, 1], [-1, -1]], [[0, 1], [0, paid]])
    assert mdp.terminal.tolist() == [False, not paid]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"next_states": [[0, 5], [1, 0]]}, r"next_states\[0, 1\] is 5"),
        ({"next_states": [[0, -2], [1, 0]]}, r"is -2"),
        ({"next_states": [[0.5, 1.0], [1.0, 0.0]]}, "expected integers"),
        ({"next_states": [0, 1]}, "expected integers of shape"),
        ({"next_states": [[1, 0], [0]]}, "next_states: .*inhomogeneous.*expected an array of numbers"),
        ({"rewards": [["a", 1], [0, 0]]}, "rewards: could not convert .*expected an array of numbers"),
        ({"rewards": [[0, np.nan], [0, 0]]}, "state 0, action 1 is nan"),
        ({"rewards": [[0, np.inf], [0, 0]]}, "inf"),
        ({"rewards": [[0, 1]]}, r"shape \(1, 2\)"),
        ({"gamma": 1.5}, "gamma"),
        ({"gamma": float("nan")}, "gamma"),
        ({"initial": 2}, "initial names state 2"),
        ({"initial": [0.5, 0.6]}, "sum to 1"),
        ({"horizon": 0}, "horizon"),
        ({"horizon": 2**31}, "horizon"),
        ({"terminal": [True, False]}, "terminal"),
    ],
)
def test_arrays_that_are_no_mdp_get_a_clear_error(change, message):
    good = {"next_states": [[0, 1], [1, 0]], "rewards": [[0.0, 1.0], [0.0, 0.0]]}
    assert re.search(message, refusal(ParameterError, TabularMDP.from_arrays, **{**good, **change}))


@pytest.mark.parametrize(
    ("P", "R", "message"),
    [
        (np.ones((2, 1, 2)), np.zeros((2, 1)), "sums to 2"),
        (-np.ones((2, 1, 2)) / 2, np.zeros((2, 1)), "negative"),
        (np.ones((2, 1, 3)), np.zeros((2, 1)), "expected"),
        (np.ones((2, 1, 2)) / 2, np.zeros((3, 1)), "shape"),
        (np.full((2, 1, 2), np.nan), np.zeros((2, 1)), "NaN"),
        (np.ones((2, 2)) / 2, np.zeros((2, 1)), r"shape \(2, 2\); expected \(states, actions, states\)"),
        (np.ones((2, 0, 2)), np.zeros((2, 0)), "expected"),
        (sparse.csr_matrix(np.ones((5, 2)) / 2), np.zeros((2, 2)), r"shape \(5, 2\); expected \(states \* actions"),
        (sparse.csr_matrix([[1.0, 0], [0, 1], [0, 1], [0.5, 0.6]]), np.zeros((2, 2)), "state 1, action 1 sums to 1.1"),
        (sparse.csr_matrix([[0, 1], [1 + 2e-6, 0], [0, 1], [0, 1]]), np.zeros((2, 2)), "state 0, action 1 sums to 1"),
        (sparse.csr_matrix([[1.0, 0], [0, 1]]), np.zeros((2, 1, 3)), "shape"),
    ],
)
def test_matrices_that_are_no_mdp_get_a_clear_error(P, R, message):
    assert re.search(message, refusal(ParameterError, TabularMDP.from_matrices, P, R))


def test_arrays_in_the_place_of_dynamics_are_told_where_they_go():
    for arrays in ([[[0, 1]], [[1, 0]]], np.array([[1], [0]])):
        with pytest.raises(TypeError, match=r"TabularMDP\.from_matrices\(P, R, gamma=0\.99\)"):
            TabularMDP(arrays, [[0.0], [0.0]], gamma=0.9)


def test_other_rewards_leave_terminal_states_without_any():
    mdp = TabularMDP.from_arrays([[1], [-1]], [[1.0], [0.0]])
    assert mdp.with_rewards([[2.0], [0.0]]).rewards.tolist() == [[2.0], [0.0]]
    assert "rewards[1, 0] is 3.0, but state 1 is terminal" in refusal(ParameterError, mdp.with_rewards, [[2.0], [3.0]])


def test_next_states_take_four_bytes_each():
    assert TabularMDP.from_arrays(np.array([[1], [0]], np.int64), np.zeros((2, 1))).next_states.dtype == np.int32


@pytest.mark.parametrize("p", [-0.1, 1.1, float("nan"), "often"])
@pytest.mark.parametrize("randomize", [sticky_actions, random_actions])
def test_a_probability_lies_between_zero_and_one(randomize, p):
    assert "probability" in refusal(ParameterError, randomize, TabularMDP.from_arrays([[0]], [[0.0]]), p)


@pytest.mark.slow
def test_a_state_space_becomes_an_mdp_with_its_own_or_other_rewards(tmp_path):
    space = pharos.build(pharos.make("simple_grid/4x4-decoy"), tmp_path / "grid", progress=False)
    own = space.mdp(gamma=0.9)
    goal = int(np.flatnonzero(own.rewards.max(axis=1) == 1)[0])
    assert own.rewards[goal].max() == 1
    assert (space.mdp(rewards=2 * own.rewards).rewards == 2 * own.rewards).all()
    assert (space.mdp(rewards=lambda self, state, action, next_state: 3.0).rewards[~own.terminal] == 3).all()


@pytest.mark.long
@examples(100, small_mdps(), st.integers(1, 6))
def test_states_that_an_episode_cannot_meet_do_not_matter_to_it(mdp, steps):
    found = mdp_within(mdp, steps)
    met = {int(s) for s, p in zip(mdp.start_states, mdp.start_probabilities, strict=True) if p > 0}
    frontier = set(met)
    for _ in range(steps):
        pairs = [(s, a) for s in frontier for a in range(mdp.num_actions)]
        frontier = {t for s, a in pairs for t, p in naive_mdp.outcomes(mdp, s, a) if t >= 0 and p > 0} - met
        met |= frontier
    assert set(np.flatnonzero(states_within(mdp, steps))) == met
    assert found.num_states == len(met | set(mdp.start_states.tolist()))
    for solve in (value_iteration, uniform_value, worst_value):
        whole, part = (solve(each.with_gamma(1.0).with_horizon(steps)) for each in (mdp, found))
        assert part.value_at_start == pytest.approx(whole.value_at_start, abs=1e-12)


def test_an_mdp_whose_states_are_all_met_stays_itself_and_a_smaller_one_has_other_numbers():
    line = TabularMDP.from_arrays([[1], [2], [3], [3]], [[0.0], [0.0], [1.0], [0.0]], initial=1)
    assert mdp_within(line.with_initial(0), 3).num_states == 4
    mdp = line.with_initial(0)
    assert mdp_within(mdp, 3) is mdp
    part = mdp_within(line, 1)
    assert part.next_states.tolist() == [[1], [1]] and part.rewards.tolist() == [[0.0], [1.0]] and part.initial == 0
    assert part.folder is None and not part.terminal.any()
