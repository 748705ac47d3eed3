"""Models that were trained elsewhere: what stands between the world and their network is applied, or is refused."""

import re
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import pharos
from pharos import importers, solvers, training
from pharos.environments import make
from pharos.errors import ParameterError
from pharos.training import Task
from refusals import refusal

sb3 = pytest.importorskip("stable_baselines3")
pytestmark = pytest.mark.slow

LAKE = "frozen_lake/4x4"
PAGE = Path(__file__).parents[2] / "docs/agents-from-gymnasium.md"


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def lake():
    return pharos.build(LAKE, progress=False).mdp(gamma=1.0).with_horizon(100)


def states_of(lake):
    return pharos.load(lake.folder).states(np.arange(lake.num_states))


def ppo(env, kind=None, **options):
    return (kind or sb3.PPO)(
        "MlpPolicy", env, **{"n_steps": 64, "batch_size": 64, "n_epochs": 2, "seed": 0, "device": "cpu", **options}
    )


def probabilities(model, observations, **options):
    """Straight from the network, in this order of observations."""
    import torch

    with torch.no_grad():
        tensor, _ = model.policy.obs_to_tensor(observations)
        found = model.policy.get_distribution(tensor, **options).distribution.probs.numpy().astype(float)
    return found / found.sum(axis=1, keepdims=True)


def environments(observation="vector", number=2):
    from stable_baselines3.common.vec_env import DummyVecEnv

    return DummyVecEnv([lambda: gymnasium.make("pharos/FrozenLake-4x4-v0", observation=observation)] * number)


# VecNormalize --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def normalized():
    from stable_baselines3.common.vec_env import VecNormalize

    env = VecNormalize(environments(), norm_obs=True, norm_reward=False)
    return ppo(env, learning_rate=1e-2).learn(512), env


def test_a_model_behind_vec_normalize_has_the_value_of_what_it_sees(lake, normalized):
    model, env = normalized
    seen = pharos.observe(make(LAKE), "vector")(states_of(lake))
    mean, var = env.obs_rms.mean.copy(), env.obs_rms.var.copy()
    by_hand = np.clip((seen - mean) / np.sqrt(var + env.epsilon), -env.clip_obs, env.clip_obs).astype(np.float32)
    expected = solvers.evaluate_policy(lake, probabilities(model, by_hand)).value_at_start
    wrong = solvers.evaluate_policy(lake, probabilities(model, seen)).value_at_start
    assert abs(expected - wrong) > 1e-3
    assert pharos.evaluate_policy(lake, model, observation="vector").value_at_start == pytest.approx(expected, abs=1e-6)
    found = training.evaluate_agent(model, Task.of(LAKE))
    assert found.exact and found.value == pytest.approx(expected, abs=1e-6)
    assert (env.obs_rms.mean == mean).all() and (env.obs_rms.var == var).all()


def test_a_model_whose_vec_normalize_was_left_behind_is_refused(lake, normalized, tmp_path):
    from stable_baselines3.common.vec_env import VecNormalize

    model, env = normalized
    model.save(tmp_path / "model.zip")
    env.save(str(tmp_path / "normalizer.pkl"))
    expected = pharos.evaluate_policy(lake, model, observation="vector").value_at_start
    whole = VecNormalize.load(str(tmp_path / "normalizer.pkl"), environments())
    loaded = sb3.PPO.load(tmp_path / "model.zip", env=whole, device="cpu")
    assert pharos.evaluate_policy(lake, loaded, observation="vector").value_at_start == expected
    for others in ({}, {"env": environments()}):
        loaded = sb3.PPO.load(tmp_path / "model.zip", device="cpu", **others)
        for said in (
            refusal(ParameterError, pharos.evaluate_policy, lake, loaded, observation="vector"),
            refusal(ParameterError, training.evaluate_agent, loaded, Task.of(LAKE)),
        ):
            assert "PPO: was trained behind a VecNormalize, which is not with it; load it with env=VecNormalize" in said


@pytest.mark.parametrize(("on_top", "norm_obs"), [(False, True), (True, True), (True, False)])
def test_what_stands_above_vec_normalize_is_refused_and_below_compared(lake, on_top, norm_obs):
    from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize

    if on_top:
        model = ppo(VecFrameStack(VecNormalize(environments(), norm_obs=norm_obs), 2))
    else:
        model = ppo(VecNormalize(VecFrameStack(environments(), 2)))
    said = refusal(ParameterError, pharos.evaluate_policy, lake, model, observation="vector")
    expected = "between its VecNormalize and its network" if on_top and norm_obs else "of shape (4,); 'vector' gives"
    assert expected in said


