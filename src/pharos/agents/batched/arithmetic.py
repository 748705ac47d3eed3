"""Arithmetic of W runs on a device: pinned buffers and recorded CUDA graphs, losses, their gradients and Adam.

The arithmetic is there in two ways: compiled loops on the processor, tensor operations elsewhere. Both take and give
tensors. The loops see them as arrays. What they compute is in kernels/batched.py. Tensor operations wait for nothing,
so that a GPU can record them.
"""

import warnings
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from pharos.kernels import batched as kernels


class PinnedBuffer:
    """A host array and its tensor on a device, with copies in both directions.

    On the processor both are one. Otherwise the array lies in memory that a GPU can reach, so that neither waits:
    whoever writes into it, or reads from it, waits for the device first (`wait`).

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
    """Operations on tensors with fixed addresses, recorded as a CUDA graph on a GPU and run as one launch.

    The first call runs them one by one, which also takes all the room that they need. The second one records them.
    If that fails they are run one by one, with a warning, as recording changes no result.
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
    """Whether a device of torch is a GPU, which records CUDA graphs."""
    return torch.device(device).type == "cuda"


def wait(device: str) -> None:
    """Synchronize with the device. Returns at once on the processor."""
    if is_gpu(device):
        torch.cuda.current_stream().synchronize()


# Losses and Adam ------------------------------------------------------------------------------------------------------


class CompiledArithmetic:
    """Losses and Adam as compiled loops on the processor, one pass over memory each."""

    def __init__(self, device: str, width: int):
        self.device = device
        self._steps: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float] | None = None  # of the next `adam`

    def huber(
        self, q: Tensor, q_next: Tensor, q_choice: Tensor, minibatch: Sequence[Tensor], dq: Tensor, loss: PinnedBuffer
    ) -> None:
        """Write the Huber loss of DQN (W,) and its gradient. minibatch: (actions, rewards, discounts) (W, B)."""
        q_arrays = q.numpy(), q_next.numpy(), q_choice.numpy()
        kernels.huber(*q_arrays, tuple(part.numpy() for part in minibatch), dq.numpy(), loss.array)

    def clipped_loss(
        self, scores: Tensor, values: Tensor, minibatch: Sequence[Tensor], weights: Sequence[Tensor],
        gradients: Sequence[Tensor], loss: PinnedBuffer, divergence: PinnedBuffer,
    ) -> None:  # fmt: skip
        """Write the clipped loss of PPO and its gradients. minibatch: (actions, old log p, advantages, returns) (W, B).

        Args:
            weights: (clip range, of the entropy, of the value), (W,) float64 each.
            gradients: of scores and values, written.
            loss, divergence: (W,), written.
        """
        tuples = (tuple(part.numpy() for part in parts) for parts in (minibatch, weights, gradients))
        kernels.clipped_loss(scores.numpy(), values.numpy(), *tuples, loss.array, divergence.array)

    def plan(
        self, counts: np.ndarray, is_active: np.ndarray, rates: np.ndarray, max_norms: np.ndarray, eps: float
    ) -> None:
        """Set learning rates and active runs (W,) of the next `adam`. It increments `counts` (W,) of active runs.

        Args:
            rates, max_norms: (W,).
        """
        self._steps = counts, is_active, rates, max_norms, eps

    def adam(self, state: Sequence[Tensor]) -> None:
        """Adam step set by `plan`. state: (parameters, gradients, means, squares), (W, P) each."""
        assert self._steps is not None
        kernels.adam(tuple(tensor.numpy() for tensor in state), *self._steps)


