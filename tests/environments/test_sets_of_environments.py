"""Environments in which actions exist in some states only: builder, steps, masks, agents, folders."""

from dataclasses import dataclass

import numpy as np
import pytest

import pharos
from pharos import exporters, importers, training
from pharos.environments import Environment, parameter
from pharos.errors import ParameterError
from pharos.interaction import GymEnv, VectorEnv
from pharos.mdp import TabularMDP
from pharos.solvers import uniform_policy, uniform_value
from refusals import refusal


@dataclass(frozen=True, kw_only=True)
class Corridor(Environment):
    """A corridor with a wall on the left and a door on the right, which opens beside it alone."""

    length: int = parameter(6, low=2)

    name = "corridor_of_sets"
    actions = ("open", "left", "right")
    max_episode_steps = 30

    def variables(self):
        return {"x": range(self.length + 1)}

    def initial_state(self):
        return (2,)

    def is_available(self, state, action):
        if action == 0:
            return state[0] == self.length - 1
        return state[0] > 0 if action == 1 else state[0] < self.length - 1

    def transition(self, state, action, out):
        out[0] = self.length if action == 0 else state[0] + (1 if action == 2 else -1)

    def is_terminal(self, state):
        return state[0] == self.length

    def reward(self, state, action, next_state):
        return 1.0 if action == 0 else -0.01


@dataclass(frozen=True, kw_only=True)
class Slippery(Corridor):
    """A corridor in which a step to the right fails now and then; the sets are those of the class above."""

    name = "slippery_of_sets"
    outcomes = 2

    def probability(self, state, action, outcome):
        fails = 0.25 if action == 2 else 0.0
        return fails if outcome == 1 else 1.0 - fails

    def transition(self, state, action, outcome, out):
        if outcome == 0:
            out[0] = self.length if action == 0 else state[0] + (1 if action == 2 else -1)


@dataclass(frozen=True, kw_only=True)
class OpenEnd(Corridor):
    """A corridor without a wall on the left in its sets: a class that changes the sets alone."""

    name = "open_end_of_sets"

    def is_available(self, state, action):
        return action != 1 and (action == 2) == (state[0] < self.length - 1)


def expected_sets(length):
    """The sets of a corridor by the number of its place."""
    x = np.arange(length + 1)
    sets = np.stack([x == length - 1, x > 0, x < length - 1], axis=1)
    sets[length] = True
    return sets


@pytest.mark.long
@pytest.mark.parametrize(("kind", "length"), [(Corridor, 6), (Slippery, 6), (Corridor, 3000), (Slippery, 3000)])
def test_a_built_space_has_the_sets_of_the_rules_and_leads_nowhere_else(kind, length):
    space = pharos.build(kind(length=length))
    places = space.states()[:, 0]
    assert sorted(places) == list(range(length + 1))
    mdp = space.mdp(gamma=0.9)
    np.testing.assert_array_equal(mdp.available, expected_sets(length)[places])
    if kind is Corridor:
        after = places[np.asarray(mdp.next_states)]
        moved = np.stack([np.full(length + 1, length), places - 1, places + 1], axis=1)
        live = mdp.available & ~mdp.terminal[:, None]
        np.testing.assert_array_equal(after[live], moved[live])
        # others lead where the first available action leads
        rows, first = np.nonzero(~mdp.available)[0], mdp.available.argmax(axis=1)
        np.testing.assert_array_equal(after[~mdp.available], after[rows, first[rows]])
    assert pharos.value_iteration(mdp).v[space.index((length - 1,))] == 1.0


@pytest.mark.long
def test_a_class_that_changes_the_sets_alone_has_its_own():
    mdp = pharos.build(OpenEnd()).mdp(gamma=1.0)
    assert mdp.available.sum(axis=1).tolist() == [1] * (mdp.num_states - 1) + [3]
    assert pharos.value_iteration(mdp).value_at_start == uniform_value(mdp).value_at_start == pytest.approx(0.97)


@pytest.mark.long
def test_given_rewards_of_a_space_count_for_available_actions():
    space = pharos.build(Corridor())
    sets = space.mdp().available
    rewards = np.where(sets & ~space.terminal[:, None], 2.0, -np.inf)
    rewards[space.terminal] = 0.0
    mdp = space.mdp(gamma=0.5, rewards=rewards)
    assert set(np.unique(mdp.rewards)) == {0.0, 2.0}


