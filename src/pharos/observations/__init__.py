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
    from pharos.observations.look_alikes import Aliasing, aliasing, counted, observation_classes
    from pharos.observations.memoryless import MemorylessLoss, memoryless_loss
    from pharos.observations.own import OwnObservation, imported, observation_of, own_observation
    from pharos.observations.rendered import RENDERERS, render, renderers
    from pharos.observations.simple_image import SimpleImage

_FILES = {
    "Aliasing": "look_alikes",
    "ComplexImage": "complex_image",
    "MemorylessLoss": "memoryless",
    "OwnObservation": "own",
    "RENDERERS": "rendered",
    "SimpleImage": "simple_image",
    "aliasing": "look_alikes",
    "counted": "look_alikes",
    "imported": "own",
    "memoryless_loss": "memoryless",
    "observation_classes": "look_alikes",
    "observation_of": "own",
    "own_observation": "own",
    "render": "rendered",
    "renderers": "rendered",
}

__all__ = [
    "NO_ACTION",
    "RENDERERS",
    "Aliasing",
    "ComplexImage",
    "FunctionObservation",
    "Index",
    "MemorylessLoss",
    "Observation",
    "ObservationInContext",
    "OneHot",
    "OwnObservation",
    "SimpleImage",
    "Vector",
    "aliasing",
    "counted",
    "imported",
    "in_blocks",
    "memoryless_loss",
    "names",
    "observation_classes",
    "observation_of",
    "observe",
    "own_observation",
    "register",
    "render",
    "renderers",
    "title",
]

__getattr__ = lazy.attributes(__name__, _FILES)
