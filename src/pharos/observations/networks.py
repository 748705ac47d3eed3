"""The networks that agents are made of, by name: what their tangent kernels follow from. Loads no PyTorch.

    mlp128      one hidden layer of 128 units
    mlp128x2    two of them: what agents of pharos learn from vectors with
    mlp256-64   one of 256, then one of 64
    cnn16       a convolution of 16 filters of 3 x 3, then two hidden layers of 128: small images
    cnn16-64x3  the same with three of 64
    nature      the three convolutions of Mnih et al. (2015), then two of 128: images from 36 pixels on

All units are ReLUs; "+tanh" behind the name makes hyperbolic tangents of the hidden layers after the first, as the
policies of PPO and A2C have in Stable-Baselines3.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pharos.errors import ParameterError

FEATURES = (128, 128)
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
    """Convolutions, hidden layers and a linear output; see the top of the file for names.

    Attributes:
        name: as `Network.of` reads it.
        convolutions: with ReLUs; their output is flattened. None of them: observations are flattened.
        hidden: units of each hidden layer.
        tanh: whether hidden layers after the first have hyperbolic tangents; the first always has ReLUs.
        initialisation: "pytorch", its default: weights and biases uniform in +-1 / sqrt(fan-in), so of variance
            1 / (3 fan-in); that is what DQN has. "sb3", of actor-critics in Stable-Baselines3: orthogonal weights with
            gain sqrt(2), of the output 1 (that of the value; policies have 0.01), biases 0.
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
        return Network(network, convolutions, layers or FEATURES, bool(match["tanh"]), initialisation)

    def weight_variances(self, inputs: int, outputs: int, *, is_output: bool = False) -> tuple[float, float]:
        """(of a weight, of a bias) of a layer from `inputs` numbers to `outputs` units."""
        if self.initialisation == "pytorch":
            return 1 / (3 * inputs), 1 / (3 * inputs)
        gain = 1.0 if is_output else 2.0
        return gain / max(inputs, outputs), 0.0


def default_network(space: Any) -> str:
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
    """`128x2-64` -> (128, 128, 64); None where it is not of that form."""
    layers: list[int] = []
    for part in text.split("-") if text else ():
        match = re.fullmatch(r"([1-9]\d*)(?:x([1-9]\d?))?", part)
        if match is None:
            return None
        layers += [int(match[1])] * int(match[2] or 1)
    return tuple(layers)
