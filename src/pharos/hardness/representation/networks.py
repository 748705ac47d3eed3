"""The networks of agents, by name, and their tangent kernels. Loads no PyTorch.

    mlp128      one hidden layer of 128 units
    mlp128x2    two of them: what agents of pharos learn from vectors with
    mlp256-64   one of 256, then one of 64
    cnn16       a convolution of 16 filters of 3 x 3, then two hidden layers of 128: small images
    cnn16-64x3  the same with three of 64
    nature      the three convolutions of Mnih et al. (2015), then two of 128: images from 36 pixels on

All units are ReLUs. "+tanh" behind the name makes hyperbolic tangents of the hidden layers after the first, as the
policies of PPO and A2C have in Stable-Baselines3.

The neural tangent kernel of a network in closed form:

    K(x, y) = E[ sum over parameters w of d f(x) / d w  d f(y) / d w ],   f one output of the network at initialisation

(Jacot, Gabriel and Hongler, 2018). Learning by small gradient steps changes what the network says of y in proportion to
K(x, y) times the error at x. The expectation over weights and biases follows layer by layer, which have the standard
parametrisation: with q the covariance of pre-activations of a layer and T their kernel, n units, v and b the variances
of a weight and a bias of the next layer,

    q' = v n E[f(u) f(u')] + b,    T' = n E[f(u) f(u')] + 1 + v n E[f'(u) f'(u')] T,    (u, u') centred Gaussian of q

exact for wide layers, in which the number of units still counts. After a convolution a position of one picture meets
the same position of the other alone, as each position has weights of its own after flattening (Arora et al., 2019).
"""

import itertools
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pharos.errors import ParameterError
from pharos.system.threads import in_blocks

if TYPE_CHECKING:
    import gymnasium

EXTRACTOR_LAYERS = (128, 128)
INITIALISATIONS = ("pytorch", "sb3")
_FORM = re.compile(r"(?:(?P<mlp>mlp)|cnn(?P<filters>\d+)-?|(?P<nature>nature)-?)(?P<layers>[\dx-]*)(?P<tanh>\+tanh)?")
_EXPECTED = "mlp128, mlp128x2, mlp256-64, cnn16, cnn16-64x3 or nature, with +tanh where wanted"


@dataclass(frozen=True)
class Convolution:
    """A convolution with ReLUs: `filters` of `size` x `size` pixels."""

    filters: int
    size: int
    stride: int = 1
    padding: int = 0


_NATURE = (Convolution(32, 8, 4), Convolution(64, 4, 2), Convolution(64, 3))


