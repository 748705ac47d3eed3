"""W networks of one shape as one: the networks of agents/sb3.py with the heads of Stable-Baselines3.

Layers have parameters with a leading axis of runs, and their gradients are written out.

Parameters of all runs lie in one (W, P) array and their gradients in another, so that clipping and Adam are one pass
over each. Weights of linear layers are kept (in, out), the transpose of Stable-Baselines3's, which multiplies faster.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from pharos.agents.batched.runs import is_small
from pharos.kernels import patches
from pharos.kernels.batched import linear_row

ALIGNED_FLOATS = 16  # floats: each parameter of each run begins at a multiple of 64 bytes
RELU_ACTIVATION, TANH_ACTIVATION, NO_ACTIVATION = "relu", "tanh", "none"
ALL_PARAMETERS = "all parameters"
PIXEL_MASK = "which pixels there are"
KERNEL = 3  # of the small convolution
FEATURES = 128

Values = dict[str, Tensor]
NetArch = Sequence[int] | dict[str, Sequence[int]]
Draws = Callable[[int], np.ndarray]
"""number of draws -> (W, number) uniform in (0, 1)."""


@dataclass(frozen=True)
class Shape:
    """One parameter.

    Attributes:
        name: in Stable-Baselines3.
        shape: of one run's, here.
        offset: at which it begins in a row of parameters.
        fan_in: of the layer.
        stored: (shape) -> the array as Stable-Baselines3 has it.
        own: the array as Stable-Baselines3 has it -> as it is kept here.
    """

    name: str
    shape: tuple[int, ...]
    offset: int
    fan_in: int
    stored: Callable[[np.ndarray], np.ndarray]
    own: Callable[[np.ndarray], np.ndarray]

    @property
    def size(self) -> int:
        return math.prod(self.shape)


class Parameters:
    """The positions of all parameters of a network in a row of P numbers.

    Attributes:
        shapes: in their order.
        length: P.
    """

    def __init__(self) -> None:
        self.shapes: list[Shape] = []
        self.length = 0

    def add(
        self,
        name: str,
        shape: tuple[int, ...],
        fan_in: int,
        stored: Callable[[np.ndarray], np.ndarray],
        own: Callable[[np.ndarray], np.ndarray],
    ) -> None:
        """Append a parameter."""
        self.shapes.append(Shape(name, shape, self.length, fan_in, stored, own))
        self.length += -(-self.shapes[-1].size // ALIGNED_FLOATS) * ALIGNED_FLOATS

    def views(self, rows: Tensor) -> Values:
        """name -> (W, ...) view of (W, P), all of it under the name ALL_PARAMETERS."""
        views = {
            each.name: rows[:, each.offset : each.offset + each.size].view(len(rows), *each.shape)
            for each in self.shapes
        }
        return {**views, ALL_PARAMETERS: rows}


def aligned_zeros(width: int, *shape: int, device: str | torch.device | None = None) -> Tensor:
    """(W, ...) float32 zeros. Each run begins at a multiple of 64 bytes, so that its position changes no result."""
    size = math.prod(shape)
    rows = torch.zeros((width, -(-size // ALIGNED_FLOATS) * ALIGNED_FLOATS), device=device)
    return rows[:, :size].view(width, *shape)


def flat_view(y: Tensor) -> Tensor:
    """(W, padded size) view of `aligned_zeros` with the padding of each run: no run is at a loop's ragged end."""
    return y.as_strided((y.shape[0], y.stride(0)), (y.stride(0), 1))


