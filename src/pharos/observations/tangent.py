"""Observations of states as networks take them, and their tangent kernels: doors to `hardness.representation`."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.environments import Environment, make
from pharos.errors import ParameterError
from pharos.hardness import (
    ModuleKernel,
    Network,
    OutputLayer,
    Representation,
    check_memory,
    default_network,
    is_channels_last,
    kernel_of_module,
    tangent_kernel,
)
from pharos.mdp import whole_number
from pharos.observations.classes import observation_classes
from pharos.observations.observation import Observation, observe
from pharos.system import sources

if TYPE_CHECKING:
    from pharos.state_space import StateSpace

DIGEST_STATES = 4096  # states whose observations the digest is of
EVENNESS_STATES = 64  # of different observations, over which the evenness of gradients is measured


def network_inputs(observation: Observation, states: np.ndarray) -> np.ndarray:
    """(N, ...) float32 input of the first layer of a network for states (N, D), as Stable-Baselines3 prepares it.

    Pictures of bytes are (C, H, W) in [0, 1]. Numbers of categories become ones among zeros.

    Raises:
        ParameterError: the space of the observation is none that networks take.
    """
    from gymnasium import spaces

    space, values = observation.space, np.asarray(observation(states))
    if isinstance(space, spaces.Discrete):
        return (values[:, None] - int(space.start) == np.arange(int(space.n))).astype(np.float32)
    if isinstance(space, spaces.MultiDiscrete):
        columns = (values[:, i, None] == np.arange(n) for i, n in enumerate(space.nvec))
        return np.concatenate([column.astype(np.float32) for column in columns], axis=1)
    if isinstance(space, spaces.MultiBinary):
        return values.astype(np.float32)
    if not isinstance(space, spaces.Box):
        raise ParameterError(
            f"observation {observation.name!r}: its space is {space!r}; expected a Box, Discrete, MultiDiscrete or "
            "MultiBinary of Gymnasium"
        )
    if values.ndim == 4 and values.dtype == np.uint8:
        values = values.transpose(0, 3, 1, 2) if is_channels_last(values.shape[1:]) else values
        return values.astype(np.float32) / np.float32(255)
    return values.astype(np.float32)


def ntk(
    env: "Environment | StateSpace | str",
    observation: object = "vector",
    network: "Network | str | None" = None,
    *,
    initialisation: str = "pytorch",
    states: Sequence[Sequence[int]] | np.ndarray | None = None,
    others: Sequence[Sequence[int]] | np.ndarray | None = None,
    **options: object,
) -> np.ndarray:
    """Return the tangent kernel of an agent's network on observations of an environment's states.

    Args:
        env: an environment, its name, or its state space.
        observation: as for `observe`. `options` are its options.
        network: a name such as "mlp128x2" or "cnn16", see `Network`. Default: the network of the agents of pharos.
        initialisation: "pytorch" (DQN) or "sb3" (actor-critics), see `Network`.
        states: (N, D) states. Default: all reachable ones, in the order of the state space.
        others: (M, D) states y. Default: the same as `states`.
    Returns:
        (N, M) float32, symmetric if `others` is None. Sums are float64.
    Raises:
        ParameterError: the network has no closed form, does not fit the observation, or the kernel does not fit into
            memory. UnknownName: no such environment or observation.
    Cost: O(N M) times inputs, 4 bytes a pair. 1,500 states: 0.1 s with mlp128x2, 0.5 s with cnn16 on 8 x 8 cells.
    Source: Jacot et al. (2018); Cho and Saul (2009) for ReLUs; Arora et al. (2019) for convolutions.
    """
    from pharos.state_space import StateSpace

    space = env if isinstance(env, StateSpace) else None
    world = space.environment if space is not None else make(env) if isinstance(env, str) else env
    if world is None:
        raise ParameterError(f"{env}: the class of its environment is not known; give the environment")
    if space is None and (states is None or observation == "index"):
        from pharos.state_space import build

        space = build(world)  # type: ignore[arg-type]
    observer = observe(world, observation, state_space=space, **options)  # type: ignore[arg-type]
    net = Network.of(default_network(observer.space) if network is None else network, initialisation)
    if states is None:
        assert space is not None
        check_memory(space.num_states, space.num_states if others is None else len(others), str(world))
        states = space.states()
    x = network_inputs(observer, np.asarray(states, np.int64))
    y = None if others is None else network_inputs(observer, np.asarray(others, np.int64))
    return tangent_kernel(net, x, y)


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
            20 random ones, see `empirical_ntk`. So is its output layer, if its outputs are a torch.nn.Linear's.
            Initialisation is the function's.
        landmarks: of the approximation of the kernel, at least 2. Default: if there are more than 4,096 different
            observations. 0: never.
    Raises:
        ParameterError: the environment's class is not known, the network has no closed form or does not fit the
            observation, the observation has no space that networks take, or landmarks is no number of them.
    Cost: one observation of each state now, the kernel when a measure asks for it. For a network of one's own, also
        gradients of 20 networks at up to 64 different observations now, as for their kernel.
    """
    if space.environment is None:
        raise ParameterError(f"{space}: the class of its environment is not known, so nothing is seen of its states")
    if landmarks is not None:
        landmarks = whole_number(landmarks, "landmarks", "a whole number, 0 for none, or None", least=0)
    observer = observe(space.environment, observation, state_space=space, **options)
    first = network_inputs(observer, space.states(slice(0, 1)))
    of_module: ModuleKernel | None = None
    layers: OutputLayer | None = None
    tangent: Callable[..., np.ndarray]
    if callable(network) or sources.is_reference(network):
        of_module, named = kernel_of_module(network, first.shape[1:])
        tangent = of_module
    else:
        net = Network.of(default_network(observer.space) if network is None else network, initialisation)
        tangent, named = partial(tangent_kernel, net), {"network": net.name, "initialisation": net.initialisation}
        if net.tanh and net.initialisation == "sb3":
            named["kernel"] = 2  # results that were kept of zeros without a slope are not taken
        layers = _output_layer(net, first.shape[1:])
    tangent(first, None)  # what does not fit is said before all states are looked at

    def inputs(states: np.ndarray) -> np.ndarray:
        return network_inputs(observer, space.states(states))

    def pairs(function: Callable[..., np.ndarray], rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        check_memory(len(rows), len(columns), str(space.environment))
        same = rows is columns
        return function(inputs(rows), None if same else inputs(columns))

    classes = observation_classes(space, observer)
    if of_module is not None:
        different = np.sort(np.unique(classes, return_index=True)[1])
        layers = of_module.output_layer(inputs(different[:EVENNESS_STATES]))
    return Representation(
        kernel=partial(pairs, tangent),
        classes=classes,
        time_limit=int(space.environment.max_episode_steps),
        landmarks=landmarks,
        conventions={
            "observation": observer.name,
            "options": {
                name: value if isinstance(value, str | int | float) else str(value) for name, value in options.items()
            },
            **named,
            "landmarks": landmarks,
            "digest": _inputs_digest(inputs, space.num_states),
        },
        covariance=partial(pairs, partial(tangent, of_outputs=True)),
        output_layer=None if layers is None else replace(layers, kernel=partial(pairs, layers.kernel)),
    )


def _output_layer(network: Network, shape: Sequence[int]) -> OutputLayer:
    """The output layer of a network, whose kernel takes inputs: of the covariance v h(x) . h(y) + b of its outputs."""
    units = network.hidden[-1]
    weight, bias = network.weight_variances(units, 1, is_output=True)

    def kernel(x: np.ndarray, y: np.ndarray | None = None) -> np.ndarray:
        return (tangent_kernel(network, x, y, of_outputs=True) - np.float32(bias)) / np.float32(weight) + 1

    largest = units + 1.0 if network.tanh and len(network.hidden) > 1 else math.inf
    return OutputLayer(kernel, units * weight, network.parameters(shape), network.evenness, largest, bias=bias / weight)


def _inputs_digest(inputs: Callable[[np.ndarray], np.ndarray], num_states: int) -> str:
    """Digest of the network's input in up to DIGEST_STATES states all over the space."""
    import xxhash

    states = np.unique(np.linspace(0, num_states - 1, min(DIGEST_STATES, num_states)).astype(np.int64))
    return xxhash.xxh3_128_hexdigest(np.ascontiguousarray(inputs(states)).data)
