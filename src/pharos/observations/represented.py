"""An observation and a network as measures of hardness take them.

Tangent kernels of any network of PyTorch, as a mean over random networks: where no closed form is known.
"""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.errors import MissingExtra, ParameterError, PharosError
from pharos.hardness import Representation
from pharos.mdp import whole_number
from pharos.observations.networks import Network, check_memory, default_network, network_inputs, tangent_kernel
from pharos.observations.observation import observe
from pharos.observations.observation_aliasing import observation_classes
from pharos.system import sources

if TYPE_CHECKING:
    import torch

    from pharos.state_space import StateSpace

NETWORKS = 20  # random ones, where there is no closed form
SAMPLE = 4096  # states whose observations the digest is of


def representation(
    space: "StateSpace",
    observation: object = "vector",
    network: Network | str | Callable[[tuple[int, ...]], Any] | None = None,
    *,
    initialisation: str = "pytorch",
    landmarks: int | None = None,
    **options: object,
) -> Representation:
    """Return the representation of a state space by an observation and a network, for `pharos.hardness.report`.

        hardness.report(space.mdp(), representation=observations.representation(space, "vector", "mlp128x2"))

    Args:
        observation, options: as for `observe`.
        network, initialisation: as for `ntk`. Or a network of one's own, a function of the shape of an input that
            returns a torch.nn.Module, or its name, "file.py:function" or "module:function": its kernel is the mean over
            20 random ones, see `empirical_ntk`; initialisation is the function's.
        landmarks: of the approximation of the kernel, at least 2; None: where there are more than 4,096 different
            observations; 0: never.
    Raises:
        ParameterError: the environment's class is not known, the network has no closed form or does not fit the
            observation, the observation has no space that networks take, or landmarks is no number of them.
    Cost: one observation of each state now; the kernel when a measure asks for it.
    """
    if space.environment is None:
        raise ParameterError(f"{space}: the class of its environment is not known, so nothing is seen of its states")
    if landmarks is not None:
        landmarks = whole_number(landmarks, "landmarks", "a whole number, 0 for none, or None", least=0)
    observer = observe(space.environment, observation, state_space=space, **options)
    first = network_inputs(observer, space.states(slice(0, 1)))
    if callable(network) or sources.is_reference(network):
        tangent, named = _own_network(network, first.shape[1:])
    else:
        net = Network.of(default_network(observer.space) if network is None else network, initialisation)
        tangent, named = partial(tangent_kernel, net), {"network": net.name, "initialisation": net.initialisation}
        if net.tanh and net.initialisation == "sb3":
            named["kernel"] = 2  # results that were kept of zeros without a slope are not taken
    tangent(first, None)  # what does not fit is said before all states are looked at

    def inputs(states: np.ndarray) -> np.ndarray:
        return network_inputs(observer, space.states(states))

    def kernel(rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        check_memory(len(rows), len(columns), str(space.environment))
        same = rows is columns
        return tangent(inputs(rows), None if same else inputs(columns))

    return Representation(
        kernel=kernel,
        classes=observation_classes(space, observer),
        time_limit=int(space.environment.max_episode_steps),
        landmarks=landmarks,
        conventions={
            "observation": observer.name,
            "options": {
                name: value if isinstance(value, str | int | float) else str(value) for name, value in options.items()
            },
            **named,
            "landmarks": landmarks,
            "digest": _digest(inputs, space.num_states),
        },
    )


def _own_network(network: object, shape: tuple[int, ...]) -> tuple[Callable[..., np.ndarray], dict[str, Any]]:
    """(kernel of inputs x, y; its description), of a function of the shape or of its name."""
    source = sources.find(network) if isinstance(network, str) else sources.source_of(network)
    function = sources.load(source) if isinstance(network, str) and source is not None else network
    name = source.name if source is not None else str(getattr(network, "__name__", network))
    if function is None:
        raise ParameterError(f"network {name!r}: there is no such name in the file")
    if not callable(function):
        raise ParameterError(f"network {name!r}: found {function!r}; expected a function of the shape of an input")

    def kernel(x: np.ndarray, y: np.ndarray | None = None) -> np.ndarray:
        try:
            return empirical_ntk(partial(function, shape), x, others=y, networks=NETWORKS)
        except MissingExtra:
            raise
        except Exception as error:
            kind = "" if isinstance(error, PharosError) else f"{type(error).__name__}: "
            words = kind + " ".join(str(error).split())
            raise ParameterError(f"network {name!r} on inputs of shape {shape}: {words}") from error

    checksum = None if source is None else source.checksum
    return kernel, {"network": name, "initialisation": "its own", "networks": NETWORKS, "code": checksum}


def _digest(inputs: Callable[[np.ndarray], np.ndarray], num_states: int) -> str:
    """Digest of the network's input in up to SAMPLE states all over the space."""
    import xxhash

    states = np.unique(np.linspace(0, num_states - 1, min(SAMPLE, num_states)).astype(np.int64))
    return xxhash.xxh3_128_hexdigest(np.ascontiguousarray(inputs(states)).data)


# Empirical ------------------------------------------------------------------------------------------------------------


def empirical_ntk(
    make: Callable[[], Any], x: np.ndarray, *, others: np.ndarray | None = None, networks: int = 100, seed: int = 0
) -> np.ndarray:
    """Return the mean over random networks of the inner products of gradients of the first output.

    Args:
        make: () -> a torch.nn.Module from inputs (N, ...) to outputs (N, A), with parameters drawn anew.
        x: (N, ...) inputs, see `network_inputs`.
        others: (M, ...) inputs y; None: x.
        networks: how many; the standard error falls with the square root.
        seed: of PyTorch's random numbers, which are left as they were.
    Returns:
        (N, M) float32; symmetric where `others` is None.
    Raises:
        MissingExtra: PyTorch is not installed. ParameterError: no network, or none was asked for; its outputs are not
            (N, A), or its gradients are not finite.
    Cost: `networks` times N + M gradients, which lie in memory one network at a time.
    Source: Jacot, Gabriel and Hongler (2018).
    """
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
            rows = _gradients(network, inputs)
            facing = rows if columns is None else _gradients(network, columns)
            total += (rows @ facing.T).double().numpy()
    if not np.isfinite(total).all():
        raise ParameterError("gradients of the network are not finite; expected finite parameters and inputs")
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
