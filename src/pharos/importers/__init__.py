"""MDPs from elsewhere: BRIDGE's files, any `P` table of Gymnasium, transition matrices; and folders that keep them.

Nothing here unpickles: files hold plain arrays and JSON, or are refused.
"""

from pharos.importers._bridge import bridge, bridge_screens
from pharos.importers._folder import load, save
from pharos.importers._gymnasium import gymnasium, matrices

__all__ = ["bridge", "bridge_screens", "gymnasium", "load", "matrices", "save"]
