"""Observations and available actions of W runs, as their networks take them.

Observations are tensors: gathered from one table if it fits, else drawn for those who ask.
"""

import math
from collections.abc import Iterator, Sequence

import numpy as np
import torch

from pharos.agents.batched.arithmetic import PinnedBuffer, is_gpu
from pharos.agents.batched.networks import aligned_zeros, flat_view, input_indices
from pharos.agents.batched.runs import OBSERVED_AT_ONCE, BatchRun, ObservationSource, as_networks_see, is_small
from pharos.kernels import batched as kernels

OBSERVED_BYTES = 1 << 28  # bytes of observations as networks take them, on the processor
SHARE_OF_DEVICE = 0.5  # of a GPU's free memory that a table may take


class NetworkView:
    """Observations of one source as a network sees them.

    An observation is one frame, or k frames one after another along the channels.

    Attributes:
        frames: k.
        shape: of an observation as Stable-Baselines3's networks take it, images with their channels first.
        length: numbers of one frame.
    """

    def __init__(self, source: ObservationSource):
        self.source, self.frames = source, source.frames
        self.shape, self._turns = as_networks_see(tuple(source.shape), source.is_image)
        self.length = math.prod(self.shape) // self.frames

    def rows(self, observations: np.ndarray) -> np.ndarray:
        """(N, M) of observations as the environment gives them, or of single frames: channels first."""
        turned = np.moveaxis(observations, -1, 1) if self._turns else observations
        return turned.reshape(len(turned), -1)

    def in_blocks(self) -> Iterator[tuple[int, np.ndarray]]:
        """Yield (first state, single frames) of all states in blocks."""
        look = self.source.at if self.frames == 1 else self.source.frame
        for first in range(0, self.source.num_states, OBSERVED_AT_ONCE):
            yield first, look(np.arange(first, min(first + OBSERVED_AT_ONCE, self.source.num_states)))


class ObservationTable:
    """Observations of runs whose observations have the same shape.

    Images are kept as bytes. If they do not fit, minibatches are drawn: 0.3 us an image of a small Breakout. If
    several frames are seen single ones are kept, and put together for those who ask.

    Attributes:
        views: of the distinct sources; which: (W,) the index in `views` of each run's.
        frames: k, how many states are seen at once.
        shape: of an observation as the lane's network takes it.
        size: numbers that its first layer takes.
        is_image: whether it is one.
        mask: None, as all have the same shape.
    """

    mask: torch.Tensor | None = None

    def __init__(self, runs: Sequence[BatchRun], device: str = "cpu"):
        self.device, self.is_image = device, runs[0].observe.is_image
        sources = list({id(run.observe): run.observe for run in runs}.values())
        index = {id(source): i for i, source in enumerate(sources)}
        self.views = [NetworkView(source) for source in sources]
        self.which = np.array([index[id(run.observe)] for run in runs])
        self._ends = np.cumsum([0, *(source.num_states for source in sources)])
        self._begins = self._ends[self.which]
        self.shape, self.frames = self.views[0].shape, self.views[0].frames
        self.size = math.prod(self.shape)
        self._allocate_table()

    def _allocate_table(self) -> None:
        kind = torch.uint8 if self.is_image else torch.float32
        self._table: torch.Tensor | None = None
        length = self.size // self.frames
        if self._ends[-1] * length * kind.itemsize > OBSERVED_BYTES:
            return
        self._table = torch.empty((int(self._ends[-1]), length), dtype=kind)
        for view, begin in zip(self.views, self._ends, strict=False):
            for first, block in view.in_blocks():
                rows = np.ascontiguousarray(view.rows(block))
                self._table[begin + first : begin + first + len(block)] = torch.from_numpy(rows)

    def at(self, states: PinnedBuffer, out: torch.Tensor) -> torch.Tensor:
        """Write the observations of states (W, B) into out (W, B, size) float32; images from 0 to 255.

        If k frames are seen states are (W, B, k), the last ones of the episode, the oldest first.
        """
        target = flat_view(out).numpy()
        if self._table is not None:
            kernels.look_up_rows(self._table.numpy(), self._begins, states.array.reshape(len(target), -1), target)
        else:
            for i, view in enumerate(self.views):
                runs = np.flatnonzero(self.which == i)
                drawn = view.rows(view.source.at(states.array[runs].reshape(-1, *states.array.shape[2:])))
                target[runs, : states.array.shape[1] * self.size] = drawn.reshape(len(runs), -1)
        return out

    def encoded(self, observations: np.ndarray, i: int) -> torch.Tensor:
        """(N, size) float32 of observations (N, ...) as the environment of run i gives them."""
        rows = self.views[self.which[i]].rows(observations)
        return torch.from_numpy(np.ascontiguousarray(rows, np.float32))


