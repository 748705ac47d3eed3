"""What W runs see of their states, as tensors: gathered from one table where it fits, else drawn for those who ask."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from pharos.agents.batched.layers import KERNEL, whole
from pharos.agents.batched.networks import is_small
from pharos.agents.batched.runs import BLOCK, BatchRun
from pharos.kernels import batched_worlds

look_up: Any = batched_worlds.look_up
LARGEST_TABLE = 1 << 28  # bytes of observations as networks take them
LARGEST_RAW_TABLE = 1 << 30  # bytes of images as they are


class Seen:
    """The observations of runs that see alike.

    Images are kept as bytes. Those of the small convolution are kept with the 9 C neighbours of each pixel where they
    fit, so that nothing is unfolded while runs learn.

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
        self._begins = begins[self._which][:, None]
        kind = torch.uint8 if self.is_image else torch.float32
        self._table: torch.Tensor | None = None
        self._is_encoded = begins[-1] * self.size * kind.itemsize <= LARGEST_TABLE
        size = self.size if self._is_encoded else int(np.prod(self.shape))
        if self._is_encoded or begins[-1] * size * kind.itemsize <= LARGEST_RAW_TABLE:
            table = torch.empty((int(begins[-1]), size), dtype=kind)
            for source, begin in zip(self.sources, begins, strict=False):
                for row in range(0, source.num_states, BLOCK):
                    rows = np.arange(row, min(row + BLOCK, source.num_states))
                    raw = self._turned(source.at(rows))
                    table[begin + row : begin + row + len(rows)] = torch.from_numpy(
                        self._encoded(raw) if self._is_encoded else raw.reshape(len(raw), -1)
                    )
            self._table = table.to(device)

    def at(self, states: np.ndarray, out: torch.Tensor) -> torch.Tensor:
        """Write what is seen in states (W, B) into out (W, B, size) float32; images from 0 to 255."""
        if self._table is not None and self._is_encoded and self._table.device.type == "cpu":
            look_up(self._table.numpy(), self._begins[:, 0], states, whole(out).numpy())
            return out
        if self._table is not None:
            rows = torch.from_numpy((states + self._begins).ravel()).to(self.device)
            found = self._table.index_select(0, rows)
            if not self._is_encoded:
                raw = found.cpu().numpy().reshape(len(found), *self.shape)
                found = torch.from_numpy(self._encoded(raw)).to(self.device)
            return out.copy_(found.view(out.shape))
        for i, source in enumerate(self.sources):
            members = np.flatnonzero(self._which == i)
            drawn = self.encoded(source.at(states[members].ravel()))
            out[torch.from_numpy(members).to(self.device)] = drawn.view(len(members), states.shape[1], -1)
        return out

    def encoded(self, observations: np.ndarray) -> torch.Tensor:
        """(N, size) float32 of observations (N, ...) as the environment gives them."""
        return torch.from_numpy(self._encoded(self._turned(observations))).to(self.device).float()

    def _turned(self, observations: np.ndarray) -> np.ndarray:
        return np.moveaxis(observations, -1, 1) if self._turns else observations

    def _encoded(self, observations: np.ndarray) -> np.ndarray:
        """(N, size) of observations (N, *shape)."""
        count = len(observations)
        if not self._is_small:
            return np.ascontiguousarray(observations).reshape(count, -1)
        padded = np.pad(observations, ((0, 0), (0, 0), (1, 1), (1, 1)))
        windows = np.lib.stride_tricks.sliding_window_view(padded, (KERNEL, KERNEL), axis=(2, 3))  # type: ignore[call-overload]
        return np.ascontiguousarray(windows.transpose(0, 2, 3, 1, 4, 5)).reshape(count, -1)


def as_networks_see(shape: tuple[int, ...], is_image: bool) -> tuple[tuple[int, ...], bool]:
    """(shape as networks take it, whether images are turned): their channels come first.

    Stable-Baselines3 takes the smallest side of an image for its channels, and turns it unless that comes first.
    """
    if not is_image or int(np.argmin(shape)) == 0:
        return shape, False
    return (shape[2], *shape[:2]), True
