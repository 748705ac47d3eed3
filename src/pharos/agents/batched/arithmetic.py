"""Losses, their gradients and Adam, in two ways: compiled loops on the processor, tensor operations elsewhere.

Both take and give tensors; the loops see them as arrays. What they compute is in kernels/batched.py. Tensor operations
wait for nothing, so that a GPU can record them.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from pharos.agents.batched.device_buffers import PinnedBuffer, is_gpu
from pharos.kernels import batched as kernels


class CompiledArithmetic:
    """On the processor: one pass over memory each."""

    def __init__(self, device: str, width: int):
        self.device = device
        self._steps: Any = None  # what the next step of Adam takes

    def huber(
        self, q: Tensor, q_next: Tensor, q_choice: Tensor, minibatch: Any, dq: Tensor, loss: PinnedBuffer
    ) -> None:
        """The loss of DQN (W,) and its gradient; minibatch: (actions, rewards, discounts) (W, B)."""
        q_arrays = q.numpy(), q_next.numpy(), q_choice.numpy()
        actions, rewards, discounts = (part.numpy() for part in minibatch)
        kernels.huber(*q_arrays, actions, rewards, discounts, dq.numpy(), loss.array)

    def clipped_loss(
        self, scores: Tensor, values: Tensor, minibatch: Any, weights: Any, gradients: Any, loss: PinnedBuffer,
        divergence: PinnedBuffer,
    ) -> None:  # fmt: skip
        """The loss of PPO and its gradients; minibatch: (actions, old log p, advantages, returns) (W, B).

        Args:
            weights: (clip range, of the entropy, of the value), (W,) float64 each.
            gradients: of scores and values, written.
            loss, divergence: (W,), written.
        """
        arrays = tuple(part.numpy() for part in minibatch)
        own = tuple(part.numpy() for part in weights)
        written = (*(gradient.numpy() for gradient in gradients), loss.array, divergence.array)
        kernels.clipped_loss(scores.numpy(), values.numpy(), arrays, *own, *written)

    def plan(self, counts: np.ndarray, is_active: np.ndarray, rates: Any, max_norms: Any, eps: float) -> None:
        """Say what the next `adam` does: a step for the active runs (W,), which `counts` (W,) goes up for.

        Args:
            rates, max_norms: (W,).
        """
        self._steps = counts, is_active, rates, max_norms, eps

    def adam(self, state: Any) -> None:
        """The step that was planned; state: (parameters, gradients, means, squares), (W, P) each."""
        kernels.adam(*(tensor.numpy() for tensor in state), *self._steps)


class TensorArithmetic(CompiledArithmetic):
    """The same by operations of torch, on any device."""

    def __init__(self, device: str, width: int):
        super().__init__(device, width)
        self._planned = PinnedBuffer((5, width, 1), torch.float32, device)
        self._fused = fused_adam() if is_gpu(device) else None

    def huber(
        self, q: Tensor, q_next: Tensor, q_choice: Tensor, minibatch: Any, dq: Tensor, loss: PinnedBuffer
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
        self, scores: Tensor, values: Tensor, minibatch: Any, weights: Any, gradients: Any, loss: PinnedBuffer,
        divergence: PinnedBuffer,
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
        for mirror, part in ((loss, total), (divergence, ratio - 1.0 - gained)):
            mirror.tensor.copy_(part.mean(1))
            mirror.fetch()
        of_log_p = torch.where(free <= bound, -free / number, torch.zeros_like(free))[..., None]
        chosen = torch.zeros_like(p).scatter_(2, actions[..., None], 1.0)
        torch.mul(p, log_p + entropy[..., None], out=dscores).mul_(of_entropy[..., None] / number)
        dscores.add_(of_log_p * (chosen - p))
        dvalues.copy_((2.0 * of_value * error / number)[..., None])

    def plan(self, counts: np.ndarray, is_active: np.ndarray, rates: Any, max_norms: Any, eps: float) -> None:
        """See `CompiledArithmetic`."""
        counts += is_active
        steps = np.maximum(counts, 1)
        root = np.sqrt(1.0 - 0.999**steps)
        step = np.where(is_active, rates / (1.0 - 0.9**steps) * root, 0.0)
        rows = (max_norms, 0.1 * is_active, 0.001 * is_active, step, eps * root)
        for row, values in zip(self._planned.array, rows, strict=True):
            row[:, 0] = values

    def adam(self, state: Any) -> None:
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


def fused_adam() -> Any:
    """Adam in one pass over a GPU's memory, by Triton, which torch for CUDA brings along; None where it does not."""
    try:
        from pharos.agents.batched.fused import adam
    except ImportError:
        return None
    return adam