def test_dqn_behind_vec_normalize_acts_as_it_predicts(lake):
    from stable_baselines3.common.vec_env import VecNormalize

    env = VecNormalize(environments())
    model = sb3.DQN("MlpPolicy", env, learning_starts=32, buffer_size=500, seed=0, device="cpu").learn(200)
    seen = pharos.observe(make(LAKE), "vector")(states_of(lake))
    actions, _ = model.predict(env.normalize_obs(seen), deterministic=True)
    expected = solvers.evaluate_policy(lake, actions).value_at_start
    assert pharos.evaluate_policy(lake, model, observation="vector").value_at_start == expected


# Masks ---------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def masked():
    contrib = pytest.importorskip("sb3_contrib")
    from sb3_contrib.common.wrappers import ActionMasker

    env = ActionMasker(
        gymnasium.make("pharos/FrozenLake-4x4-v0", observation="vector"), lambda _: np.array([True, True, True, False])
    )
    return ppo(env, contrib.MaskablePPO).learn(128)


def test_a_masked_model_has_the_value_of_its_masked_probabilities(lake, masked):
    states = states_of(lake)
    masks = np.ones((lake.num_states, 4), bool)
    masks[:, 3] = False
    masks[states[:, 0] == 0, 0] = False  # and no step to the left in the first row
    free = probabilities(masked, pharos.observe(make(LAKE), "vector")(states))
    by_hand = np.where(masks, free, 0.0)
    expected = solvers.evaluate_policy(lake, by_hand / by_hand.sum(axis=1, keepdims=True)).value_at_start
    assert abs(expected - solvers.evaluate_policy(lake, free).value_at_start) > 1e-4

    def function(seen):  # of states, (N, 2)
        allowed = np.tile([True, True, True, False], (len(seen), 1))
        allowed[seen[:, 0] == 0, 0] = False
        return allowed

    for given in (masks, masks.astype(int), masks.tolist(), function):
        found = pharos.evaluate_policy(lake, masked, observation="vector", masks=given).value_at_start
        assert found == pytest.approx(expected, abs=1e-6)
        task = Task.of(LAKE)
        assert training.evaluate_agent(masked, task, masks=given).value == pytest.approx(expected, abs=1e-6)
        estimate = training.evaluate_agent(masked, task, masks=given, max_states=2, episodes=500)
        assert not estimate.exact and abs(estimate.value - expected) <= estimate.error_bound
        greedy = training.evaluate_agent(masked, task, masks=given, deterministic=True).value
        chosen = by_hand.argmax(axis=1)
        assert greedy == pytest.approx(solvers.evaluate_policy(lake, chosen).value_at_start, abs=1e-6)


def test_masks_that_are_missing_or_do_not_fit_are_refused(lake, masked):
    task, all_true = Task.of(LAKE), np.ones((lake.num_states, 4), bool)
    for said in (
        refusal(ParameterError, pharos.evaluate_policy, lake, masked, observation="vector"),
        refusal(ParameterError, training.evaluate_agent, masked, task),
    ):
        assert "MaskablePPO: was trained under action masks" in said and "give masks=, (S, A) bool" in said
    none = all_true.copy()
    none[3] = False
    for masks, text in (
        (none, "masks allow no action in state 3"),
        (lambda states: np.zeros((len(states), 4), bool), "masks allow no action in state 0"),
        (all_true[:3], "masks have shape (3, 4) and type bool; expected (16, 4) bool"),
        (all_true * 0.5, "type float64"),
        (all_true * 2, "expected (16, 4) bool"),
        (lambda states: all_true[0], "expected (1, 4) bool"),
    ):
        assert text in refusal(ParameterError, pharos.evaluate_policy, lake, masked, observation="vector", masks=masks)
        assert text in refusal(ParameterError, training.evaluate_agent, masked, task, masks=masks)
    for policy in (ppo(environments()), lambda seen: np.zeros(len(seen), int), np.zeros(lake.num_states, int)):
        for evaluate, options in (
            (training.evaluate_agent, {}),
            (pharos.evaluate_policy, {} if isinstance(policy, np.ndarray) else {"observation": "vector"}),
        ):
            first = (policy, task) if evaluate is training.evaluate_agent else (lake, policy)
            assert "masks" in refusal(ParameterError, evaluate, *first, masks=all_true, **options)
    open_at_the_end = all_true & ~np.asarray(lake.terminal)[:, None]  # the end needs no action
    assert pharos.evaluate_policy(lake, masked, observation="vector", masks=open_at_the_end).value_at_start > 0


