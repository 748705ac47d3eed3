"""Bisimulation: the coarsest partition by brute force, values that are kept, published minimal MDPs."""

import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import strategies as st

import pharos
from naive import mdp as naive_mdp
from pharos import importers
from pharos.errors import ParameterError
from pharos.mdp import TabularMDP, random_actions, sticky_actions
from pharos.mdp.bisimulation import minimize
from strategies import deterministic_mdps, examples, general_mdps, outcome_mdps, probabilities

BRIDGE = Path(__file__).parents[1] / "data" / "bridge"


def bisimilar(mdp):
    """(S + 1, S + 1) bool by a greatest fixed point over all pairs; the last state is the implicit end."""
    size, end = mdp.num_states + 1, mdp.num_states
    table = np.vstack([np.where(mdp.next_states < 0, end, mdp.next_states), np.full((1, mdp.num_actions), end)])
    rewards = np.vstack([mdp.rewards, np.full((1, mdp.num_actions), np.inf)])
    same = (rewards[:, None] == rewards[None]).all(axis=2)
    over = np.append(mdp.terminal, True)
    same &= over[:, None] == over[None]
    while True:
        new = same.copy()
        for s in range(size):
            for t in range(size):
                new[s, t] &= all(same[table[s, a], table[t, a]] for a in range(mdp.num_actions))
        if (new == same).all():
            return same
        same = new


def assert_values_are_kept(mdp, found):
    whole, merged = (pharos.value_iteration(each, 1e-9) for each in (mdp, found.mdp))
    np.testing.assert_allclose(merged.v[found.classes], whole.v, atol=1e-6)
    assert merged.value_at_start == pytest.approx(whole.value_at_start, abs=1e-6)


@pytest.mark.long
@examples(150, deterministic_mdps(max_states=7, max_actions=2))
def test_classes_are_those_of_the_greatest_bisimulation(mdp):
    classes = minimize(mdp).classes
    assert ((classes[:, None] == classes[None]) == bisimilar(mdp)[:-1, :-1]).all()


@pytest.mark.long
@examples(80, deterministic_mdps(max_states=7, max_actions=2), probabilities, probabilities)
def test_values_are_kept_under_every_chance(mdp, sticky, random):
    mdp = random_actions(sticky_actions(mdp, sticky), random)
    found = minimize(mdp)
    assert_values_are_kept(mdp, found)
    assert found.mdp.chance == mdp.chance


@pytest.mark.long
@examples(50, deterministic_mdps(max_states=7, max_actions=2))
def test_a_minimal_mdp_stays_as_it_is(mdp):
    smaller = minimize(mdp)
    assert minimize(smaller.mdp).num_classes == smaller.num_classes
    assert (np.diff(smaller.representatives) > 0).all()


@examples(50, deterministic_mdps(max_states=6, max_actions=2), st.data())
def test_states_that_look_different_stay_apart(mdp, data):
    looks = np.array(data.draw(st.lists(st.integers(0, 2), min_size=mdp.num_states, max_size=mdp.num_states)))
    found = minimize(mdp, looks)
    for each in range(found.num_classes):
        assert len(set(looks[found.classes == each])) == 1
    assert found.num_classes >= minimize(mdp).num_classes
    assert minimize(mdp, np.arange(mdp.num_states)).num_classes == mdp.num_states


def test_copies_of_a_state_are_merged():
    """A corridor in which every cell is there twice."""
    length = 6
    cells = np.arange(length)
    table = np.tile(np.stack([np.append(cells[1:], -1), cells], axis=1), (2, 1))
    rewards = np.zeros((2 * length, 2))
    rewards[[length - 1, 2 * length - 1], 0] = 1
    found = minimize(TabularMDP.from_arrays(table, rewards))
    assert found.num_classes == length
    assert (found.classes == np.tile(cells, 2)).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["key-corridor-s3r1", "empty-16x16-distance-shaped"])
def test_what_bridge_has_consolidated_is_minimal_or_tells_screens_apart(name):
    mdp = importers.bridge(BRIDGE / f"{name}.npz", horizon=100)
    found = minimize(mdp)
    one, other = (pharos.value_iteration(each).value_at_start for each in (mdp, found.mdp))
    assert one == pytest.approx(other, abs=1e-12)
    try:
        screens = importers.bridge_screens(BRIDGE / f"{name}.npz")
    except pharos.errors.FileFormatError:
        return
    assert minimize(mdp, screens).num_classes >= found.num_classes


