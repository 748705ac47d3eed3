"""Tables of several outcomes: what they are made from, how compactly they are held, and what is refused."""

from fractions import Fraction

import numpy as np
import pytest

from naive import exact
from pharos.errors import ParameterError
from pharos.kernels import outcomes as kernels
from pharos.mdp import OutcomeTable, TabularMDP
from pharos.solvers import evaluate_policy, value_iteration
from strategies import LAYOUTS, outcome_table

# Two states: one action of state 0 stays or goes on, the other ends or goes on; state 1 leads to itself.
SUCCESSORS = [[[0, 1], [-1, 1]], [[1, 1], [1, 0]]]
PROBABILITIES = [[[0.25, 0.75], [0.5, 0.5]], [[1.0, 0.0], [1.0, 0.0]]]
REWARDS = [[1.0, 2.0], [0.0, 0.0]]


def changed(array, place, value):
    result = np.array(array)
    result[place] = value
    return result


def test_distinct_vectors_of_probabilities_are_held_once():
    dynamics = OutcomeTable.from_arrays(SUCCESSORS, PROBABILITIES)
    assert dynamics.palette.tolist() == [[0.25, 0.75], [0.5, 0.5], [1.0, 0.0]]
    assert dynamics.codes.tolist() == [[0, 1], [2, 2]]
    assert (dynamics.codes.dtype, dynamics.successors.dtype) == (np.uint8, np.int32)
    assert dynamics.successors.tolist() == [[[0, 1], [-1, 1]], [[1, 1], [1, 1]]]  # what is impossible repeats the first


@pytest.mark.parametrize(("vectors", "dtype"), [(256, np.uint8), (257, np.uint16), (65536, np.uint16), (65537, None)])
def test_codes_take_as_few_bytes_as_their_palette_allows(vectors, dtype):
    first = np.arange(vectors) / (2 * vectors) + 0.25
    probabilities = np.stack([first, 1 - first], axis=1)[:, None]
    dynamics = OutcomeTable.from_arrays(np.zeros((vectors, 1, 2), int), probabilities)
    if dtype is None:
        assert dynamics.codes is None
        assert (dynamics.probabilities == probabilities).all()
    else:
        assert dynamics.codes.dtype == dtype
        assert (dynamics.palette[dynamics.codes] == probabilities).all()


def test_rows_lie_one_after_another_where_more_than_30_percent_would_be_padding():
    successors, probabilities = np.zeros((10, 1, 2), int), np.tile([0.5, 0.5], (10, 1, 1))
    probabilities[:6] = [1.0, 0.0]
    assert OutcomeTable.from_arrays(successors, probabilities).offsets is None
    probabilities[6] = [0.0, 1.0]  # 13 of 20 are possible
    dynamics = OutcomeTable.from_arrays(successors, probabilities)
    assert dynamics.offsets.tolist() == [0, 1, 2, 3, 4, 5, 6, 7, 9, 11, 13]
    assert dynamics.successors.shape == (13,)


def test_impossible_outcomes_are_left_out_wherever_they_stand():
    one = OutcomeTable.from_arrays([[[1, 0, 1]], [[0, 1, 0]]], [[[0.0, 0.5, 0.5]], [[0.5, 0.0, 0.5]]])
    assert one.successors.tolist() == [[[0, 1]], [[0, 0]]]
    assert one.successors_of(np.array([1])).tolist() == [0]


@pytest.mark.slow
def test_a_table_of_single_outcomes_is_deterministic():
    one = TabularMDP.from_outcomes([[[1, 0]], [[-1, 0]]], [[[1.0, 0.0]], [[1.0, 0.0]]], [[1.0], [2.0]], gamma=0.5)
    assert one.is_deterministic
    assert one.dynamics.deterministic_table().tolist() == [[1], [-1]]
    assert value_iteration(one).value_at_start == 2.0
    assert not OutcomeTable.from_arrays(SUCCESSORS, PROBABILITIES).is_deterministic