@pytest.mark.parametrize(
    ("agent", "hyperparameters", "text"),
    [
        ("sb3_contrib:MaskablePPO", {}, "needs action masks, .*ActionMasker.*masks="),
        ("ppo", {"normalize": True}, "normalize is RL Zoo's, for wrappers; leave it out"),
        ("dqn", {"frame_stack": 4}, "frame_stack is RL Zoo's.*frames=k"),
        ("ppo", {"env_wrapper": "x.Y"}, "env_wrapper is RL Zoo's"),
    ],
)
def test_training_says_what_to_do_about_masks_and_wrappers_of_rl_zoo(agent, hyperparameters, text):
    pytest.importorskip("sb3_contrib")
    said = refusal(ParameterError, pharos.train, agent, LAKE, steps=64, hyperparameters=hyperparameters)
    assert re.search(text, said)


class HalfAModel:
    """What looks like a model of Stable-Baselines3, but is none."""

    def __init__(self, policy, env, **options):
        self.policy = policy

    def learn(self, total_timesteps, callback=None):
        return self


def test_a_class_that_lacks_parts_of_the_interface_is_refused_by_their_names():
    said = refusal(ParameterError, pharos.train, HalfAModel, LAKE, steps=64)
    assert "has no num_timesteps, set_logger, get_parameters, set_parameters; expected a class derived from" in said


# Numbers of states ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "options", "world", "parameters"),
    [
        ("FrozenLake-v1", {"is_slippery": False}, "frozen_lake", {"size": 4}),
        ("FrozenLake-v1", {"map_name": "8x8", "is_slippery": True}, "frozen_lake", {"size": 8, "slippery": True}),
        ("CliffWalking-v1", {}, "cliff_walking", {}),
        ("Taxi-v4", {}, "taxi", {}),
    ],
)
def test_numbers_are_those_of_gymnasium(name, options, world, parameters):
    """Walks in both, by the same actions: Gymnasium's observation is the number of the state here."""
    env, ours = gymnasium.make(name, **options).unwrapped, make(world, **parameters)
    number = pharos.observe(ours, "number")
    assert number.space == env.observation_space
    starts = np.array([state for state, _ in ours.initial_states()])
    assert sorted(number(starts)) == np.flatnonzero(env.initial_state_distrib).tolist()
    of_number = dict(zip(number(starts).tolist(), starts.tolist(), strict=True))
    rng = np.random.default_rng(0)
    for episode in range(20):
        seen, _ = env.reset(seed=episode)
        state = of_number[int(seen)]
        for _ in range(40):
            action = int(rng.integers(env.action_space.n))
            seen, _, ended, _, _ = env.step(action)
            followers = {int(number(np.array([ours.next_state(state, action, k)]))[0]): k for k in range(ours.outcomes)}
            assert int(seen) in followers
            state = ours.next_state(state, action, followers[int(seen)])
            if ended:
                break


@pytest.fixture(scope="module")
def imported():
    return importers.gymnasium(gymnasium.make("FrozenLake-v1", is_slippery=False), gamma=1.0, horizon=100)


@pytest.fixture(scope="module")
def of_gymnasium():
    return ppo(gymnasium.make("FrozenLake-v1", is_slippery=False), learning_rate=1e-2).learn(256)


@pytest.mark.long
def test_a_model_of_gymnasium_has_the_same_exact_value_by_every_way(lake, imported, of_gymnasium, tmp_path):
    table = probabilities(of_gymnasium, np.arange(16))
    expected = pytest.approx(solvers.evaluate_policy(imported, table).value_at_start, abs=1e-6)
    world = importers.environment(imported)
    kept = importers.load(importers.save(imported, tmp_path / "kept"))
    assert pharos.evaluate_policy(imported, of_gymnasium, observation="number").value_at_start == expected
    assert pharos.evaluate_policy(kept, of_gymnasium, observation="number").value_at_start == expected
    assert pharos.evaluate_policy(lake, of_gymnasium, observation="number").value_at_start == expected
    for task in (Task.of(LAKE, observation="number"), Task(world, observation="number", horizon=100)):
        found = training.evaluate_agent(of_gymnasium, task)
        assert found.exact and found.value == expected
    sticky = pharos.sticky_actions(imported, 0.25)
    found = pharos.evaluate_policy(sticky, of_gymnasium, observation="number").value_at_start
    assert found == pytest.approx(solvers.evaluate_policy(sticky, table).value_at_start, abs=1e-6)


