"""MDPs for other programs: BRIDGE's npz, Gymnasium's `P` table, Storm's explicit DRN format."""

from pharos.exporters.drn import bridge, drn, gym_p

__all__ = [
    "bridge",
    "drn",
    "gym_p",
]