def test_a_small_outcome_behind_a_certain_one_is_an_outcome():
    """Rows may sum to 1 + 1e-9: what is 1 need not be all."""
    mdp = TabularMDP.from_outcomes([[[0, 1]], [[1, 1]]], [[[1.0, 9e-10]], [[1.0, 0.0]]], [[0.0], [1.0]], gamma=0.9)
    assert not mdp.is_deterministic
    solution = evaluate_policy(mdp, [0, 0])
    rows = exact.exact(np.ones((2, 1, 1)))
    truth = exact.values_of(mdp, rows)
    assert truth[0, 0] > 8e-8 and exact.largest_error(solution.v, truth) <= Fraction(solution.error_bound)


def test_rewards_of_outcomes_are_averaged_and_those_of_impossible_ones_ignored():
    rewards = np.array([[[4.0, 8.0], [1.0, 3.0]], [[0.0, np.nan], [0.0, np.inf]]])
    mdp = TabularMDP.from_outcomes(SUCCESSORS, PROBABILITIES, rewards)
    assert mdp.rewards.tolist() == [[7.0, 2.0], [0.0, 0.0]]


def test_terminal_states_are_those_that_end_or_stay_with_reward_0():
    ends = TabularMDP.from_outcomes([[[0, 1]], [[-1, -1]]], [[[0.5, 0.5]], [[0.5, 0.5]]], [[1.0], [0.0]])
    assert ends.terminal.tolist() == [False, True]
    stays = TabularMDP.from_outcomes(SUCCESSORS, PROBABILITIES, REWARDS, terminal=[False, True])
    assert stays.terminal.tolist() == [False, True]
    with pytest.raises(ParameterError, match="true only where a state leads to itself"):
        TabularMDP.from_outcomes(SUCCESSORS, PROBABILITIES, REWARDS, terminal=[True, False])


@pytest.mark.parametrize(
    ("successors", "probabilities", "rewards", "message"),
    [
        (np.zeros((2, 2), int), PROBABILITIES, REWARDS, r"successors have shape \(2, 2\) and type int64"),
        (np.zeros((2, 2, 2)), PROBABILITIES, REWARDS, "type float64; expected integers"),
        (changed(SUCCESSORS, (0, 1, 1), 2), PROBABILITIES, REWARDS, r"successors\[0, 1, 1\] is 2; expected a state"),
        (changed(SUCCESSORS, (1, 0, 0), -2), PROBABILITIES, REWARDS, r"successors\[1, 0, 0\] is -2"),
        (SUCCESSORS, np.ones((2, 2)), REWARDS, r"probabilities have shape \(2, 2\)"),
        (SUCCESSORS, changed(PROBABILITIES, (0, 1, 0), -0.5), REWARDS, r"probabilities\[0, 1, 0\] is -0.5"),
        (SUCCESSORS, changed(PROBABILITIES, (0, 1, 0), 1.5), REWARDS, r"probabilities\[0, 1, 0\] is 1.5"),
        (SUCCESSORS, changed(PROBABILITIES, (0, 1, 0), np.nan), REWARDS, r"probabilities\[0, 1, 0\] is nan"),
        (SUCCESSORS, changed(PROBABILITIES, (1, 0, 0), 0.9), REWARDS, "state 1, action 0 sum to 0.9"),
        (SUCCESSORS, changed(PROBABILITIES, (1, 0, 0), 1 - 2e-6), REWARDS, "state 1, action 0 sum to 0.99"),
        (SUCCESSORS, PROBABILITIES, np.zeros(2), r"rewards have shape \(2,\); expected \(2, 2\)"),
        (SUCCESSORS, PROBABILITIES, changed(REWARDS, (0, 1), np.nan), "reward of state 0, action 1 is nan"),
        (SUCCESSORS, PROBABILITIES, np.full((2, 2, 2), np.inf), "reward of state 0, action 0, outcome 0 is inf"),
    ],
)
def test_errors_name_the_first_entry_that_is_wrong(successors, probabilities, rewards, message):
    with pytest.raises(ParameterError, match=message):
        TabularMDP.from_outcomes(successors, probabilities, rewards)


def test_an_outcome_table_takes_a_palette_or_probabilities():
    with pytest.raises(ParameterError, match="codes with a palette, or probabilities"):
        OutcomeTable(np.zeros((1, 1, 1), np.int32), 1)


