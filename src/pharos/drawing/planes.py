"""Planes: what an environment says is where, one plane of cells for each layer."""

from collections.abc import Sequence

import numpy as np

from pharos.environments import Environment
from pharos.errors import ParameterError


def planes_of(env: Environment, state: Sequence[int]) -> np.ndarray:
    """(L, rows, columns) uint8: for each layer, 0 where nothing is, 1, 2, ... where its things are.

    Raises:
        ParameterError: the class declares no `grid` or `draw`, or `state` is none of its states.
    """
    check_state(env, state)
    try:
        rows, columns = env.grid()
        planes = np.zeros((len(env.layers), rows, columns), np.uint8)
        env.draw(tuple(int(value) for value in state), planes)
    except NotImplementedError as error:
        raise ParameterError(f"{env}: cannot be drawn: {error}") from error
    return planes


def check_state(env: Environment, state: Sequence[int]) -> None:
    """ParameterError unless `state` has D components, each in its declared range."""
    components = env.components
    if len(state) != len(components):
        raise ParameterError(f"{env}: found a state with {len(state)} components; expected {len(components)}")
    for name, value, low, high in zip(components.names, state, components.low, components.high, strict=True):
        if not low <= value <= high:
            raise ParameterError(f"{env}: state has {name} = {value}; expected {low} to {high}")
