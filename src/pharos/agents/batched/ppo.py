"""PPO of W runs at once (Schulman et al., 2017), as Stable-Baselines3 has it."""

from collections.abc import Sequence

import numpy as np
import torch

from pharos.agents.batched.arithmetic import CudaGraph, PinnedBuffer, wait
from pharos.agents.batched.lane import Lane
from pharos.agents.batched.networks import ActorCritics
from pharos.agents.batched.runs import BatchRun
from pharos.kernels import batched as kernels

LOSS_WEIGHTS = ("clip_range", "ent_coef", "vf_coef")


class PPOLane(Lane[ActorCritics]):
    """W runs of PPO.

    Attributes:
        states, next_states (W, T, E, *depth), actions_taken (W, T, E) int64, log_probabilities, kept_values, rewards,
            begins, advantages (W, T, E) float32: the rollout that goes on. begins is 1 if a step is the first of its
            episode.
        timeouts: (W, T, E) bool, whether a step was cut off by the time limit.
        begin: (W, E) float32, whether the next step is the first of its episode.
        weights: (W,) float64 each: the clip range, and what entropy and value weigh in the loss.
        divergence: (W,) float64, from the policy that acted, on the last minibatch.
    """

    agent = "ppo"

    def __init__(self, runs: Sequence[BatchRun], width: int, device: str = "cpu"):
        super().__init__(runs, width, device)
        shape = (width, int(self.group.shared["n_steps"]), self.group.copies)
        self.states, self.next_states = (np.zeros((*shape, *self.inputs.depth), np.int64) for _ in range(2))
        self.actions_taken = np.zeros(shape, np.int64)
        self.log_probabilities, self.kept_values, self.rewards, self.begins, self.advantages = (
            np.zeros(shape, np.float32) for _ in range(5)
        )
        self.timeouts = np.zeros(shape, np.bool_)
        self.begin = np.ones((width, self.group.copies), np.float32)
        self._log_p = np.zeros((width, self.group.copies), np.float32)
        self._order = np.zeros((width, shape[1] * shape[2]), np.int64)
        self._valued = PinnedBuffer((width, self.group.copies, 1), torch.float32, device)
        self.divergence = PinnedBuffer((width,), torch.float64, device)
        self.weights = tuple(PinnedBuffer((width,), torch.float64, device) for _ in LOSS_WEIGHTS)
        for buffer, name in zip(self.weights, LOSS_WEIGHTS, strict=True):
            buffer.array[:] = self.group.own[name]
            buffer.send()
        self._minibatch_updates: dict[int, MinibatchUpdate] = {}

    def network_for(self, shape: tuple[int, ...]) -> ActorCritics:
        """See `Lane`."""
        layers, num_actions = self.group.shared["net_arch"], self.group.num_actions
        return ActorCritics(shape, self.inputs.table.is_image, layers, num_actions, self.device)

    def evaluate(self, x: torch.Tensor) -> torch.Tensor:
        """See `Lane`. Writes the values of the states, too."""
        scores, values = self.networks.network.both(self.networks.values, x)
        self._valued.tensor.copy_(values)
        self._valued.fetch()
        return scores

    def probabilities(self, scores: np.ndarray) -> np.ndarray:
        """The softmax of the scores."""
        weights = np.exp(scores.astype(np.float64) - scores.max(axis=1, keepdims=True))
        return weights / weights.sum(axis=1, keepdims=True)

    def step(self) -> None:
        """See `Lane`."""
        worlds, t = self.worlds, self.collected
        scores = self.scores_of(worlds.seen)
        kernels.act(self.group.keys, self.calls, scores, self.actions, self._log_p)
        self.states[:, t] = worlds.seen
        self.execute_actions()
        self.next_states[:, t], self.actions_taken[:, t] = worlds.next_seen, self.actions
        self.log_probabilities[:, t], self.kept_values[:, t] = self._log_p, self._valued.array[..., 0]
        self.rewards[:, t], self.begins[:, t] = worlds.reward, self.begin
        self.timeouts[:, t] = worlds.flags & kernels.TIMEOUT
        self.begin[:] = worlds.flags & kernels.ENDED
        self.steps += self.group.copies
        self.calls += 1
        self.collected = (t + 1) % self.states.shape[1]
        self.is_due = self.collected == 0

    def update(self) -> None:
        """See `Lane`."""
        self.add_values_of_cut_episodes()
        last = self.values_of(self.worlds.seen)
        rollout, own = (self.rewards, self.kept_values, self.begins), self.group.own
        kernels.advantages(rollout, last, self.begin > 0, own["gamma"], own["gae_lambda"], self.advantages)
        returns = self.advantages + self.kept_values
        parts = (self.states, self.actions_taken, self.log_probabilities, self.advantages, returns)
        sources = tuple(part.reshape(self.group.width, -1, *part.shape[3:]) for part in parts)
        number, size = self._order.shape[1], int(self.group.shared["batch_size"])
        is_active = ~self.group.is_idle
        for epoch in range(int(self.group.shared["n_epochs"])):
            kernels.shuffle(self.group.keys, self.calls, epoch, self._order)
            for first in range(0, number, size):
                shape = (self.group.width, min(size, number - first))
                minibatch = tuple(np.empty((*shape, *part.shape[2:]), part.dtype) for part in sources)
                kernels.gather(self._order, first, sources, minibatch)
                is_active &= self.learn_minibatch(minibatch, is_active)
                if not is_active.any():
                    return

    def add_values_of_cut_episodes(self) -> None:
        """Add gamma V(s') to rewards of steps at which the time limit cut an episode off, E steps a run at once."""
        runs, indices = np.nonzero(self.timeouts.reshape(self.group.width, -1))
        if not len(runs):
            return
        rank = np.arange(len(runs)) - np.searchsorted(runs, runs)  # of each in its run
        rewards, next_values = (
            part.reshape(self.group.width, -1, *part.shape[3:]) for part in (self.rewards, self.next_states)
        )
        for block in range(int(rank.max()) // self.group.copies + 1):
            now = rank // self.group.copies == block
            i, index, column = runs[now], indices[now], rank[now] % self.group.copies
            states = self.worlds.seen.copy()
            states[i, column] = next_values[i, index]
            value = self.group.own["gamma"][i] * self.values_of(states)[i, column].astype(np.float64)
            rewards[i, index] = (rewards[i, index] + value).astype(np.float32)

    def values_of(self, states: np.ndarray) -> np.ndarray:
        """(W, E) float32 values of states (W, E, *depth)."""
        self.scores_of(states)
        return self._valued.array[..., 0].copy()

    def learn_minibatch(self, minibatch: tuple[np.ndarray, ...], is_active: np.ndarray) -> np.ndarray:
        """One gradient step of the active runs whose policy has not moved too far (`target_kl`). Return (W,) bool:
        these runs.

        Args:
            minibatch: (states, actions, logarithms of probabilities, advantages, returns), (W, B) each, states
                (W, B, *depth).
        """
        size = minibatch[0].shape[1]
        if size not in self._minibatch_updates:
            self._minibatch_updates[size] = MinibatchUpdate(self, size)
        update = self._minibatch_updates[size]
        wait(self.device)
        for buffer, part in zip(update.minibatch, minibatch, strict=True):
            buffer.array[:] = part
        if self.group.shared["normalize_advantage"] and size > 1:
            kernels.normalize_advantages(update.minibatch[3].array)
        update.forward()
        if self.group.shared["target_kl"] is not None:
            wait(self.device)
            is_active = is_active & ~(self.divergence.array > 1.5 * float(self.group.shared["target_kl"]))
        self.networks.plan(is_active)
        update.optimizer_step()
        return is_active

    def own_arrays(self) -> dict[str, np.ndarray]:
        """See `Lane`."""
        names = ("states", "next_states", "actions_taken", "log_probabilities", "kept_values", "rewards", "begins")
        return {f"rollout_{name}": getattr(self, name) for name in (*names, "timeouts")} | {"begin": self.begin}


class MinibatchUpdate:
    """Update of PPO on minibatches of one size. A GPU records both parts.

    `forward`: scores, values, loss and its gradients. `optimizer_step`: backward pass and Adam.

    Attributes:
        minibatch: states (W, B, *depth), actions (W, B) int64, old logarithms of probabilities, advantages, returns
            (W, B) float32.
    """

    def __init__(self, lane: PPOLane, size: int):
        device, shape = lane.device, (lane.group.width, size)
        kinds = [torch.int64] * 2 + [torch.float32] * 3
        shapes = [(*shape, *lane.inputs.depth), *[shape] * 4]
        self.minibatch = tuple(PinnedBuffer(each, kind, device) for each, kind in zip(shapes, kinds, strict=True))
        self._lane = lane
        self._gradients = tuple(torch.zeros((*shape, last), device=device) for last in (lane.group.num_actions, 1))
        self.forward, self.optimizer_step = CudaGraph(self._forward, device), CudaGraph(self._optimizer_step, device)

    def _forward(self) -> None:
        lane, networks = self._lane, self._lane.networks
        for part in self.minibatch:
            part.send()
        states, *others = self.minibatch
        scores, values = networks.network.both(networks.values, lane.inputs.observed(states))
        scores = lane.inputs.masked(scores, states)
        parts, weights = tuple(part.tensor for part in others), tuple(part.tensor for part in lane.weights)
        written = self._gradients, networks.loss, lane.divergence
        networks.arithmetic.clipped_loss(scores, values, parts, weights, *written)

    def _optimizer_step(self) -> None:
        networks = self._lane.networks
        networks.network.backward(networks.values, networks.gradient_views, *self._gradients)
        networks.adam()


LANE = PPOLane
"""The class of lanes that batch.py makes."""
