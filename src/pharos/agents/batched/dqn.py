"""DQN of W runs at once (Mnih et al., 2015), as Stable-Baselines3 has it; `double` as van Hasselt et al. (2016)."""

from typing import Any

import numpy as np
import torch

from pharos.agents.batched import networks
from pharos.agents.batched.lane import Lane
from pharos.agents.batched.replay import Replay
from pharos.kernels import batched_learning as learning
from pharos.kernels import batched_worlds as kernels

ADAM_EPS = 1e-8


class DQNLane(Lane):
    """W runs of DQN."""

    agent = "dqn"

    def __init__(self, runs: Any, width: int):
        super().__init__(runs, width)
        shared, own = self.shared, self.own
        self.target = self.parameters.clone()
        self.target_values = self.network.parameters.views(self.target)
        self.replay = Replay(self.keys, int(shared["buffer_size"]), self.copies, int(shared["batch_size"]))
        self.epsilon = np.zeros(width)  # as Stable-Baselines3: the first action knows no schedule yet
        self.actions = np.zeros((width, self.copies), np.int64)
        self._explores = np.zeros(width, np.bool_)
        self._target_calls = np.maximum(own["target_update_interval"].astype(np.int64) // self.copies, 1)
        self.losses = np.zeros(width)

    def _network(self) -> Any:
        sizes = networks.sizes_of(self.shared["net_arch"])
        return networks.QNetworks(self.shape, self.seen.is_image, sizes, self.num_actions)

    def _first_parameters(self) -> np.ndarray:
        return networks.initial_uniform(self.network.parameters, self._draws())

    def _scores(self, x: torch.Tensor) -> torch.Tensor:
        return self.network.forward(self.values, x)

    def probabilities(self, scores: torch.Tensor) -> np.ndarray:
        """(M, A): one for the best action."""
        return np.eye(self.num_actions)[scores.numpy().argmax(axis=1)]

    def _step(self) -> None:
        worlds, calls = self.worlds, self.calls
        is_warming = self.steps < self.own["learning_starts"]
        kernels.exploring(self.keys, calls, self.epsilon, is_warming, self._explores)
        everyone_explores = self._explores[: self.number].all()
        q = self._no_scores if everyone_explores else self._scores(self.observed(worlds.state)).numpy()
        kernels.choose(self.keys, calls, self._explores | self.is_idle, q, self.actions)
        before = worlds.state.copy()
        worlds.step(calls, self.actions, counts=self.steps + self.copies <= self.total)
        self.replay.add(calls, before, worlds.next_state, self.actions, worlds.reward, worlds.flags)
        self.steps += self.copies
        self.calls += 1
        self._follow_schedules()
        self.collected = (self.collected + 1) % int(self.shared["train_freq"])
        self.is_due = self.collected == 0 and bool(self._learns().any())

    @property
    def _no_scores(self) -> np.ndarray:
        return np.zeros((self.width, self.copies, self.num_actions), np.float32)

    def _learns(self) -> np.ndarray:
        """(W,) which runs have begun to learn."""
        return (self.steps > self.own["learning_starts"]) & ~self.is_idle

    def _follow_schedules(self) -> None:
        """After each step: copy to the targets where it is time, and move the exploration rates."""
        copied = self.calls % self._target_calls == 0
        if copied.any():
            for i in np.flatnonzero(copied):
                tau = float(self.own["tau"][i])
                self.target[i].mul_(1.0 - tau).add_(self.parameters[i], alpha=tau)
        own, passed = self.own, 1.0 - (1.0 - self.steps / self.total)
        first, last, share = (own[f"exploration_{name}"] for name in ("initial_eps", "final_eps", "fraction"))
        with np.errstate(divide="ignore", invalid="ignore"):
            self.epsilon = np.where(passed > share, last, first + passed * (last - first) / share)

    def _update(self) -> None:
        number = int(self.shared["gradient_steps"])
        if number < 0:
            number = int(self.shared["train_freq"]) * self.copies
        for draw in range(number):
            self.replay.sample(self.calls, draw, self.own["gamma"].astype(np.float64), int(self.shared["n_steps"]))
            self.learn_minibatch()

    def learn_minibatch(self) -> None:
        """One step of gradient descent on the minibatch that the replay memory has drawn."""
        batch = self.replay
        following = self.observed(batch.next_states)
        q_next = self.network.forward(self.target_values, following).clone()
        q_choice = self._scores(following).clone() if self.shared["double"] else q_next
        q = self._scores(self.observed(batch.states))
        dq = torch.empty_like(q)
        learning.huber(
            q.numpy(), q_next.numpy(), q_choice.numpy(), batch.actions, batch.rewards, batch.discounts, dq.numpy(),
            self.losses,
        )  # fmt: skip
        self.network.backward(self.values, self.gradient_views, dq)
        self._adam(self._learns(), ADAM_EPS)

    def own_arrays(self) -> dict[str, np.ndarray]:
        return {"target": self.target.numpy(), "epsilon": self.epsilon, **self.replay.arrays(self.calls)}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Go on from what `arrays` gave."""
        self.calls = int(arrays["counters"][1])  # how much of the memory is filled
        super().restore(arrays)

    def stored(self, i: int) -> dict[str, np.ndarray]:
        """The online and the target network of run i."""
        targets = {name: networks.as_stored(name, view[i].numpy()) for name, view in self.target_values.items()}
        return {
            **super().stored(i),
            **{name.replace("q_net", "q_net_target", 1): value for name, value in targets.items()},
        }
