"""Compiled loops: flat arrays in, flat arrays out, nothing else.

The package announces its files. Each is loaded when it is first used, and loads Numba.
"""

from pharos.system import compiling

compiling.prepare()

from pharos.kernels import outcomes  # noqa: E402  (it loads Numba)

_shared = """
    actor_critic batched bellman elimination end_components gaps graph hash_table hitting horizon idealised_network
    kernel_cache linear_algebra many_searches observation_kernels occupancy outcomes partition patches stepping
"""
