"""Small MDPs of every kind, for property tests."""

import itertools
from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from naive import mdp as naive_mdp
from pharos.mdp import OutcomeTable, TabularMDP, lazy_actions, random_actions, sticky_actions

probabilities = st.sampled_from([0.0, 0.1, 0.25, 0.5, 1.0])
gammas = st.sampled_from([0.0, 0.5, 0.9, 0.99])
gammas_near_1 = st.sampled_from([0.9, 0.999, 0.9998, 1 - 1e-5, 1 - 1e-7])
rewards_of_games = st.sampled_from([-1.0, 0.0, 0.1, 0.5, 1.0])


def examples(count: int, /, *arguments, **named):
    """Return a decorator: the property is tested on so many examples that strategies draw, however long each takes."""
    return lambda test: settings(max_examples=count)(given(*arguments, **named)(test))


@st.composite
def deterministic_mdps(draw, max_states: int = 6, max_actions: int = 3, rewards=rewards_of_games, ends: bool = True):
    """A deterministic MDP, with transitions to the end (-1), terminal states and one or several start states."""
    num_states = draw(st.integers(1, max_states))
    num_actions = draw(st.integers(1, max_actions))
    shape = (num_states, num_actions)
    lowest = -1 if ends else 0
    next_states = draw(hnp.arrays(np.int32, shape, elements=st.integers(lowest, num_states - 1)))
    paid = draw(hnp.arrays(np.float64, shape, elements=rewards))
    terminal = draw(hnp.arrays(np.bool_, num_states))
    next_states[terminal] = np.flatnonzero(terminal)[:, None]
    paid[terminal] = 0.0
    starts = draw(st.lists(st.integers(0, num_states - 1), min_size=1, max_size=3))
    gamma = draw(gammas)
    mdp = TabularMDP.from_arrays(next_states, paid, gamma=gamma, terminal=terminal)
    return mdp.with_initial(starts[0] if len(starts) == 1 else starts)


@st.composite
def general_mdps(draw, max_states: int = 5, max_actions: int = 3):
    """An MDP with arbitrary transition probabilities, some of which end the episode."""
    num_states = draw(st.integers(1, max_states))
    num_actions = draw(st.integers(1, max_actions))
    weights = draw(
        hnp.arrays(np.float64, (num_states, num_actions, num_states + 1), elements=st.sampled_from([0.0, 1.0, 2.0]))
    )
    weights[..., 0] += weights.sum(axis=2) == 0
    matrix = (weights / weights.sum(axis=2, keepdims=True))[..., :num_states]
    paid = draw(hnp.arrays(np.float64, (num_states, num_actions), elements=rewards_of_games))
    return TabularMDP.from_matrices(matrix, paid, gamma=draw(gammas), axes="SAS", ends=True)


# How tables of several outcomes can be held: (rows one after another, palette, outcomes of the widest row).
LAYOUTS = {
    "dense, palette": (False, True, 2),
    "ragged, palette": (True, True, 3),
    "dense, one by one": (False, False, 5),
    "ragged, one by one": (True, False, 3),
}

FEW = ("dense, palette", "ragged, palette")  # what most tests have kernels compiled for


def outcome_table(lists, num_actions, ragged, palette, width):
    """An OutcomeTable of lists of (next state, probability), row s A + a; width: the widest row's, at least."""
    num_states, width = len(lists) // num_actions, max(width, *map(len, lists))
    states = np.array([[t for t, _ in row] + [row[0][0]] * (width - len(row)) for row in lists], np.int32)
    chances = np.array([[p for _, p in row] + [0.0] * (width - len(row)) for row in lists])
    arrays = {"successors": states.reshape(num_states, num_actions, width)}
    if ragged:
        arrays = {
            "successors": np.concatenate([states[i, : len(row)] for i, row in enumerate(lists)]),
            "offsets": np.cumsum([0, *map(len, lists)]),
        }
    if palette:
        vectors, codes = np.unique(chances, axis=0, return_inverse=True)
        arrays.update(palette=vectors, codes=codes.reshape(num_states, num_actions).astype(np.uint8))
    else:
        arrays["probabilities"] = chances[chances > 0] if ragged else chances.reshape(num_states, num_actions, width)
    return OutcomeTable(num_actions=num_actions, **arrays)


def as_outcome_tables(mdp):
    """The same MDP as tables of outcomes in every layout."""
    pairs = [(s, a) for s in range(mdp.num_states) for a in range(mdp.num_actions)]
    lists = [[(t, p) for t, p in naive_mdp.outcomes(mdp, s, a) if p > 1e-12] for s, a in pairs]
    return [outcome_table(lists, mdp.num_actions, *layout) for layout in LAYOUTS.values()]