class NetworkLayer:
    """x (W, B, in) -> (W, B, out). Keeps its buffers for each number of rows, overwritten by the next call.

    Attributes:
        number: how many of the W networks are runs, None if all are. Idle ones after them fill a narrow lane. On the
            processor no convolution is computed for them: there outputs and gradients are 0.
    """

    def __init__(self, name: str, inputs: int, outputs: int, activation: str):
        self.name, self.inputs, self.outputs, self.activation = name, inputs, outputs, activation
        self.number: int | None = None
        self._rooms: dict[tuple[int, int], tuple[Tensor, Tensor]] = {}

    def forward(self, values: Values, x: Tensor) -> Tensor:
        """The outputs."""
        raise NotImplementedError

    def backward(self, values: Values, gradients: Values, x: Tensor, dy: Tensor, *, onward: bool) -> Tensor | None:
        """Write the gradients of the parameters, after `forward` of x. Return the gradient of x if `onward`."""
        raise NotImplementedError

    def _buffers(self, x: Tensor, *, onward: bool = False) -> tuple[Tensor, Tensor]:
        """Buffers for y and for the gradient of x."""
        key = (x.shape[0], x.shape[1])
        y, dx = self._rooms.get(key, (None, None))
        if y is None:
            y = aligned_zeros(*key, self.outputs, device=x.device)
        if dx is None or (onward and not dx.numel()):
            dx = aligned_zeros(*key, self.inputs, device=x.device) if onward else y[:0]
        self._rooms[key] = y, dx
        return y, dx

    def _activate(self, y: Tensor) -> None:
        if self.activation == RELU_ACTIVATION:
            y.clamp_(min=0.0)
        elif self.activation == TANH_ACTIVATION:
            flat_view(y).tanh_()

    def _before_activation(self, dy: Tensor, y: Tensor) -> Tensor:
        """Gradient before the activation, written over dy."""
        if self.activation == RELU_ACTIVATION:
            return torch.ops.aten.threshold_backward.grad_input(dy, y, 0, grad_input=dy)
        if self.activation == TANH_ACTIVATION:
            return torch.ops.aten.tanh_backward.grad_input(dy, y, grad_input=dy)
        return dy


class LinearLayer(NetworkLayer):
    """y = activation(x w + b).

    Args:
        pixels: if the inputs are `pixels` cells of a picture with all channels each. Stable-Baselines3 has the channels
            outside.
    """

    def __init__(
        self, parameters: Parameters, name: str, inputs: int, outputs: int, activation: str, *, pixels: int = 1
    ):
        super().__init__(name, inputs, outputs, activation)
        channels = inputs // pixels

        def stored(w: np.ndarray) -> np.ndarray:
            return w.reshape(pixels, channels, outputs).transpose(2, 1, 0).reshape(outputs, inputs)

        def own(w: np.ndarray) -> np.ndarray:
            return w.reshape(outputs, channels, pixels).transpose(2, 1, 0).reshape(inputs, outputs)

        parameters.add(f"{name}.weight", (inputs, outputs), inputs, stored, own)
        parameters.add(f"{name}.bias", (1, outputs), inputs, np.ravel, np.atleast_2d)
        self._offsets = tuple(each.offset for each in parameters.shapes[-2:])

    def forward(self, values: Values, x: Tensor) -> Tensor:
        """The outputs."""
        y, _ = self._buffers(x)
        if x.shape[1] == 1 and x.device.type == "cpu" and self.activation != TANH_ACTIVATION:
            # to act once is to read all weights; weights of inputs that a ReLU made 0 need not be
            rows = values[ALL_PARAMETERS].numpy()
            weight, bias = self._offsets
            linear_row(rows, weight, bias, x[:, 0].numpy(), self.activation == RELU_ACTIVATION, y[:, 0].numpy())
            return y
        torch.baddbmm(values[f"{self.name}.bias"], x, values[f"{self.name}.weight"], out=y)
        self._activate(y)
        return y

    def backward(self, values: Values, gradients: Values, x: Tensor, dy: Tensor, *, onward: bool) -> Tensor | None:
        """See `NetworkLayer`."""
        y, dx = self._buffers(x, onward=onward)
        dy = self._before_activation(dy, y)
        torch.sum(dy, 1, keepdim=True, out=gradients[f"{self.name}.bias"])
        torch.bmm(x.transpose(1, 2), dy, out=gradients[f"{self.name}.weight"])
        return torch.bmm(dy, values[f"{self.name}.weight"].transpose(1, 2), out=dx) if onward else None


