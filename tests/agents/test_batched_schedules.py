"""What happens when in the batched engine, beside Stable-Baselines3 on the same transitions, step by step.

A lane plays a small table; a vector environment then plays the same transitions to Stable-Baselines3's own algorithm,
which stores them, follows its schedules and asks to be trained.
"""

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.vec_env import VecEnv

from batched_runs import RUN, assert_same_rollouts, drawn_rows, updates_of
from pharos.agents import make_model
from pharos.agents.batched import BatchRun, make_batch
from pharos.kernels import batched
from pharos.mdp import TabularMDP

STATES, ACTIONS = 9, 3


class OneHots:
    """The observations of a table: a one for the state."""

    shape, dtype, is_image, num_states, frames = (STATES,), np.dtype(np.float32), False, STATES, 1

    def at(self, indices):
        return np.eye(STATES, dtype=np.float32)[indices]


@pytest.fixture(scope="module")
def table():
    rng = np.random.default_rng(3)
    next_states = rng.integers(-1, STATES, (STATES, ACTIONS))
    next_states[-1] = STATES - 1  # a terminal state, besides ends without a state
    rewards = rng.normal(size=(STATES, ACTIONS))
    rewards[-1] = 0.0
    terminal = np.arange(STATES) == STATES - 1
    return TabularMDP.from_arrays(next_states, rewards, initial=[0, 1, 4], terminal=terminal)


class Recorded(VecEnv):
    """Plays what a lane has recorded of one run, whatever the actions are."""

    def __init__(self, starts, steps):
        self.starts, self.steps, self.at = starts, steps, 0
        space = gymnasium.spaces.Box(0.0, 1.0, (STATES,), np.float32)
        super().__init__(len(starts), space, gymnasium.spaces.Discrete(ACTIONS))

    def reset(self):
        return OneHots().at(self.starts)

    def step_async(self, actions):
        pass

    def step_wait(self):
        step = self.steps[self.at]
        self.at += 1
        infos = [{} for _ in self.starts]
        done = step["flags"] & batched.ENDED > 0
        for e in np.flatnonzero(done):
            infos[e] = {
                "terminal_observation": OneHots().at(step["next_state"][e]),
                "TimeLimit.truncated": bool(step["flags"][e] & batched.TIMEOUT),
            }
        return OneHots().at(step["state"]), step["reward"].copy(), done, infos

    def close(self):
        pass

    def get_attr(self, name, indices=None):
        return [None] * self.num_envs

    def set_attr(self, name, value, indices=None):
        raise NotImplementedError

    def env_method(self, name, *arguments, indices=None, **options):
        raise NotImplementedError

    def env_is_wrapped(self, wrapper, indices=None):
        return [False] * self.num_envs


def lane_of(agent, table, hyperparameters, steps):
    source = OneHots()
    runs = [BatchRun(table, source, 5, hyperparameters, steps, i, 7 + i) for i in range(3)]
    return make_batch(agent, runs).lanes[0]


def recorded(lane, steps):
    """Let a lane learn; what happened to one of its runs at each step, as the table says."""
    starts, found, step = lane.worlds.state[RUN].copy(), [], lane.step

    def record():
        before = {"epsilon": lane.epsilon[RUN]} if lane.agent == "dqn" else {}
        step()
        now = lane.worlds
        parts = {name: getattr(now, name)[RUN].copy() for name in ("state", "next_state", "reward", "flags")}
        found.append({**before, **parts, "actions": lane.actions[RUN].copy(), "steps": lane.steps})

    lane.step = record
    lane.advance(steps)
    flags = np.concatenate([each["flags"] for each in found])
    assert {0, batched.ENDED, batched.ENDED | batched.TIMEOUT} == set(flags.tolist())
    return Recorded(starts, found)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"n_envs": 2, "train_freq": 3, "gradient_steps": -1, "target_update_interval": 5, "n_steps": 3, "tau": 0.5},
        {"n_envs": 3, "learning_starts": 0, "gradient_steps": 2, "target_update_interval": 4, "buffer_size": 31},
    ],
)
def test_dqn_does_everything_when_stable_baselines3_does(table, options, monkeypatch):
    hyperparameters = {"learning_starts": 17, "buffer_size": 40, "batch_size": 8, "train_freq": 4, "net_arch": [4],
                       "target_update_interval": 10, "exploration_fraction": 0.6, **options}  # fmt: skip
    total = 121
    lane = lane_of("dqn", table, hyperparameters, total)
    updates, copies = [], []
    monkeypatch.setattr(lane, "learn_minibatch", lambda: updates.append(lane.steps))
    monkeypatch.setattr(lane, "copy_to_targets", lambda runs: copies.extend([lane.steps] * (RUN in runs)))
    env = recorded(lane, total)

    model = make_model(DQN, env, hyperparameters, seed=0)
    theirs, their_copies, epsilons = [], [], []

    def train(gradient_steps, batch_size):
        theirs.extend([model.num_timesteps] * gradient_steps)

    def sample_action(learning_starts, noise, n_envs):
        epsilons.append(model.exploration_rate)
        actions = env.steps[env.at]["actions"]
        return actions, actions

    monkeypatch.setattr(model, "train", train)
    monkeypatch.setattr(model, "_sample_action", sample_action)
    monkeypatch.setattr(
        "stable_baselines3.dqn.dqn.polyak_update",
        lambda source, target, tau: their_copies.append(model.num_timesteps) if list(target) else None,
    )
    model.learn(total)
    assert updates == theirs
    assert copies == their_copies
    assert [step["epsilon"] for step in env.steps] == pytest.approx(epsilons, rel=1e-12, abs=1e-15)
    assert len(env.steps) == env.at
    assert_same_memory(lane, model)
    assert_same_minibatch(lane, model, monkeypatch)