@st.composite
def outcome_mdps(draw, layouts=tuple(LAYOUTS)):
    """An MDP of two actions with one or several outcomes each, that may lead to one state, in some layout."""
    num_states, num_actions = draw(st.integers(1, 4)), 2
    ragged, palette, width = LAYOUTS[draw(st.sampled_from(layouts))]
    vectors = [[1.0], [0.5, 0.5], [0.3, 0.7], [0.1, 0.9], [1 / 3, 2 / 3]]
    vectors += [[1 / 3, 1 / 3, 1 / 3], [0.8, 0.1, 0.1], [0.7, 0.2, 0.1]] if width > 2 else []
    chances = draw(st.lists(st.sampled_from(vectors), min_size=2 * num_states, max_size=2 * num_states))
    states = st.integers(-1, num_states - 1)
    lists = [[(draw(states), p) for p in vector] for vector in chances]
    paid = draw(hnp.arrays(np.float64, (num_states, num_actions), elements=rewards_of_games))
    terminal = draw(hnp.arrays(np.bool_, num_states))
    for s in np.flatnonzero(terminal):
        lists[2 * s : 2 * s + 2] = [[(int(s), 1.0)]] * 2
        paid[s] = 0.0
    mdp = TabularMDP.from_arrays(np.zeros((num_states, num_actions), int), paid, gamma=draw(gammas))
    starts = draw(st.lists(st.integers(0, num_states - 1), min_size=1, max_size=3))
    dynamics = outcome_table(lists, num_actions, ragged, palette, width)
    return replace(mdp, dynamics=dynamics, terminal=terminal).with_initial(starts[0] if len(starts) == 1 else starts)


@st.composite
def acyclic_mdps(draw):
    """(MDP with any chance of choosing, age (S,)): no state can be visited twice; tables, outcomes or matrices."""
    num_states, num_actions = draw(st.integers(1, 5)), 2
    number = np.array(draw(st.permutations(range(num_states))))  # of the state at each place of the order
    vectors = draw(st.lists(st.sampled_from([[1.0], [0.3, 0.7], [1 / 3, 2 / 3]]), min_size=10, max_size=10))
    kind = draw(st.sampled_from(["table", "outcomes", "matrices"]))
    lists = {}
    for place, a in itertools.product(range(num_states), range(num_actions)):
        later = st.sampled_from([-1, *number[place + 1 :].tolist()])
        vector = [1.0] if kind == "table" else vectors[2 * place + a]
        lists[number[place], a] = [(draw(later), p) for p in vector]
    rows = [lists[s, a] for s in range(num_states) for a in range(num_actions)]
    paid = draw(hnp.arrays(np.float64, (num_states, num_actions), elements=rewards_of_games))
    paid *= draw(st.sampled_from([0.7, 1.0, 1e-3, 1e12]))
    mdp = TabularMDP.from_arrays(np.array([row[0][0] for row in rows]).reshape(-1, num_actions), paid)
    if kind != "table":
        mdp = replace(mdp, dynamics=outcome_table(rows, num_actions, False, True, 2))
    if kind == "matrices":
        matrix = mdp.dynamics.matrix()[:, :-1]
        mdp = TabularMDP.from_matrices(matrix, paid, ends=True)
    age = np.empty(num_states, np.int64)
    age[number] = 3 * np.arange(num_states) - 4
    return _with_chance(draw, mdp.with_gamma(draw(st.sampled_from([1.0, 1.0, 0.9, 1 - 1e-7])))), age


@st.composite
def with_chance(draw, mdps):
    """An MDP with any chance of choosing."""
    return _with_chance(draw, draw(mdps))


@st.composite
def hard_mdps(draw):
    """MDPs whose values are hard on floats: gamma near 1, rewards that are no sums of powers of 2, values of 1e12 and
    more."""
    mdp = draw(small_mdps(max_states=4))
    scale = draw(st.sampled_from([0.7, 1.0, 1e-3, 1e12]))
    return mdp.with_gamma(draw(gammas_near_1)).with_rewards(scale * mdp.rewards)


@st.composite
def small_mdps(draw, **options):
    """Any of the above, with any chance."""
    of_outcomes = outcome_mdps(FEW)
    return _with_chance(draw, draw(st.one_of(deterministic_mdps(**options), general_mdps(), of_outcomes)))


@st.composite
def lazy_mdps(draw):
    """An MDP in which actions have no effect now and then, which pays what it wants, with any chance of choosing."""
    mdp = draw(st.one_of(deterministic_mdps(), general_mdps(), outcome_mdps(FEW)))
    staying = draw(hnp.arrays(np.float64, mdp.rewards.shape, elements=rewards_of_games))
    staying[np.asarray(mdp.terminal)] = 0.0
    mdp = lazy_actions(mdp, draw(st.sampled_from([0.1, 1 / 3, 0.9])), staying=draw(st.sampled_from([None, staying])))
    return _with_chance(draw, mdp)


def _with_chance(draw, mdp):
    first, second = draw(probabilities), draw(probabilities)
    kind = draw(st.sampled_from(["plain", "random", "sticky", "random outside", "sticky outside"]))
    if kind == "random":
        return random_actions(mdp, first)
    if kind == "sticky":
        return sticky_actions(mdp, first)
    if kind == "random outside":
        return random_actions(sticky_actions(mdp, first), second)
    if kind == "sticky outside":
        return sticky_actions(random_actions(mdp, first), second)
    return mdp
