"""Pinned host and device buffers, and recorded CUDA graphs."""

import warnings
from collections.abc import Callable

import numpy as np
import torch


class PinnedBuffer:
    """An array of the processor's, and the tensor on a device that it is sent to or fetched from.

    On the processor both are one. Elsewhere the array lies where a GPU can reach it, so that neither waits; whoever
    writes into it, or reads from it, waits for the device first (`wait`).

    Attributes:
        array: on the processor.
        tensor: on the device.
    """

    def __init__(self, shape: tuple[int, ...], dtype: torch.dtype, device: str):
        self._kept = torch.zeros(shape, dtype=dtype, pin_memory=is_gpu(device))
        self.array: np.ndarray = self._kept.numpy()
        self.tensor = self._kept if device == "cpu" else torch.zeros(shape, dtype=dtype, device=device)

    def send(self) -> None:
        """Copy the array to the device."""
        if self.tensor is not self._kept:
            self.tensor.copy_(self._kept, non_blocking=True)

    def fetch(self) -> None:
        """Copy the tensor back."""
        if self.tensor is not self._kept:
            self._kept.copy_(self.tensor, non_blocking=True)


class CudaGraph:
    """Operations on tensors that stay in their places. A GPU records them, and runs them as one launch.

    The first call runs them one by one, which also takes all the room that they need; the second one records them.
    Where that fails they are run one by one, with a warning, as recording changes no result.
    """

    def __init__(self, operations: Callable[[], None], device: str):
        self._operations, self._is_recorded = operations, is_gpu(device)
        self._has_run = False
        self._graph: torch.cuda.CUDAGraph | None = None

    def __call__(self) -> None:
        if self._graph is not None:
            self._graph.replay()
        elif self._is_recorded and self._has_run and self._record():
            self()
        else:
            self._operations()
            self._has_run = True

    def _record(self) -> bool:
        graph = torch.cuda.CUDAGraph()
        try:
            with torch.cuda.graph(graph, capture_error_mode="thread_local"):
                self._operations()
        except RuntimeError as error:
            self._is_recorded = False
            reason = (str(error).splitlines() or [""])[0]
            warnings.warn(f"the GPU does not record the updates, which are slower so: {reason}", stacklevel=2)
            return False
        self._graph = graph
        return True


def is_gpu(device: str) -> bool:
    """Whether a device of torch records programs."""
    return torch.device(device).type == "cuda"


def wait(device: str) -> None:
    """Until the device has done what it was told."""
    if is_gpu(device):
        torch.cuda.current_stream().synchronize()
