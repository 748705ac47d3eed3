"""Observations of W runs as tensors: gathered from one table where it fits, else drawn for those who ask."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from pharos.agents.batched.device_buffers import PinnedBuffer, is_gpu
from pharos.agents.batched.layers import KERNEL, whole
from pharos.agents.batched.runs import BLOCK, BatchRun, ObservationSource, as_networks_see, is_small
from pharos.kernels import batched as kernels

LARGEST_TABLE = 1 << 28  # bytes of observations as networks take them, on the processor
SHARE_OF_DEVICE = 0.5  # of a GPU's free memory that a table may take


class Sight:
    """Observations of one source as a network sees them.

    An observation is one frame, or k frames one after another along the channels.

    Attributes:
        frames: k.
        shape: of an observation as Stable-Baselines3's networks take it, images with their channels first.
        size: numbers that the first layer takes.
        places: (size,) where each of them is in a `raw` observation; beyond the border of an image in its 0.
        of_a_frame: (size // k,) the same for an observation of one frame.
        piece: how many numbers of one frame stand beside each other: the neighbours of a pixel, or all of them.
    """

    def __init__(self, source: ObservationSource):
        self.source, self.frames = source, source.frames
        self.shape, self._turns = as_networks_see(tuple(source.shape), source.is_image)
        self.is_small = is_small(self.shape, source.is_image)
        self.places = places_of(self.shape, self.is_small)
        self.of_a_frame, self.size = self.places, len(self.places)
        if self.frames > 1:
            self.of_a_frame = places_of((self.shape[0] // self.frames, *self.shape[1:]), self.is_small)
        self.length = int(np.prod(self.shape)) // self.frames
        self.piece = self.shape[0] // self.frames * KERNEL**2 if self.is_small else self.length

    def raw(self, observations: np.ndarray) -> np.ndarray:
        """(N, M + 1) observations, or single frames, with their channels first, and a 0."""
        turned = np.moveaxis(observations, -1, 1) if self._turns else observations
        return np.pad(turned.reshape(len(turned), -1), ((0, 0), (0, 1)))

    def encoded(self, observations: np.ndarray) -> np.ndarray:
        """(N, size) of observations as the environment gives them."""
        return self.raw(observations)[:, self.places]

    def in_blocks(self) -> Any:
        """(first state, single frames) of all states, a block at a time."""
        look = self.source.at if self.frames == 1 else self.source.frame
        for first in range(0, self.source.num_states, BLOCK):
            yield first, look(np.arange(first, min(first + BLOCK, self.source.num_states)))


def places_of(shape: tuple[int, ...], is_small: bool) -> np.ndarray:
    """Places of the first layer's input in an observation of a shape with a 0 behind it."""
    places = np.arange(int(np.prod(shape)))
    if not is_small:
        return places
    inside = places.reshape(shape)  # the small convolution takes the 9 C neighbours of each pixel
    padded = np.pad(inside, ((0, 0), (1, 1), (1, 1)), constant_values=inside.size)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (KERNEL, KERNEL), axis=(1, 2))  # type: ignore[call-overload]
    return np.ascontiguousarray(windows.transpose(1, 2, 0, 3, 4)).ravel()


