"""Property tests draw the same examples in every run, so that a failure is a change; `HYPOTHESIS_PROFILE=explore` draws
others. None fails because the machine is busy: examples and what draws them may take any time. `patience.py` has the
limit of all other waiting.

Threads that wait give the processor back: `make test` runs as many processes as there are cores, and threads that spin
take from them.

What is there once tests are collected, a million objects, stays to the end. It is frozen, so that garbage is sought in
what came after it: a tenth of the processor went into seeking it in all.
"""

import fcntl
import gc
import math
import os
import sysconfig
import tempfile
import zlib
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# before NumPy and Numba are imported
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from pharos.cli import answers
from pharos.system import compiling

compiling.announces = False  # else what a test finds on standard error depends on what was compiled before
answers.SLOW_AFTER = math.inf  # or on how busy the machine is

for name, derandomize in (("fixed", True), ("explore", False)):
    settings.register_profile(
        name, derandomize=derandomize, deadline=None, suppress_health_check=[HealthCheck.too_slow]
    )
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "fixed"))


HERE, ROOT = Path(__file__).parent, Path(__file__).parents[1]

INTERPRETED_BELOW = compiling.SMALL_STATES
INTERPRETED = {"agents", "benchmark", "interaction", "training"}
"""Folders whose worlds are interpreted where a user's would be, as their tests are of what comes after. Elsewhere the
small worlds of tests are of compiled code."""


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    compiling.SMALL_STATES = INTERPRETED_BELOW if item.path.relative_to(HERE).parts[0] in INTERPRETED else 0


gc.disable()


def pytest_collection_finish():
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)
    gc.enable()


@pytest.fixture
def packed_runs():
    """Folder of packed studies whose runs are there: a source distribution leaves 26 MB of them out."""
    studies = ROOT / "docs" / "studies"
    if (ROOT / "PKG-INFO").exists() and not (studies / "paper" / "runs.parquet").exists():
        pytest.skip("the packed runs of docs/studies are in the repository, and not in a source distribution")
    return studies


@pytest.fixture(scope="session")
def quantecon():
    """The package quantecon, imported by one process at a time.

    Its import compiles two ufuncs into Numba's cache beside it. Two processes that do so at once leave files that do
    not fit together, and every import after that ends the process ("LLVM ERROR: Symbol not found: __gufunc__").
    """
    installed = sysconfig.get_path("purelib").encode()
    with (Path(tempfile.gettempdir()) / f"quantecon-{os.getuid()}-{zlib.crc32(installed):08x}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        import quantecon

        return quantecon