class PatchConvolutionLayer(NetworkLayer):
    """A convolution of 3 x 3 with padding as one product: x holds the 9 C neighbours of each pixel, from 0 to 255.

    They come out of a table, so that nothing is unfolded here. 1 / 255 is a factor of the weights. y is (W, B, pixels
    x filters). Runs whose pictures are smaller than the pictures of others in their lane have a mask (W, pixels) among
    the values, which keeps what is no pixel of theirs at 0.
    """

    def __init__(self, parameters: Parameters, name: str, shape: tuple[int, ...], filters: int):
        channels, height, width = shape
        self.pixels, self.neighbours, self.filters = height * width, channels * KERNEL**2, filters
        super().__init__(name, self.pixels * self.neighbours, self.pixels * filters, RELU_ACTIVATION)
        outside = (filters, channels, KERNEL, KERNEL)
        parameters.add(
            f"{name}.weight",
            (self.neighbours, filters),
            self.neighbours,
            lambda w: w.T.reshape(outside),
            lambda w: w.reshape(filters, -1).T,
        )
        parameters.add(f"{name}.bias", (1, filters), self.neighbours, np.ravel, np.atleast_2d)

    def forward(self, values: Values, x: Tensor) -> Tensor:
        """The outputs."""
        y, _ = self._buffers(x)
        weights = values[f"{self.name}.weight"] * (1 / 255)
        torch.baddbmm(values[f"{self.name}.bias"], self._rows(x), weights, out=self._rows(y))
        self._activate(y)
        if PIXEL_MASK in values:
            y.view(*y.shape[:2], self.pixels, self.filters).mul_(values[PIXEL_MASK][:, None, :, None])
        return y

    def backward(self, values: Values, gradients: Values, x: Tensor, dy: Tensor, *, onward: bool) -> None:
        """See `NetworkLayer`. There is no gradient of the input."""
        y, _ = self._buffers(x)
        rows = self._rows(self._before_activation(dy, y))
        torch.sum(rows, 1, keepdim=True, out=gradients[f"{self.name}.bias"])
        gradient = gradients[f"{self.name}.weight"]
        torch.bmm(self._rows(x).transpose(1, 2), rows, out=gradient).mul_(1 / 255)

    def _rows(self, x: Tensor) -> Tensor:
        return x.view(x.shape[0], x.shape[1] * self.pixels, -1)


