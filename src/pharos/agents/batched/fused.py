"""Adam in one pass over a GPU's memory. Tensor operations read and write moments and parameters some twenty times."""

from collections.abc import Sequence

import triton
import triton.language as tl
from torch import Tensor

PROGRAM_PARAMETERS = 1024  # parameters of a program


@triton.jit
def step_of_adam(parameters, gradients, means, squares, plans, length, size: tl.constexpr):  # type: ignore[no-untyped-def]
    """A block of one run's parameters. plans: (scale, first, second, step, eps) of each run."""
    run = tl.program_id(0).to(tl.int64)
    step = tl.load(plans + run * 5 + 3)
    if step != 0.0:
        scale, first = tl.load(plans + run * 5), tl.load(plans + run * 5 + 1)
        second, eps = tl.load(plans + run * 5 + 2), tl.load(plans + run * 5 + 4)
        index = tl.program_id(1) * size + tl.arange(0, size)
        inside = index < length
        index += run * length
        gradient = scale * tl.load(gradients + index, mask=inside, other=0.0)
        mean = tl.load(means + index, mask=inside, other=0.0)
        square = tl.load(squares + index, mask=inside, other=0.0)
        mean += (gradient - mean) * first
        square += (gradient * gradient - square) * second
        tl.store(means + index, mean, mask=inside)
        tl.store(squares + index, square, mask=inside)
        old = tl.load(parameters + index, mask=inside, other=0.0)
        tl.store(parameters + index, old - step * mean / (tl.sqrt(square) + eps), mask=inside)


def adam_on_gpu(state: Sequence[Tensor], plans: Tensor) -> None:
    """A step for each run whose step is not 0. state: (parameters, gradients, means, squares) (W, P), plans (W, 5)."""
    width, length = state[0].shape
    step_of_adam[(width, triton.cdiv(length, PROGRAM_PARAMETERS))](*state, plans, length, PROGRAM_PARAMETERS)
