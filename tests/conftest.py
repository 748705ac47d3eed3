"""Property tests draw the same examples in every run, so that a failure is a change; `HYPOTHESIS_PROFILE=explore` draws
others.

Threads that wait give the processor back: `make test` runs as many processes as there are cores, and threads that spin
take from them.
"""

import os

from hypothesis import settings

# before NumPy and Numba are imported
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

settings.register_profile("fixed", derandomize=True)
settings.register_profile("explore", derandomize=False)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "fixed"))
