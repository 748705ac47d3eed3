"""MDPs from elsewhere, and folders that keep them: files of BRIDGE, tables of Gymnasium, matrices, MiniGrid, Storm,
games of Atari and Procgen.

Nothing here unpickles: files hold plain arrays and JSON, or are refused.
"""

from pharos.importers.consoles import Recording, atari, building_folder, procgen, save_recording
from pharos.importers.files import bridge, bridge_screens, has_screens, how_to_import
from pharos.importers.folder import environment, is_folder, load, save
from pharos.importers.gymnasium import (
    gymnasium,
    gymnasium_outcomes,
    matrices,
    minigrid,
    minigrid_grids,
    minigrid_recording,
)
from pharos.importers.jax_stepping import JaxFunctions, jax_stepping
from pharos.importers.models import Question, storm, storm_import, storm_recording
from pharos.importers.one_player import OnePlayer
from pharos.importers.search import SteppedStates
from pharos.importers.step_target import StepTarget
from pharos.importers.stepping import StepRecording, stepping

__all__ = [
    "JaxFunctions",
    "OnePlayer",
    "Question",
    "Recording",
    "atari",
    "bridge",
    "bridge_screens",
    "environment",
    "gymnasium",
    "gymnasium_outcomes",
    "jax_stepping",
    "load",
    "matrices",
    "minigrid",
    "minigrid_grids",
    "procgen",
    "save",
    "save_recording",
    "stepping",
    "storm",
    "storm_import",
    "storm_recording",
]
