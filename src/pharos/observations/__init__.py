"""What an agent sees: pure functions of the state with a Gymnasium space, chosen at the moment of interaction.

`observe(env, "vector")` gives one; calling it with states (N, D) gives N observations. Nothing is stored with the
states. Pictures (rendered.py) are loaded when they are first asked for.
"""

import importlib
from typing import TYPE_CHECKING, Any

from pharos.observations.blocks import in_blocks
from pharos.observations.complex_image import ComplexImage
from pharos.observations.context import NO_ACTION, ObservationInContext
from pharos.observations.observation import FunctionObservation, Observation, add_built_in, names, observe, register
from pharos.observations.own import OwnObservation, imported, observation_of, own_observation
from pharos.observations.simple_image import SimpleImage
from pharos.observations.vector import Index, OneHot, Vector

if TYPE_CHECKING:
    from pharos.observations.rendered import RENDERERS, render, renderers

add_built_in("vector", Vector)
add_built_in("simple_image", SimpleImage)
add_built_in("complex_image", ComplexImage)
add_built_in("one_hot", OneHot)
add_built_in("index", Index)

__all__ = [
    "NO_ACTION",
    "RENDERERS",
    "ComplexImage",
    "FunctionObservation",
    "Index",
    "Observation",
    "ObservationInContext",
    "OneHot",
    "OwnObservation",
    "SimpleImage",
    "Vector",
    "imported",
    "in_blocks",
    "names",
    "observation_of",
    "observe",
    "own_observation",
    "register",
    "render",
    "renderers",
]


def __getattr__(name: str) -> Any:
    if name not in ("RENDERERS", "render", "renderers"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module("pharos.observations.rendered"), name)