class DeviceObservationTable(ObservationTable):
    """Observations on a device other than the processor, for runs whose observations may differ in size.

    A table of all observations lies there. Smaller observations are filled up with zeros, and a mask says which pixels
    of the small convolution there are.

    Raises:
        MemoryError: the table takes more than its share of the device's memory.
    """

    def __init__(self, runs: Sequence[BatchRun], device: str = "cpu"):
        super().__init__(runs, device)
        if len({view.shape for view in self.views}) == 1:
            return
        pixels = np.array([math.prod(view.shape[1:]) for view in self.views])[self.which]
        self.shape = (self.shape[0], 1, int(pixels.max())) if self.is_image else (self.size,)
        if self.is_image:
            is_there = np.arange(pixels.max()) < pixels[:, None]
            self.mask = torch.from_numpy(is_there.astype(np.float32)).to(device)

    def _allocate_table(self) -> None:
        kind, total = torch.uint8 if self.is_image else torch.float32, int(self._ends[-1])
        length = max(view.length for view in self.views) + 1
        needed = total * length * kind.itemsize
        if is_gpu(self.device) and needed > SHARE_OF_DEVICE * torch.cuda.mem_get_info()[0]:
            raise MemoryError(
                f"out of memory: observations of {total:,} states take {needed >> 20:,} MiB on {self.device}, "
                f"more than {SHARE_OF_DEVICE:.0%} of what is free; a run alone that is too large trains on cpu"
            )
        table = torch.zeros((total, length), dtype=kind)
        of_views = [input_indices(view.shape, is_small(view.shape, self.is_image)) for view in self.views]
        self.size = max(map(len, of_views))
        indices = np.full((len(self.views), self.size), length - 1)
        for view, own, row, begin in zip(self.views, of_views, indices, self._ends, strict=False):
            frame, inside = np.divmod(own, view.length)
            row[: len(own)] = np.where(frame < view.frames, frame * length + inside, length - 1)
            for first, block in view.in_blocks():
                rows = np.ascontiguousarray(view.rows(block))
                table[begin + first : begin + first + len(rows), : rows.shape[1]] = torch.from_numpy(rows)
        self._table = table.to(self.device)
        offsets = self._begins[:, None] if self.frames == 1 else self._begins[:, None, None]
        self._offsets = torch.from_numpy(offsets).to(self.device)
        self._indices = torch.from_numpy(indices[self.which][:, None]).to(self.device)
        self._in_an_observation = [torch.from_numpy(own).to(self.device) for own in of_views]

    def at(self, states: PinnedBuffer, out: torch.Tensor) -> torch.Tensor:
        """See `ObservationTable`; a GPU can record it."""
        assert self._table is not None
        rows = (states.tensor + self._offsets).view(-1)
        raw = self._table.index_select(0, rows).view(*states.tensor.shape[:2], -1)
        return out.copy_(raw.gather(2, self._indices.expand(-1, raw.shape[1], -1)))

    def encoded(self, observations: np.ndarray, i: int) -> torch.Tensor:
        """See `ObservationTable`; what travels is a 36th of the neighbours of pixels as float32."""
        which = self.which[i]
        raw = torch.from_numpy(np.ascontiguousarray(self.views[which].rows(observations))).to(self.device)
        rows = torch.nn.functional.pad(raw, (0, 1)).index_select(1, self._in_an_observation[which]).float()
        return torch.nn.functional.pad(rows, (0, self.size - rows.shape[1]))


class ActionSets:
    """The actions that are available in the states of the runs of a lane.

    Attributes:
        table: (N, A) bool, of the states of all MDPs, one after the other. begins: (W, 1) the row of each run's state
        0.
    """

    def __init__(self, runs: Sequence[BatchRun], device: str):
        tables = {id(run.mdp.terminal): run.mdp for run in runs}
        sets = [
            np.ones((mdp.num_states, mdp.num_actions), np.bool_) if mdp.available is None else mdp.available
            for mdp in tables.values()
        ]
        begins = dict(zip(tables, np.cumsum([0, *map(len, sets)]).tolist(), strict=False))
        self._table = np.concatenate(sets)
        self._begins = np.array([[begins[id(run.mdp.terminal)]] for run in runs])
        self.table, self.begins = (torch.from_numpy(each).to(device) for each in (self._table, self._begins))

    @staticmethod
    def of(runs: Sequence[BatchRun], device: str) -> "ActionSets | None":
        """The sets of runs; None if all actions are available to all of them."""
        return None if all(run.mdp.available is None for run in runs) else ActionSets(runs, device)

    def of_states(self, states: torch.Tensor) -> torch.Tensor:
        """(W, B, A) bool, of states (W, B)."""
        return self.table[states + self.begins]

    def of_episodes(self, states: np.ndarray) -> np.ndarray:
        """(W, E, A) bool, of states (W, E) in main memory."""
        return np.asarray(self._table[states + self._begins])


MASKED = -1e8
"""The score of an action that is not available: its probability is 0, and its logarithm times that, too."""


class NetworkInputs:
    """Inputs of the networks of a lane: observations of states, and the actions that are available there.

    Attributes:
        table: of all observations. sets: of the available actions, None if all are available to all runs.
        depth: (k,) if k frames are seen, so that what is seen is k numbers of states; else ().
    """

    def __init__(self, runs: Sequence[BatchRun], device: str):
        self.table = (ObservationTable if device == "cpu" else DeviceObservationTable)(runs, device)
        self.sets = ActionSets.of(runs, device)
        self.depth = (self.table.frames,) if self.table.frames > 1 else ()
        self._width, self._device = len(runs), device
        self._buffers: dict[int, torch.Tensor] = {}

    def observed(self, states: PinnedBuffer) -> torch.Tensor:
        """(W, B, size) float32 observations of states (W, B, *depth), in a buffer reused for this B."""
        number = states.array.shape[1]
        if number not in self._buffers:
            self._buffers[number] = aligned_zeros(self._width, number, self.table.size, device=self._device)
        return self.table.at(states, self._buffers[number])

    def masked(self, scores: torch.Tensor, states: PinnedBuffer) -> torch.Tensor:
        """Scores (W, B, A) of states (W, B, *depth), in place: MASKED for actions that are not available there."""
        if self.sets is None:
            return scores
        numbers = states.tensor[..., -1] if self.depth else states.tensor
        return scores.masked_fill_(~self.sets.of_states(numbers), MASKED)
