"""Faults that people make in agents, each a switch of a small DQN or PPO: what `pharos diagnose` knows.

    pharos diagnose pharos.benchmark.faults:dqn --set fault=target_never_copied
    pharos benchmark run --agent pharos.benchmark.faults:ppo --set fault=gamma_half --out results/fault

Both agents are generators of policies in NumPy alone, with two hidden layers. Their policies give `q_values` or
`values`. Without a fault they are healthy. Sources: Mnih et al. (2015); Schulman et al. (2017); Huang et al. (2022),
The 37 implementation details of proximal policy optimization.
"""

from collections.abc import Iterator
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from pharos.errors import UnknownName

HEALTHY = "none"
DQN_FAULTS = {
    "target_never_copied": "the target network is never copied from the network that learns",
    "terminal_bootstrapped": "the value of what comes after the end of an episode is added to its last reward",
    "truncation_as_end": "an episode that the time limit cuts counts as one that has ended",
    "last_feature_lost": "the last number of each observation never reaches the network",
    "bytes_not_divided": "pixels from 0 to 255 reach the network undivided",
    "rewards_clipped": "rewards are replaced by their signs",
    "replay_too_small": "the replay buffer keeps the last 50 steps",
    "learning_rate_high": "the learning rate is 100 times too high",
    "learning_rate_low": "the learning rate is 100 times too low",
    "epsilon_stuck": "epsilon stays 1 while it learns",
    "never_explores": "epsilon is 0 from the first step",
    "action_off_by_one": "the action that is played is the one after the action that was chosen, when it is judged",
    "seeds_ignored": "every run has the same random numbers",
    "gamma_half": "the discount is 0.5",
    "next_is_observation": "the observation is stored as the next observation, too",
    "rewards_shifted": "each transition is stored with the reward of the one before",
    "plays_at_random": "one action in five is random when it is judged",
    "mean_backup": "targets have the mean of the next values in place of the largest",
    "frames_reshaped": "a batch is reshaped where axes ought to be swapped: numbers of several observations are mixed",
}
PPO_FAULTS = {
    "advantages_not_normalised": "advantages are used as they are, whatever the size of rewards",
    "stale_log_probabilities": "old log-probabilities are those of the policy that learns: nothing is clipped",
    "value_without_mask": "advantages and values run on over the ends of episodes",
    "truncation_as_end": "an episode that the time limit cuts counts as one that has ended",
    "gamma_half": "the discount is 0.5",
    "rollout_reshaped": "steps and environments of a rollout are mixed up: advantages are those of other steps",
    "learning_rate_high": "the learning rate is 100 times too high",
    "entropy_penalised": "the sign of the entropy bonus is wrong",
    "action_off_by_one": "the action that is played is the one after the action that was chosen, when it is judged",
}
FAULTS = {"dqn": DQN_FAULTS, "ppo": PPO_FAULTS}
"""Faults by agent: name -> what is wrong, in words."""
FAMILIES = {
    "updates": (
        "how values or a policy are updated: targets, learning rates, discount, replay, losses",
        (
            *("target_never_copied", "learning_rate_high", "learning_rate_low", "replay_too_small", "gamma_half"),
            *("next_is_observation", "mean_backup", "advantages_not_normalised", "stale_log_probabilities"),
            "rollout_reshaped",
        ),
    ),
    "ends": ("ends of episodes", ("terminal_bootstrapped", "truncation_as_end", "value_without_mask")),
    "rewards": ("rewards on their way into the update", ("rewards_clipped", "rewards_shifted")),
    "observations": (
        "observations on their way into the network",
        ("last_feature_lost", "bytes_not_divided", "frames_reshaped"),
    ),
    "exploration": ("exploration", ("epsilon_stuck", "never_explores", "entropy_penalised")),
    "play": ("how the policy is played when it is judged", ("action_off_by_one", "plays_at_random")),
    "seeds": ("random numbers", ("seeds_ignored",)),
}
"""Families of faults: name -> what they are about, and which."""
ALIKE = {
    "dqn": (
        ("truncation_as_end", "replay_too_small", "mean_backup", "rewards_clipped"),
        ("last_feature_lost", "terminal_bootstrapped"),
        ("learning_rate_high", "frames_reshaped"),
        ("target_never_copied", "next_is_observation", "rewards_shifted"),
    ),
    "ppo": (
        (HEALTHY, "truncation_as_end", "entropy_penalised"),
        ("advantages_not_normalised", "value_without_mask"),
        ("learning_rate_high", "stale_log_probabilities", "rollout_reshaped"),
    ),
}
"""Faults by agent that a finished run hardly tells apart, nor from health. Each other one is alone."""
ALIKE_BY_SCORES = {
    "dqn": (
        (HEALTHY, "bytes_not_divided", "epsilon_stuck", "replay_too_small", "truncation_as_end"),
        ("last_feature_lost", "terminal_bootstrapped"),
        ("learning_rate_high", "frames_reshaped"),
        ("target_never_copied", "next_is_observation", "learning_rate_low", "gamma_half", "rewards_shifted"),
    ),
    "ppo": ALIKE["ppo"],
}
"""The same of a run that has no image, or of which nobody knows what was played."""


