"""Tangent kernels of any network of PyTorch, as a mean over random networks: if no closed form is known."""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.errors import MissingExtra, ParameterError, PharosError
from pharos.system import sources

if TYPE_CHECKING:
    import torch

NETWORKS = 20  # random ones, if there is no closed form


def kernel_of_module(network: object, shape: tuple[int, ...]) -> tuple[Callable[..., np.ndarray], dict[str, Any]]:
    """Return (kernel of inputs x and y, its description) of a function of a shape that makes networks, or of its
    name. With `of_outputs` the kernel is the covariance of an output of the random networks."""
    source = sources.find_source(network) if isinstance(network, str) else sources.source_of(network)
    function = sources.load_source(source) if isinstance(network, str) and source is not None else network
    name = source.name if source is not None else str(getattr(network, "__name__", network))
    if function is None:
        raise ParameterError(f"network {name!r}: there is no such name in the file")
    if not callable(function):
        raise ParameterError(f"network {name!r}: found {function!r}; expected a function of the shape of an input")

    def kernel(x: np.ndarray, y: np.ndarray | None = None, *, of_outputs: bool = False) -> np.ndarray:
        features = _outputs if of_outputs else _gradients
        try:
            return _mean_products(features, partial(function, shape), x, y, NETWORKS)
        except MissingExtra:
            raise
        except Exception as error:
            kind = "" if isinstance(error, PharosError) else f"{type(error).__name__}: "
            words = kind + " ".join(str(error).split())
            raise ParameterError(f"network {name!r} on inputs of shape {shape}: {words}") from error

    checksum = None if source is None else source.checksum
    return kernel, {"network": name, "initialisation": "its own", "networks": NETWORKS, "code": checksum}


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
    try:
        import torch
    except ImportError as error:
        raise MissingExtra("an empirical kernel", "torch", "agents") from error
    if networks < 1:
        raise ParameterError(f"networks is {networks!r}; expected at least 1")
    inputs = torch.as_tensor(np.asarray(x, np.float32))
    columns = None if others is None else torch.as_tensor(np.asarray(others, np.float32))
    total = np.zeros((len(x), len(x if others is None else others)))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        for _ in range(networks):
            network = make()
            if not isinstance(network, torch.nn.Module):
                raise ParameterError(f"make returned {network!r}; expected a torch.nn.Module")
            rows = features(network, inputs)
            facing = rows if columns is None else features(network, columns)
            total += (rows @ facing.T).double().numpy()
    if not np.isfinite(total).all():
        what = "outputs" if features is _outputs else "gradients"
        raise ParameterError(f"{what} of the network are not finite; expected finite parameters and inputs")
    if others is None:
        total = (total + total.T) / 2  # products of one matrix with its own transpose may differ in the last bits
    return (total / networks).astype(np.float32)


def _gradients(network: "torch.nn.Module", inputs: "torch.Tensor") -> "torch.Tensor":
    """(N, P): of the first output by all parameters."""
    import torch

    parameters = {name: value.detach() for name, value in network.named_parameters()}

    def output(values: dict[str, torch.Tensor], one: torch.Tensor) -> torch.Tensor:
        outputs = torch.func.functional_call(network, values, (one[None],))
        if outputs.ndim != 2:
            raise ParameterError(f"outputs of one input have shape {tuple(outputs.shape)}; expected (1, A)")
        return outputs[0, 0]

    gradients = torch.func.vmap(torch.func.grad(output), in_dims=(None, 0))(parameters, inputs)
    return torch.cat([each.flatten(1) for each in gradients.values()], dim=1)


def _outputs(network: "torch.nn.Module", inputs: "torch.Tensor") -> "torch.Tensor":
    """(N, A): the outputs, so scaled that products are means over outputs."""
    import torch

    with torch.no_grad():
        outputs = network(inputs)
    return outputs / outputs.shape[1] ** 0.5