class ConvolutionLayer(NetworkLayer):
    """A strided convolution without padding, on the processor run by run, else as one grouped one.

    Args:
        shape: (C, H, W) of its inputs. scale: a factor of them.
    Attributes:
        shape_out: (filters, H, W).
    """

    def __init__(
        self, parameters: Parameters, name: str, shape: tuple[int, ...], filters: int, kernel: int, stride: int,
        scale: float = 1.0,
    ):  # fmt: skip
        channels, height, width = shape
        self.shape_in, self.stride, self.scale = shape, stride, scale
        self.shape_out = (filters, (height - kernel) // stride + 1, (width - kernel) // stride + 1)
        super().__init__(name, math.prod(shape), math.prod(self.shape_out), RELU_ACTIVATION)
        fan_in = channels * kernel**2

        def same(w: np.ndarray) -> np.ndarray:
            return w

        parameters.add(f"{name}.weight", (filters, channels, kernel, kernel), fan_in, same, same)
        parameters.add(f"{name}.bias", (1, filters), fan_in, np.ravel, np.atleast_2d)

    def forward(self, values: Values, x: Tensor) -> Tensor:
        """The outputs."""
        y, _ = self._buffers(x)
        weights, bias = values[f"{self.name}.weight"] * self.scale, values[f"{self.name}.bias"]
        if is_one_by_one(x):
            for i in range(len(x[: self.number])):
                images = x[i].view(-1, *self.shape_in)
                y[i] = torch.nn.functional.conv2d(images, weights[i], bias[i, 0], self.stride).flatten(1)
        else:
            images = self._side_by_side(x, self.shape_in)
            out = torch.nn.functional.conv2d(images, weights.flatten(0, 1), bias.flatten(), self.stride, groups=len(x))
            y.copy_(self._apart(out, y))
        self._activate(y)
        return y

    def backward(self, values: Values, gradients: Values, x: Tensor, dy: Tensor, *, onward: bool) -> Tensor | None:
        """See `NetworkLayer`."""
        y, dx = self._buffers(x, onward=onward)
        dy = self._before_activation(dy, y)
        if is_one_by_one(x):
            for i in range(len(x[: self.number])):
                images, out = x[i].view(-1, *self.shape_in), dy[i].view(-1, *self.shape_out)
                self._gradients(values, gradients, slice(i, i + 1), images, out, dx[i : i + 1] if onward else None)
        else:
            images, out = self._side_by_side(x, self.shape_in), self._side_by_side(dy, self.shape_out)
            self._gradients(values, gradients, slice(None), images, out, dx if onward else None)
        return dx if onward else None

    def _gradients(
        self, values: Values, gradients: Values, runs: slice, images: Tensor, out: Tensor, dx: Tensor | None
    ) -> None:
        """Write the gradients of some runs, whose images (B, runs x C, H, W) and output gradients are side by side."""
        own = values[f"{self.name}.weight"][runs]
        weights, steps = own.flatten(0, 1), [self.stride] * 2
        of_x, of_weights, of_bias = torch.ops.aten.convolution_backward(
            out, images, weights, [len(weights)], steps, [0, 0], [1, 1], False, [0, 0], len(own),
            [dx is not None, True, True],
        )  # fmt: skip
        torch.mul(of_weights.view(own.shape), self.scale, out=gradients[f"{self.name}.weight"][runs])
        gradients[f"{self.name}.bias"][runs, 0] = of_bias.view(len(own), -1)
        if dx is not None:
            dx.copy_(self._apart(of_x, dx))

    @staticmethod
    def _side_by_side(x: Tensor, shape: tuple[int, ...]) -> Tensor:
        """(B, W C, H, W') of (W, B, C H W')."""
        return x.view(*x.shape[:2], *shape).transpose(0, 1).flatten(1, 2)

    @staticmethod
    def _apart(x: Tensor, like: Tensor) -> Tensor:
        """Inverse of `_side_by_side`, as a view: (W, B, C H W')."""
        return x.reshape(like.shape[1], like.shape[0], -1).transpose(0, 1)


class PictureLayers(NetworkLayer):
    """The small convolution and the linear layer after it, on the processor: each different patch once.

    x (W, B, C pixels), from 0 to 255. The parameters belong to the two layers, see kernels/patches.py.
    """

    def __init__(self, parameters: Parameters, name: str, shape: tuple[int, ...]):
        self.shape, self.indices = shape, input_indices(shape, True).reshape(math.prod(shape[1:]), -1)
        super().__init__(name, math.prod(shape), FEATURES, RELU_ACTIVATION)
        picture_layers(parameters, name, shape)
        self._offsets = tuple(each.offset for each in parameters.shapes[-4:])
        self._memories: dict[tuple[int, int], tuple[np.ndarray, ...]] = {}

    def forward(self, values: Values, x: Tensor) -> Tensor:
        """The outputs."""
        y, _ = self._buffers(x)
        width, number, pixels = *x.shape[:2], len(self.indices)
        if (width, number) not in self._memories:
            groups = (width, number * pixels)  # at most
            self._memories[width, number] = (
                np.zeros((width, pixels + 1), np.int64),
                *(np.empty(groups, np.int32) for _ in range(2)),
                np.empty(groups, np.int64),
                np.empty((*groups, patches.FILTERS), np.float32),
                np.empty((width, pixels, number), np.int32),
                np.zeros(width, np.int64),
                np.empty((width, patches.COLOURS + 1, self.shape[0]), np.float32),
            )
        memory, pictures = self._memories[width, number], flat_view(x).numpy()
        rows = values[ALL_PARAMETERS].numpy()[: self.number]
        patches.forward(rows, self._offsets, self.shape, self.indices, pictures, y.numpy(), memory)
        return y

    def backward(self, values: Values, gradients: Values, x: Tensor, dy: Tensor, *, onward: bool) -> None:
        """See `NetworkLayer`. There is no gradient of the input."""
        dy = self._before_activation(dy, self._buffers(x)[0])
        rows, written = values[ALL_PARAMETERS].numpy()[: self.number], gradients[ALL_PARAMETERS].numpy()
        memory, pictures = self._memories[x.shape[0], x.shape[1]], flat_view(x).numpy()
        patches.backward(rows, written, self._offsets, self.shape, self.indices, pictures, dy.numpy(), memory)


def input_indices(shape: tuple[int, ...], is_small: bool) -> np.ndarray:
    """Places of the first layer's input in an observation of a shape with a 0 behind it."""
    indices = np.arange(math.prod(shape))
    if not is_small:
        return indices
    inside = indices.reshape(shape)  # the small convolution takes the 9 C neighbours of each pixel
    padded = np.pad(inside, ((0, 0), (1, 1), (1, 1)), constant_values=inside.size)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (KERNEL, KERNEL), axis=(1, 2))  # type: ignore[call-overload]
    return np.ascontiguousarray(windows.transpose(1, 2, 0, 3, 4)).ravel()


