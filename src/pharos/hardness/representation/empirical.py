"""Tangent kernels of any network of PyTorch, as a mean over random networks: if no closed form is known."""

from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pharos.errors import MissingExtra, ParameterError, PharosError
from pharos.hardness.representation.learning import OutputLayer
from pharos.system import sources

if TYPE_CHECKING:
    import torch

NETWORKS = 20  # random ones, if there is no closed form
GRADIENT_BLOCK = 16  # inputs whose gradients lie in memory together, if only their squares are needed


def kernel_of_module(network: object, shape: tuple[int, ...]) -> "tuple[ModuleKernel, dict[str, Any]]":
    """Return (kernel of inputs x and y, its description) of a function of a shape that makes networks, or of its
    name."""
    source = sources.find_source(network) if isinstance(network, str) else sources.source_of(network)
    function = sources.load_source(source) if isinstance(network, str) and source is not None else network
    name = source.name if source is not None else str(getattr(network, "__name__", network))
    if function is None:
        raise ParameterError(f"network {name!r}: there is no such name in the file")
    if not callable(function):
        raise ParameterError(f"network {name!r}: found {function!r}; expected a function of the shape of an input")
    checksum = None if source is None else source.checksum
    description = {"network": name, "initialisation": "its own", "networks": NETWORKS, "code": checksum}
    return ModuleKernel(function, name, shape), description


class ModuleKernel:
    """Tangent kernel of inputs x (N, ...) and y (M, ...) of a function of their shape that makes networks."""

    def __init__(self, function: Callable[[tuple[int, ...]], object], name: str, shape: tuple[int, ...]):
        self.make, self.name, self.shape = partial(function, shape), name, shape

    def __call__(self, x: np.ndarray, y: np.ndarray | None = None, *, of_outputs: bool = False) -> np.ndarray:
        """(N, M) float32. of_outputs: the covariance of an output of the random networks instead."""
        return self._products(_outputs if of_outputs else _gradients, x, y)

    def output_layer(self, x: np.ndarray) -> OutputLayer | None:
        """The output layer, measured on the random networks of the kernel. None if no Linear gives the outputs.

        Args:
            x: (N, ...) different inputs, over which evenness is measured.
        Cost: their gradients, of NETWORKS networks.
        """
        groups: list[_Groups | None] = []
        with self._named_errors():
            inputs = _tensor(x)
            _visit_networks(self.make, lambda network: groups.append(_parameter_groups(network, inputs)), NETWORKS)
        first, *others = groups
        if first is None or None in others:
            return None
        numbers = [(each.weights, *each.evenness) for each in groups if each is not None]
        weights, of_output, of_beneath = np.mean(numbers, axis=0).tolist()
        kernel = partial(self._products, _output_gradients)
        return OutputLayer(kernel, weights, first.parameters, (of_output, of_beneath), has_bias=first.has_bias)

    def _products(
        self,
        features: "Callable[[torch.nn.Module, torch.Tensor], torch.Tensor]",
        x: np.ndarray,
        y: np.ndarray | None = None,
    ) -> np.ndarray:
        with self._named_errors():
            return _mean_products(features, self.make, x, y, NETWORKS)

    @contextmanager
    def _named_errors(self) -> Iterator[None]:
        """Name the network in errors of the user's code."""
        try:
            yield
        except MissingExtra:
            raise
        except Exception as error:
            kind = "" if isinstance(error, PharosError) else f"{type(error).__name__}: "
            words = kind + " ".join(str(error).split())
            raise ParameterError(f"network {self.name!r} on inputs of shape {self.shape}: {words}") from error


def empirical_ntk(
    make: Callable[[], Any], x: np.ndarray, *, others: np.ndarray | None = None, networks: int = 100, seed: int = 0
) -> np.ndarray:
    """Return the mean over random networks of the inner products of gradients of the first output.

    Args:
        make: () -> a torch.nn.Module from inputs (N, ...) to outputs (N, A), with parameters drawn anew.
        x: (N, ...) inputs, see `network_inputs`.
        others: (M, ...) inputs y. Default: x.
        networks: how many. The standard error falls with the square root.
        seed: of PyTorch's random numbers, which are left as they were.
    Returns:
        (N, M) float32, symmetric if `others` is None.
    Raises:
        MissingExtra: PyTorch is not installed. ParameterError: no network, none was asked for, its outputs are not (N,
        A), or its gradients are not finite.
    Cost: `networks` times N + M gradients, which lie in memory one network at a time.
    Source: Jacot, Gabriel and Hongler (2018).
    """
    return _mean_products(_gradients, make, x, others, networks, seed)


def _mean_products(
    features: Callable[["torch.nn.Module", "torch.Tensor"], "torch.Tensor"],
    make: Callable[[], Any],
    x: np.ndarray,
    others: np.ndarray | None,
    networks: int,
    seed: int = 0,
) -> np.ndarray:
    """The mean over random networks of the inner products of features of their inputs. See `empirical_ntk`."""
    total = np.zeros((len(x), len(x if others is None else others)))

    def add(network: "torch.nn.Module") -> None:
        rows = features(network, _tensor(x))
        facing = rows if others is None else features(network, _tensor(others))
        total[:] += (rows @ facing.T).double().numpy()

    _visit_networks(make, add, networks, seed)
    if not np.isfinite(total).all():
        raise not_finite("outputs" if features is _outputs else "gradients")
    if others is None:
        total = (total + total.T) / 2  # products of one matrix with its own transpose may differ in the last bits
    return (total / networks).astype(np.float32)