def assert_same_memory(lane, model):
    buffer, (state, following, action, reward, flags) = model.replay_buffer, (part[RUN] for part in lane.replay.memory)
    filled = min(lane.calls, lane.replay.size)
    assert (buffer.buffer_size, buffer.size()) == (lane.replay.size, filled)
    seen = slice(0, filled)
    assert (buffer.observations.argmax(axis=2) == state)[seen].all()
    assert (buffer.next_observations.argmax(axis=2) == following)[seen].all()
    assert (buffer.actions[..., 0] == action)[seen].all()
    assert (buffer.rewards == reward)[seen].all()
    assert (buffer.dones == (flags & batched.ENDED > 0))[seen].all()
    assert (buffer.timeouts == (flags & batched.TIMEOUT > 0))[seen].all()


def assert_same_minibatch(lane, model, monkeypatch):
    """The same rows and copies of both memories: returns of n steps, the states they end in, what follows is worth."""
    memory, size, filled = lane.replay, 500, min(lane.calls, lane.replay.size)
    states, nexts, actions = (np.zeros((lane.group.width, size), np.int64) for _ in range(3))
    rewards, factors = (np.zeros((lane.group.width, size), np.float32) for _ in range(2))
    batch, place = (states, nexts, actions, rewards, factors), lane.calls % memory.size
    steps = lane.group.shared["n_steps"]
    batched.sample(lane.group.keys, (7, 0), (place, filled), lane.group.own["gamma"], int(steps), memory.memory, batch)
    rows, copies = drawn_rows(lane, size, filled)
    assert {place, (place - 1) % filled} & set(rows.tolist()), "the ends of the memory are among them"
    monkeypatch.setattr(np.random, "randint", lambda *_, **__: copies)
    theirs = model.replay_buffer._get_samples(rows)
    discounts = model.gamma if theirs.discounts is None else theirs.discounts.numpy()[:, 0]
    assert (theirs.observations.numpy().argmax(axis=1) == states[RUN]).all()
    assert (theirs.actions.numpy()[:, 0] == actions[RUN]).all()
    assert np.abs(theirs.rewards.numpy()[:, 0] - rewards[RUN]).max() <= 1e-6
    continues = (1 - theirs.dones.numpy()[:, 0]) * discounts
    assert np.abs(continues - factors[RUN]).max() <= 1e-6
    assert (theirs.next_observations.numpy().argmax(axis=1) == nexts[RUN])[continues > 0].all()


def test_ppo_gathers_what_stable_baselines3_gathers(table, monkeypatch):
    hyperparameters = {"n_envs": 3, "n_steps": 16, "batch_size": 24, "n_epochs": 1, "net_arch": [6], "gamma": 0.9}
    total = 3 * 48 - 5  # the last rollout goes on beyond it
    lane = lane_of("ppo", table, hyperparameters, total)
    monkeypatch.setattr(lane, "learn_minibatch", lambda minibatch, is_active: is_active)
    names = ("rewards", "kept_values", "begins", "advantages", "states", "actions_taken", "log_probabilities")
    ours, theirs = updates_of(lane, names, monkeypatch), []
    env = recorded(lane, total)
    model = make_model(PPO, env, hyperparameters, seed=0)
    model.policy.load_state_dict({name: torch.from_numpy(array) for name, array in lane.stored(RUN).items()})
    buffer = model.rollout_buffer

    def train():
        kept = ("rewards", "values", "episode_starts", "advantages", "observations", "returns")
        theirs.append({name: getattr(buffer, name).copy() for name in kept})

    monkeypatch.setattr(model, "train", train)
    model.learn(total)
    assert len(ours) == len(theirs) == 3
    for mine, their in zip(ours, theirs, strict=True):
        assert (their["observations"].argmax(axis=2) == mine["states"]).all()
        assert (their["episode_starts"] == mine["begins"]).all()
        assert_same_rollouts(mine, their, 1e-6)
        assert np.abs(their["returns"] - mine["advantages"] - mine["kept_values"]).max() <= 1e-6
        parts = (OneHots().at(mine["states"].ravel()), mine["actions_taken"].ravel())
        seen, actions = map(torch.from_numpy, parts)
        _, log_p, _ = model.policy.evaluate_actions(seen, actions)
        assert np.abs(log_p.detach().numpy() - mine["log_probabilities"].ravel()).max() <= 1e-6
