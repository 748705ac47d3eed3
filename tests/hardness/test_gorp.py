"""GORP's bound against the enumeration of all samples, against BRIDGE's published value, and against GORP itself."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume
from hypothesis import strategies as st

from naive.gorp import failure_probability, returns_of_paths
from pharos import hardness, importers
from pharos.errors import ParameterError, UndefinedMeasure
from pharos.hardness.gorp import METHODS, GorpSearch, knapsack
from pharos.mdp import TabularMDP, sticky_actions
from refusals import refusal
from strategies import deterministic_mdps, examples, small_mdps

DATA = Path(__file__).parents[1] / "data" / "bridge"
PROVEN = METHODS[1:]


@pytest.fixture(scope="module")
def corridor():
    return importers.bridge(DATA / "key-corridor-s3r1.npz", horizon=100)


@pytest.mark.long
def test_the_published_bound_of_key_corridor_is_reproduced(corridor):
    published = json.loads((DATA / "key-corridor-s3r1_gorp_bounds.json").read_text())
    found = hardness.gorp_bound(corridor, methods=("binomial", "bernstein"))
    assert found.ms == [244]
    assert found.value == pytest.approx(published["effective_horizon"], rel=1e-12)
    assert found.ms[0] * 6 * 100**2 == published["sample_complexity"]
    assert not found.proven


@pytest.mark.parametrize(
    "name, horizon", [pytest.param("freeway_10_fs30", 10, marks=pytest.mark.slow), ("maze_easy_l0_30_fs1", 30)]
)
def test_the_published_bounds_of_other_games_are_reproduced(name, horizon):
    published = json.loads((DATA / f"{name}_gorp_bounds.json").read_text())
    mdp = importers.bridge(DATA / f"{name}.npz", horizon=horizon)
    found = hardness.gorp_bound(mdp, max_k=len(published["k_results"]))
    assert found.value == found.values[0] == pytest.approx(published["effective_horizon"], rel=1e-12)
    assert found.ms[0] * mdp.num_actions * horizon**2 == published["sample_complexity"]


@pytest.mark.long
def test_exact_probabilities_give_a_smaller_bound_that_is_proven(corridor):
    found = hardness.gorp_bound(corridor, methods=("exact", "bernstein"))
    assert found.proven and found.ms == [50]
    assert found.failure_probabilities[0] <= 0.5


@pytest.mark.long
def test_gorp_succeeds_as_often_as_the_exact_probability_says(corridor):
    search = GorpSearch(corridor, 100, ("exact",))
    runs = hardness.run_gorp(corridor, k=1, m=100, runs=60, seed=3)
    expected = 1 - search.failure(100, 1)
    assert runs.success_rate == pytest.approx(expected, abs=3.3 * math.sqrt(expected * (1 - expected) / 60))
    assert set(np.unique(runs.returns)) <= {0.0, 1.0}
    assert runs.actions.shape == (60, 100)


def test_gorp_repeats_itself_with_the_same_seed(corridor):
    one, other = (hardness.run_gorp(corridor, m=3, runs=2, seed=7) for _ in range(2))
    assert (one.actions == other.actions).all()
    assert (one.actions != hardness.run_gorp(corridor, m=3, runs=2, seed=8).actions).any()


@examples(
    60,
    deterministic_mdps(max_states=4, max_actions=2),
    st.integers(1, 3),
    st.integers(1, 2),
    st.sampled_from([1, 2]),
    st.sampled_from(PROVEN),
)
def test_no_proven_method_is_below_the_probability_of_failure(mdp, steps, k, m, method):
    mdp = mdp.with_initial(int(mdp.start_states[0]))
    search = GorpSearch(mdp, steps, (method,))
    assert search.failure(m, k) >= failure_probability(mdp, steps, k, m) - 1e-9


def within_sets(mdp, seed, steps=None):
    """The MDP in which some actions are not available, with one start."""
    rng = np.random.default_rng(seed)
    sets = rng.random(mdp.next_states.shape) < 0.5
    sets[np.arange(len(sets)), rng.integers(mdp.num_actions, size=len(sets))] = True
    options = {"terminal": np.asarray(mdp.terminal), "gamma": 1.0, "horizon": steps, "available": sets}
    return TabularMDP.from_arrays(mdp.next_states, mdp.rewards, **options).with_initial(int(mdp.start_states[0]))


@examples(
    60,
    deterministic_mdps(max_states=4, max_actions=3),
    st.integers(0, 2**32 - 1),
    st.integers(1, 3),
    st.integers(1, 2),
    st.sampled_from(PROVEN),
)
def test_within_sets_no_proven_method_is_below_the_probability_of_failure(mdp, seed, steps, k, method):
    mdp = within_sets(mdp, seed)
    search = GorpSearch(mdp, steps, (method,))
    assert search.failure(1, k) >= failure_probability(mdp, steps, k, 1) - 1e-9


@st.composite
def paying_once(draw):
    """Deterministic MDPs whose returns are 0 or 1: an episode ends when it is paid."""
    mdp = draw(deterministic_mdps(max_states=4, max_actions=3, rewards=st.just(0.0)))
    ends = np.asarray(mdp.next_states) < 0
    ends[np.asarray(mdp.terminal)] = False
    assume(ends.any())
    paid = ends.astype(float)
    return TabularMDP.from_arrays(
        mdp.next_states, paid, terminal=np.asarray(mdp.terminal), gamma=1.0, horizon=4
    ).with_initial(int(mdp.start_states[0]))


@pytest.mark.long
@examples(60, paying_once(), st.integers(1, 4), st.integers(1, 2), st.integers(1, 3))
def test_the_exact_method_is_the_probability_of_failure(mdp, steps, k, m):
    assume(mdp.num_actions**k <= 4)
    search = GorpSearch(mdp, steps, ("exact",))
    if search.two_valued:
        assert search.failure(m, k) == pytest.approx(failure_probability(mdp, steps, k, m), abs=1e-9)


@pytest.mark.long
@examples(60, paying_once(), st.integers(0, 2**32 - 1), st.integers(1, 4), st.integers(1, 2), st.integers(1, 3))
def test_within_sets_the_exact_method_is_the_probability_of_failure(mdp, seed, steps, k, m):
    assume(mdp.num_actions**k <= 4)
    mdp = within_sets(mdp, seed, 4)
    search = GorpSearch(mdp, steps, ("exact",))
    if search.two_valued:
        assert search.failure(m, k) == pytest.approx(failure_probability(mdp, steps, k, m), abs=1e-9)


def test_within_sets_gorp_fails_as_often_as_the_exact_probability_says():
    table, sets = [[2, 1, 0], [-1, -1, 1], [2, -1, 2]], [[True, True, False], [True, False, True], [True, True, True]]
    rewards = [[0, 0, 0], [1, 0, 0], [0, 0, 0]]
    mdp = TabularMDP.from_arrays(table, np.array(rewards, float), gamma=1.0, horizon=2, available=np.array(sets))
    runs = hardness.run_gorp(mdp, m=2, runs=2000, seed=3)
    expected = 1 - failure_probability(mdp, 2, 1, 2)
    assert expected == 0.75  # both samples after action 1 miss the reward with probability 1/4
    assert runs.success_rate == pytest.approx(expected, abs=3.3 * math.sqrt(expected * (1 - expected) / 2000))
    assert (runs.actions[:, 0] < 2).all()
    bound = hardness.gorp_bound(mdp, methods=PROVEN)
    assert bound.value == 1 + math.log(bound.ms[0]) / math.log(3)
    assert hardness.effective_horizon(mdp, horizon=2, tight=1).tight == hardness.gorp_bound(mdp).value


@pytest.mark.slow
@examples(100, st.integers(1, 5), st.data())
def test_the_knapsack_is_the_linear_program(n, data):
    from scipy.optimize import linprog

    unit = st.floats(0, 1)
    f, lower = (np.array(data.draw(st.lists(unit, min_size=n, max_size=n))) for _ in range(2))
    lower /= max(1, lower.sum())
    upper = np.array([data.draw(st.floats(low, 1)) for low in lower])
    assume(upper.sum() >= 1)
    found = linprog(-f, A_eq=np.ones((1, n)), b_eq=[1], bounds=list(zip(lower, upper, strict=True)))
    assert knapsack(lower[None], upper[None], f[None])[0] == pytest.approx(-found.fun, abs=1e-6)


@pytest.mark.slow
@examples(60, small_mdps(max_states=4, max_actions=2), st.integers(1, 4), st.data())
def test_the_return_distribution_is_that_of_all_paths(mdp, steps, data):
    policy = np.array(
        [data.draw(st.sampled_from([[1.0, 0.0], [0.0, 1.0], [0.5, 0.5], [0.2, 0.8]])) for _ in range(mdp.num_states)]
    )
    policy = policy if mdp.num_actions == 2 else None
    found = hardness.return_distribution(mdp, policy, horizon=steps)
    naive = policy if policy is not None else np.full((mdp.num_states, mdp.num_actions), 1 / mdp.num_actions)
    expected = {key: p for key, p in returns_of_paths(mdp, naive, steps).items() if p > 1e-12}
    kept = found.probabilities > 1e-12
    np.testing.assert_allclose(found.returns[kept], sorted(expected), atol=1e-5)
    np.testing.assert_allclose(found.probabilities[kept], [expected[key] for key in sorted(expected)], atol=1e-9)
    assert found.probabilities.sum() == pytest.approx(1)


def test_the_mean_return_of_key_corridor_is_the_published_value_of_random_play(corridor):
    found = hardness.return_distribution(corridor)
    assert found.returns.tolist() == [0.0, 1.0]
    assert found.mean == pytest.approx(0.0032357130, abs=1e-10)
    assert found.quantile(0.99) == 0.0 and found.quantile(0.999) == 1.0


@pytest.mark.parametrize(
    "options, message",
    [
        ({"methods": ("bennett",)}, "unknown method 'bennett'"),
        ({"methods": ()}, "no methods"),
        ({"max_k": 0}, "max_k is 0"),
    ],
)
def test_wrong_options_are_refused(corridor, options, message):
    assert message in refusal(ParameterError, hardness.gorp_bound, corridor, **options)


def test_gorp_is_not_defined_under_chance_or_without_a_horizon(corridor):
    assert "deterministic" in refusal(UndefinedMeasure, hardness.gorp_bound, sticky_actions(corridor, 0.25))
    assert "deterministic" in refusal(UndefinedMeasure, hardness.run_gorp, sticky_actions(corridor, 0.25))
    with pytest.raises(UndefinedMeasure, match="horizon"):
        hardness.return_distribution(TabularMDP.from_arrays(np.zeros((1, 1), int), np.ones((1, 1))))
    assert "m is 0" in refusal(ParameterError, hardness.run_gorp, corridor, m=0)
