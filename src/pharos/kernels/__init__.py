"""Compiled loops: flat arrays in, flat arrays out, nothing else.

The package announces its files; each is loaded where it is used, and loads Numba.
"""

from pathlib import Path

from pharos.system import compiling

compiling.prepare(Path(__file__).parent)

from pharos.kernels import packed_indices  # noqa: E402  (it loads Numba, which reads where to keep compiled code)

_shared = """
    batched_learning batched_rollouts batched_worlds bellman clocks components dense_search disk_table gaps graph
    hash_table hitting horizon krylov landmarks learning many_searches observation_kernels occupancy outcomes
    packed_indices packing palettes partition paths philox refinement sampled_learning stepping symmetry tails
    tangent travel vicinity
"""
