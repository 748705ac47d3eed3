"""Stacked frames in the batched engine: agents see what Stable-Baselines3 shows them, step by step."""

import importlib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.vec_env import VecEnvWrapper

import pharos
from batched_runs import (
    RUN,
    Killed,
    assert_same_rollouts,
    bytes_of,
    difference,
    drawn_rows,
    kill_at,
    learned,
    outcome,
    runs_of,
    updates_of,
)
from pharos.agents import make_model
from pharos.agents.batched import ObservationSource, group_key, make_batch
from pharos.agents.batched import inputs as network_inputs
from pharos.errors import ParameterError
from pharos.interaction import make_sb3_vec
from pharos.kernels import batched
from pharos.policies import walk_values
from pharos.training import ChanceSetting, Task, evaluate_agent, load_agent, train_many

BREAKOUT = pharos.make("breakout", height=6, columns=3, brick_rows=1)
SIGHTS = {
    "small": ("simple_image", {"frames": 3, "grey": True}),
    "planes": ("simple_image", {"frames": 2, "motion": True}),
    "large": ("complex_image", {"frames": 2, "size": (40, 44)}),
    "channels first": ("complex_image", {"frames": 3, "size": (20, 24), "grey": True, "channels_first": True}),
}
DQN_OPTIONS = {"learning_rate": 0.01, "buffer_size": 60, "learning_starts": 20, "batch_size": 8, "train_freq": 4,
               "n_envs": 2, "target_update_interval": 10, "net_arch": [12], "n_steps": 2}  # fmt: skip
PPO_OPTIONS = {"n_envs": 3, "n_steps": 16, "batch_size": 24, "n_epochs": 2, "net_arch": [6], "gamma": 0.9}
AGENTS = {"dqn": DQN_OPTIONS, "ppo": PPO_OPTIONS}
LIMIT = 9


def task_of(sight="small", **options):
    name, seen = SIGHTS[sight]
    return Task(BREAKOUT, observation=name, observation_options=seen, horizon=LIMIT, **options)


class Scripted(VecEnvWrapper):
    """An environment in which the actions of a script are executed, whatever those that are chosen."""

    def __init__(self, env, script):
        super().__init__(env)
        self.script, self.at = script, 0

    def reset(self):
        return self.venv.reset()

    def step_async(self, actions):
        self.venv.step_async(self.script[self.at])
        self.at += 1

    def step_wait(self):
        return self.venv.step_wait()


def recorded(agent, task, hyperparameters, steps):
    """A lane that has taken its steps, without updates; and the environment in which Stable-Baselines3 takes them."""
    lane, *_ = make_batch(agent, runs_of(task, hyperparameters, steps=steps)).lanes
    script, flags, move = [], set(), lane.execute_actions

    def record():
        move()
        script.append(lane.actions[RUN].copy())
        flags.update(lane.worlds.flags[RUN].tolist())

    lane.execute_actions = record
    env = make_sb3_vec(task.env, lane.group.copies, seed=0, **task.interaction)
    return lane, Scripted(env, script), flags


def channels_first(observations, shape):
    """Images (N, ...) as Stable-Baselines3 keeps them, in this shape."""
    return observations if observations.shape[1:] == tuple(shape) else np.moveaxis(observations, -1, 1)


@pytest.mark.long
@pytest.mark.parametrize("n_steps", [1, 3])
@pytest.mark.parametrize("sight", SIGHTS)
def test_dqn_learns_from_the_frames_that_stable_baselines3_keeps(sight, n_steps, monkeypatch):
    """From a memory that has gone round, with episodes that end and that are cut off."""
    hyperparameters = {**DQN_OPTIONS, "n_steps": n_steps, "buffer_size": 63, "n_envs": 3, "exploration_final_eps": 1.0}
    task, total = task_of(sight), 600
    lane, env, flags = recorded("dqn", task, hyperparameters, total)
    monkeypatch.setattr(lane, "learn_minibatch", lambda: None)
    lane.advance(total)
    assert flags == {0, batched.ENDED, batched.ENDED | batched.TIMEOUT}
    model = make_model(DQN, env, hyperparameters, seed=0)
    monkeypatch.setattr(model, "train", lambda **_: None)
    model.learn(total)
    buffer, memory, frames = model.replay_buffer, lane.replay, task.observation_options["frames"]
    assert buffer.full and buffer.buffer_size == memory.size == 21
    assert memory.memory[0].shape[1] == memory.rows == memory.size + frames - 1
    assert set(memory.memory[4][RUN].ravel().tolist()) == flags

    size, place = 400, lane.calls % memory.rows
    states, nexts = (np.zeros((lane.group.width, size, frames), np.int64) for _ in range(2))
    actions = np.zeros((lane.group.width, size), np.int64)
    rewards, factors = (np.zeros((lane.group.width, size), np.float32) for _ in range(2))
    batch = (states, nexts, actions, rewards, factors)
    gammas = lane.group.own["gamma"]
    batched.sample_histories(lane.group.keys, (7, 0), (place, memory.size), gammas, n_steps, memory.memory, batch)
    rows, copies = drawn_rows(lane, size, memory.size)
    assert set(rows.tolist()) == set(range(memory.size)), "all of the memory is among them"
    monkeypatch.setattr(np.random, "randint", lambda *_, **__: copies)
    theirs = buffer._get_samples((lane.calls - memory.size + rows) % memory.size)
    source = lane.group.runs[RUN].observe
    for mine, their in ((states, theirs.observations), (nexts, theirs.next_observations)):
        assert (channels_first(source.at(mine[RUN]), their.shape[1:]) == their.numpy()).all()
    assert np.abs(rewards[RUN] - theirs.rewards.numpy()[:, 0]).max() <= 1e-6
    assert len(np.unique(states[RUN], axis=0)) > len(np.unique(states[RUN, :, -1])), "frames tell more than one"


