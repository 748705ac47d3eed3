"""Observations: pure functions of the state with a Gymnasium space, chosen when an agent interacts.

`observe(env, "vector")` gives one. Calling it with states (N, D) gives N observations. Nothing is stored with the
states. Images are loaded when they are first asked for.
"""

from typing import TYPE_CHECKING

from pharos.observations.context import NO_ACTION, ObservationInContext, Seen
from pharos.observations.observation import (
    FunctionObservation,
    Observation,
    check_options,
    names,
    observe,
    register,
    registered,
    title,
)
from pharos.observations.vector import Index, OneHot, Vector
from pharos.system import lazy

if TYPE_CHECKING:
    from pharos.hardness import Network, empirical_ntk, memoryless_loss
    from pharos.observations.classes import aliasing, history_aliasing, observation_classes
    from pharos.observations.images import RENDERERS, ComplexImage, SimpleImage, num_values, render, renderers
    from pharos.observations.observation import OwnObservation, imported, observation_of, own_observation
    from pharos.observations.tangent import network_inputs, ntk, representation
    from pharos.observations.vector import Hash

__all__ = [
    "Network",
    "Observation",
    "aliasing",
    "empirical_ntk",
    "memoryless_loss",
    "ntk",
    "observation_classes",
    "observe",
    "register",
    "representation",
]

__getattr__ = lazy.attributes(__name__)
