"""MDPs from elsewhere, and folders that keep them: files of BRIDGE, tables of Gymnasium, matrices, MiniGrid, Storm.

Nothing here unpickles: files hold plain arrays and JSON, or are refused.
"""

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
from pharos.importers.models import Question, storm, storm_import, storm_recording

__all__ = [
    "Question",
    "bridge",
    "bridge_screens",
    "environment",
    "gymnasium",
    "gymnasium_outcomes",
    "load",
    "matrices",
    "minigrid",
    "minigrid_grids",
    "save",
    "storm",
    "storm_import",
    "storm_recording",
]