class TensorArithmetic(CompiledArithmetic):
    """Losses and Adam as operations of torch, on any device."""

    def __init__(self, device: str, width: int):
        super().__init__(device, width)
        self._planned = PinnedBuffer((5, width, 1), torch.float32, device)
        self._fused = fused_adam() if is_gpu(device) else None

    def huber(
        self, q: Tensor, q_next: Tensor, q_choice: Tensor, minibatch: Sequence[Tensor], dq: Tensor, loss: PinnedBuffer
    ) -> None:
        """See `CompiledArithmetic`."""
        actions, rewards, discounts = minibatch
        best = q_choice.argmax(2, keepdim=True)
        target = rewards + discounts * q_next.gather(2, best)[..., 0]
        difference = q.gather(2, actions[..., None])[..., 0] - target
        size = difference.abs()
        loss.tensor.copy_(torch.where(size < 1.0, 0.5 * size * size, size - 0.5).mean(1))
        loss.fetch()
        dq.zero_().scatter_(2, actions[..., None], (difference.clamp(-1.0, 1.0) / q.shape[1])[..., None])

    def clipped_loss(
        self, scores: Tensor, values: Tensor, minibatch: Sequence[Tensor], weights: Sequence[Tensor],
        gradients: Sequence[Tensor], loss: PinnedBuffer, divergence: PinnedBuffer,
    ) -> None:  # fmt: skip
        """See `CompiledArithmetic`."""
        actions, old, advantages, returns = minibatch
        clip, of_entropy, of_value = (part.float()[:, None] for part in weights)
        dscores, dvalues = gradients
        number = scores.shape[1]
        log_p = scores.log_softmax(2)
        p = log_p.exp()
        entropy = -(p * log_p).sum(2)
        gained = log_p.gather(2, actions[..., None])[..., 0] - old
        ratio = gained.exp()
        free, bound = advantages * ratio, advantages * ratio.clamp(1.0 - clip, 1.0 + clip)
        error = values[..., 0] - returns
        total = -torch.minimum(free, bound) - of_entropy * entropy + of_value * error * error
        for buffer, part in ((loss, total), (divergence, ratio - 1.0 - gained)):
            buffer.tensor.copy_(part.mean(1))
            buffer.fetch()
        of_log_p = torch.where(free <= bound, -free / number, torch.zeros_like(free))[..., None]
        one_hot = torch.zeros_like(p).scatter_(2, actions[..., None], 1.0)
        torch.mul(p, log_p + entropy[..., None], out=dscores).mul_(of_entropy[..., None] / number)
        dscores.add_(of_log_p * (one_hot - p))
        dvalues.copy_((2.0 * of_value * error / number)[..., None])

    def plan(
        self, counts: np.ndarray, is_active: np.ndarray, rates: np.ndarray, max_norms: np.ndarray, eps: float
    ) -> None:
        """See `CompiledArithmetic`."""
        counts += is_active
        steps = np.maximum(counts, 1)
        root = np.sqrt(1.0 - 0.999**steps)
        step = np.where(is_active, rates / (1.0 - 0.9**steps) * root, 0.0)
        rows = (max_norms, 0.1 * is_active, 0.001 * is_active, step, eps * root)
        for row, values in zip(self._planned.array, rows, strict=True):
            row[:, 0] = values

    def adam(self, state: Sequence[Tensor]) -> None:
        """See `CompiledArithmetic`."""
        parameters, gradients, means, squares = state
        self._planned.send()
        max_norms, first, second, step, eps = self._planned.tensor
        norm = torch.linalg.vector_norm(gradients, dim=1, keepdim=True)
        scale = (max_norms / (norm + 1e-6)).clamp_(max=1.0)
        if self._fused is not None:
            self._fused(state, torch.cat([scale, first, second, step, eps], 1))
            return
        scaled = gradients * scale
        means.add_((scaled - means) * first)
        squares.add_((scaled * scaled - squares) * second)
        parameters.sub_((means * step).div_(squares.sqrt().add_(eps)))


def fused_adam() -> Callable[[Sequence[Tensor], Tensor], None] | None:
    """Adam in one pass over a GPU's memory, by Triton, which torch for CUDA brings along. None if it does not."""
    try:
        from pharos.agents.batched import fused
    except ImportError:
        return None
    return fused.adam_on_gpu