def alike(agent: str, fault: str, *, by_scores: bool = False) -> tuple[str, ...]:
    """The faults that a finished run of an agent hardly tells from a fault, which is among them.

    Args:
        by_scores: whether the run has no image, or nobody knows what was played.
    """
    groups = (ALIKE_BY_SCORES if by_scores else ALIKE).get(agent, ())
    return next((group for group in groups if fault in group), (fault,))


def faulty_agent(
    agent: str, fault: str | None = HEALTHY, **hyperparameters: Any
) -> partial[Iterator["Greedy | Stochastic"]]:
    """The agent "dqn" or "ppo" with a fault, as learn(env, steps, seed), which `benchmark.run` and `diagnose` take.

    Args:
        fault: a key of `FAULTS[agent]`, or "none" for a healthy agent.
        hyperparameters: other keywords of `dqn` or `ppo`.
    Raises:
        UnknownName: there is no such agent or fault.
    """
    if agent not in FAULTS:
        raise UnknownName("agent with faults", agent, FAULTS)
    fault = _checked(agent, fault)
    learn: Any = {"dqn": dqn, "ppo": ppo}[agent]
    return partial(learn, fault=fault, **hyperparameters)


def _checked(agent: str, fault: str | None) -> str:
    """The fault, if the agent has it. None is healthy: so the command line reads `--set fault=none`."""
    fault = HEALTHY if fault is None else fault
    if fault != HEALTHY and fault not in FAULTS[agent]:
        raise UnknownName(f"fault of {agent}", fault, [HEALTHY, *FAULTS[agent]])
    return fault