def is_one_by_one(x: Tensor) -> bool:
    """Whether convolutions go run by run, which is faster on the processor."""
    return x.device.type == "cpu"


class Stack:
    """Layers one after another."""

    def __init__(self, layers: Sequence[NetworkLayer]):
        self.layers = list(layers)
        self._inputs: list[Tensor] = []

    def forward(self, values: Values, x: Tensor) -> Tensor:
        """The outputs of the last layer."""
        self._inputs = []
        for layer in self.layers:
            self._inputs.append(x)
            x = layer.forward(values, x)
        return x

    def backward(self, values: Values, gradients: Values, dy: Tensor, *, onward: bool = False) -> Tensor:
        """Write the gradients of all parameters, after `forward`. Return the gradient of the input if `onward`."""
        for i in range(len(self.layers) - 1, -1, -1):
            dx = self.layers[i].backward(values, gradients, self._inputs[i], dy, onward=onward or i > 0)
            dy = dy if dx is None else dx
        return dy


# Networks -------------------------------------------------------------------------------------------------------------


def picture_layers(parameters: Parameters, name: str, shape: tuple[int, ...]) -> list[NetworkLayer]:
    """The small convolution and the linear layer after it, for observations with the neighbours of each pixel."""
    small = PatchConvolutionLayer(parameters, f"{name}.layers.0.0", shape, patches.FILTERS)
    return [
        small,
        LinearLayer(parameters, f"{name}.layers.1", small.outputs, FEATURES, RELU_ACTIVATION, pixels=small.pixels),
    ]


def extractor_layers(
    parameters: Parameters, name: str, shape: tuple[int, ...], is_image: bool, device: str
) -> list[NetworkLayer]:
    """The layers from an observation to 128 features: SmallMLP, or SmallCNN with one or three convolutions."""
    if not is_image:
        return [LinearLayer(parameters, f"{name}.layers.1", math.prod(shape), FEATURES, RELU_ACTIVATION)]
    if is_small(shape, is_image):
        return [PictureLayers(parameters, name, shape)] if device == "cpu" else picture_layers(parameters, name, shape)
    convolutions: list[NetworkLayer] = []
    for i, (filters, kernel, stride) in enumerate(((32, 8, 4), (64, 4, 2), (64, 3, 1))):
        scale = 1 / 255 if i == 0 else 1.0
        layer = ConvolutionLayer(parameters, f"{name}.layers.0.{2 * i}", shape, filters, kernel, stride, scale)
        convolutions.append(layer)
        shape = layer.shape_out
    return [*convolutions, LinearLayer(parameters, f"{name}.layers.1", math.prod(shape), FEATURES, RELU_ACTIVATION)]


