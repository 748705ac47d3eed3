"""The batched engine by itself: its random numbers, that runs do not feel each other, and that it can be resumed."""

from dataclasses import replace

import numpy as np
import pytest

from batched_runs import difference, learned, outcome, runs_of
from pharos.agents.agent import RunShape
from pharos.agents.batched import group_key, make_batch, supports
from pharos.agents.batched.arithmetic import TensorArithmetic
from pharos.agents.batched.runs import lane_width, lane_widths
from pharos.environments import make
from pharos.errors import ParameterError
from pharos.kernels.batched import philox
from pharos.mdp import ChanceSetting, lazy_actions, random_actions
from pharos.policies import is_walk, walk_values
from pharos.training import Task, evaluate_agent

DQN = {"learning_rate": 0.01, "buffer_size": 60, "learning_starts": 20, "batch_size": 8, "train_freq": 4, "n_envs": 2,
       "target_update_interval": 10, "net_arch": [12], "n_steps": 2}  # fmt: skip

PPO = {"n_envs": 2, "n_steps": 8, "batch_size": 12, "n_epochs": 2, "net_arch": [7], "target_kl": 0.01}
AGENTS = {"dqn": DQN, "ppo": PPO}
PI = (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344, 0xA4093822, 0x299F31D0)  # its digits


@pytest.fixture(scope="module")
def grid():
    return Task.of(make("simple_grid"), sticky=0.2, random=0.1)


