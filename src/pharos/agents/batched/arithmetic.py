"""Losses, their gradients and Adam, in two ways: compiled loops on the processor, tensor operations elsewhere.

Both take and give tensors; the loops see them as arrays. What they compute is in kernels/batched_learning.py and
kernels/batched_rollouts.py.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from pharos.kernels import batched_learning, batched_rollouts

learning: Any = batched_learning  # compiled functions, whose types are hidden
rollouts: Any = batched_rollouts


class CompiledArithmetic:
    """On the processor: one pass over memory each."""

    def __init__(self, device: Any = None):
        self.device = device

    def huber(self, q: Tensor, q_next: Tensor, q_choice: Tensor, minibatch: Any, dq: Tensor, loss: np.ndarray) -> None:
        """The loss of DQN and its gradient; minibatch: (actions, rewards, discounts) (W, B)."""
        learning.huber(q.numpy(), q_next.numpy(), q_choice.numpy(), *minibatch, dq.numpy(), loss)

    def clipped_loss(
        self, scores: Tensor, values: Tensor, minibatch: Any, weights: Any, gradients: Any,
        loss: np.ndarray, divergence: np.ndarray,
    ) -> None:  # fmt: skip
        """The loss of PPO and its gradients; minibatch: (actions, old log p, advantages, returns) (W, B).

        Args:
            weights: (clip range, of the entropy, of the value), (W,) each.
            gradients: of scores and values, written.
        """
        arrays = tuple(gradient.numpy() for gradient in gradients)
        rollouts.clipped_loss(scores.numpy(), values.numpy(), minibatch, *weights, *arrays, loss, divergence)

    def adam(
        self, state: Any, counts: np.ndarray, is_active: np.ndarray, rates: Any, max_norms: Any, eps: float
    ) -> None:
        """A step for the active runs; state: (parameters, gradients, means, squares), (W, P) each."""
        learning.adam(*(tensor.numpy() for tensor in state), counts, is_active, rates, max_norms, eps)


class TensorArithmetic(CompiledArithmetic):
    """The same by operations of torch, on any device."""

    def huber(self, q: Tensor, q_next: Tensor, q_choice: Tensor, minibatch: Any, dq: Tensor, loss: np.ndarray) -> None:
        """As `CompiledArithmetic` says."""
        actions, rewards, discounts = (self._sent(part) for part in minibatch)
        best = q_choice.argmax(2, keepdim=True)
        target = rewards + discounts * q_next.gather(2, best)[..., 0]
        difference = q.gather(2, actions[..., None])[..., 0] - target
        size = difference.abs()
        loss[:] = torch.where(size < 1.0, 0.5 * size * size, size - 0.5).mean(1).cpu().numpy()
        dq.zero_().scatter_(2, actions[..., None], (difference.clamp(-1.0, 1.0) / q.shape[1])[..., None])

    def clipped_loss(
        self, scores: Tensor, values: Tensor, minibatch: Any, weights: Any, gradients: Any,
        loss: np.ndarray, divergence: np.ndarray,
    ) -> None:  # fmt: skip
        """As `CompiledArithmetic` says."""
        actions, old, advantages, returns = (self._sent(part) for part in minibatch)
        clip, of_entropy, of_value = (self._sent(part).float()[:, None] for part in weights)
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
        loss[:], divergence[:] = (part.mean(1).cpu().numpy() for part in (total, ratio - 1.0 - gained))
        of_log_p = torch.where(free <= bound, -free / number, torch.zeros_like(free))[..., None]
        chosen = torch.zeros_like(p).scatter_(2, actions[..., None], 1.0)
        torch.mul(p, log_p + entropy[..., None], out=dscores).mul_(of_entropy[..., None] / number)
        dscores.add_(of_log_p * (chosen - p))
        dvalues.copy_((2.0 * of_value * error / number)[..., None])

    def adam(
        self, state: Any, counts: np.ndarray, is_active: np.ndarray, rates: Any, max_norms: Any, eps: float
    ) -> None:
        """As `CompiledArithmetic` says."""
        parameters, gradients, means, squares = state
        counts += is_active
        steps = np.maximum(counts, 1)
        root = np.sqrt(1.0 - 0.999**steps)
        step, first, second = rates / (1.0 - 0.9**steps) * root, 0.1 * is_active, 0.001 * is_active
        norm = torch.linalg.vector_norm(gradients, dim=1, keepdim=True)
        scaled = gradients * (self._column(max_norms) / (norm + 1e-6)).clamp(max=1.0)
        means.add_((scaled - means) * self._column(first))
        squares.add_((scaled * scaled - squares) * self._column(second))
        change = means * self._column(np.where(is_active, step, 0.0))
        parameters.sub_(change.div_(squares.sqrt().add_(self._column(eps * root))))

    def _sent(self, array: np.ndarray) -> Tensor:
        return torch.from_numpy(array).to(self.device)

    def _column(self, array: np.ndarray) -> Tensor:
        """(W,) numbers as a (W, 1) float32 tensor."""
        return self._sent(np.asarray(array, np.float32))[:, None]
