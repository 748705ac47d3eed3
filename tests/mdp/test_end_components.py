"""End components against their definition: every set of nodes is tried."""

import itertools

import numpy as np
import pytest
from hypothesis import strategies as st

from naive import mdp as naive_mdp
from pharos.mdp import TabularMDP, end_components, sticky_actions
from strategies import examples, small_mdps


def components_by_definition(mdp, pairs=None):
    """[(nodes, choices)] of the maximal end components, nodes s W + b; every subset of the nodes is tried."""
    num_actions, width = mdp.num_actions, mdp.width
    nodes = [(s, b) for s in range(mdp.num_states) for b in range(width)]
    successors = {}
    for s, b in nodes:
        for a in range(num_actions):
            weights = naive_mdp.executed(mdp, b if mdp.is_sticky else num_actions)[a]
            after = {
                (t, x if width > 1 else 0) if t >= 0 else None
                for x in np.flatnonzero(weights)
                for t, p in naive_mdp.outcomes(mdp, s, x)
                if p > 1e-15
            }
            is_allowed = not mdp.terminal[s] and (pairs is None or pairs[s, a])
            successors[s, b, a] = after if is_allowed else {None}

    def is_component(subset):
        edges = {n: set() for n in subset}
        for n in subset:
            for a in range(num_actions):
                if successors[*n, a] <= subset:
                    edges[n] |= successors[*n, a]
        if not all(edges.values()):
            return False
        return all(reached(edges, n) == subset for n in subset)

    sets = [
        frozenset(subset)
        for size in range(1, len(nodes) + 1)
        for subset in itertools.combinations(nodes, size)
        if is_component(frozenset(subset))
    ]
    maximal = [each for each in sets if not any(each < other for other in sets)]
    return [
        (each, {(*n, a) for n in each for a in range(num_actions) if successors[*n, a] <= each}) for each in maximal
    ]


def reached(edges, node):
    seen, queue = set(), [node]
    while queue:
        for m in edges[queue.pop()] - seen:
            seen.add(m)
            queue.append(m)
    return frozenset(seen)


def check(mdp, pairs=None):
    components = end_components(mdp, pairs)
    labels = components.labels.reshape(mdp.num_states, mdp.width)
    choices = components.pairs.reshape(mdp.num_states, mdp.width, mdp.num_actions)
    expected = components_by_definition(mdp, pairs)
    assert components.total == len(expected)
    groups = {frozenset(map(tuple, np.argwhere(labels == c).tolist())) for c in range(components.total)}
    assert groups == {nodes for nodes, _ in expected}
    assert set(map(tuple, np.argwhere(choices).tolist())) == set().union(*(inside for _, inside in expected))


@pytest.mark.long
@examples(300, small_mdps(), st.data())
def test_they_are_the_maximal_sets_that_no_choice_leaves(mdp, data):
    if mdp.num_states * mdp.width > 9:
        return
    check(mdp)
    bits = st.lists(st.booleans(), min_size=mdp.num_states * mdp.num_actions, max_size=mdp.num_states * mdp.num_actions)
    check(mdp, np.array(data.draw(bits)).reshape(mdp.num_states, mdp.num_actions))


@pytest.mark.long
def test_a_component_inside_of_another_one_appears_where_choices_are_left_out():
    # 0 <-> 1 by action 0; 1 -> 2 -> 0 by action 1; 2 may leave to 3, the terminal state
    mdp = TabularMDP.from_arrays([[1, 0], [0, 2], [0, 3], [3, 3]], np.zeros((4, 2)), terminal=[0, 0, 0, 1])
    whole = end_components(mdp)
    assert whole.labels.tolist() == [0, 0, 0, -1]
    assert whole.pairs.tolist() == [[True, True], [True, True], [True, False], [False, False]]
    inner = end_components(mdp, np.array([[True, False], [True, False], [False, True], [True, True]]))
    assert inner.labels.tolist() == [0, 0, -1, -1]


def test_under_sticky_actions_nodes_are_pairs():
    # from 0 action 0 stays and action 1 ends: once action 1 may be repeated, nothing is for ever
    mdp = sticky_actions(TabularMDP.from_arrays([[0, -1]], [[0.0, 0.0]]), 0.25)
    components = end_components(mdp)
    assert components.labels.tolist() == [[0, -1]]
    assert components.pairs.tolist() == [[[True, False], [False, False]]]


@pytest.mark.parametrize("length", [1, 2, 50_000])
def test_a_long_way_takes_no_longer_than_its_states(length):
    # a corridor that ends: every choice goes, one after the other, in one pass
    next_states = np.arange(1, length + 1)[:, None]
    next_states[-1] = -1
    assert end_components(TabularMDP.from_arrays(next_states, np.ones((length, 1)))).total == 0