def _visit_networks(
    make: Callable[[], object], visit: "Callable[[torch.nn.Module], object]", networks: int, seed: int = 0
) -> None:
    """Call `visit` with each of the random networks of a seed."""
    try:
        import torch
    except ImportError as error:
        raise MissingExtra("an empirical kernel", "torch", "agents") from error
    if networks < 1:
        raise ParameterError(f"networks is {networks!r}; expected at least 1")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        for _ in range(networks):
            network = make()
            if not isinstance(network, torch.nn.Module):
                raise ParameterError(f"make returned {network!r}; expected a torch.nn.Module")
            visit(network)


def _tensor(x: np.ndarray) -> "torch.Tensor":
    import torch

    return torch.as_tensor(np.asarray(x, np.float32))


def not_finite(what: str) -> ParameterError:
    """The error for outputs or gradients that are not finite."""
    return ParameterError(f"{what} of the network are not finite; expected finite parameters and inputs")


def _gradients(network: "torch.nn.Module", inputs: "torch.Tensor") -> "torch.Tensor":
    """(N, P): of the first output by all parameters."""
    import torch

    names = [name for name, _ in network.named_parameters()]
    return torch.cat([each.flatten(1) for each in _named_gradients(network, inputs, names).values()], dim=1)


def _named_gradients(
    network: "torch.nn.Module", inputs: "torch.Tensor", names: Collection[str]
) -> "dict[str, torch.Tensor]":
    """(N, ...) of the first output by each of the parameters of some names."""
    import torch

    parameters = {name: value.detach() for name, value in network.named_parameters()}
    moved = {name: value for name, value in parameters.items() if name in names}

    def output(values: dict[str, torch.Tensor], one: torch.Tensor) -> torch.Tensor:
        outputs = torch.func.functional_call(network, {**parameters, **values}, (one[None],))
        if outputs.ndim != 2:
            raise ParameterError(f"outputs of one input have shape {tuple(outputs.shape)}; expected (1, A)")
        return outputs[0, 0]

    return torch.func.vmap(torch.func.grad(output), in_dims=(None, 0))(moved, inputs)


def _outputs(network: "torch.nn.Module", inputs: "torch.Tensor") -> "torch.Tensor":
    """(N, A): the outputs, so scaled that products are means over outputs."""
    import torch

    with torch.no_grad():
        outputs = network(inputs)
    return outputs / outputs.shape[1] ** 0.5


# The output layer -----------------------------------------------------------------------------------------------------


class _Groups(NamedTuple):
    """Numbers of one network's output layer and of the layers beneath, see `OutputLayer`."""

    weights: float
    parameters: tuple[int, int]
    has_bias: bool
    evenness: tuple[float, float]


def _parameter_groups(network: "torch.nn.Module", inputs: "torch.Tensor") -> _Groups | None:
    """The output layer and the layers beneath, by gradients at the inputs. None if no Linear gives the outputs."""
    import torch

    output = _output_parameters(network, inputs)
    if output is None:
        return None
    trained = {name: value for name, value in network.named_parameters() if value.requires_grad or name in output}
    squares = {name: torch.zeros_like(value, requires_grad=False) for name, value in trained.items()}
    for block in inputs.split(GRADIENT_BLOCK):
        for name, gradients in _named_gradients(network, block, trained).items():
            squares[name] += gradients.square().sum(dim=0)
    if not all(bool(torch.isfinite(each).all()) for each in squares.values()):
        raise not_finite("gradients")
    of_output = [squares[name][0].flatten() for name in output]
    beneath = [each.flatten() for name, each in squares.items() if name not in output]
    return _Groups(
        weights=float(trained[output[0]][0].detach().double().square().sum()),
        parameters=(sum(map(len, of_output)), sum(map(len, beneath))),
        has_bias=len(output) == 2,
        evenness=(_evenness(of_output), _evenness(beneath)),
    )


def _evenness(squares: "list[torch.Tensor]") -> float:
    """Mean of the roots as a share of the root of the mean. 0 if there is no gradient, so that nothing moves."""
    values = np.concatenate([np.zeros(0), *(each.double().numpy() for each in squares)])
    return float(np.sqrt(values).mean() / np.sqrt(values.mean())) if values.any() else 0.0


def _output_gradients(network: "torch.nn.Module", inputs: "torch.Tensor") -> "torch.Tensor":
    """(N, P): of the first output by its own weights and bias in the output layer, which the network has."""
    import torch

    names = _output_parameters(network, inputs)
    assert names is not None
    gradients = _named_gradients(network, inputs, names).values()
    return torch.cat([each[:, 0].reshape(len(inputs), -1) for each in gradients], dim=1)


def _output_parameters(network: "torch.nn.Module", inputs: "torch.Tensor") -> list[str] | None:
    """The names of the weight and, if there is one, the bias of the last Linear whose outputs are the network's.

    None if there is no such layer, as the outputs are computed from more than one, or are changed after it.
    """
    import torch

    layers = {name: module for name, module in network.named_modules() if isinstance(module, torch.nn.Linear)}
    results: dict[torch.nn.Module, list[torch.Tensor]] = {layer: [] for layer in layers.values()}
    hooks = [layer.register_forward_hook(lambda layer, _, result: results[layer].append(result)) for layer in results]
    with torch.no_grad():
        outputs = network(inputs[:1])
    for hook in hooks:
        hook.remove()
    parameters = [name for name, _ in network.named_parameters()]
    for prefix, layer in reversed(layers.items()):
        if len(results[layer]) == 1 and torch.equal(results[layer][0], outputs):  # of a layer that is used once
            weight, bias = (f"{prefix}.{name}".lstrip(".") for name in ("weight", "bias"))
            return [name for name in (weight, bias) if name in parameters] if weight in parameters else None
    return None