class ObservationTable:
    """The observations of runs that see alike.

    Images are kept as bytes, those of the small convolution with the 9 C neighbours of each pixel, so that nothing is
    unfolded while runs learn. Where they do not fit, minibatches are drawn: 0.3 us an image of a small Breakout, and
    as much again for each ten pixels to copy their neighbours. Where several frames are seen single ones are kept, and
    put together for those who ask.

    Attributes:
        sights: of the distinct sources; which: (W,) the number of each run's.
        frames: k, how many states are seen at once.
        shape: of an observation as the lane's network takes it.
        size: numbers that its first layer takes.
        is_image: whether it is one.
        mask: None, as all have the same shape.
    """

    mask: torch.Tensor | None = None

    def __init__(self, runs: Sequence[BatchRun], device: Any = None):
        self.device, self.is_image = device, runs[0].observe.is_image
        sources = list({id(run.observe): run.observe for run in runs}.values())
        place = {id(source): i for i, source in enumerate(sources)}
        self.sights = [Sight(source) for source in sources]
        self.which = np.array([place[id(run.observe)] for run in runs])
        self._ends = np.cumsum([0, *(source.num_states for source in sources)])
        self._begins = self._ends[self.which]
        self.shape, self.size, self.frames = self.sights[0].shape, self.sights[0].size, self.sights[0].frames
        self._take_room()

    def _take_room(self) -> None:
        kind = torch.uint8 if self.is_image else torch.float32
        self._table: torch.Tensor | None = None
        length = self.size // self.frames
        if self._ends[-1] * length * kind.itemsize > LARGEST_TABLE:
            return
        self._table = torch.empty((int(self._ends[-1]), length), dtype=kind)
        for sight, begin in zip(self.sights, self._ends, strict=False):
            for first, block in sight.in_blocks():
                rows = sight.raw(block)[:, sight.of_a_frame]
                self._table[begin + first : begin + first + len(block)] = torch.from_numpy(rows)

    def at(self, states: PinnedBuffer, out: torch.Tensor) -> torch.Tensor:
        """Write what is seen in states (W, B) into out (W, B, size) float32; images from 0 to 255.

        Where k frames are seen states are (W, B, k), the last ones of the episode, the oldest first.
        """
        target = whole(out).numpy()
        if self._table is not None and self.frames > 1:
            kernels.look_up_frames(self._table.numpy(), self._begins, states.array, self.sights[0].piece, target)
        elif self._table is not None:
            kernels.look_up(self._table.numpy(), self._begins, states.array, target)
        else:
            for i, sight in enumerate(self.sights):
                members = np.flatnonzero(self.which == i)
                rows = states.array[members].reshape(-1, *states.array.shape[2:])
                kernels.write_drawn(sight.raw(sight.source.at(rows)), sight.places, members, target)
        return out

    def encoded(self, observations: np.ndarray, i: int) -> torch.Tensor:
        """(N, size) float32 of observations (N, ...) as the environment of run i gives them."""
        rows = torch.from_numpy(self.sights[self.which[i]].encoded(observations)).float()
        return torch.nn.functional.pad(rows, (0, self.size - rows.shape[1])).to(self.device)


class DeviceObservationTable(ObservationTable):
    """The same on another device than the processor, for runs that see alike but for the size of what they see.

    A table of all observations lies there. Smaller observations are filled up with zeros, and a mask says which pixels
    of the small convolution there are.

    Raises:
        MemoryError: the table takes more than its share of the device's memory.
    """

    def __init__(self, runs: Sequence[BatchRun], device: Any = None):
        super().__init__(runs, device)
        if len({sight.shape for sight in self.sights}) == 1:
            return
        self.size = max(sight.size for sight in self.sights)
        channels = self.shape[0] * KERNEL**2
        self.shape = (self.shape[0], 1, self.size // channels) if self.is_image else (self.size,)
        if self.is_image:
            pixels = np.array([sight.size // channels for sight in self.sights])[self.which]
            is_there = np.arange(self.size // channels) < pixels[:, None]
            self.mask = torch.from_numpy(is_there.astype(np.float32)).to(device)

    def _take_room(self) -> None:
        kind, total = torch.uint8 if self.is_image else torch.float32, int(self._ends[-1])
        length = max(sight.length for sight in self.sights) + 1
        needed = total * length * kind.itemsize
        if is_gpu(self.device) and needed > SHARE_OF_DEVICE * torch.cuda.mem_get_info()[0]:
            raise MemoryError(
                f"out of memory: observations of {total:,} states take {needed >> 20:,} MiB on {self.device}, "
                f"more than {SHARE_OF_DEVICE:.0%} of what is free; a run alone that is too large trains on cpu"
            )
        table = torch.zeros((total, length), dtype=kind)
        places = np.full((len(self.sights), max(sight.size for sight in self.sights)), length - 1)
        for sight, row, begin in zip(self.sights, places, self._ends, strict=False):
            frame, inside = np.divmod(sight.places, sight.length)
            row[: sight.size] = np.where(frame < sight.frames, frame * length + inside, length - 1)
            for first, block in sight.in_blocks():
                raw = sight.raw(block)[:, :-1]
                table[begin + first : begin + first + len(raw), : raw.shape[1]] = torch.from_numpy(raw)
        self._table = table.to(self.device)
        offsets = self._begins[:, None] if self.frames == 1 else self._begins[:, None, None]
        self._offsets = torch.from_numpy(offsets).to(self.device)
        self._places = torch.from_numpy(places[self.which][:, None]).to(self.device)

    def at(self, states: PinnedBuffer, out: torch.Tensor) -> torch.Tensor:
        """See `ObservationTable`; a GPU can record it."""
        assert self._table is not None
        rows = (states.tensor + self._offsets).view(-1)
        raw = self._table.index_select(0, rows).view(*states.tensor.shape[:2], -1)
        return out.copy_(raw.gather(2, self._places.expand(-1, raw.shape[1], -1)))