class SmallNetwork:
    """A network of two hidden layers with ReLU, and Adam. x (N, D) -> (N, outputs), float32."""

    def __init__(self, inputs: int, width: int, outputs: int, rng: np.random.Generator):
        sizes = (inputs, width, width, outputs)
        self.shapes = [shape for fan_in, fan_out in pairwise(sizes) for shape in ((fan_in, fan_out), (fan_out,))]
        bounds = [bound for fan_in in sizes[:-1] for bound in (1 / np.sqrt(fan_in),) * 2]
        drawn = [rng.uniform(-bound, bound, shape) for bound, shape in zip(bounds, self.shapes, strict=True)]
        self.values = np.concatenate([each.ravel() for each in drawn]).astype(np.float32)
        self.parameters = self.views(self.values)
        self.mean, self.square, self.gradient = np.zeros((3, len(self.values)), np.float32)
        self.gradients = self.views(self.gradient)
        self.updates = 0
        self.layers: list[np.ndarray] = []

    def views(self, values: np.ndarray) -> list[np.ndarray]:
        """Weights and biases of each layer, in an array of all."""
        ends = np.cumsum([int(np.prod(shape)) for shape in self.shapes])
        parts = zip(np.split(values, ends[:-1]), self.shapes, strict=True)
        return [part.reshape(shape) for part, shape in parts]

    def __call__(self, x: np.ndarray) -> np.ndarray:
        w1, b1, w2, b2, w3, b3 = self.parameters
        h1 = np.maximum(x @ w1 + b1, 0)
        h2 = np.maximum(h1 @ w2 + b2, 0)
        self.layers = [x, h1, h2]
        return h2 @ w3 + b3

    def update(self, gradient: np.ndarray, rate: float, limit: float = 10.0) -> None:
        """One step of Adam along the gradient (N, outputs) of the loss by the outputs of the last call."""
        for k in (2, 1, 0):
            layer = self.layers[k]
            np.matmul(layer.T, gradient, out=self.gradients[2 * k])
            gradient.sum(axis=0, out=self.gradients[2 * k + 1])
            if k:
                gradient = (gradient @ self.parameters[2 * k].T) * (layer > 0)
        norm = float(np.sqrt(self.gradient @ self.gradient))
        if not np.isfinite(norm):
            return
        step = self.gradient * np.float32(min(1.0, limit / (norm + 1e-6)))
        self.updates += 1
        correction = np.sqrt(1 - 0.999**self.updates) / (1 - 0.9**self.updates)
        self.mean += np.float32(0.1) * (step - self.mean)
        self.square += np.float32(0.001) * (step * step - self.square)
        self.values -= np.float32(rate * correction) * self.mean / (np.sqrt(self.square) + np.float32(1e-8))

    def copy(self) -> "SmallNetwork":
        """A network with the same weights, for targets and policies."""
        twin = object.__new__(SmallNetwork)
        twin.shapes, twin.values, twin.layers = self.shapes, self.values.copy(), []
        twin.parameters = twin.views(twin.values)
        return twin


def encoded(observations: npt.ArrayLike, fault: str) -> np.ndarray:
    """(N, ...) observations as (N, D) float32, bytes divided by 255."""
    x = np.asarray(observations)
    is_bytes = x.dtype == np.uint8 and fault != "bytes_not_divided"
    rows = x.reshape(len(x), -1).astype(np.float32) / np.float32(255 if is_bytes else 1)
    if fault == "last_feature_lost":
        rows[:, -1] = 0
    return rows


def batch_of(rows: np.ndarray, fault: str) -> np.ndarray:
    """(N, D) observations as a network is asked about them."""
    return rows.T.reshape(rows.shape) if fault == "frames_reshaped" else rows


class Greedy:
    """Greedy policy of a network of values of actions; `q_values(observations)` is (N, A)."""

    def __init__(self, network: SmallNetwork, fault: str, random_play: float = 0.2):
        self.network, self.fault, self.random_play = network.copy(), fault, random_play

    def q_values(self, observations: npt.ArrayLike) -> np.ndarray:
        return self.network(batch_of(encoded(observations, self.fault), self.fault))

    def __call__(self, observations: npt.ArrayLike) -> np.ndarray:
        q = self.q_values(observations)
        probabilities = np.eye(q.shape[1])[q.argmax(axis=1)]
        if self.fault == "plays_at_random":
            probabilities = (1 - self.random_play) * probabilities + self.random_play / q.shape[1]
        return np.roll(probabilities, self.fault == "action_off_by_one", axis=1)