@pytest.mark.long
def test_masks_are_in_the_infos_and_asked_for_as_sb3_contrib_does():
    env = GymEnv(Corridor())
    _, info = env.reset(seed=0)
    for action, mask in ((2, [0, 1, 1]), (2, [0, 1, 1]), (2, [1, 1, 0])):
        assert info["action_mask"].dtype == np.int8 and info["action_mask"].tolist() == [0, 1, 1]
        info = env.step(action)[4]
        assert info["action_mask"].tolist() == mask == env.action_masks().astype(int).tolist()
    assert info["action_mask"].tolist() == [1, 1, 0]
    vector = VectorEnv(Corridor(), 3)
    _, info = vector.reset(seed=0)
    assert info["action_mask"].tolist() == [[0, 1, 1]] * 3 == vector.action_masks().astype(int).tolist()
    info = vector.step(np.array([1, 2, 2]))[4]
    np.testing.assert_array_equal(info["action_mask"], expected_sets(6)[info["state"][:, 0]])
    assert "action_mask" not in GymEnv("frozen_lake/4x4").reset(seed=0)[1]


def test_an_action_that_is_not_available_acts_as_the_first_one_that_is():
    env = GymEnv(Corridor())
    env.reset(seed=0)
    assert env.step(0)[4]["state"].tolist() == [1]  # open, which is not there: left


CHANCES = {"sticky": {"sticky": 0.3}, "random": {"random": 0.4}, "both": {"sticky": 0.3, "random": 0.4}}


def likely(sets, chosen, previous, *, sticky=0.0, random=0.0):
    """(A,) how likely each action is executed: random actions replace the choice, which then may stick."""
    uniform = sets / sets.sum()
    result = (1 - random) * np.eye(len(sets))[chosen] + random * uniform
    if previous >= 0 and sets[previous]:
        result = (1 - sticky) * result + sticky * np.eye(len(sets))[previous]
    return result


@pytest.mark.parametrize("chance", CHANCES)
@pytest.mark.parametrize("tabulated", [False, True])
def test_steps_execute_what_is_available_as_often_as_they_should(chance, tabulated):
    world, n, counts = Corridor(), 4000, {}
    space = pharos.build(world) if tabulated else None
    env = VectorEnv(world, n, autoreset_mode="NextStep", space=space, time_limit=6, **CHANCES[chance])
    env.reset(seed=3)
    rng, sets = np.random.default_rng(0), expected_sets(world.length)
    for _ in range(14):
        x, previous, ended = env.states[:, 0], env._previous.copy(), env._ended.copy()
        chosen = (rng.random((n, 3)) * sets[x]).argmax(axis=1)
        executed = env.step(chosen)[4]["executed_action"]
        assert (executed[ended] == -1).all() and sets[x, executed][~ended].all()
        for key in zip(x[~ended], chosen[~ended], previous[~ended], executed[~ended], strict=True):
            counts.setdefault(key[:3], np.zeros(3))[key[3]] += 1
    assert len(counts) > 15
    for (x, chosen, previous), seen in counts.items():
        p = likely(sets[x], chosen, previous, **CHANCES[chance])
        assert (np.abs(seen - seen.sum() * p) <= 5 * np.sqrt(seen.sum() * p * (1 - p)) + 1e-9).all()


@pytest.mark.long
@pytest.mark.parametrize("chance", CHANCES)
def test_one_environment_and_many_draw_the_same_within_the_sets(chance):
    one = GymEnv(Slippery(), **CHANCES[chance])
    many = VectorEnv(Slippery(), 1, autoreset_mode="Disabled", **CHANCES[chance])
    rng = np.random.default_rng(1)
    info, _ = one.reset(seed=5)[1], many.reset(seed=[5])
    for _ in range(20):
        action = int(rng.choice(np.flatnonzero(info["action_mask"])))
        *_, done, cut, info = one.step(action)
        others = many.step(np.array([action]))[4]
        assert info["executed_action"] == others["executed_action"][0]
        assert info["state"].tolist() == others["state"][0].tolist()
        if done or cut:
            return


def test_a_choice_that_is_not_available_acts_as_the_first_one_that_is_before_chance():
    env = GymEnv(Corridor(), sticky=0.01)
    env.reset(seed=0)
    assert env.step(0)[4]["executed_action"] == 1  # open, which is not there