@dataclass(frozen=True)
class Network:
    """Convolutions, hidden layers and a linear output. The top of the file explains names.

    Attributes:
        name: as `Network.of` reads it.
        convolutions: with ReLUs. Their output is flattened. Without any, observations are flattened.
        hidden: units of each hidden layer.
        tanh: whether hidden layers after the first have hyperbolic tangents. The first always has ReLUs.
        initialisation: "pytorch", its default: weights and biases uniform in +-1 / sqrt(fan-in), so of variance 1 / (3
            fan-in), as DQN has. "sb3", of actor-critics in Stable-Baselines3: orthogonal weights with gain sqrt(2), of
            the output 1 (of the value; policies have 0.01), biases 0.
    """

    name: str
    convolutions: tuple[Convolution, ...]
    hidden: tuple[int, ...]
    tanh: bool = False
    initialisation: str = "pytorch"

    @staticmethod
    def of(network: "Network | str", initialisation: str = "pytorch") -> "Network":
        """The network of a name.

        Raises:
            ParameterError: it has another form, or no closed form of its kernel is known.
        """
        if isinstance(network, Network):
            return network
        if initialisation not in INITIALISATIONS:
            raise ParameterError(f"initialisation is {initialisation!r}; expected one of {', '.join(INITIALISATIONS)}")
        match = _FORM.fullmatch(network) if isinstance(network, str) else None
        layers = () if match is None else _layers(match["layers"])
        if match is None or layers is None or (match["mlp"] and not layers):
            raise ParameterError(
                f"network {network!r} has no closed form that is known; expected {_EXPECTED}; for any network of "
                "PyTorch file.py:function, a function of the shape of an input, or observations.empirical_ntk"
            )
        filters = int(match["filters"] or 0)
        if match["filters"] and not filters:
            raise ParameterError(f"network {network!r} has no filters; expected at least 1, as in cnn16")
        small = (Convolution(filters, 3, padding=1),) if filters else ()
        convolutions = _NATURE if match["nature"] else small
        return Network(network, convolutions, layers or EXTRACTOR_LAYERS, bool(match["tanh"]), initialisation)

    def weight_variances(self, inputs: int, outputs: int, *, is_output: bool = False) -> tuple[float, float]:
        """(of a weight, of a bias) of a layer from `inputs` numbers to `outputs` units."""
        if self.initialisation == "pytorch":
            return 1 / (3 * inputs), 1 / (3 * inputs)
        gain = 1.0 if is_output else 2.0
        return gain / max(inputs, outputs), 0.0

    def parameters(self, shape: Sequence[int]) -> tuple[int, int]:
        """(of one output, of all layers beneath): numbers of parameters, for inputs of a shape."""
        size, beneath = math.prod(shape), 0
        if self.convolutions:
            channels, sides = shape[0], tuple(shape[1:])
            for layer in self.convolutions:
                beneath += layer.filters * (channels * layer.size**2 + 1)
                sides = tuple((side + 2 * layer.padding - layer.size) // layer.stride + 1 for side in sides)
                channels = layer.filters
            size = channels * math.prod(sides)
        for units in self.hidden:
            beneath += units * (size + 1)
            size = units
        return size + 1, beneath

    @property
    def evenness(self) -> tuple[float, float]:
        """(of the output layer, of the weights of the last hidden layer): `OutputLayer.evenness`, in closed form.

        Of one observation and many units, with pre-activations that are normal and, of hyperbolic tangents, small: a
        ReLU is a half-normal number or 0, its slope 1 or 0. Of observations that differ gradients are more even.
        """
        normal, relu, gate = math.sqrt(2 / math.pi), math.sqrt(1 / math.pi), math.sqrt(1 / 2)
        weight = math.sqrt(3) / 2 if self.initialisation == "pytorch" else normal  # uniform, or orthogonal
        kinds = [normal if self.tanh and layer else relu for layer in range(len(self.hidden))]
        slope = 1.0 if self.tanh and len(self.hidden) > 1 else gate
        return kinds[-1], weight * slope * (kinds[-2] if len(kinds) > 1 else 1.0)


def default_network(space: "gymnasium.Space") -> str:
    """The name of the network that agents get for a Gymnasium space of observations."""
    shape = space.shape or ()
    if len(shape) != 3 or space.dtype != "uint8":
        return "mlp128x2"
    rows_and_columns = shape[:2] if is_channels_last(shape) else shape[1:]
    return "cnn16" if min(rows_and_columns) < 36 else "nature"


def is_channels_last(shape: Sequence[int]) -> bool:
    """Whether Stable-Baselines3 takes the last dimension of an image for channels: the first is not the smallest."""
    return shape[0] > min(shape)


def _layers(text: str) -> tuple[int, ...] | None:
    """`128x2-64` -> (128, 128, 64), or None if it is not of that form."""
    layers: list[int] = []
    for part in text.split("-") if text else ():
        match = re.fullmatch(r"([1-9]\d*)(?:x([1-9]\d?))?", part)
        if match is None:
            return None
        layers += [int(match[1])] * int(match[2] or 1)
    return tuple(layers)


PAIR_BLOCK = 512  # observations on a side of a block of pairs
MAP_BYTES = 1 << 26  # bytes of the maps of a block after a convolution
TERMS, NODES = 48, 200  # of a power series of hyperbolic tangents; of a quadrature
LEAST_VARIANCE = 1e-12  # of a hyperbolic tangent's pre-activations, in the place of 0: the limit in float64


def check_memory(rows: int, columns: int, what: str) -> None:
    """Refuse a kernel that would not fit.

    Raises:
        ParameterError: it takes more than half of what is free. The message says which size fits, and what to do.
    """
    from pharos.system.memory import available_memory

    free = available_memory() // 2
    if 4 * rows * columns > free:
        fits = math.isqrt(free // 4)
        raise ParameterError(
            f"{what}: the kernel of {rows:,} x {columns:,} states takes {4 * rows * columns / 2**30:.1f} GiB; "
            f"{fits:,} states fit into memory: give some of them as states, or measure with landmarks=..."
        )


def tangent_kernel(
    network: Network, x: np.ndarray, y: np.ndarray | None = None, *, of_outputs: bool = False
) -> np.ndarray:
    """The tangent kernel (N, M) float32 of a network on inputs x (N, ...), y (M, ...) as `network_inputs` gives them.

    Args:
        of_outputs: return the covariance of an output of the random network instead, q of the last layer. Outputs of
            wide networks before training are a Gaussian process (Neal, 1996, Lee et al., 2018).
    Raises:
        ParameterError: the network has convolutions and the inputs are no images, or these are too small.
    """
    others = x if y is None else y
    out = np.empty((len(x), len(others)), np.float32)
    if not out.size:
        return out
    first: _Flat | _Convolved
    first = _Convolved(network, x, others) if network.convolutions else _Flat(network, x, others)
    head = _Head(network, first)
    side = min(PAIR_BLOCK, max(16, math.isqrt(MAP_BYTES // (8 * first.positions))))
    rows, columns = range(0, len(x), side), range(0, len(others), side)
    blocks = [(i, j) for i, j in itertools.product(rows, columns) if y is not None or i <= j]

    def run(begin: int, end: int) -> None:
        for i, j in blocks[begin:end]:
            block = slice(i, i + side), slice(j, j + side)
            head(*first(*block), *block, of_outputs, out[block])

    in_blocks(run, len(blocks), 1)
    if y is None:
        from pharos.kernels.observation_kernels import mirrored

        mirrored(out)
    return out


class _Flat:
    """Covariance and kernel of a first dense layer on flattened inputs."""

    positions = 1

    def __init__(self, network: Network, x: np.ndarray, y: np.ndarray):
        self.x = x.reshape(len(x), -1).astype(np.float64)
        self.y = self.x if y is x else y.reshape(len(y), -1).astype(np.float64)
        self.weight, self.bias = network.weight_variances(self.x.shape[1], network.hidden[0])

    @property
    def variances(self) -> tuple[np.ndarray, np.ndarray]:
        """(N,), (M,): of the pre-activations."""
        of_x, of_y = (self.weight * np.einsum("nd,nd->n", each, each) + self.bias for each in (self.x, self.y))
        return of_x, of_y

    def __call__(self, rows: slice, columns: slice) -> tuple[np.ndarray, np.ndarray]:
        gram = self.x[rows] @ self.y[columns].T
        return self.weight * gram + self.bias, gram + 1.0


class _Convolved:
    """Covariance and kernel of the first dense layer after convolutions, flattened.

    At each position of the first convolution equal patches are found once, and pairs of different ones computed once.

    Attributes:
        positions: of the first convolution.
    """

    def __init__(self, network: Network, x: np.ndarray, y: np.ndarray):
        if x.ndim != 4:
            raise ParameterError(
                f"network {network.name!r} has convolutions; expected images of bytes (channels, rows, columns), found "
                f"observations of shape {x.shape[1:]}: use mlp128x2"
            )
        self.layers = network.convolutions
        shape, inputs = x.shape[2:], x.shape[1]
        self.taps: list[np.ndarray] = []  # for each convolution after the first: (positions, window), indices before it
        self.constants: list[tuple[float, float]] = []
        for number, layer in enumerate(self.layers):
            after = tuple((side + 2 * layer.padding - layer.size) // layer.stride + 1 for side in shape)
            if min(after) < 1:
                raise ParameterError(f"network {network.name!r} needs larger images than {x.shape[2]} x {x.shape[3]}")
            if number:
                self.taps.append(_windows(shape, after, layer))
            self.constants.append(network.weight_variances(inputs * layer.size**2, layer.filters))
            shape, inputs = after, layer.filters
        size = math.prod(shape)
        self.taps.append(np.arange(size)[None])
        self.constants.append(network.weight_variances(inputs * size, network.hidden[0]))
        self.x = [_Patches(patch) for patch in _patches(x, self.layers[0])]
        self.y = self.x if y is x else [_Patches(patch) for patch in _patches(y, self.layers[0])]
        self.positions = len(self.x)
        self.variances_x = self._variances(self.x)
        self.variances_y = self.variances_x if y is x else self._variances(self.y)

    @property
    def variances(self) -> tuple[np.ndarray, np.ndarray]:
        """(N,), (M,): of the pre-activations of the first dense layer."""
        return self.variances_x[-1][0], self.variances_y[-1][0]

    def _variances(self, patches: "list[_Patches]") -> list[np.ndarray]:
        """(positions, N) of each layer's pre-activations, the first dense one last: of a ReLU, E[f^2] is half of it."""
        weight, bias = self.constants[0]
        result = [np.stack([(weight * each.squares + bias)[each.codes] for each in patches])]
        for number, taps in enumerate(self.taps):
            weight, bias = self.constants[number + 1]
            half = np.concatenate([result[-1] / 2, np.zeros((1, result[-1].shape[1]))])  # -1, padding, reads the zeros
            inner = np.stack([half[window].sum(axis=0) for window in taps])
            result.append(weight * self.layers[number].filters * inner + bias)
        return result

    def __call__(self, rows: slice, columns: slice) -> tuple[np.ndarray, np.ndarray]:
        from pharos.kernels import observation_kernels

        shape = (len(self.x[0].codes[rows]), len(self.y[0].codes[columns]))
        value, slope = (np.empty((self.positions, *shape), np.float32) for _ in range(2))
        weight, bias = self.constants[0]
        for p in range(self.positions):
            (of_x, codes_x, squares_x), (of_y, codes_y, squares_y) = self.x[p].subset(rows), self.y[p].subset(columns)
            variances = weight * squares_x + bias, weight * squares_y + bias
            observation_kernels.patches(of_x @ of_y.T, codes_x, codes_y, *variances, weight, bias, value[p], slope[p])
        q, theta = np.empty(shape), np.empty(shape)
        for number, taps in enumerate(self.taps):
            filters, constants = float(self.layers[number].filters), self.constants[number + 1]
            is_last = number == len(self.taps) - 1
            after = None if is_last else [np.empty((len(taps), *shape), np.float32) for _ in range(2)]
            for p, window in enumerate(taps):
                observation_kernels.gathered(value, slope, window, filters, *constants, q, theta)
                if after is not None:
                    of_x, of_y = self.variances_x[number + 1][p, rows], self.variances_y[number + 1][p, columns]
                    observation_kernels.rectified(q, theta, of_x, of_y, after[0][p], after[1][p])
            if after is not None:
                value, slope = after
        return q, theta


class _Patches:
    """Patches of N images at one position: different ones (U, K) float64, their squares (U,), which one (N,)."""

    def __init__(self, patches: np.ndarray):
        rows = np.ascontiguousarray(patches).view(f"V{patches.shape[1] * patches.itemsize}").ravel()
        _, first, codes = np.unique(rows, return_index=True, return_inverse=True)
        self.different = patches[first].astype(np.float64)
        self.codes = codes.ravel()
        self.squares = np.einsum("uk,uk->u", self.different, self.different)

    def subset(self, block: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(different patches, codes, squares) of a block of images alone."""
        codes = self.codes[block]
        used = np.zeros(len(self.different), np.bool_)
        used[codes] = True
        number = np.cumsum(used) - 1
        return self.different[used], number[codes], self.squares[used]


def _patches(images: np.ndarray, layer: Convolution) -> "Sequence[np.ndarray]":
    """(N, C size size) at each position of images (N, C, H, W), row by row."""
    pad, size = layer.padding, layer.size
    padded = np.pad(images, ((0, 0), (0, 0), (pad, pad), (pad, pad)))
    tops = range(0, padded.shape[2] - size + 1, layer.stride)
    lefts = range(0, padded.shape[3] - size + 1, layer.stride)
    return [padded[:, :, i : i + size, j : j + size].reshape(len(images), -1) for i in tops for j in lefts]


def _windows(before: tuple[int, ...], after: tuple[int, ...], layer: Convolution) -> np.ndarray:
    """(positions, window): indices of the positions before a convolution that each one after it sees, -1 for
    padding."""
    offsets = np.arange(layer.size)
    rows, columns = (layer.stride * np.arange(n)[:, None] - layer.padding + offsets for n in after)
    is_inside = [(index >= 0) & (index < n) for index, n in zip((rows, columns), before, strict=True)]
    indices = rows[:, None, :, None] * before[1] + columns[None, :, None, :]
    inside = is_inside[0][:, None, :, None] & is_inside[1][None, :, None, :]
    return np.where(inside, indices, -1).reshape(math.prod(after), -1)


class _Head:
    """The hidden layers and the output."""

    def __init__(self, network: Network, first: "_Flat | _Convolved"):
        hidden = network.hidden
        next_sizes = [*hidden[1:], 1]
        pairs = [
            network.weight_variances(n, m, is_output=layer == len(hidden) - 1)
            for layer, (n, m) in enumerate(zip(hidden, next_sizes, strict=True))
        ]
        self.widths = np.array(hidden, np.float64)
        self.weights, self.biases = (np.array(each, np.float64) for each in zip(*pairs, strict=True))
        self.kinds = np.array([0] + [int(network.tanh)] * (len(hidden) - 1))
        of_x, of_y = first.variances
        self.x = self._variances(of_x)
        self.y = self.x if of_y is of_x else self._variances(of_y)

    def _variances(self, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(L, N) of pre-activations, and (L, N, M) Hermite coefficients, M = 0 if all units are ReLUs."""
        variances, coefficients = [variance], []
        for layer, kind in enumerate(self.kinds):
            if kind:  # an observation of zeros has slope 1 here; a ReLU, as in PyTorch, none
                variances[-1] = np.maximum(variances[-1], LEAST_VARIANCE)
                series, square = _tanh_coefficients(variances[-1])
            else:
                series, square = np.zeros((len(variance), TERMS if self.kinds.any() else 0)), variances[-1] / 2
            coefficients.append(series)
            variances.append(self.weights[layer] * self.widths[layer] * square + self.biases[layer])
        return np.stack(variances[:-1]), np.stack(coefficients)

    def __call__(
        self, q: np.ndarray, theta: np.ndarray, rows: slice, columns: slice, of_outputs: bool, out: np.ndarray
    ) -> None:
        from pharos.kernels.observation_kernels import dense

        (of_x, series_x), (of_y, series_y) = self.x, self.y
        sides = of_x[:, rows], of_y[:, columns]
        series = series_x[:, rows], series_y[:, columns]
        dense(q, theta, *sides, self.kinds, *series, self.widths, self.weights, self.biases, of_outputs, out)


def _tanh_coefficients(variances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """((N, TERMS) Hermite coefficients of degree 1, 3, ... of tanh(s z), z standard normal, and (N,) E[tanh(s
    z)^2])."""
    z, weights = np.polynomial.hermite_e.hermegauss(NODES)
    weights = weights / weights.sum()
    polynomials = np.empty((2 * TERMS, NODES))  # normalised: h_n+1 = (z h_n - sqrt(n) h_n-1) / sqrt(n + 1)
    polynomials[0], polynomials[1] = 1.0, z
    for n in range(1, 2 * TERMS - 1):
        polynomials[n + 1] = (z * polynomials[n] - math.sqrt(n) * polynomials[n - 1]) / math.sqrt(n + 1)
    values = np.tanh(np.sqrt(variances)[:, None] * z)
    return (values * weights) @ polynomials[1::2].T, (values**2) @ weights