@pytest.mark.parametrize(
    ("counter", "key", "words"),
    [
        ((0, 0, 0, 0), (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
        ((0xFFFFFFFF,) * 4, (0xFFFFFFFF,) * 2, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
        (PI[:4], PI[4:], (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1)),
    ],
)
def test_philox_gives_the_known_answers_of_random123(counter, key, words):
    from numba import njit

    answer = njit(lambda c, k: philox(c[0], c[1], c[2], c[3], k))
    assert tuple(map(int, answer(tuple(map(np.uint64, counter)), np.uint64(key[0] | key[1] << 32)))) == words


@pytest.mark.parametrize("agent", AGENTS)
def test_a_run_is_the_same_alone_among_others_and_in_another_order(grid, agent):
    runs = runs_of(grid, AGENTS[agent], 40)
    staying = np.zeros((grid.mdp.num_states, grid.mdp.num_actions))
    runs[5] = replace(runs[5], chance=ChanceSetting(lazy=0.1, reward_noise=0.1, reward_delay=3), staying=staying)
    together, backwards, alone = learned(agent, runs), learned(agent, runs[::-1]), learned(agent, runs[5:6])
    assert outcome(together, 5) == outcome(alone, 0)
    assert all(outcome(together, i) == outcome(backwards, 39 - i) for i in range(40))
    assert len({outcome(together, i) for i in range(40)}) == 40


@pytest.mark.parametrize("agent", AGENTS)
def test_a_checkpoint_of_other_lanes_goes_on_in_those(agent, monkeypatch):
    """As one of an older pharos, whose lanes were wider."""
    task = Task.of(make("simple_grid"), observation="simple_image")
    runs, ended = runs_of(task, AGENTS[agent], 7), learned(agent, runs_of(task, AGENTS[agent], 7))
    for width in (2, 8):
        monkeypatch.setattr("pharos.agents.batched.runs.WIDTH_OF_SMALL_IMAGES", width)
        older = make_batch(agent, runs)
        older.learn([ended.steps // 2], lambda step: None)
        monkeypatch.undo()
        newer = make_batch(agent, runs)
        assert [lane.group.width for lane in newer.lanes] == [4, 4]
        newer.restore(older.state())
        assert [lane.group.width for lane in newer.lanes] == {2: [2, 2, 2, 2], 8: [8]}[width]
        newer.learn([ended.steps], lambda step: None)
        assert all(outcome(newer, i) == outcome(ended, i) for i in range(7))


@pytest.mark.parametrize("widths", [[], [7], [8, 2], [2, 6], [0, 8], [10**9], [4, 4, 4], [6, 2, 0]])
def test_a_checkpoint_of_lanes_that_do_not_hold_its_runs_is_refused(widths):
    batch = make_batch("dqn", runs_of(Task.of(make("simple_grid"), observation="simple_image"), DQN, 8))
    state = {name: array for name, array in batch.state().items() if not name.endswith("/updates")}
    state |= {f"{i}/updates": np.broadcast_to(np.int64(0), width) for i, width in enumerate(widths)}
    with pytest.raises(ParameterError, match="expected lanes of 8 runs"):
        batch.restore(state)


@pytest.mark.parametrize("agent", AGENTS)
@pytest.mark.parametrize("observation", ["vector", "simple_image"])
def test_a_run_is_the_same_in_lanes_of_every_width(observation, agent, monkeypatch):
    task = Task.of(make("simple_grid"), sticky=0.2, random=0.1, observation=observation)
    runs = runs_of(task, AGENTS[agent], 12)
    first = outcome(learned(agent, runs[:1]), 0)
    assert all(outcome(learned(agent, runs[:number]), 0) == first for number in (5, 7, 12))
    for width in (2, 6, 12):
        monkeypatch.setattr("pharos.agents.batched.runs.WIDTH_OF_SMALL_IMAGES", width)
        assert outcome(learned(agent, runs), 0) == first


def test_a_lane_has_at_most_three_idle_runs():
    vector, screen, lake, court = (
        RunShape(shape, "uint8", len(shape) == 3, 1, 2, 9) for shape in ((5,), (84, 84, 3), (3, 8, 8), (3, 24, 8))
    )
    assert [lane_widths(number, vector) for number in (1, 5, 10, 32, 37)] == [[4], [6], [10], [32], [32, 6]]
    assert [lane_widths(9, shape) for shape in (screen, lake, court)] == [[8, 4], [4, 4, 4], [2, 2, 2, 2, 2]]
    assert [lane_widths(number, court) for number in (1, 3)] == [[2], [2, 2]]
    assert [lane_widths(number, vector, "cuda") for number in (9, 33, 300)] == [[10], [34], [256, 44]]
    assert lane_widths(9, court, "cuda") == [10]
    assert lane_width(True, "cuda") == 256


def test_a_policy_asked_about_few_observations_answers_as_about_many(grid):
    batch = learned("ppo", runs_of(grid, PPO, 1))
    seen = np.tile(grid.observer.observe.observation(grid.space.states(np.arange(grid.space.num_states))), (30, 1))
    many = batch.policy(0).action_probabilities(seen)
    few = np.concatenate([batch.policy(0).action_probabilities(seen[i : i + 7]) for i in range(0, len(seen), 7)])
    assert np.allclose(many, few, rtol=0, atol=1e-6)


@pytest.mark.parametrize("agent", AGENTS)
def test_a_restored_batch_goes_on_bit_for_bit(grid, agent):
    runs = runs_of(grid, AGENTS[agent])
    kept = {}
    batch = make_batch(agent, runs)
    batch.learn([50, 120], lambda point: kept.setdefault(point, batch.state()))
    resumed = make_batch(agent, runs)
    resumed.restore(kept[50])
    assert resumed.steps == 50
    resumed.learn([120], lambda point: None)
    assert all((resumed.state()[name] == array).all() for name, array in batch.state().items())


def test_what_the_engine_lacks_is_named(grid):
    assert supports("dqn", DQN) is None
    assert supports("a2c", {}).startswith("agent 'a2c'")
    assert supports("dqn", {"train_freq": (1, "episode")}).startswith("train_freq")
    assert supports("ppo", {"use_sde": True}).startswith("use_sde")
    assert supports("dqn", {"policy_kwargs": 3}) == "policy_kwargs: 3; expected a mapping"
    assert supports("dqn", {"policy_kwargs": {"activation_fn": None}}) == "policy_kwargs: activation_fn"
    with pytest.raises(ParameterError, match=r"learning_rate: .* takes a number"):
        make_batch("dqn", runs_of(grid, {**DQN, "learning_rate": "lin_0.1"}))


def test_runs_of_other_shapes_are_of_another_group(grid):
    one, other, alike = (runs_of(grid, {**DQN, **more}, 1)[0] for more in ({}, {"batch_size": 4}, {"gamma": 0.5}))
    assert group_key("dqn", one) == group_key("dqn", alike) != group_key("dqn", other)
    with pytest.raises(ParameterError, match="2 groups"):
        make_batch("dqn", [one, other])


@pytest.mark.parametrize("agent", AGENTS)
def test_tensor_operations_compute_what_the_compiled_loops_do(grid, agent):
    """What runs on other devices, here on the processor."""
    runs = runs_of(grid, AGENTS[agent])
    compiled, tensors = (make_batch(agent, runs) for _ in range(2))
    tensors.lanes[0].networks.arithmetic = TensorArithmetic("cpu", tensors.lanes[0].group.width)
    for batch in (compiled, tensors):
        batch.learn([60], lambda point: None)
    for i in range(3):
        assert difference(compiled.parameters(i), tensors.parameters(i)) <= 1e-5


@pytest.mark.parametrize("agent", AGENTS)
def test_networks_are_on_the_device_that_is_asked_for(grid, agent):
    """Here the processor by the name that devices have, so that no other is needed."""
    other, usual = (learned(agent, runs_of(grid, AGENTS[agent], 1), [60], device=name) for name in ("cpu:0", "cpu"))
    (lane,) = other.lanes
    assert lane.device == "cpu:0"
    assert isinstance(lane.networks.arithmetic, TensorArithmetic)
    assert difference(other.parameters(0), usual.parameters(0)) <= 1e-5


@pytest.mark.long
def test_policies_that_walk_together_are_worth_what_they_are_alone():
    tasks = [Task.of(make("deep_sea", size=5), gamma=gamma) for gamma in (1.0, 0.9)]
    runs = [replace(run, mdp=tasks[i % 2].mdp) for i, run in enumerate(runs_of(tasks[0], DQN, 11))]
    batch = make_batch("dqn", runs)
    mdps = [tasks[i % 2].mdp for i in range(11)]
    together = walk_values(mdps, batch.best_actions)
    alone = [evaluate_agent(batch.policy(i), tasks[i % 2]) for i in range(11)]
    for one, other in zip(together, alone, strict=True):
        assert abs(one.value - other.value) <= one.error_bound + other.error_bound
        assert (one.exact, one.states) == (other.exact, other.states)
    assert len({one.value for one in together}) > 1
    assert all(map(is_walk, mdps)) and not is_walk(random_actions(mdps[0], 0.1))
    assert not is_walk(lazy_actions(mdps[0], 0.1)) and not is_walk(Task.of(make("frozen_lake", slippery=True)).mdp)