@pytest.mark.long
@pytest.mark.parametrize("sight", SIGHTS)
def test_ppo_gathers_the_frames_and_values_that_stable_baselines3_gathers(sight, monkeypatch):
    """Its values are those of the same network: of each observation, and of the last one before a time limit."""
    task, total = task_of(sight), 4 * 48
    lane, env, flags = recorded("ppo", task, PPO_OPTIONS, total)
    monkeypatch.setattr(lane, "learn_minibatch", lambda minibatch, is_active: is_active)
    ours = updates_of(lane, ("states", "rewards", "kept_values", "begins", "advantages"), monkeypatch)
    theirs = []
    lane.advance(total)
    assert flags == {0, batched.ENDED, batched.ENDED | batched.TIMEOUT}
    model = make_model(PPO, env, PPO_OPTIONS, seed=0)
    model.policy.load_state_dict({name: torch.from_numpy(array) for name, array in lane.stored(RUN).items()})
    buffer = model.rollout_buffer
    kept = ("observations", "rewards", "values", "episode_starts", "advantages")
    monkeypatch.setattr(model, "train", lambda: theirs.append({name: getattr(buffer, name).copy() for name in kept}))
    model.learn(total)
    assert len(ours) == len(theirs) == 4
    source = lane.group.runs[RUN].observe
    for mine, their in zip(ours, theirs, strict=True):
        steps, copies, *shape = their["observations"].shape
        seen = source.at(mine["states"].reshape(steps * copies, -1))
        assert (channels_first(seen, tuple(shape)).reshape(their["observations"].shape) == their["observations"]).all()
        assert (their["episode_starts"] == mine["begins"]).all()
        # of order 1 in float32: sums of a thousand products, in the order that the processor's library takes
        assert_same_rollouts(mine, their, 1e-5)


@pytest.mark.long
@pytest.mark.parametrize("agent", AGENTS)
def test_a_run_with_frames_is_the_same_alone_among_others_and_drawn(agent, monkeypatch):
    """`drawn`: where pictures fit no table."""
    runs = runs_of(task_of(sticky=0.1), AGENTS[agent], 11)
    runs[5] = replace(runs[5], chance=ChanceSetting(reward_noise=0.1, reward_delay=3))
    together, backwards = learned(agent, runs), learned(agent, runs[::-1])
    alone = outcome(learned(agent, runs[5:6]), 0)
    assert outcome(together, 5) == alone
    assert all(outcome(together, i) == outcome(backwards, 10 - i) for i in range(11))
    assert len({outcome(together, i) for i in range(11)}) == 11
    monkeypatch.setattr(network_inputs, "OBSERVED_BYTES", 0)
    assert outcome(learned(agent, runs[5:6]), 0) == alone


@pytest.mark.long
@pytest.mark.parametrize("agent", AGENTS)
def test_a_batch_with_frames_goes_on_from_its_state_bit_for_bit(agent):
    runs, kept = runs_of(task_of(), {**AGENTS[agent], "n_envs": 3}, steps=240), {}
    batch = make_batch(agent, runs)
    batch.learn([99, 150, 240], lambda point: kept.setdefault(point, batch.state()))
    for point in (99, 150):  # before and after the memory has gone round
        resumed = make_batch(agent, runs)
        resumed.restore(kept[point])
        resumed.learn([240], lambda point: None)
        assert all((resumed.state()[name] == array).all() for name, array in batch.state().items())


@pytest.mark.long
@pytest.mark.parametrize("agent", AGENTS)
def test_frames_elsewhere_are_those_of_the_processor(agent):
    """On other devices a table of single pictures lies there; sizes share a lane."""
    courts = (BREAKOUT, pharos.make("breakout", height=5, columns=4, brick_rows=1))
    tasks = [Task(env, observation="simple_image", observation_options={"frames": 2, "grey": True}) for env in courts]
    runs = [run for i, task in enumerate(tasks) for run in runs_of(task, AGENTS[agent], 2 + i)]
    elsewhere = learned(agent, runs, device="cpu:0")
    assert len(elsewhere.lanes) == 1
    for first, last in ((0, 2), (2, 5)):
        usual = learned(agent, runs[first:last])
        for i in range(last - first):
            assert difference(elsewhere.parameters(first + i), usual.parameters(i)) <= 1e-4