@pytest.mark.slow
@pytest.mark.parametrize(("ragged", "palette", "width"), LAYOUTS.values(), ids=LAYOUTS)
def test_next_states_are_drawn_as_often_as_they_are_probable(ragged, palette, width):
    rows = [[(1, 0.5), (0, 0.25), (-1, 0.25)], [(1, 1.0)], [(0, 1.0)], [(1, 0.5), (1, 0.5)]]
    dynamics = outcome_table(rows, 2, ragged, palette, width)
    for row, outcomes in enumerate(rows):
        states, actions = np.full(4000, row // 2), np.full(4000, row % 2)
        drawn = dynamics.sample(states, actions, np.random.default_rng(row))
        for state in (-1, 0, 1):
            assert abs((drawn == state).mean() - sum(p for t, p in outcomes if t == state)) < 0.04


def hostile(**changes):
    """Arrays of an OutcomeTable of two states and an action, with something changed."""
    arrays = {
        "successors": np.array([[[0, 1]], [[1, 1]]], np.int32),
        "codes": np.array([[0], [1]], np.uint8),
        "palette": np.array([[0.5, 0.5], [1.0, 0.0]]),
    }
    return {name: array for name, array in {**arrays, **changes}.items() if array is not None}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({}, None),
        ({"successors": np.array([0, 1, 1], np.int32), "offsets": np.array([0, 2, 3])}, None),
        ({"codes": None, "palette": None, "probabilities": np.array([[[0.5, 0.5]], [[1.0, 0.0]]])}, None),
        ({"successors": np.array([[[0, 2]], [[1, 1]]], np.int32)}, "from state 0 to state 2; expected -1 to 1"),
        ({"successors": np.array([[[0, 1]], [[1, 0]]], np.int32)}, "padding that does not repeat its first outcome"),
        ({"successors": np.array([[[0.0, 1]], [[1, 1]]])}, "type float64; expected integers"),
        ({"successors": np.array([0, 1, 1], np.int32), "offsets": np.array([0, 3, 3])}, "has 3 outcomes; expected 2"),
        ({"successors": np.array([0, 1, 1], np.int32), "offsets": np.array([0, 1, 3])}, "has 1 outcomes; expected 2"),
        (
            {"successors": np.array([0, 1, 1], np.int32), "offsets": np.array([0, 2, 4])},
            "ends with 4; expected 0 and 3",
        ),
        ({"codes": np.array([[0], [2]], np.uint8)}, "action 0 in state 1 has the code 2; expected 0 to 1"),
        ({"codes": np.array([0, 1], np.uint8)}, r"codes: shape \(2,\)"),
        ({"palette": np.array([[0.5, 0.4], [1.0, 0.0]])}, "palette: vector 0 has the probabilities 0.5, 0.4; expected"),
        ({"palette": np.array([[1.5, -0.5], [1.0, 0.0]])}, "expected positive ones that sum to 1"),
        ({"palette": np.array([[0.5, np.nan], [1.0, 0.0]])}, "expected positive ones that sum to 1"),
        ({"palette": np.array([[0.5, 0.5], [0.0, 1.0]])}, "vector 1 has the probabilities 0.0, 1.0"),
        ({"palette": np.array([[1.0], [1.0]])}, r"palette: shape \(2, 1\) .*; expected float64 of shape \(2, 2\)"),
        ({"codes": None, "palette": None, "probabilities": np.ones((2, 1))}, r"probabilities: shape \(2, 1\)"),
    ],
)
def test_arrays_that_are_no_outcome_table_are_told(changes, message):
    dynamics = OutcomeTable(num_actions=1, **hostile(**changes))
    if message is None:
        dynamics.check()
        return
    with pytest.raises(ParameterError, match=message):
        dynamics.check()


def test_memory_maps_are_not_copied(tmp_path, monkeypatch):
    monkeypatch.setattr(kernels, "UNROLLED_FROM", 0)  # as if states were many
    arrays = hostile()
    maps = {}
    for name, array in arrays.items():
        np.save(tmp_path / f"{name}.npy", array)
        maps[name] = np.load(tmp_path / f"{name}.npy", mmap_mode="r")
    dynamics = OutcomeTable(num_actions=1, **maps)
    assert dynamics.for_kernels[0].base is not None and not dynamics.for_kernels[0].flags.writeable
    assert dynamics.expected(np.array([2.0, 4.0, 0.0])).tolist() == [[3.0], [4.0]]
    assert dynamics.restricted_to(np.array([1])).successors.tolist() == [[[0, 0]]]
