"""What W runs see of their states, as tensors: gathered from one table where it fits, else drawn for those who ask."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from pharos.agents.batched.layers import KERNEL, whole
from pharos.agents.batched.networks import is_small
from pharos.agents.batched.runs import BLOCK, BatchRun
from pharos.kernels import batched_worlds

kernels: Any = batched_worlds  # compiled functions, whose types are hidden
LARGEST_TABLE = 1 << 28  # bytes of observations as networks take them


class Seen:
    """The observations of runs that see alike.

    Images are kept as bytes, those of the small convolution with the 9 C neighbours of each pixel, so that nothing is
    unfolded while runs learn. Where they do not fit, minibatches are drawn: 0.3 us an image of a small Breakout, and
    as much again for each ten pixels to copy their neighbours.

    Attributes:
        shape: of an observation as Stable-Baselines3's networks take it, images with their channels first.
        size: numbers that the first layer takes.
        is_image: whether it is one.
    """

    def __init__(self, runs: Sequence[BatchRun], device: Any = None):
        first = runs[0].observe
        self.is_image, self.device = first.is_image, device
        self.shape, self._turns = as_networks_see(tuple(first.shape), first.is_image)
        self._is_small = is_small(self.shape, self.is_image)
        self.size = int(np.prod(self.shape)) * (KERNEL**2 if self._is_small else 1)
        self.sources = list({id(run.observe): run.observe for run in runs}.values())
        place = {id(source): i for i, source in enumerate(self.sources)}
        self._which = np.array([place[id(run.observe)] for run in runs])
        begins = np.cumsum([0, *(source.num_states for source in self.sources)])
        self._begins = begins[self._which]
        self._places = self._places_of_inputs()
        kind = torch.uint8 if self.is_image else torch.float32
        self._table: torch.Tensor | None = None
        if begins[-1] * self.size * kind.itemsize <= LARGEST_TABLE:
            table = torch.empty((int(begins[-1]), self.size), dtype=kind)
            for source, begin in zip(self.sources, begins, strict=False):
                for row in range(0, source.num_states, BLOCK):
                    rows = np.arange(row, min(row + BLOCK, source.num_states))
                    block = torch.from_numpy(self._encoded(source.at(rows)))
                    table[begin + row : begin + row + len(rows)] = block
            self._table = table.to(device)

    def at(self, states: np.ndarray, out: torch.Tensor) -> torch.Tensor:
        """Write what is seen in states (W, B) into out (W, B, size) float32; images from 0 to 255."""
        if self._table is None:
            drawn = whole(out) if out.device.type == "cpu" else whole(torch.empty_like(out, device="cpu"))
            for i, source in enumerate(self.sources):
                members = np.flatnonzero(self._which == i)
                raw = self._raw(source.at(states[members].ravel()))
                kernels.write_drawn(raw, self._places, members, drawn.numpy())
            return out if out.device.type == "cpu" else out.copy_(drawn[:, : out[0].numel()].view(out.shape))
        if self._table.device.type == "cpu":
            kernels.look_up(self._table.numpy(), self._begins, states, whole(out).numpy())
            return out
        rows = torch.from_numpy((states + self._begins[:, None]).ravel()).to(self.device)
        return out.copy_(self._table.index_select(0, rows).view(out.shape))

    def encoded(self, observations: np.ndarray) -> torch.Tensor:
        """(N, size) float32 of observations (N, ...) as the environment gives them."""
        return torch.from_numpy(self._encoded(observations)).to(self.device).float()

    def _raw(self, observations: np.ndarray) -> np.ndarray:
        """(N, M + 1) observations with their channels first, and a 0."""
        turned = np.moveaxis(observations, -1, 1) if self._turns else observations
        return np.pad(turned.reshape(len(turned), -1), ((0, 0), (0, 1)))

    def _encoded(self, observations: np.ndarray) -> np.ndarray:
        """(N, size) of observations."""
        return self._raw(observations)[:, self._places]

    def _places_of_inputs(self) -> np.ndarray:
        """(size,): where each input of the first layer is in a `_raw` observation; beyond the border in its 0."""
        inside = np.arange(int(np.prod(self.shape)))
        if not self._is_small:
            return inside
        padded = np.pad(inside.reshape(self.shape), ((0, 0), (1, 1), (1, 1)), constant_values=len(inside))
        windows = np.lib.stride_tricks.sliding_window_view(padded, (KERNEL, KERNEL), axis=(1, 2))  # type: ignore[call-overload]
        return np.ascontiguousarray(windows.transpose(1, 2, 0, 3, 4)).ravel()


def as_networks_see(shape: tuple[int, ...], is_image: bool) -> tuple[tuple[int, ...], bool]:
    """(shape as networks take it, whether images are turned): their channels come first.

    Stable-Baselines3 takes the smallest side of an image for its channels, and turns it unless that comes first.
    """
    if not is_image or int(np.argmin(shape)) == 0:
        return shape, False
    return (shape[2], *shape[:2]), True