def pad(own: Parameters, rows: np.ndarray, common: Parameters) -> np.ndarray:
    """(N, P) parameters of networks, zero-padded to a larger network of the same layers.

    The larger network has more inputs in its first layers, after those that both have.
    """
    result = np.zeros((len(rows), common.length), np.float32)
    for each, slot in zip(own.shapes, common.shapes, strict=True):
        part = result[:, slot.offset : slot.offset + slot.size].reshape(-1, *slot.shape)
        part[:, *(slice(n) for n in each.shape)] = rows[:, each.offset : each.offset + each.size].reshape(
            -1, *each.shape
        )
    return result


def hidden(parameters: Parameters, name: str, sizes: Sequence[int], activation: str) -> list[NetworkLayer]:
    """Hidden layers as Stable-Baselines3 numbers them: name.0, name.2, ..."""
    inputs = [FEATURES, *sizes]
    return [
        LinearLayer(parameters, f"{name}.{2 * i}", inputs[i], outputs, activation) for i, outputs in enumerate(sizes)
    ]


def sizes_of(net_arch: NetArch, head: str = "pi") -> list[int]:
    """The hidden layers of a head: net_arch is a list for all heads, or a dict of lists."""
    return list(net_arch.get(head, ())) if isinstance(net_arch, dict) else list(net_arch)


def parameter_names(name: str) -> list[str]:
    """All names of a parameter in Stable-Baselines3. Parameters of shared parts have several."""
    extractors = [name]
    if name.startswith("features_extractor."):
        extractors += [f"{part}_{name}" for part in ("pi", "vf")]
    return [*extractors, *(each.replace(".layers.0.", ".convolutions.") for each in extractors if ".layers.0." in each)]


class BatchedNetwork(Protocol):
    """W networks of one shape, the interface to a lane.

    Attributes:
        parameters: their positions. eps: of Adam. layers: all of them.
    """

    parameters: Parameters
    eps: float
    layers: list[NetworkLayer]

    def scores(self, values: Values, x: Tensor) -> Tensor:
        """(W, B, A) scores of actions in observations (W, B, size)."""
        ...

    def initial(self, draws: Draws) -> np.ndarray:
        """(W, P): initial parameters."""
        ...


class QNetworks:
    """A value for each action: `net_arch` hidden layers after the features. torch's own initialisation."""

    eps = 1e-8  # of Adam

    def __init__(
        self, shape: tuple[int, ...], is_image: bool, net_arch: NetArch, num_actions: int, device: str = "cpu"
    ):
        self.parameters = parameters = Parameters()
        sizes = sizes_of(net_arch)
        layers = extractor_layers(parameters, "q_net.features_extractor", shape, is_image, device)
        layers += hidden(parameters, "q_net.q_net", sizes, RELU_ACTIVATION)
        last = LinearLayer(
            parameters, f"q_net.q_net.{2 * len(sizes)}", [FEATURES, *sizes][-1], num_actions, NO_ACTIVATION
        )
        self.layers = [*layers, last]
        self.stack = Stack(self.layers)

    def scores(self, values: Values, x: Tensor) -> Tensor:
        """(W, B, A) values of actions in observations (W, B, size)."""
        return self.stack.forward(values, x)

    def backward(self, values: Values, gradients: Values, dq: Tensor) -> None:
        """Write the gradients. Called after `scores`."""
        self.stack.backward(values, gradients, dq)

    def initial(self, draws: Draws) -> np.ndarray:
        """(W, P): weights and biases uniform in +- 1 / sqrt(fan in)."""
        rows = draws(self.parameters.length)
        for each in self.parameters.shapes:
            part = slice(each.offset, each.offset + each.size)
            rows[:, part] = (2.0 * rows[:, part] - 1.0) / math.sqrt(each.fan_in)
        return rows.astype(np.float32)


