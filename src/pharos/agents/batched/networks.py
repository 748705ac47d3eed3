"""The networks of agents/deep.py with the heads that Stable-Baselines3 puts on them, for W runs at once."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from torch import Tensor

from pharos.agents.batched.layers import (
    NONE,
    RELU,
    TANH,
    Convolution,
    Layer,
    Linear,
    Parameters,
    PatchConvolution,
    Stack,
    Values,
)
from pharos.agents.batched.runs import is_small

FEATURES = 128
FILTERS = 16

Draws = Callable[[int], np.ndarray]
"""number of draws -> (W, number) uniform in (0, 1)."""


def extractor(parameters: Parameters, name: str, shape: tuple[int, ...], is_image: bool) -> list[Layer]:
    """The layers from an observation to 128 features: SmallMLP, or SmallCNN with one or three convolutions."""
    if not is_image:
        return [Linear(parameters, f"{name}.layers.1", math.prod(shape), FEATURES, RELU)]
    if is_small(shape, is_image):
        small = PatchConvolution(parameters, f"{name}.layers.0.0", shape, FILTERS)
        return [small, Linear(parameters, f"{name}.layers.1", small.outputs, FEATURES, RELU, pixels=small.pixels)]
    convolutions: list[Layer] = []
    for i, (filters, kernel, stride) in enumerate(((32, 8, 4), (64, 4, 2), (64, 3, 1))):
        scale = 1 / 255 if i == 0 else 1.0
        made = Convolution(parameters, f"{name}.layers.0.{2 * i}", shape, filters, kernel, stride, scale)
        convolutions.append(made)
        shape = made.shape_out
    return [*convolutions, Linear(parameters, f"{name}.layers.1", math.prod(shape), FEATURES, RELU)]


def spread(own: Parameters, rows: np.ndarray, common: Parameters) -> np.ndarray:
    """(N, P) parameters of networks in the places that a larger network of the same layers has for them; 0 elsewhere.

    The larger one has more inputs in its first layers, which follow those that both have.
    """
    result = np.zeros((len(rows), common.length), np.float32)
    for each, place in zip(own.shapes, common.shapes, strict=True):
        part = result[:, place.offset : place.offset + place.size].reshape(-1, *place.shape)
        part[:, *(slice(n) for n in each.shape)] = rows[:, each.offset : each.offset + each.size].reshape(
            -1, *each.shape
        )
    return result


def hidden(parameters: Parameters, name: str, sizes: Sequence[int], activation: str) -> list[Layer]:
    """Hidden layers as Stable-Baselines3 numbers them: name.0, name.2, ..."""
    inputs = [FEATURES, *sizes]
    return [Linear(parameters, f"{name}.{2 * i}", inputs[i], outputs, activation) for i, outputs in enumerate(sizes)]


def sizes_of(net_arch: Any, head: str = "pi") -> list[int]:
    """The hidden layers of a head: net_arch is a list for all heads, or a dict of lists."""
    return list(net_arch.get(head, ())) if isinstance(net_arch, dict) else list(net_arch)


def names_of(name: str) -> list[str]:
    """All the names that a parameter has in Stable-Baselines3: parts of a network that are shared have several."""
    extractors = [name]
    if name.startswith("features_extractor."):
        extractors += [f"{whose}_{name}" for whose in ("pi", "vf")]
    return [*extractors, *(each.replace(".layers.0.", ".convolutions.") for each in extractors if ".layers.0." in each)]


class QNetworks:
    """A value for each action: `net_arch` hidden layers after the features. torch's own initialisation."""

    eps = 1e-8  # of Adam

    def __init__(self, shape: tuple[int, ...], is_image: bool, net_arch: object, num_actions: int):
        self.parameters = parameters = Parameters()
        sizes = sizes_of(net_arch)
        layers = extractor(parameters, "q_net.features_extractor", shape, is_image)
        layers += hidden(parameters, "q_net.q_net", sizes, RELU)
        last = Linear(parameters, f"q_net.q_net.{2 * len(sizes)}", [FEATURES, *sizes][-1], num_actions, NONE)
        self.stack = Stack([*layers, last])

    def scores(self, values: Values, x: Tensor) -> Tensor:
        """(W, B, A) values of actions in observations (W, B, size)."""
        return self.stack.forward(values, x)

    def backward(self, values: Values, gradients: Values, dq: Tensor) -> None:
        """The gradients, after `scores`."""
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

    def __init__(self, shape: tuple[int, ...], is_image: bool, net_arch: object, num_actions: int):
        self.parameters = parameters = Parameters()
        self.trunk = Stack(extractor(parameters, "features_extractor", shape, is_image))
        actor, critic = sizes_of(net_arch, "pi"), sizes_of(net_arch, "vf")
        actor_layers = hidden(parameters, "mlp_extractor.policy_net", actor, TANH)
        critic_layers = hidden(parameters, "mlp_extractor.value_net", critic, TANH)
        actor_layers.append(Linear(parameters, "action_net", [FEATURES, *actor][-1], num_actions, NONE))
        critic_layers.append(Linear(parameters, "value_net", [FEATURES, *critic][-1], 1, NONE))
        self.actor, self.critic = Stack(actor_layers), Stack(critic_layers)

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
        """The gradients, after `both`."""
        features = self.actor.backward(values, gradients, dscores, onward=True)
        features.add_(self.critic.backward(values, gradients, dvalues, onward=True))
        self.trunk.backward(values, gradients, features)

    def initial(self, draws: Draws) -> np.ndarray:
        """(W, P): orthogonal weights times sqrt(2), 0.01 for the actions and 1 for the value; biases 0.

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
    """Orthonormal rows, or columns where there are more rows, from a matrix of normal numbers."""
    turned = len(drawn) < drawn.shape[1]
    q, r = np.linalg.qr(drawn.T if turned else drawn)
    q = q * np.sign(np.diag(r))
    return q.T if turned else q
