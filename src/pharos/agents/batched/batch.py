"""A batch: any number of runs, packed into lanes."""

import importlib
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch

from pharos.agents.agent import joined_states, learner_state
from pharos.agents.batched.arithmetic import is_gpu
from pharos.agents.batched.lane import RunPolicy
from pharos.agents.batched.runs import NARROWEST, BatchRun, group_key, lane_widths
from pharos.errors import ParameterError


class Batch:
    """N independent runs as one program.

    Attributes:
        runs: as given.
        steps: of each run so far.
        episodes: (N,) int64, finished ones. returns: (N,) float64, the sums of their returns.
    """

    def __init__(self, agent: str, runs: Sequence[BatchRun], device: str = "cpu"):
        if not runs:
            raise ParameterError("a batch has no runs; expected at least one")
        keys = {group_key(agent, run, device) for run in runs}
        if len(keys) > 1:
            raise ParameterError(f"{len(runs)} runs are of {len(keys)} groups; expected one batch a group (group_key)")
        self.runs = list(runs)
        self._agent, self._device = agent, device
        self._make_lanes(lane_widths(len(runs), runs[0].shape, device))

    def _make_lanes(self, widths: Sequence[int]) -> None:
        """Pack the runs into lanes of these widths."""
        self.width = widths[0]  # of all lanes but the last
        lane = importlib.import_module(f"pharos.agents.batched.{self._agent}").LANE
        self.lanes = [
            lane(self.runs[i * self.width : (i + 1) * self.width], width, self._device)
            for i, width in enumerate(widths)
        ]

    @property
    def steps(self) -> int:
        """Steps of each run so far, without the steps of a rollout beyond the end of the training."""
        return min(self.lanes[-1].steps, self.lanes[-1].group.total)

    @property
    def episodes(self) -> np.ndarray:
        """(N,) int64, finished episodes."""
        return np.concatenate([lane.worlds.episodes[: lane.group.number] for lane in self.lanes])

    @property
    def returns(self) -> np.ndarray:
        """(N,) float64, the sums of the returns of finished episodes."""
        return np.concatenate([lane.worlds.returns[: lane.group.number] for lane in self.lanes])

    def learn(self, points: Sequence[int], at_point: Callable[[int], object]) -> None:
        """Train from `steps` on, and call `at_point` at each of the points.

        As in Stable-Baselines3's callbacks that is before the update that is due then. At the last step of the training
        it is after it.
        """
        for point in points:
            torch.set_flush_denormal(True)  # moments below 1e-38 would make Adam three times as slow
            try:
                for lane in self.lanes:
                    lane.advance(int(point))
            finally:
                torch.set_flush_denormal(False)
            at_point(point)

    def best_actions(self, states: np.ndarray) -> np.ndarray:
        """(N,) the best action of each run in its own state (N,), or history (N, k) if it sees k frames."""
        return np.concatenate(
            [lane.best_actions(states[k * self.width : (k + 1) * self.width]) for k, lane in enumerate(self.lanes)]
        )

    def greedy_actions(self, indices: Sequence[int]) -> None:
        """None: these policies are no tables of states. They are queried about observations."""

    def policy(self, i: int) -> RunPolicy:
        """The current policy of run i: greedy for DQN, probabilities for PPO."""
        return RunPolicy(self.lanes[i // self.width], i % self.width)

    def parameters(self, i: int) -> dict[str, np.ndarray]:
        """The network of run i, under the names of Stable-Baselines3's `policy.state_dict()`."""
        return self.lanes[i // self.width].stored(i % self.width)

    def set_parameters(self, i: int, parameters: Mapping[str, np.ndarray]) -> None:
        """Replace the network of run i by what `parameters` returned, on the processor alone."""
        self.lanes[i // self.width].networks.restore_run(i % self.width, parameters)

    def state(self) -> dict[str, np.ndarray]:
        """State of the batch for `restore`, which goes on bit for bit. The arrays are copies."""
        return joined_states({name: array.copy() for name, array in lane.arrays().items()} for lane in self.lanes)

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Restore a state that `state` returned, in a batch of the same runs, in lanes of the widths that it has.

        Raises:
            ParameterError: these are no lanes of so many runs.
        """
        widths = [len(array) for name, array in state.items() if name.endswith("/updates")]
        if widths != [lane.group.width for lane in self.lanes]:
            full, idle = set(widths[:-1]), sum(widths) - len(self.runs)
            if not 0 <= idle < min(NARROWEST, *widths) or not full <= {max(widths)}:
                raise ParameterError(f"the state has lanes of {widths} runs; expected lanes of {len(self.runs)} runs")
            self._make_lanes(widths)
        for k, lane in enumerate(self.lanes):
            lane.restore(learner_state(state, k))


def make_batch(agent: str, runs: Sequence[BatchRun], *, device: str = "cpu", threads: int | None = None) -> Batch:
    """A batch of runs of one group.

    Args:
        device: of torch, for the networks. Episodes and replay memories stay on the processor.
        threads: of torch. Default: one, as studies use processes.
    Raises:
        ParameterError: the engine lacks a hyperparameter, or the runs are of several groups.
    """
    torch.set_num_threads(threads or 1)
    if is_gpu(device):  # products in whole single precision, as elsewhere
        torch.backends.cudnn.allow_tf32 = False
    return Batch(agent, runs, device)
