"""Observations that several states share: how many there are, and what they cost an agent without memory."""

import itertools

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import strategies as st

import pharos
from command_line import answer, usage_error
from patience import PATIENCE
from pharos.errors import ParameterError
from pharos.observations import aliasing, memoryless_loss, observation_classes, observe
from refusals import refusal
from strategies import examples

pytestmark = pytest.mark.long  # with each class compiled


@pytest.fixture(scope="module")
def breakout(tmp_path_factory):
    env = pharos.make("breakout", height=7, columns=4, brick_rows=1)
    return pharos.build(env, tmp_path_factory.mktemp("space") / "breakout", progress=False)


def test_states_that_share_an_image_are_counted(breakout):
    observation = observe(breakout.environment, "simple_image")
    image = aliasing(breakout, observation)
    assert (image.num_states, image.num_observations) == (1658, 1068)
    assert round(100 * image.share, 1) == 62.5
    assert aliasing(breakout, observe(breakout.environment, "vector")).share == 0
    pixels = observation(breakout.states())
    _, classes, counts = np.unique(pixels.reshape(len(pixels), -1), axis=0, return_inverse=True, return_counts=True)
    assert image.num_sharing == counts[counts > 1].sum()
    alive = np.bincount(classes[~breakout.terminal])
    assert image.num_confused == alive[alive > 1].sum() < image.num_sharing
    found = observation_classes(breakout, observation)
    assert len(set(zip(found.tolist(), classes.tolist(), strict=True))) == len(counts) == found.max() + 1


def test_the_command_line_counts_them_for_each_observation(breakout):
    told = answer("observations", breakout.folder)
    assert told["num_states"] == 1658
    entries = {entry["observation"]: entry for entry in told["observations"] if not entry["options"]}
    assert [entries[name]["num_sharing"] for name in ("vector", "one_hot", "index")] == [0, 0, 0]
    for name in ("simple_image", "complex_image"):
        assert (entries[name]["num_observations"], entries[name]["num_sharing"]) == (1068, 1037)
    assert (entries["vector"]["shape"], entries["vector"]["dtype"]) == ([9], "float32")
    for entry in told["observations"]:  # what images share does not matter in this game, and none is shared with motion
        assert entry["loss"]["exact"]
        assert 0 <= entry["loss"]["lower"] <= entry["loss"]["upper"] <= 1e-6
        assert entry["num_sharing"] == (0 if entry["options"] else entries[entry["observation"]]["num_sharing"])
    assert sum(entry["options"] == {"motion": True} for entry in told["observations"]) == 2
    words = ("--budget", 0, "--observation", "simple_image", "--option", "scale=2")
    (one,) = answer("observations", breakout.folder, *words)["observations"]
    assert (one["options"], one["shape"], one["num_sharing"]) == ({"scale": 2}, [3, 14, 8], 1037)
    assert one["loss"] is None


def test_an_observation_of_ones_own_is_counted_too(breakout):
    from pharos.observations import register

    register("ball_row", lambda env, states: states[:, 0], spaces.Discrete(7))
    (rows,) = answer("observations", breakout.folder, "--observation", "ball_row")["observations"]
    assert (rows["num_observations"], rows["share"], rows["shape"]) == (7, 1.0, [])
    assert "--option goes with --observation" in usage_error("observations", breakout.folder, "--option", "scale=2")


@pytest.mark.parametrize("seed", range(12))
def test_the_loss_is_that_of_the_best_of_all_policies(seed):
    rng = np.random.default_rng(seed)
    P, R = rng.dirichlet(np.full(6, 0.4), (6, 2)), rng.normal(size=(6, 2))
    classes = np.array([0, 0, 0, 1, 1, 2])[rng.permutation(6)]
    if seed % 2:
        table = rng.integers(6, size=(6, 2))
        mdp = pharos.random_actions(pharos.TabularMDP.from_arrays(table, R, gamma=0.9), 0.5)
    else:
        mdp = pharos.TabularMDP.from_matrices(P, R, gamma=0.9)
    every = (
        pharos.evaluate_policy(mdp, np.array(policy)[classes], 1e-9) for policy in itertools.product((0, 1), repeat=3)
    )
    expected = pharos.value_iteration(mdp, 1e-9).value_at_start - max(each.value_at_start for each in every)
    loss = memoryless_loss(mdp, classes, budget=PATIENCE)
    assert loss.exact
    assert loss.lower - 2e-9 <= expected <= loss.upper + 2e-9
    hurried = memoryless_loss(mdp, classes, budget=0)
    assert hurried.lower - 2e-9 <= expected <= hurried.upper + 2e-9


@examples(40, st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.5]))
def test_the_loss_within_sets_is_that_of_the_best_policy_that_takes_what_is_available(seed, random):
    rng = np.random.default_rng(seed)
    sets = rng.random((6, 3)) < 0.7
    sets[np.arange(6), rng.integers(3, size=6)] = True
    classes = np.array([0, 0, 0, 1, 1, 2])[rng.permutation(6)]
    R = np.where(sets, np.round(rng.normal(size=(6, 3)), 1), -np.inf)
    table = rng.integers(6, size=(6, 3))
    mdp = pharos.random_actions(pharos.TabularMDP.from_arrays(table, R, gamma=0.9), random)
    common = [[a for a in range(3) if sets[classes == c, a].all()] for c in range(3)]
    if not all(common):
        assert "no action is available in all of them" in refusal(ParameterError, memoryless_loss, mdp, classes)
        return

    def value(choose):
        """V by sweeps of plain Python; choose: (state, {action: q}) -> the action."""
        v = [0.0] * 6
        for _ in range(400):
            q = [{a: R[s, a] + 0.9 * v[table[s, a]] for a in range(3) if sets[s, a]} for s in range(6)]
            v = [random * sum(q[s].values()) / len(q[s]) + (1 - random) * q[s][choose(s, q[s])] for s in range(6)]
        return v[0]

    best = value(lambda _, q: max(q, key=q.get))
    loss = best - max(value(lambda s, _, p=policy: p[classes[s]]) for policy in itertools.product(*common))
    result = memoryless_loss(mdp, classes, budget=PATIENCE)
    assert result.exact
    assert result.lower - 1e-6 <= loss <= result.upper + 1e-6


def test_two_rooms_that_look_alike_cost_half_of_the_prizes():
    """From the start to one of two rooms; each pays for another action, so one of them must be missed."""
    successors, probabilities = np.full((3, 2, 2), -1), np.zeros((3, 2, 2))
    successors[0], probabilities[0] = (1, 2), 0.5
    probabilities[1:, :, 0] = 1.0
    mdp = pharos.TabularMDP.from_outcomes(successors, probabilities, [[0, 0], [4, 0], [0, 2]], gamma=0.5)
    loss = memoryless_loss(mdp, np.array([0, 1, 1]), budget=PATIENCE)
    assert loss.exact
    assert loss.lower <= 0.5 * 0.5 * 2 <= loss.upper
    assert memoryless_loss(mdp, np.arange(3), budget=PATIENCE).upper <= 1e-6
    with pytest.raises(ParameterError, match="under sticky actions a policy without memory does not know the state"):
        memoryless_loss(pharos.sticky_actions(mdp, 0.25), np.array([0, 1, 1]))
