"""MDPs from elsewhere, and folders that keep them: files of BRIDGE, tables of Gymnasium, matrices, MiniGrid, Storm.

Nothing here unpickles: files hold plain arrays and JSON, or are refused.
"""

from pharos.importers.bridge import bridge, bridge_screens, has_screens
from pharos.importers.folder import Outcomes, environment, is_folder, load, save
from pharos.importers.gymnasium import gymnasium, gymnasium_outcomes, matrices
from pharos.importers.minigrid import minigrid, minigrid_grids, minigrid_recording
from pharos.importers.storm import storm, storm_recording

__all__ = [
    "Outcomes",
    "bridge",
    "bridge_screens",
    "environment",
    "gymnasium",
    "gymnasium_outcomes",
    "has_screens",
    "is_folder",
    "load",
    "matrices",
    "minigrid",
    "minigrid_grids",
    "minigrid_recording",
    "save",
    "storm",
    "storm_recording",
]