@pytest.mark.long
def test_a_state_without_actions_is_refused():
    @dataclass(frozen=True, kw_only=True)
    class Stuck(Corridor):
        name = "stuck_of_sets"

        def is_available(self, state, action):
            return action == 2 and state[0] < 4

    assert "has no available action" in refusal(ParameterError, pharos.build(Stuck()).mdp)


# Folders, files and agents --------------------------------------------------------------------------------------------


def tree():
    """A tree whose states have 2, 1 and 3 choices; and what it is with all of them."""
    after = [[1, 2, 0], [3, 0, 0], [3, 4, 3], [-1] * 3, [-1] * 3]
    rewards = [[1.0, 1.5, np.nan], [0.25, np.nan, np.nan], [2.0, 1.0, 0.5], [0.0] * 3, [0.0] * 3]
    sets = ~np.isnan(rewards)
    return TabularMDP.from_arrays(after, np.where(sets, rewards, -np.inf), gamma=0.9)


@pytest.mark.long
def test_a_folder_keeps_the_sets(tmp_path):
    mdp = tree()
    folder = importers.save(mdp, tmp_path / "tree", actions=["a", "b", "c"])
    loaded = importers.load(folder)
    np.testing.assert_array_equal(loaded.available, mdp.available)
    assert uniform_value(loaded).value_at_start == uniform_value(mdp).value_at_start
    space = pharos.build(importers.environment(folder))
    built = space.mdp(gamma=0.9)
    assert uniform_value(built).value_at_start == pytest.approx(uniform_value(mdp).value_at_start)
    assert pharos.hardness.sum_of_reciprocal_gaps(built) == pytest.approx(pharos.hardness.sum_of_reciprocal_gaps(mdp))


def test_tables_and_drn_have_the_choices_that_there_are(tmp_path):
    table = exporters.gym_p(tree())
    assert [len(table[s]) for s in range(5)] == [2, 1, 3, 3, 3]
    text = exporters.drn(tree(), tmp_path / "tree.drn").read_text()
    state = text.split("state 1 ")[1].split("state 2 ")[0]
    assert state.count("action") == 1
    assert "have a next state for each action in each state" in refusal(
        ParameterError, exporters.bridge, tree(), tmp_path / "t.npz"
    )


@pytest.mark.long
@pytest.mark.parametrize("chance", ["none", *CHANCES])
def test_q_learning_and_the_batched_engine_learn_within_the_sets(chance, tmp_path):
    world = importers.environment(tree())
    for agent, options in (("q_learning", {}), ("dqn", {"engine": "batched"}), ("ppo", {"engine": "batched"})):
        out = tmp_path / agent
        result = pharos.train(agent, world, steps=2048, out=out, **options, **CHANCES.get(chance, {}))
        values = [row["value"] for row in result.curve]
        assert np.isfinite(values).all()
        loaded, policy = training.load_agent(out)
        again = training.evaluate_agent(policy, loaded)
        assert again.exact and again.value == pytest.approx(values[-1], abs=1e-6)
    said = refusal(ParameterError, pharos.train, "ppo", world, steps=64, engine="sb3")
    assert "takes no action masks" in said and "MaskablePPO" in said


def test_a_masked_model_is_evaluated_with_the_sets_of_the_mdp():
    contrib = pytest.importorskip("sb3_contrib")
    from pharos.interaction import make_sb3_vec

    model = contrib.MaskablePPO("MlpPolicy", make_sb3_vec(Corridor(), 2, seed=0), n_steps=64, seed=0, device="cpu")
    model.learn(256)
    mdp = pharos.build(Corridor()).mdp(gamma=1.0).with_horizon(30)
    own = pharos.evaluate_policy(mdp, model, observation="vector").value_at_start
    given = pharos.evaluate_policy(mdp, model, observation="vector", masks=mdp.available).value_at_start
    assert own == given
    assert own > pharos.evaluate_policy(mdp, uniform_policy(mdp)).value_at_start - 1.0
    plain = contrib.TRPO("MlpPolicy", make_sb3_vec(Corridor(), 1, seed=0), device="cpu")
    assert "is not available" in refusal(ParameterError, pharos.evaluate_policy, mdp, plain, observation="vector")