class ActorCritics:
    """Scores of actions and a value, from shared features. Orthogonal initialisation."""

    eps = 1e-5

    def __init__(
        self, shape: tuple[int, ...], is_image: bool, net_arch: NetArch, num_actions: int, device: str = "cpu"
    ):
        self.parameters = parameters = Parameters()
        self.trunk = Stack(extractor_layers(parameters, "features_extractor", shape, is_image, device))
        actor, critic = sizes_of(net_arch, "pi"), sizes_of(net_arch, "vf")
        actor_layers = hidden(parameters, "mlp_extractor.policy_net", actor, TANH_ACTIVATION)
        critic_layers = hidden(parameters, "mlp_extractor.value_net", critic, TANH_ACTIVATION)
        actor_layers.append(LinearLayer(parameters, "action_net", [FEATURES, *actor][-1], num_actions, NO_ACTIVATION))
        critic_layers.append(LinearLayer(parameters, "value_net", [FEATURES, *critic][-1], 1, NO_ACTIVATION))
        self.actor, self.critic = Stack(actor_layers), Stack(critic_layers)
        self.layers = [*self.trunk.layers, *actor_layers, *critic_layers]

    def both(self, values: Values, x: Tensor) -> tuple[Tensor, Tensor]:
        """(W, B, A) scores, whose softmax is the policy, and (W, B, 1) values."""
        features = self.trunk.forward(values, x)
        return self.actor.forward(values, features), self.critic.forward(values, features)

    def scores(self, values: Values, x: Tensor) -> Tensor:
        """(W, B, A)."""
        return self.actor.forward(values, self.trunk.forward(values, x))

    def values(self, values: Values, x: Tensor) -> Tensor:
        """(W, B, 1)."""
        return self.critic.forward(values, self.trunk.forward(values, x))

    def backward(self, values: Values, gradients: Values, dscores: Tensor, dvalues: Tensor) -> None:
        """Write the gradients. Called after `both`."""
        features = self.actor.backward(values, gradients, dscores, onward=True)
        features.add_(self.critic.backward(values, gradients, dvalues, onward=True))
        self.trunk.backward(values, gradients, features)

    def initial(self, draws: Draws) -> np.ndarray:
        """(W, P): orthogonal weights times sqrt(2), 0.01 for the actions and 1 for the value. Biases are 0.

        Source: Saxe et al. (2014), as torch draws it: the Q of a normal matrix, its columns signed by R's diagonal.
        """
        uniform = draws(2 * self.parameters.length)
        normal = np.sqrt(-2.0 * np.log(uniform[:, ::2])) * np.cos(2.0 * np.pi * uniform[:, 1::2])  # Box and Muller
        rows = np.zeros((len(normal), self.parameters.length), np.float32)
        gains = {"action_net.weight": 0.01, "value_net.weight": 1.0}
        for each in self.parameters.shapes:
            if each.name.endswith("weight"):
                part = slice(each.offset, each.offset + each.size)
                shape = each.stored(np.empty(each.shape)).shape
                for row, drawn in zip(rows, normal[:, part], strict=True):
                    weights = orthogonal(drawn.reshape(shape[0], -1)) * gains.get(each.name, math.sqrt(2.0))
                    row[part] = each.own(weights.reshape(shape)).ravel()
        return rows


def orthogonal(drawn: np.ndarray) -> np.ndarray:
    """Orthonormal rows, or columns if there are more rows, from a matrix of normal numbers."""
    turned = len(drawn) < drawn.shape[1]
    q, r = np.linalg.qr(drawn.T if turned else drawn)
    q = q * np.sign(np.diag(r))
    return q.T if turned else q
