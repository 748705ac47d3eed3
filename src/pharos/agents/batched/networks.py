"""W networks of one shape as one: parameters with a leading axis of runs, forward and backward written out.

The networks are those of agents/networks.py with the heads that Stable-Baselines3 puts on them. Parameters of all runs
lie in one (W, P) array, the gradients in another, so that clipping and Adam are one pass over each. Weights of linear
layers are kept (in, out), the transpose of Stable-Baselines3's, which multiplies faster.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

FEATURES = 128
ALIGNED = 16  # floats: each parameter of each run begins at a multiple of 64 bytes
RELU, TANH, NONE = "relu", "tanh", "none"


@dataclass(frozen=True)
class Shape:
    """One parameter: its name in Stable-Baselines3, its shape here, and where it lies in a row of parameters."""

    name: str
    shape: tuple[int, ...]
    offset: int

    @property
    def size(self) -> int:
        return math.prod(self.shape)


class Parameters:
    """(W, P) float32 parameters and gradients of W runs, and the views that layers use."""

    def __init__(self) -> None:
        self.shapes: list[Shape] = []
        self.length = 0

    def add(self, name: str, *shape: int) -> Shape:
        """Room for one more parameter."""
        added = Shape(name, shape, self.length)
        self.shapes.append(added)
        self.length += -(-added.size // ALIGNED) * ALIGNED
        return added

    def views(self, rows: Tensor) -> dict[str, Tensor]:
        """name -> (W, ...) view of (W, P)."""
        return {
            each.name: rows[:, each.offset : each.offset + each.size].view(len(rows), *each.shape)
            for each in self.shapes
        }


def room(width: int, *shape: int, device: Any = None) -> Tensor:
    """(W, ...) float32 whose runs begin at multiples of 64 bytes, so that a run's place changes nothing."""
    size = math.prod(shape)
    rows = torch.zeros((width, -(-size // ALIGNED) * ALIGNED), device=device)
    return rows[:, :size].view(width, *shape)


class Linear:
    """y = activation(x w + b) for (W, B, in) -> (W, B, out)."""

    def __init__(self, parameters: Parameters, name: str, inputs: int, outputs: int, activation: str):
        self.name, self.inputs, self.outputs, self.activation = name, inputs, outputs, activation
        parameters.add(f"{name}.weight", inputs, outputs)
        parameters.add(f"{name}.bias", 1, outputs)
        self._rooms: dict[tuple[int, int], tuple[Tensor, Tensor]] = {}

    def forward(self, values: dict[str, Tensor], x: Tensor) -> Tensor:
        """The outputs; they stay until the next call with as many rows."""
        y, _ = self._room(x)
        torch.baddbmm(values[f"{self.name}.bias"], x, values[f"{self.name}.weight"], out=y)
        if self.activation == RELU:
            y.clamp_(min=0.0)
        elif self.activation == TANH:
            _whole(y).tanh_()
        return y

    def backward(
        self, values: dict[str, Tensor], gradients: dict[str, Tensor], x: Tensor, dy: Tensor, *, onward: bool
    ) -> Tensor | None:
        """Write the gradients of the parameters; return that of x where it goes `onward`. Changes dy."""
        y, dx = self._room(x)
        if self.activation == RELU:
            dy = torch.ops.aten.threshold_backward(dy, y, 0)
        elif self.activation == TANH:
            dy = torch.ops.aten.tanh_backward(dy, y)
        torch.sum(dy, 1, keepdim=True, out=gradients[f"{self.name}.bias"])
        torch.bmm(x.transpose(1, 2), dy, out=gradients[f"{self.name}.weight"])
        return torch.bmm(dy, values[f"{self.name}.weight"].transpose(1, 2), out=dx) if onward else None

    def _room(self, x: Tensor) -> tuple[Tensor, Tensor]:
        key = (x.shape[0], x.shape[1])
        if key not in self._rooms:
            made = (room(*key, self.outputs, device=x.device), room(*key, self.inputs, device=x.device))
            self._rooms[key] = made
        return self._rooms[key]


def _whole(y: Tensor) -> Tensor:
    """All the memory of a `room`, in which each run has a multiple of 64 bytes: no run is at a loop's ragged end."""
    return y.as_strided((y.shape[0], y.stride(0)), (y.stride(0), 1))


class Stack:
    """Layers one after another."""

    def __init__(self, layers: Sequence[Any]):
        self.layers = list(layers)
        self._inputs: list[Tensor] = []

    def forward(self, values: dict[str, Tensor], x: Tensor) -> Tensor:
        """The outputs of the last layer."""
        self._inputs = []
        for layer in self.layers:
            self._inputs.append(x)
            x = layer.forward(values, x)
        return x

    def backward(
        self, values: dict[str, Tensor], gradients: dict[str, Tensor], dy: Tensor, *, onward: bool = False
    ) -> Tensor | None:
        """The gradients of all parameters, after `forward`; that of the input where it goes `onward`."""
        for i in range(len(self.layers) - 1, -1, -1):
            dx = self.layers[i].backward(values, gradients, self._inputs[i], dy, onward=onward or i > 0)
            if dx is None:
                return None
            dy = dx
        return dy


def sizes_of(net_arch: Any, head: str = "pi") -> list[int]:
    """The hidden layers of a head: net_arch is a list for all heads, or a dict of lists."""
    return list(net_arch.get(head, ())) if isinstance(net_arch, dict) else list(net_arch)


def hidden(parameters: Parameters, name: str, inputs: int, sizes: Sequence[int], activation: str) -> list[Linear]:
    """Hidden layers as Stable-Baselines3 numbers them: name.0, name.2, ..."""
    layers = []
    for i, outputs in enumerate(sizes):
        layers.append(Linear(parameters, f"{name}.{2 * i}", inputs, outputs, activation))
        inputs = outputs
    return layers


def vector_extractor(parameters: Parameters, name: str, shape: tuple[int, ...]) -> list[Any]:
    """The layers of SmallMLP."""
    return [Linear(parameters, f"{name}.layers.1", math.prod(shape), FEATURES, RELU)]


def initial_uniform(parameters: Parameters, draws: Callable[[int], np.ndarray]) -> np.ndarray:
    """(W, P): weights and biases uniform in +- 1 / sqrt(fan in), as torch begins.

    Args:
        draws: number of draws -> (W, number) uniform in (0, 1).
    """
    uniform = draws(parameters.length)
    fan_in = 1
    for each in parameters.shapes:  # a bias follows its weights
        if each.name.endswith("weight"):
            fan_in = math.prod(each.shape[1:]) if len(each.shape) == 4 else each.shape[0]
        part = slice(each.offset, each.offset + each.size)
        uniform[:, part] = (2.0 * uniform[:, part] - 1.0) / math.sqrt(fan_in)
    return uniform.astype(np.float32)


def as_stored(name: str, value: np.ndarray) -> np.ndarray:
    """A parameter of one run in the shape that Stable-Baselines3 gives it."""
    if name.endswith("bias"):
        return value.reshape(-1).copy()
    return value.T.copy() if value.ndim == 2 else value.copy()


class QNetworks:
    """The Q-networks of W runs: an extractor of features, hidden layers, a value for each action."""

    def __init__(self, shape: tuple[int, ...], is_image: bool, net_arch: Sequence[int], num_actions: int):
        self.parameters = parameters = Parameters()
        extractor = "q_net.features_extractor"
        layers: list[Any] = _extractor(parameters, extractor, shape, is_image)
        layers += hidden(parameters, "q_net.q_net", FEATURES, net_arch, RELU)
        last = net_arch[-1] if net_arch else FEATURES
        layers.append(Linear(parameters, f"q_net.q_net.{2 * len(net_arch)}", last, num_actions, NONE))
        self.stack = Stack(layers)

    def forward(self, values: dict[str, Tensor], x: Tensor) -> Tensor:
        """(W, B, A) values of observations (W, B, ...)."""
        return self.stack.forward(values, x)

    scores = forward

    def backward(self, values: dict[str, Tensor], gradients: dict[str, Tensor], dq: Tensor) -> None:
        """The gradients after `forward`."""
        self.stack.backward(values, gradients, dq)


def _extractor(parameters: Parameters, name: str, shape: tuple[int, ...], is_image: bool) -> list[Any]:
    if is_image:
        from pharos.agents.batched.convolutions import image_extractor

        return image_extractor(parameters, name, shape)
    return vector_extractor(parameters, name, shape)
