"""DQN of W runs at once (Mnih et al., 2015), as Stable-Baselines3 has it, with `double` as in van Hasselt et al.
(2016).

Its replay memory has numbers of states instead of what they look like, 14 bytes a transition. If several frames are
seen a transition is no larger: the states before are in the rows before.
"""

from collections.abc import Sequence

import numpy as np
import torch

from pharos.agents.batched.arithmetic import CudaGraph, PinnedBuffer, wait
from pharos.agents.batched.lane import Lane
from pharos.agents.batched.networks import QNetworks
from pharos.agents.batched.runs import BatchRun, remembers_targets
from pharos.kernels import batched as kernels


class Replay:
    """The last transitions of W runs with E copies each. A row is one step of all copies.

    As in Stable-Baselines3 minibatches are drawn from the last max(buffer_size // E, 1) rows. If k frames are seen,
    k - 1 rows before them are kept as well.

    Attributes:
        size: of how many rows minibatches are drawn. rows: how many there are, of which the oldest is overwritten.
        states, next_states (W, B) int64, or (W, B, k) if k frames are seen, actions (W, B) int64, rewards, discounts
            (W, B) float32: the minibatch that was drawn.
    """

    def __init__(
        self,
        keys: np.ndarray,
        number: int,
        buffer_size: int,
        copies: int,
        batch_size: int,
        device: str = "cpu",
        frames: int = 1,
    ):
        width, self.keys, self.number, self.frames = len(keys), keys, number, frames
        self.size = max(buffer_size // copies, 1)
        self.rows = self.size + frames - 1
        shape = (width, self.rows, copies)
        self.memory: tuple[np.ndarray, ...] = (
            np.zeros(shape, np.int32),
            np.zeros(shape, np.int32),
            np.zeros(shape, np.uint8),
            np.zeros(shape, np.float32),
            np.full(shape, kernels.ENDED, np.uint8),  # so that nothing comes before what is written first
        )
        kinds, depth = [torch.int64] * 3 + [torch.float32] * 2, (frames,) if frames > 1 else ()
        shapes = [(width, batch_size, *depth)] * 2 + [(width, batch_size)] * 3
        self.drawn = tuple(PinnedBuffer(each, kind, device) for each, kind in zip(shapes, kinds, strict=True))
        self.states, self.next_states, self.actions, self.rewards, self.discounts = self.drawn

    def add(
        self,
        calls: int,
        state: np.ndarray,
        next_state: np.ndarray,
        actions: np.ndarray,
        reward: np.ndarray,
        flags: np.ndarray,
    ) -> None:
        """Keep the transitions (W, E) of step `calls`, counted from 0."""
        row = calls % self.rows
        for array, new in zip(self.memory, (state, next_state, actions, reward, flags), strict=True):
            array[:, row] = new

    def sample(self, calls: int, draw: int, gammas: np.ndarray, num_steps: int) -> None:
        """Draw a minibatch for each run that is not idle, after `calls` steps, see `kernels.sample`."""
        batch = tuple(part.array[: self.number] for part in self.drawn)
        rows = calls % self.rows, min(calls, self.size)
        keys, draws = self.keys[: self.number], kernels.sample if self.frames == 1 else kernels.sample_histories
        draws(keys, (calls, draw), rows, gammas, num_steps, self.memory, batch)

    def arrays(self, calls: int) -> dict[str, np.ndarray]:
        """The filled rows of the memory, by name."""
        names = ("replay_state", "replay_next", "replay_action", "replay_reward", "replay_flags")
        filled = min(calls, self.rows)
        return {name: array[:, :filled] for name, array in zip(names, self.memory, strict=True)}


# Runs -----------------------------------------------------------------------------------------------------------------


class DQNLane(Lane[QNetworks]):
    """W runs of DQN.

    Attributes:
        target: (W, P) parameters of the target networks.
        epsilon: (W,) the share of random actions. 0 before the first step, which knows no schedule yet.
    """

    agent = "dqn"

    def __init__(self, runs: Sequence[BatchRun], width: int, device: str = "cpu"):
        super().__init__(runs, width, device)
        group, self._rows = self.group, torch.arange(width, device=device)[:, None]
        self.target = self.networks.parameters.clone()
        self.target_values = self.networks.views(self.target)
        size, rows = int(group.shared["batch_size"]), int(group.shared["buffer_size"])
        self.replay = Replay(group.keys, group.number, rows, group.copies, size, device, runs[0].observe.frames)
        self._dq = torch.zeros((width, size, group.num_actions), device=device)
        self._recorded_step = CudaGraph(self.gradient_step, device)
        self.epsilon = np.zeros(width)
        names = ("initial_eps", "final_eps", "fraction")
        self._exploration = tuple(group.own[f"exploration_{name}"] for name in names)
        self._explores = np.zeros(width, np.bool_)
        self._no_scores = np.zeros((width, group.copies, group.num_actions), np.float32)
        self._remembers = device == "cpu" and all(remembers_targets(run) for run in group.runs)
        self._target_table: torch.Tensor | None = None  # (W, S, A) values of target networks, if kept
        self._target_calls = np.maximum(group.own["target_update_interval"].astype(np.int64) // group.copies, 1)

    def network_for(self, shape: tuple[int, ...]) -> QNetworks:
        """See `Lane`."""
        layers, num_actions = self.group.shared["net_arch"], self.group.num_actions
        return QNetworks(shape, self.inputs.table.is_image, layers, num_actions, self.device)

    def probabilities(self, scores: np.ndarray) -> np.ndarray:
        """One-hot probabilities of the greedy action."""
        return np.eye(self.group.num_actions)[scores.argmax(axis=1)]

    def step(self) -> None:
        """See `Lane`."""
        worlds, scores = self.worlds, self._no_scores
        is_warming = self.steps < self.group.own["learning_starts"]
        kernels.exploring(self.group.keys, self.calls, self.epsilon, is_warming, self._explores)
        if not self._explores[: self.group.number].all():
            scores = self.scores_of(worlds.seen)
        if self.inputs.sets is None:
            kernels.choose(self.group.keys, self.calls, self._explores, scores, self.actions)
        else:
            sets = self.inputs.sets.of_states(torch.from_numpy(worlds.state).to(self.device)).cpu().numpy()
            kernels.choose_of_sets(self.group.keys, self.calls, self._explores, scores, sets, self.actions)
        before = worlds.state.copy()
        self.execute_actions()
        self.replay.add(self.calls, before, worlds.next_state, self.actions, worlds.reward, worlds.flags)
        self.steps += self.group.copies
        self.calls += 1
        self._follow_schedules()
        self.collected = (self.collected + 1) % int(self.group.shared["train_freq"])
        self.is_due = self.collected == 0 and bool(self._learns().any())

    def _learns(self) -> np.ndarray:
        """(W,) bool: runs that have begun to learn."""
        return (self.steps > self.group.own["learning_starts"]) & ~self.group.is_idle

    def _follow_schedules(self) -> None:
        """Copy to target networks that are due and anneal the exploration rates. Called after each step."""
        copied = np.flatnonzero(self.calls % self._target_calls == 0)
        if len(copied):
            self.copy_to_targets(copied)
        progress = 1.0 - (1.0 - self.steps / self.group.total)
        first, last, share = self._exploration
        kernels.anneal(first, last, share, progress, self.epsilon)

    def copy_to_targets(self, runs: np.ndarray) -> None:
        """Move the target networks of some runs towards the online ones, all the way if tau is 1."""
        rows = torch.from_numpy(runs).to(self.device)
        tau = torch.from_numpy(self.group.own["tau"][runs].astype(np.float32)[:, None]).to(self.device)
        self._target_table = None
        self.target[rows] = self.target[rows].mul_(1.0 - tau) + self.networks.parameters[rows] * tau

    def update(self) -> None:
        """See `Lane`."""
        number = int(self.group.shared["gradient_steps"])
        if number < 0:
            number = int(self.group.shared["train_freq"]) * self.group.copies
        for draw in range(number):
            wait(self.device)
            self.replay.sample(self.calls, draw, self.group.own["gamma"], int(self.group.shared["n_steps"]))
            self.learn_minibatch()

    def learn_minibatch(self) -> None:
        """One step of gradient descent on the minibatch that the replay memory has drawn."""
        self.networks.plan(self._learns())
        self._recorded_step()

    def gradient_step(self) -> None:
        """Forward pass, loss, backward pass and Adam on the drawn minibatch. A GPU records this."""
        batch = self.replay
        for part in batch.drawn:
            part.send()
        q_next = q_choice = self.inputs.masked(self._target_scores(batch.next_states), batch.next_states)
        if self.group.shared["double"]:
            q_choice = self.networks.scores(self.inputs.observed(batch.next_states)).clone()
            q_choice = self.inputs.masked(q_choice, batch.next_states)
        q = self.networks.scores(self.inputs.observed(batch.states))
        minibatch = (batch.actions.tensor, batch.rewards.tensor, batch.discounts.tensor)
        networks = self.networks
        networks.arithmetic.huber(q, q_next, q_choice, minibatch, self._dq, networks.loss)
        networks.network.backward(networks.values, networks.gradient_views, self._dq)
        networks.adam()

    def _target_scores(self, states: PinnedBuffer) -> torch.Tensor:
        """(W, B, A) values of states (W, B) by the target networks."""
        if not self._remembers:
            return self.networks.scores(self.inputs.observed(states), self.target_values).clone()
        if self._target_table is None:
            self._target_table = self._all_target_scores(states.array.shape[1])
        return self._target_table[self._rows, states.tensor]

    def _all_target_scores(self, size: int) -> torch.Tensor:
        """(W, S, A) of all states, `size` of each run at a time. Runs with fewer states repeat their last one."""
        numbers = np.array([run.mdp.num_states for run in self.group.runs])
        scores = torch.empty((self.group.width, int(numbers.max()), self.group.num_actions), device=self.device)
        states = PinnedBuffer((self.group.width, size), torch.int64, self.device)
        for first in range(0, scores.shape[1], size):
            states.array[:] = np.minimum(np.arange(first, first + size), numbers[:, None] - 1)
            part = scores[:, first : first + size]
            part[:] = self.networks.scores(self.inputs.observed(states), self.target_values)[:, : part.shape[1]]
        return scores

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Restore a state that `arrays` returned."""
        super().restore(arrays)
        self._target_table = None

    def tensors(self) -> dict[str, torch.Tensor]:
        """See `Lane`."""
        return {**super().tensors(), "target": self.target}

    def own_arrays(self) -> dict[str, np.ndarray]:
        """See `Lane`."""
        return {"epsilon": self.epsilon, **self.replay.arrays(self.calls)}

    def stored(self, i: int) -> dict[str, np.ndarray]:
        """The online and the target network of run i."""
        target = self.networks.as_stored(self.target_values, i)
        return {
            **super().stored(i),
            **{name.replace("q_net", "q_net_target", 1): value for name, value in target.items()},
        }


LANE = DQNLane
"""The class of lanes that batch.py makes."""
