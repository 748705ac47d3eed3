"""What an agent sees: pure functions of the state with a Gymnasium space, chosen at the moment of interaction.

`observe(env, "vector")` gives one; calling it with states (N, D) gives N observations. Nothing is stored with the
states. Images are loaded when they are first asked for.
"""

from typing import TYPE_CHECKING

from pharos import lazy
from pharos.observations.blocks import in_blocks
from pharos.observations.context import NO_ACTION, ObservationInContext
from pharos.observations.observation import FunctionObservation, Observation, names, observe, register, title
from pharos.observations.vector import Index, OneHot, Vector

if TYPE_CHECKING:
    from pharos.observations.complex_image import ComplexImage
    from pharos.observations.empirical import empirical_ntk
    from pharos.observations.hash import Hash
    from pharos.observations.look_alikes import Aliasing, aliasing, counted, history_aliasing, observation_classes
    from pharos.observations.memoryless import MemorylessLoss, memoryless_loss
    from pharos.observations.networks import Network, default_network
    from pharos.observations.own import OwnObservation, imported, observation_of, own_observation
    from pharos.observations.rendered import RENDERERS, render, renderers
    from pharos.observations.represented import representation
    from pharos.observations.simple_image import SimpleImage
    from pharos.observations.tangent_kernels import network_inputs, ntk, tangent_kernel

_FILES = {
    "Aliasing": "look_alikes",
    "ComplexImage": "complex_image",
    "Hash": "hash",
    "MemorylessLoss": "memoryless",
    "Network": "networks",
    "OwnObservation": "own",
    "RENDERERS": "rendered",
    "SimpleImage": "simple_image",
    "aliasing": "look_alikes",
    "counted": "look_alikes",
    "default_network": "networks",
    "empirical_ntk": "empirical",
    "history_aliasing": "look_alikes",
    "imported": "own",
    "memoryless_loss": "memoryless",
    "network_inputs": "tangent_kernels",
    "ntk": "tangent_kernels",
    "observation_classes": "look_alikes",
    "observation_of": "own",
    "own_observation": "own",
    "render": "rendered",
    "renderers": "rendered",
    "representation": "represented",
    "tangent_kernel": "tangent_kernels",
}

__all__ = [
    "NO_ACTION",
    "RENDERERS",
    "Aliasing",
    "ComplexImage",
    "FunctionObservation",
    "Hash",
    "Index",
    "MemorylessLoss",
    "Network",
    "Observation",
    "ObservationInContext",
    "OneHot",
    "OwnObservation",
    "SimpleImage",
    "Vector",
    "aliasing",
    "counted",
    "default_network",
    "empirical_ntk",
    "history_aliasing",
    "imported",
    "in_blocks",
    "memoryless_loss",
    "names",
    "network_inputs",
    "ntk",
    "observation_classes",
    "observation_of",
    "observe",
    "own_observation",
    "register",
    "render",
    "renderers",
    "representation",
    "tangent_kernel",
    "title",
]

__getattr__ = lazy.attributes(__name__, _FILES)