def dqn(  # noqa: PLR0913  (its hyperparameters)
    env: Any,
    steps: int,
    seed: int,
    *,
    fault: str | None = HEALTHY,
    width: int = 32,
    learning_rate: float = 0.001,
    gamma: float = 0.95,
    batch_size: int = 32,
    target_interval: int = 200,
    final_epsilon: float = 0.05,
    random_play: float = 0.2,
) -> Iterator[Greedy]:
    """DQN with a fault of DQN_FAULTS; it yields its greedy policy ten times, and at the end.

    `random_play` is the share of random actions of the fault plays_at_random.
    """
    fault = _checked("dqn", fault)
    seed = 0 if fault == "seeds_ignored" else seed
    rng = np.random.default_rng(seed)
    rate = learning_rate * {"learning_rate_high": 100, "learning_rate_low": 0.01}.get(fault, 1)
    gamma = 0.5 if fault == "gamma_half" else gamma
    observation, _ = env.reset(seed=seed)
    x = encoded(observation[None], fault)[0]
    size, num_actions = min(steps, 50_000), int(env.action_space.n)
    if fault == "replay_too_small":
        size = 50
    network = SmallNetwork(len(x), width, num_actions, rng)
    target = network.copy()
    before, after = np.zeros((2, size, len(x)), np.float32)
    actions, rewards, goes_on = np.zeros(size, np.int64), np.zeros(size, np.float32), np.zeros(size, np.float32)
    earlier = 0.0  # reward of the step before
    for step in range(steps):
        epsilon = max(final_epsilon, 1 - (1 - final_epsilon) * step / (0.3 * steps))
        epsilon = {"epsilon_stuck": 1.0, "never_explores": 0.0}.get(fault, epsilon)
        action = int(rng.integers(num_actions)) if rng.random() < epsilon else int(network(x[None])[0].argmax())
        observation, reward, terminated, truncated, _ = env.step(action)
        behind, place = encoded(observation[None], fault)[0], step % size
        before[place], after[place], actions[place] = x, x if fault == "next_is_observation" else behind, action
        stored, earlier = (earlier if fault == "rewards_shifted" else reward), float(reward)
        rewards[place] = np.sign(stored) if fault == "rewards_clipped" else stored
        ended = (terminated and fault != "terminal_bootstrapped") or (truncated and fault == "truncation_as_end")
        goes_on[place] = not ended
        x = behind
        if terminated or truncated:
            x = encoded(env.reset(**({"seed": 0} if fault == "seeds_ignored" else {}))[0][None], fault)[0]
        if step >= 200 and step % 2 == 0:
            rows = rng.integers(min(step + 1, size), size=batch_size)
            next_q = target(batch_of(after[rows], fault))
            best = next_q.mean(axis=1) if fault == "mean_backup" else next_q.max(axis=1)
            aims = rewards[rows] + np.float32(gamma) * goes_on[rows] * best
            q, gradient = network(batch_of(before[rows], fault)), np.zeros((batch_size, num_actions), np.float32)
            each = np.arange(batch_size), actions[rows]
            gradient[each] = np.clip(q[each] - aims, -1, 1) / batch_size
            network.update(gradient, rate)
        if step % target_interval == 0 and fault != "target_never_copied":
            target = network.copy()
        if (step + 1) % max(1, steps // 10) == 0 or step + 1 == steps:
            yield Greedy(network, fault, random_play)


class Stochastic:
    """Policy of a network of preferences, beside a network of values; `values(observations)` is (N,)."""

    def __init__(self, actor: SmallNetwork, critic: SmallNetwork, fault: str):
        self.actor, self.critic, self.fault = actor.copy(), critic.copy(), fault

    def values(self, observations: npt.ArrayLike) -> np.ndarray:
        return self.critic(encoded(observations, self.fault))[:, 0]

    def __call__(self, observations: npt.ArrayLike) -> np.ndarray:
        probabilities = action_probabilities(self.actor(encoded(observations, self.fault)).astype(np.float64))
        return np.roll(probabilities, self.fault == "action_off_by_one", axis=1)


def action_probabilities(x: np.ndarray) -> np.ndarray:
    """Probabilities (N, A) that are proportional to exp(x)."""
    powers = np.exp(x - x.max(axis=1, keepdims=True))
    return powers / powers.sum(axis=1, keepdims=True)


def ppo(  # noqa: PLR0913  (its hyperparameters)
    env: Any,
    steps: int,
    seed: int,
    *,
    fault: str | None = HEALTHY,
    width: int = 32,
    learning_rate: float = 0.001,
    gamma: float = 0.95,
    num_envs: int = 4,
    rollout: int = 32,
    epochs: int = 10,
    batch_size: int = 32,
    entropy: float = 0.01,
    clip_range: float = 0.2,
    gae_lambda: float = 0.95,
) -> Iterator[Stochastic]:
    """PPO with a fault of PPO_FAULTS; it yields its policy after each rollout."""
    fault = _checked("ppo", fault)
    rng = np.random.default_rng(seed)
    rate = learning_rate * (100 if fault == "learning_rate_high" else 1)
    gamma = 0.5 if fault == "gamma_half" else gamma
    entropy = -5 * entropy if fault == "entropy_penalised" else entropy
    envs = [env.copy() for _ in range(num_envs)]
    x = encoded(np.stack([each.reset()[0] for each in envs]), fault)
    num_actions, shape = int(env.action_space.n), (rollout, num_envs)
    actor, critic = SmallNetwork(x.shape[1], width, num_actions, rng), SmallNetwork(x.shape[1], width, 1, rng)
    before, actions = np.zeros((*shape, x.shape[1]), np.float32), np.zeros(shape, np.int64)
    old, rewards, v, after, goes_on, is_cut = np.zeros((6, *shape), np.float32)
    for _ in range(steps // (rollout * num_envs)):
        for t in range(rollout):
            probabilities = action_probabilities(actor(x))
            chances = probabilities.cumsum(axis=1) > rng.random((num_envs, 1))
            before[t], actions[t], v[t] = x, chances.argmax(axis=1), critic(x)[:, 0]
            old[t] = np.log(probabilities[np.arange(num_envs), actions[t]] + 1e-8)
            behind, firsts = [], []
            for k, each in enumerate(envs):
                observation, rewards[t, k], terminated, truncated, _ = each.step(int(actions[t, k]))
                is_end = terminated or (truncated and fault == "truncation_as_end")
                goes_on[t, k], is_cut[t, k] = not is_end, terminated or truncated
                behind.append(observation)
                firsts.append(each.reset()[0] if terminated or truncated else observation)
            x = encoded(np.stack(firsts), fault)
            after[t] = critic(x if fault == "value_without_mask" else encoded(np.stack(behind), fault))[:, 0]
        if fault == "value_without_mask":
            goes_on[:], is_cut[:] = 1, 0
        advantages, running = np.zeros(shape, np.float32), np.zeros(num_envs, np.float32)
        for t in reversed(range(rollout)):
            error = rewards[t] + gamma * goes_on[t] * after[t] - v[t]
            advantages[t] = running = error + gamma * gae_lambda * (1 - is_cut[t]) * running
        returns = (advantages + v).ravel()
        weights = (advantages.T if fault == "rollout_reshaped" else advantages).ravel()
        rows_of_all, flat_actions, flat_old = before.reshape(-1, x.shape[1]), actions.ravel(), old.ravel()
        for _ in range(epochs):
            for rows in np.array_split(rng.permutation(len(returns)), max(1, len(returns) // batch_size)):
                weight = weights[rows]
                if fault != "advantages_not_normalised":
                    weight = (weight - weight.mean()) / (weight.std() + 1e-8)
                probabilities = action_probabilities(actor(rows_of_all[rows]))
                each = np.arange(len(rows)), flat_actions[rows]
                log = np.log(probabilities + 1e-8)
                ratio = np.exp(log[each] - (log[each] if fault == "stale_log_probabilities" else flat_old[rows]))
                is_clipped = ((ratio > 1 + clip_range) & (weight > 0)) | ((ratio < 1 - clip_range) & (weight < 0))
                pull = -probabilities
                pull[each] += 1  # gradient of the log-probability by the preferences
                gradient = -pull * (np.where(is_clipped, 0, ratio) * weight)[:, None] + (
                    entropy * probabilities * (log - (probabilities * log).sum(axis=1, keepdims=True))
                )
                actor.update((gradient / len(rows)).astype(np.float32), rate, 0.5)
                error = critic(rows_of_all[rows])[:, 0] - returns[rows]
                critic.update((error / len(rows)).astype(np.float32)[:, None], rate, 0.5)
        yield Stochastic(actor, critic, fault)
