"""Compiled loops: flat arrays in, flat arrays out, nothing else.

The package announces its files; each is loaded where it is used, and loads Numba.
"""

from pharos.kernels import packed_indices
from pharos.system import compiling

__all__ = [
    "batched_learning",
    "batched_rollouts",
    "batched_worlds",
    "bellman",
    "clocks",
    "components",
    "dense_search",
    "disk_table",
    "distance_sweeps",
    "elimination",
    "gaps",
    "graph",
    "hash_table",
    "hitting",
    "horizon",
    "key_owner",
    "krylov",
    "landmarks",
    "learning",
    "many_searches",
    "observation_kernels",
    "occupancy",
    "outcomes",
    "packed_indices",
    "packing",
    "palettes",
    "partition",
    "paths",
    "philox",
    "refinement",
    "replacement",
    "stepping",
    "symmetric",
    "symmetry",
    "tails",
    "tangent",
    "ties",
    "travel",
    "vicinity",
]

compiling.listen()
