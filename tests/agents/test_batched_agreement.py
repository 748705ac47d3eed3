"""The batched engine beside Stable-Baselines3: the same numbers from the same weights and the same transitions."""

import numpy as np
import pytest
import torch
from stable_baselines3.common.type_aliases import ReplayBufferSamples, RolloutBufferSamples

from batched_runs import runs_of
from pharos.agents import make_model
from pharos.agents.batched import make_batch
from pharos.environments import make
from pharos.interaction import make_sb3_vec
from pharos.kernels import batched as rollouts
from pharos.policies import DeepPolicy
from pharos.training.task import Task

DQN = {"learning_rate": 0.001, "buffer_size": 200, "learning_starts": 40, "batch_size": 16, "train_freq": 4,
       "target_update_interval": 20, "net_arch": [24], "max_grad_norm": 0.05}  # fmt: skip


def batch_of(agent, task, hyperparameters):
    return make_batch(agent, runs_of(task, hyperparameters, 2, steps=10_000, first_key=0, apart=31))


def model_of(agent, task, hyperparameters):
    env = make_sb3_vec(task.env, hyperparameters.get("n_envs", 1), seed=0, **task.interaction)
    return make_model(agent, env, hyperparameters, seed=0)


def load(model, parameters):
    state = model.policy.state_dict()
    assert set(parameters) == set(state)
    model.policy.load_state_dict({name: torch.from_numpy(value) for name, value in parameters.items()})


def assert_same_parameters(model, parameters):
    state = model.policy.state_dict()
    for name, value in parameters.items():
        assert state[name].shape == value.shape
        assert np.abs(state[name].numpy() - value).max() <= 1e-6, name


def clipped(lane, i, max_norm):
    """The gradients of a run as Adam gets them, by name."""
    scale = min(1.0, max_norm / (float(lane.networks.gradients[i].norm()) + 1e-6))
    return {name: value * scale for name, value in lane.networks.as_stored(lane.networks.gradient_views, i).items()}


def as_stored(observations):
    """Images as Stable-Baselines3 keeps them: channels first."""
    is_turned = observations.ndim == 4 and observations.shape[-1] < observations.shape[1]
    return np.ascontiguousarray(observations.transpose(0, 3, 1, 2)) if is_turned else observations


def losses_of(model):
    """The losses that the model records, as they come."""
    losses = []
    model.logger.record = lambda name, value, **_: losses.append(value) if name == "train/loss" else None
    return losses


@pytest.fixture(scope="module", params=["vector", "simple_image"])
def task(request):
    return Task.of(make("frozen_lake/4x4"), observation=request.param)


@pytest.mark.long
@pytest.mark.parametrize("max_grad_norm", (0.05, 10.0))
def test_updates_of_dqn_are_those_of_stable_baselines3(task, max_grad_norm):
    check_updates_of_dqn(task, {**DQN, "max_grad_norm": max_grad_norm}, 6)


@pytest.mark.long
def test_updates_of_the_three_convolutions_are_those_of_stable_baselines3():
    task = Task.of(make("frozen_lake/4x4"), observation="complex_image")
    assert min(task.observer.observe.space.shape[:2]) >= 36
    check_updates_of_dqn(task, {**DQN, "batch_size": 4, "learning_starts": 59}, 2)


def check_updates_of_dqn(task, hyperparameters, number):
    batch = batch_of("dqn", task, hyperparameters)
    batch.learn([60], lambda point: None)
    lane, i = batch.lanes[0], 1
    for name in ("means", "squares", "updates"):  # Adam begins anew, as in a fresh model
        getattr(lane.networks, name)[:] = 0
    model = model_of("dqn", task, hyperparameters)
    load(model, batch.parameters(i))
    losses = losses_of(model)
    source = batch.runs[i].observe

    def minibatch(size, env=None):
        drawn = lane.replay
        seen, following = (as_stored(source.at(states[i])) for states in (drawn.states.array, drawn.next_states.array))
        parts = (seen, drawn.actions.array[i][:, None], following)
        ends = (drawn.discounts.array[i] == 0).astype(np.float32)
        return ReplayBufferSamples(*map(torch.from_numpy, (*parts, ends[:, None], drawn.rewards.array[i][:, None])))

    model.replay_buffer.sample = minibatch
    for update in range(number):
        lane.replay.sample(60, update, lane.group.own["gamma"], 1)
        lane.learn_minibatch()
        model.train(1, hyperparameters["batch_size"])
        assert abs(losses[-1] - lane.losses[i]) <= 1e-6
        gradients = clipped(lane, i, hyperparameters["max_grad_norm"])
        for name, parameter in model.policy.q_net.named_parameters():
            assert np.abs(parameter.grad.numpy() - gradients[f"q_net.{name}"]).max() <= 1e-6
        assert_same_parameters(model, batch.parameters(i))