@pytest.mark.long
@pytest.mark.parametrize("sight", SIGHTS)
def test_what_is_looked_up_is_what_is_drawn(sight, monkeypatch):
    task = task_of(sight)
    runs = runs_of(task, DQN_OPTIONS, 1)
    in_table, drawn = make_batch("dqn", runs).lanes[0], None
    monkeypatch.setattr(network_inputs, "OBSERVED_BYTES", 0)
    drawn = make_batch("dqn", runs).lanes[0]
    assert in_table.inputs.table._table is not None and drawn.inputs.table._table is None
    shape = (in_table.group.width, 7, *in_table.inputs.depth)
    histories = np.random.default_rng(0).integers(0, task.space.num_states, shape)
    states = SimpleNamespace(array=histories)
    assert torch.equal(in_table.inputs.observed(states), drawn.inputs.observed(states))
    seen = drawn.inputs.table.encoded(runs[0].observe.at(histories[0]), 0)
    assert torch.equal(in_table.inputs.observed(states)[0], seen)


# What policies are worth, and runs ------------------------------------------------------------------------------------


@pytest.mark.long
def test_frames_are_of_a_group_of_their_own_and_what_the_engine_lacks_is_named():
    seen = {
        frames: Task(BREAKOUT, observation="simple_image", observation_options={"frames": frames, "scale": 4})
        for frames in (1, 2)
    }
    one, two = (runs_of(task, DQN_OPTIONS, 1)[0] for task in seen.values())
    wide = replace(one, observe=SimpleNamespace(**{**vars(one.observe), "shape": two.observe.shape}))
    assert group_key("dqn", wide) != group_key("dqn", two)
    assert two.observe.at(np.zeros((5, 2), np.int64)).shape == (5, *two.observe.shape)
    options = {"observation": "complex_image", "observation_options": {"frames": 4, "size": (12, 12)}}
    with pytest.raises(ParameterError, match=r"4 frames have as many channels as rows, \(12, 12, 12\), .* sb3 has it"):
        runs_of(Task(BREAKOUT, **options), DQN_OPTIONS, 1)
    for more in ({"previous_action": True}, {"observation_options": {"irrelevant": 2}}):
        with pytest.raises(ParameterError, match="the batched engine sees functions of the last states"):
            runs_of(Task(BREAKOUT, **more), DQN_OPTIONS, 1)


@pytest.mark.long
def test_policies_of_frames_that_walk_together_are_worth_what_they_are_alone():
    """Policies of the bytes that are seen, so that nothing is compiled."""
    task = task_of()
    source = ObservationSource.of(task.space, task.observer.observe)

    def policy(seed):
        def answer(observations):
            words = [np.frombuffer(each.tobytes(), np.uint8).astype(np.uint32) for each in observations]
            return np.array([np.random.default_rng([seed, *each]).integers(3) for each in words])

        return answer

    def act(histories):
        assert histories.shape == (6, 3)
        return np.array([policy(seed)(source.at(each[None]))[0] for seed, each in enumerate(histories)])

    together = walk_values([task.mdp] * 6, act, frames=3)
    for seed, found in enumerate(together):
        alone = evaluate_agent(policy(seed), task)
        assert abs(found.value - alone.value) <= found.error_bound + alone.error_bound
        assert (found.exact, found.states) == (alone.exact, alone.states)
    assert len({(each.value, each.states) for each in together}) > 1


@pytest.mark.long
@pytest.mark.parametrize(("agent", "chance"), [("dqn", {}), ("dqn", {"random": 0.1}), ("ppo", {})])
def test_runs_with_frames_are_measured_exactly_kept_and_resumed(agent, chance, tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.import_module("pharos.training.results"), "RUN_CHECKPOINT_SECONDS", 0.0)
    small = {"dqn": {"learning_starts": 50, "buffer_size": 100}, "ppo": {"n_steps": 32, "n_envs": 2, "batch_size": 32}}
    name, seen = SIGHTS["small"]
    options = {"steps": 400, "evaluation_interval": 100, "hyperparameters": small[agent], "horizon": LIMIT,
               "observation": name, "observation_options": seen, **chance}  # fmt: skip

    def many(out, seeds, **more):
        return train_many(agent, BREAKOUT, seeds=seeds, out=tmp_path / out, **options, **more)

    whole = many("whole", (0, 1, 2))
    with pytest.raises(Killed):
        many("killed", (0, 1), progress=kill_at(2 * 200))
    ends = many("killed", (0, 1))
    for seed, end in enumerate(ends):
        folder = tmp_path / "killed" / f"seed-{seed}"
        assert bytes_of(folder) == bytes_of(tmp_path / "whole" / f"seed-{seed}")
        assert end.result["exact"] and end.result == whole[seed].result
        task, kept = load_agent(folder)
        alone = evaluate_agent(kept, task)
        assert alone.exact and alone.value == pytest.approx(end.result["final_value"], abs=1e-6)