def bisimilar_general(mdp):
    """(S, S) bool by a greatest fixed point: the probabilities of reaching each class of the relation are equal."""
    matrix = naive_mdp.matrix_of(mdp)
    same = (mdp.rewards[:, None] == mdp.rewards[None]).all(axis=2)
    same &= mdp.terminal[:, None] == mdp.terminal[None]
    while True:
        groups = np.unique(same, axis=0).astype(float)  # rows of an equivalence are its classes
        reached = np.einsum("sat,ct->sac", matrix, groups)
        new = same & (np.abs(reached[:, None] - reached[None]) < 1e-9).all(axis=(2, 3))
        if (new == same).all():
            return same
        same = new


@pytest.mark.long
@examples(100, st.one_of(general_mdps(), outcome_mdps()))
def test_classes_of_general_mdps_are_those_of_the_greatest_bisimulation(mdp):
    classes = minimize(mdp).classes
    assert ((classes[:, None] == classes[None]) == bisimilar_general(mdp)).all()


@pytest.mark.long
@examples(80, general_mdps(), probabilities, probabilities, st.data())
def test_values_of_general_mdps_are_kept_when_states_are_doubled(mdp, sticky, random, data):
    """Each state twice, and each transition spread over both copies."""
    size, actions = mdp.num_states, mdp.num_actions
    share = data.draw(st.sampled_from([0.0, 0.3, 0.5]))
    plain = mdp.transitions.toarray().reshape(size, actions, size)
    doubled = np.tile(np.concatenate([share * plain, (1 - share) * plain], axis=2), (2, 1, 1))
    twice = TabularMDP.from_matrices(doubled, np.tile(mdp.rewards, (2, 1)), gamma=mdp.gamma, axes="SAS", ends=True)
    one, other = (random_actions(sticky_actions(each, sticky), random) for each in (mdp, twice))
    found = minimize(other)
    assert found.num_classes == minimize(one).num_classes
    assert_values_are_kept(other, found)


def rounds_of_all(mdp):
    """Refinement in which every state is asked in every round."""
    classes = np.unique(np.column_stack([mdp.terminal, mdp.rewards + 0.0]), axis=0, return_inverse=True)[1].ravel()
    while True:
        following = np.where(mdp.next_states >= 0, classes[mdp.next_states], -1)
        new = np.unique(np.column_stack([classes, following]), axis=0, return_inverse=True)[1].ravel()
        if new.max() == classes.max():
            return new
        classes = new


ROAD = {"num_cars": 7, "lane_length": 6}  # 19,284 states


@pytest.mark.long
@pytest.mark.parametrize(("name", "parameters"), [("freeway", ROAD), ("frozen_lake/8x8", {}), ("simple_grid", {})])
def test_classes_of_games_are_those_of_refinement_in_full(name, parameters):
    mdp = pharos.build(pharos.make(name, **parameters)).mdp()
    found, expected = minimize(mdp).classes, rounds_of_all(mdp)
    pairs = np.unique(np.column_stack([found, expected]), axis=0)
    assert len(pairs) == found.max() + 1 == expected.max() + 1


def test_observations_must_be_one_a_state():
    mdp = pharos.build(pharos.make("frozen_lake/4x4")).mdp()
    with pytest.raises(ParameterError, match="one for each state"):
        minimize(mdp, np.zeros(3))


def long_river(length):
    """Two actions, which may both stay where they are: ends are told from each other after as many steps as there are
    states."""
    s = np.arange(length)
    ways = [np.stack([np.clip(s + step, 0, length - 1), s], axis=1) for step in (1, -1)]
    successors = np.stack(ways, axis=1)
    rewards = np.zeros((length, 2))
    rewards[-1] = 1.0
    return TabularMDP.from_outcomes(successors, np.broadcast_to([0.8, 0.2], successors.shape).copy(), rewards)


@pytest.mark.long
def test_a_river_of_twenty_thousand_states_takes_as_many_rounds_and_no_longer_than_a_second():
    minimize(long_river(3))  # compiles
    started = time.process_time()
    found = minimize(long_river(20_000))
    assert found.num_classes == 20_000 and found.rounds == 19_999
    assert time.process_time() - started < 1