PPO = {"n_envs": 3, "n_steps": 8, "batch_size": 12, "n_epochs": 2, "learning_rate": 0.001, "ent_coef": 0.02,
       "clip_range": 0.05, "net_arch": {"pi": [24], "vf": [16, 8]}}  # fmt: skip


def shared_extractor(name):
    """A parameter of PPO under the first of its names."""
    return name.removeprefix("pi_").removeprefix("vf_")


def test_an_update_of_ppo_values_what_a_time_limit_cuts_off():
    batch = batch_of("ppo", Task.of(make("frozen_lake/4x4"), horizon=3), PPO)
    lane = batch.lanes[0]
    batch.learn([24], lambda point: None)
    rewards = lane.rewards.copy()
    assert lane.timeouts.any()
    lane.add_values_of_cut_episodes()
    expected = lane.rewards.copy()
    assert (expected != rewards)[lane.timeouts].any() and (expected == rewards)[~lane.timeouts].all()
    lane.rewards[:] = rewards
    lane.update()
    assert np.array_equal(lane.rewards, expected)


@pytest.mark.long
@pytest.mark.parametrize("max_grad_norm", (0.05, 10.0))
def test_updates_of_ppo_are_those_of_stable_baselines3(task, max_grad_norm):
    hyperparameters = {**PPO, "max_grad_norm": max_grad_norm}
    batch = batch_of("ppo", task, hyperparameters)
    lane, i = batch.lanes[0], 1
    batch.learn([24], lambda point: None)  # a rollout, whose update waits
    model = model_of("ppo", task, hyperparameters)
    load(model, batch.parameters(i))
    losses, buffer = losses_of(model), model.rollout_buffer
    lane.add_values_of_cut_episodes()
    rollouts.advantages(
        (lane.rewards, lane.kept_values, lane.begins), lane.values_of(lane.worlds.state), lane.begin > 0,
        lane.group.own["gamma"], lane.group.own["gae_lambda"], lane.advantages,
    )  # fmt: skip
    returns = lane.advantages + lane.kept_values
    parts = [lane.states, lane.actions_taken, lane.log_probabilities, lane.advantages, returns]
    sources = [part.reshape(lane.group.width, -1) for part in parts]
    rng = np.random.default_rng(0)
    minibatches = [rng.permutation(24)[:12] for _ in range(6)]

    def samples(size):
        for rows in minibatches:
            states, actions, old, advantages, wanted = (part[i, rows] for part in sources)
            seen = batch.runs[i].observe.at(states)
            arrays = (seen, actions[:, None].astype(np.float32), old, old, advantages, wanted)
            yield RolloutBufferSamples(*map(torch.from_numpy, arrays))

    buffer.get = samples
    buffer.values, buffer.returns = np.zeros(24), np.zeros(24)  # for the record of the explained variance
    model.n_epochs = 1
    model.train()
    for rows in minibatches:
        lane.learn_minibatch(tuple(part[:, rows].copy() for part in sources), ~lane.group.is_idle)
    assert abs(losses[-1] - lane.losses[i]) <= 1e-6
    gradients = clipped(lane, i, max_grad_norm)
    for name, parameter in model.policy.named_parameters():
        assert np.abs(parameter.grad.numpy() - gradients[shared_extractor(name)]).max() <= 1e-6
    assert_same_parameters(model, batch.parameters(i))


@pytest.mark.long
@pytest.mark.parametrize("agent", ("dqn", "ppo"))
def test_the_policy_is_that_of_the_model(task, agent):
    hyperparameters = {"dqn": DQN, "ppo": PPO}[agent]
    batch = batch_of(agent, task, hyperparameters)
    model = model_of(agent, task, hyperparameters)
    load(model, batch.parameters(0))
    seen = batch.runs[0].observe.at(np.arange(task.space.num_states))
    difference = batch.policy(0).action_probabilities(seen) - DeepPolicy(model).action_probabilities(seen)
    assert np.abs(difference).max() <= 1e-6
