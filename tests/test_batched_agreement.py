"""The batched engine beside Stable-Baselines3: the same numbers from the same weights and the same transitions."""

import numpy as np
import pytest
import torch
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from pharos.agents import make_model
from pharos.agents.batched import BatchRun, ObservationSource, make_batch
from pharos.environments import make
from pharos.experiments.task import Task
from pharos.interaction import make_sb3_vec

DQN = {"learning_rate": 0.001, "buffer_size": 200, "learning_starts": 40, "batch_size": 16, "train_freq": 4,
       "target_update_interval": 20, "net_arch": [24], "max_grad_norm": 0.05}  # fmt: skip


def batch_of(agent, task, hyperparameters, number=2, steps=10_000):
    source = ObservationSource.of(task.space, task.sight.observe)
    run = [BatchRun(task.mdp, source, task.time_limit, hyperparameters, steps, i, 31 * i) for i in range(number)]
    return make_batch(agent, run)


def model_of(agent, task, hyperparameters):
    env = make_sb3_vec(task.env, hyperparameters.get("n_envs", 1), seed=0, **task.interaction)
    return make_model(agent, env, hyperparameters, seed=0)


def load(model, parameters):
    state = model.policy.state_dict()
    assert set(parameters) <= set(state)
    model.policy.load_state_dict({**state, **{name: torch.from_numpy(value) for name, value in parameters.items()}})


def assert_same_parameters(model, parameters):
    state = model.policy.state_dict()
    for name, value in parameters.items():
        assert state[name].shape == value.shape
        assert np.abs(state[name].numpy() - value).max() <= 1e-6, name


def clipped(lane, i, max_norm):
    """The gradients of a run as Adam gets them, by name."""
    from pharos.agents.batched.networks import as_stored

    scale = min(1.0, max_norm / (float(lane.gradients[i].norm()) + 1e-6))
    return {name: as_stored(name, view[i].numpy() * scale) for name, view in lane.gradient_views.items()}


@pytest.fixture(scope="module", params=["vector"])
def task(request):
    return Task.of(make("frozen_lake/4x4"), observation=request.param)


@pytest.mark.parametrize("max_grad_norm", (0.05, 10.0))
def test_updates_of_dqn_are_those_of_stable_baselines3(task, max_grad_norm):
    hyperparameters = {**DQN, "max_grad_norm": max_grad_norm}
    batch = batch_of("dqn", task, hyperparameters)
    batch.learn([60], lambda point: None)
    lane, i = batch.lanes[0], 1
    for name in ("means", "squares", "updates"):  # Adam begins anew, as in a fresh model
        getattr(lane, name)[:] = 0
    model = model_of("dqn", task, hyperparameters)
    load(model, batch.parameters(i))
    optimizer = model.policy.optimizer
    losses = []
    model.logger.record = lambda name, value, **_: losses.append(value) if name == "train/loss" else None
    source = batch.runs[i].observe

    def minibatch(size, env=None):
        drawn = lane.replay
        parts = (source.at(drawn.states[i]), drawn.actions[i][:, None], source.at(drawn.next_states[i]))
        ends = (drawn.discounts[i] == 0).astype(np.float32)
        return ReplayBufferSamples(*map(torch.from_numpy, (*parts, ends[:, None], drawn.rewards[i][:, None])))

    model.replay_buffer.sample = minibatch
    for update in range(6):
        lane.replay.sample(60, update, lane.own["gamma"], 1)
        lane.learn_minibatch()
        model.train(1, 16)
        assert abs(losses[-1] - lane.losses[i]) <= 1e-6
        gradients = clipped(lane, i, max_grad_norm)
        for name, parameter in model.policy.q_net.named_parameters():
            assert np.abs(parameter.grad.numpy() - gradients[f"q_net.{name}"]).max() <= 1e-6
        assert_same_parameters(model, batch.parameters(i))
    assert optimizer.param_groups[0]["eps"] == 1e-8