@pytest.mark.long
def test_numbers_of_another_kind_or_size_are_refused(lake, imported, of_gymnasium, tmp_path):
    world = importers.environment(imported)
    ours = Task(world, observation="index", horizon=100)
    of_gymnasium.save(tmp_path / "model.zip")
    alone = sb3.PPO.load(tmp_path / "model.zip", device="cpu")
    for model, source in ((of_gymnasium, "those of FrozenLakeEnv"), (alone, "of an environment that is not with it")):
        said = refusal(ParameterError, pharos.evaluate_policy, lake, model, observation="index")
        assert source in said and "'number'" in said
        said = refusal(ParameterError, training.evaluate_agent, model, ours)  # 11 states are reached, and the end
        assert "Discrete(16); 'index' gives Discrete(" in said and "'number' is the numbering of Gymnasium" in said
        for other in ("vector", "one_hot", "simple_image"):
            said = refusal(ParameterError, pharos.evaluate_policy, lake, model, observation=other)
            assert f"was trained on observations of Discrete(16); {other!r} gives" in said
        assert pharos.evaluate_policy(lake, model, observation="number").value_at_start > 0
    small = pharos.build(make("frozen_lake", map="SF/FG"), progress=False).mdp(gamma=0.9)
    said = refusal(ParameterError, pharos.evaluate_policy, small, alone, observation="number")
    assert "Discrete(16); 'number' gives Discrete(4)" in said


def test_a_model_of_pharos_on_index_is_taken_there_and_nowhere_else(lake):
    env = environments("index")
    model = ppo(env)
    table = probabilities(model, np.arange(16))
    expected = solvers.evaluate_policy(lake, table).value_at_start
    assert pharos.evaluate_policy(lake, model, observation="index").value_at_start == pytest.approx(expected, abs=1e-6)
    said = refusal(ParameterError, pharos.evaluate_policy, lake, model, observation="number")
    assert "numbers of states, index; 'number' numbers them as the source does" in said


@pytest.mark.long
def test_worlds_without_a_source_have_no_numbers(imported, lake):
    for world in ("simple_grid/4x4-plain", "blackjack", "deep_sea"):
        said = refusal(ParameterError, pharos.observe, make(world), "number")
        assert "which " in said and "use 'index'" in said
    minimal = pharos.bisimulation.minimize(lake).mdp
    said = refusal(ParameterError, pharos.evaluate_policy, minimal, lambda seen: seen * 0, observation="number")
    assert "give the policy as a table" in said
    said = refusal(ParameterError, pharos.evaluate_policy, imported, lambda seen: seen, observation="vector")
    assert "observation='number'" in said
    zero = pharos.evaluate_policy(imported, lambda seen: np.zeros(len(seen), int), observation="number")
    assert zero.value_at_start == 0.0


@pytest.mark.long
def test_imported_worlds_show_the_number_in_their_folder(tmp_path):
    table = importers.matrices(np.eye(3)[[[1, 2], [2, 2], [2, 0]]], np.eye(3, 2), gamma=0.5, initial=1)
    env = importers.environment(importers.save(table, tmp_path / "kept"))
    number = pharos.observe(env, "number")
    assert number.space.n == 3 and number(np.array([[2], [0]])).tolist() == [2, 0]
    from gymnasium.utils.env_checker import check_env

    check_env(pharos.GymEnv(env, observation="number"), skip_render_check=True)
    run = pharos.train("ppo", LAKE, observation="number", steps=64, hyperparameters={"n_envs": 2})
    assert 0 <= run.result["final_value"] <= 1


# The page ------------------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_the_page_gives_exact_values_of_the_models_that_it_trains():
    code = "\n".join(re.findall(r"```python\n(.*?)```", PAGE.read_text(), flags=re.DOTALL))
    assert "learn(30_000)" in code
    names = {}
    exec(compile(code.replace("learn(30_000)", "learn(512)"), str(PAGE), "exec"), names)
    imported, lake = names["mdp"], names["lake"]
    table = probabilities(names["model"], np.arange(16))
    assert names["value"] == pytest.approx(solvers.evaluate_policy(imported, table).value_at_start, abs=1e-6)
    assert names["regret"] == pytest.approx(1.0 - names["value"], abs=1e-6)
    flat = probabilities(names["flat"], np.eye(16))
    found = pharos.evaluate_policy(lake, names["flat"], observation=names["seen"]).value_at_start
    assert found == pytest.approx(solvers.evaluate_policy(imported, flat).value_at_start, abs=1e-6)
