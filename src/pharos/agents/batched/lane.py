"""A lane: a fixed number of runs that advance together. What DQN and PPO have in common."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from pharos.agents.batched import networks
from pharos.agents.batched.runs import BatchRun, resolved
from pharos.agents.batched.worlds import Seen, Worlds, as_networks_see
from pharos.kernels import batched_learning as learning
from pharos.kernels import batched_worlds as kernels
from pharos.kernels import philox

ASKED = 256  # observations that a policy is asked about at once


class Lane:
    """W runs of one group, the last ones idle where there are fewer: they repeat the first one.

    The width is part of the program: with it the same run has the same bits whoever else is there.

    Attributes:
        steps: of each run so far.
        total: of the training.
    """

    agent: str

    def __init__(self, runs: Sequence[BatchRun], width: int):
        self.number, self.width = len(runs), width
        self.runs = [*runs, *[runs[0]] * (width - len(runs))]
        every = [resolved(self.agent, run.hyperparameters) for run in self.runs]
        self.shared = every[0]
        self.own = {
            name: np.array([options[name] for options in every])
            for name in every[0]
            if isinstance(every[0][name], int | float)
        }
        self.total, self.copies = runs[0].steps, int(self.shared["n_envs"])
        self.num_actions = runs[0].mdp.num_actions
        self.keys = np.array([run.key for run in self.runs], np.uint64)
        self.is_idle = np.arange(width) >= len(runs)
        self.worlds = Worlds(self.runs, self.keys, self.copies)
        self.shape, moves = as_networks_see(runs[0])
        self.seen = Seen(self.runs, self.shape, moves=moves)
        self._rooms: dict[Any, torch.Tensor] = {}
        self.network = self._network()
        self.parameters = torch.from_numpy(self._first_parameters())
        self.gradients = torch.zeros_like(self.parameters)
        self.means, self.squares = torch.zeros_like(self.parameters), torch.zeros_like(self.parameters)
        self.updates = np.zeros(width, np.int64)
        self.values = self.network.parameters.views(self.parameters)
        self.gradient_views = self.network.parameters.views(self.gradients)
        self.steps = self.calls = self.collected = 0
        self.is_due = False  # whether an update waits

    # What an agent says of itself -----------------------------------------------------------------------------------

    def _network(self) -> Any:
        raise NotImplementedError

    def _first_parameters(self) -> np.ndarray:
        """(W, P) float32."""
        raise NotImplementedError

    def _step(self) -> None:
        """One step of each copy; sets `is_due` at the end of a rollout."""
        raise NotImplementedError

    def _update(self) -> None:
        """Learn from what was collected."""
        raise NotImplementedError

    def own_arrays(self) -> dict[str, np.ndarray]:
        """What the agent has to remember besides `arrays`."""
        raise NotImplementedError

    def probabilities(self, scores: torch.Tensor) -> np.ndarray:
        """(M, A) float64: the policy, from what `_scores` says."""
        raise NotImplementedError

    def _scores(self, x: torch.Tensor) -> torch.Tensor:
        """(W, B, A) of observations (W, B, size)."""
        raise NotImplementedError

    # Learning -------------------------------------------------------------------------------------------------------

    def advance(self, point: int) -> None:
        """Go on until `point` steps. The update that is due then waits, unless it is the last."""
        is_last = point >= self.total
        while self.steps < point or (is_last and self.collected):
            self._learn_what_is_due()
            self._step()
        if is_last:
            self._learn_what_is_due()

    def _learn_what_is_due(self) -> None:
        if self.is_due:
            self._update()
            self.is_due = False

    def observed(self, states: np.ndarray) -> torch.Tensor:
        """(W, B, size) float32 observations of states (W, B); they stay until the next call with as many."""
        key = ("observed", states.shape[1])
        if key not in self._rooms:
            self._rooms[key] = networks.room(self.width, states.shape[1], int(np.prod(self.shape)))
        return self.seen.at(states, self._rooms[key])

    def _adam(self, is_active: np.ndarray, eps: float) -> None:
        learning.adam(
            self.parameters.numpy(), self.gradients.numpy(), self.means.numpy(), self.squares.numpy(), self.updates,
            is_active, self.own["learning_rate"].astype(np.float64), self.own["max_grad_norm"].astype(np.float64), eps,
        )  # fmt: skip

    def _draws(self) -> Callable[[int], np.ndarray]:
        """number -> (W, number) uniform in (0, 1), for the first parameters."""

        def draws(number: int) -> np.ndarray:
            found = np.empty((self.width, -(-number // 4), 4), np.uint32)
            philox.words(self.keys, kernels.WEIGHTS, 0, found)
            return (found.reshape(self.width, -1)[:, :number] + 0.5) * 2.0**-32

        return draws

    # What is kept ---------------------------------------------------------------------------------------------------

    def arrays(self) -> dict[str, np.ndarray]:
        """All that changes, by name; those of more than one number are changed in place."""
        tensors = {name: getattr(self, name).numpy() for name in ("parameters", "means", "squares")}
        counters = np.array([self.steps, self.calls, self.collected, self.is_due], np.int64)
        return {**tensors, "updates": self.updates, "counters": counters, **self.worlds.arrays(), **self.own_arrays()}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Go on from what `arrays` gave."""
        for name, array in self.arrays().items():
            array[...] = arrays[name]
        self.steps, self.calls, self.collected, is_due = map(int, arrays["counters"])
        self.is_due = bool(is_due)

    def stored(self, i: int) -> dict[str, np.ndarray]:
        """The parameters of run i under Stable-Baselines3's names."""
        return {name: networks.as_stored(name, view[i].numpy()) for name, view in self.values.items()}


class RunPolicy:
    """The policy of one run of a lane, as it is when it is asked."""

    def __init__(self, lane: Lane, i: int):
        self.lane, self.i = lane, i

    def action_probabilities(self, observations: np.ndarray) -> np.ndarray:
        """(M, A) float64 for observations (M, ...) as the environment gives them."""
        lane, number = self.lane, len(observations)
        seen = torch.from_numpy(np.ascontiguousarray(observations))
        if lane.seen.moves:
            seen = seen.movedim(-1, 1)
        x = seen.reshape(number, -1).float()
        if lane.seen.is_image:
            x.div_(255.0)
        values = {name: view[self.i : self.i + 1] for name, view in lane.values.items()}
        block = torch.zeros((1, ASKED, x.shape[1]))  # of one size, as layers keep room for each size
        answers = []
        for first in range(0, number, ASKED):
            rows = x[first : first + ASKED]
            block[0, : len(rows)] = rows
            answers.append(lane.probabilities(lane.network.scores(values, block)[0, : len(rows)]))
        return np.concatenate(answers)
